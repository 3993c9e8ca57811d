"""Feeds spoilt text to everything that reads text from outside: `python -m tests.fuzz [COUNT] [SEED]`.

COUNT inputs each for requests to the daemon, expressions, comparisons, run files, machine files and
model files. Every input is a good one with a few changes by chance, from a seed. What may come of it: it is read, or it
is refused with an error of rtec. What may not: any other error, more than `LONGEST_S` for one input, a program or an
import started by it. Whatever does worse is printed whole.
"""

import json
import random
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

from rtec.control.desk import Desk, Peer
from rtec.control.residual import Residual
from rtec.effects.expression import Expression
from rtec.errors import ConfigError, RtecError
from rtec.loop.clock import RealClock, VirtualClock
from rtec.loop.orders import Order
from rtec.loop.run_file import NO_DEVICES, RunFile, Setup, load_setup
from rtec.machine import Machine, load_machine
from rtec.model import FittedEffect, Model, load_model, save_model
from rtec.tomlfile import read_toml, validated
from tests.support import setups
from tests.support.control_rig import FakeDaemon

LONGEST_S: Final = 20
COUNT: Final = 1_000_000
_DICTIONARY: Final = (
    *(b"", b"\0", b"\xff", b'"', b"'", b'"""', b"[", b"[[", b"]", b"{", b"}", b"=", b".", b",", b"#", b"\n", b"\\"),
    *(b"\\ud800", b"\\u0000", b"nan", b"-inf", b"1e999", b"-1", b"0", b"1e-320", b"true", b"null", b"1979-05-27"),
    *(b"9" * 30, b"9" * 5000, b"[" * 300, b"{" * 300, b"a." * 300, b"__class__", b"import os", b"${x}", b"../../etc"),
    *(
        b"**",
        b"9**9**9",
        b"sin(",
        b"lag(",
        b"(" * 100,
        b")",
        b"lambda:0",
        b"__import__('os').system('true')",
        b"x.real",
    ),
    *(b"\xe2\x80\xa8", b"\x1b[2J", b"schema", b"order", b"session", b"status", b"hold", b"effect", b"component"),
)
_OWN: Final[dict[str, Any]] = {
    "expression": "A * sin(2*pi*x/p) + B * cos(2*pi*x/p)",
    "linear": {"A": "um", "B": "um"},
    "free": {"p": {"start": 37.0, "low": 3.0, "high": 200.0, "unit": "mm"}},
}
_EXPRESSIONS: Final = (
    _OWN["expression"],
    "A * lag(T_bed, 900) * exp(-z / p) + B * max(abs(v_x), 1e-3) ** 0.5",
    "A * tanh(d_x * p) - B * (x - 3) ** 2 / sqrt(1 + min(time_s, p))",
)
_FORBIDDEN: Final = frozenset(("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "exec", "os.remove"))


class TooLong(BaseException):
    """Of one input; no error that any reader catches."""


@dataclass
class Found:
    """What came of the inputs of one kind.

    Attributes:
        read, refused: how many.
        faults: input and what came of it, of those that should not be.
        seconds: that it took.
    """

    read: int = 0
    refused: int = 0
    faults: list[tuple[bytes, str]] = field(default_factory=list)
    seconds: float = 0.0


@dataclass
class Guard:
    """Hears what the interpreter is asked to do while an input is read."""

    listening: bool = False
    heard: list[str] = field(default_factory=list)

    def hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        """An audit hook (PEP 578)."""
        if self.listening and event in _FORBIDDEN:
            self.heard.append(f"{event} {str(arguments)[:100]}")


_guard = Guard()
sys.addaudithook(_guard.hear)


def spoilt(rng: random.Random, seeds: tuple[bytes, ...]) -> bytes:
    """A good input with a few changes."""
    text = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        at, length = rng.randrange(len(text) + 1), rng.choice((0, 1, 1, 2, 8, 40))
        kind = rng.randrange(5)
        if kind == 0:
            text[at : at + length] = rng.choice(_DICTIONARY)
        elif kind == 1:
            del text[at : at + length]
        elif kind == 2:
            text[at:at] = text[at : at + length]
        elif kind == 3 and at < len(text):
            text[at] ^= 1 << rng.randrange(8)
        else:
            other = rng.choice(seeds)
            start = rng.randrange(len(other) + 1)
            text[at:at] = other[start : start + 60]
    return bytes(text)


def feed(read: Callable[[bytes], bool], seeds: tuple[bytes, ...], count: int, seed: int) -> Found:
    """Feed so many inputs to a reader.

    Args:
        read: gives whether it was read; or raises an error of rtec.
        seeds: good inputs; each must be read.
        count: of inputs.
        seed: of their changes.
    """
    rng, found, clock = random.Random(seed), Found(), RealClock()
    for text in seeds:
        if not read(text):
            raise AssertionError(f"a good input was refused: {text[:200]!r}")
    since_ns = clock.now_ns()
    for _ in range(count):
        text = spoilt(rng, seeds)
        fault = _one(read, text, found)
        if fault:
            found.faults.append((text, fault))
    found.seconds = (clock.now_ns() - since_ns) * 1e-9
    return found


def _one(read: Callable[[bytes], bool], text: bytes, found: Found) -> str:
    _guard.heard, _guard.listening = [], True
    try:
        with _at_most(LONGEST_S):
            good = read(text)
    except RtecError:
        good = False
    except TooLong:
        return f"took longer than {LONGEST_S} s"
    except Exception as e:  # noqa: BLE001 (any other error is what is looked for)
        return f"{type(e).__name__}: {e}"
    finally:
        _guard.listening = False
    found.read += good
    found.refused += not good
    return "; ".join(_guard.heard)


@contextmanager
def _at_most(seconds: int) -> Iterator[None]:
    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise TooLong

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def kinds(folder: Path) -> dict[str, tuple[Callable[[bytes], bool], tuple[bytes, ...]]]:
    """Of each kind of input: its reader, and good ones."""
    setup, trial = setups.setup(folder), folder / "trial.toml"
    own = Expression.model_validate({"effect": "expression", "component": "EXX", **_OWN})
    model = Model(setup.machine, (*setup.model.effects, FittedEffect(own, {"A": 1.4, "B": -0.2}, {"p": 37.3})))
    save_model(model, folder / "own.toml")
    left = {"name": "laser-x", "column": "reading_um", "unit": "um", "n": 812, "components": ["EXX", "EBX"]}
    compared = {"model": model.name, "measurements": [{**left, "rms_residual_um": 2.3, "noise_floor_um": 0.4}]}

    def written(load: Callable[[], object]) -> Callable[[bytes], bool]:
        def read(text: bytes) -> bool:
            trial.write_bytes(text)
            load()
            return True

        return read

    def files(*places: Path) -> tuple[bytes, ...]:
        return tuple(p.read_bytes() for p in places)

    configs, machines = setups.CONFIGS.glob("*.toml"), (setups.CONFIGS / "machines").glob("*.toml")
    return {
        "requests": _requests(setup),
        "expressions": (lambda text: _expression(text, setup.machine), tuple(t.encode() for t in _EXPRESSIONS)),
        "comparisons": (
            written(lambda: _not_trouble(Residual(trial).facts(setup.model))),
            (json.dumps(compared).encode(),),
        ),
        "run files": (
            written(lambda: validated(RunFile, {**NO_DEVICES, **read_toml(trial)}, "trial")),
            files(*sorted(configs)),
        ),
        "run files, whole": (written(lambda: load_setup(trial)), files(setup.path)),
        "machine files": (written(lambda: load_machine(trial)), files(*sorted(machines))),
        "model files": (written(lambda: load_model(trial, setup.machine)), files(folder / "own.toml")),
    }


def _requests(setup: Setup) -> tuple[Callable[[bytes], bool], tuple[bytes, ...]]:
    desk, peer = Desk(FakeDaemon(setup), VirtualClock(1), {}), Peer("cell", "operate")
    session = json.loads(desk.answer(b'{"schema":1,"ask":"session"}', peer))["session"]
    order = {"schema": 1, "ask": "order", "id": 7, "session": session, "seq": 1, "order": "mark", "text": "first part"}

    def read(text: bytes) -> bool:
        answer = json.loads(desk.answer(text, peer))
        if answer["schema"] != 1:
            raise AssertionError(f"an answer of another schema: {answer}")
        return "error" not in answer

    orders = (json.dumps({**order, "order": str(name)}).encode() for name in Order)
    return read, (*_ASKS, *orders)


_ASKS: Final = (
    b'{"schema":1,"ask":"status","id":1}',
    b'{"schema":1,"ask":"watch"}',
    b'{"schema":1,"ask":"as","name":"cell","role":"operate"}',
)


def _expression(text: bytes, machine: Machine) -> bool:
    """As a model file's own effect; checked on a machine, which works it out at three instants."""
    table = {"effect": "expression", "component": "EXX", **_OWN, "expression": text.decode("utf-8", "replace")}
    validated(Expression, table, "trial").check(machine, "trial")
    return True


def _not_trouble(found: dict[str, Any]) -> None:
    if found["trouble"]:
        raise ConfigError(found["trouble"])


def main(count: int, seed: int) -> int:
    """Feed all kinds; give an exit status."""
    wrong = 0
    warnings.simplefilter("ignore", SyntaxWarning)  # Python's own word on texts that are refused afterwards
    with tempfile.TemporaryDirectory(prefix="fuzz-rtec-", dir=_memory()) as folder:
        for name, (read, seeds) in kinds(Path(folder)).items():
            found = feed(read, seeds, count, seed)
            sys.stdout.write(
                f"{name}: {count} inputs, {found.read} read, {found.refused} refused, {len(found.faults)} faults, "
                f"{found.seconds:.0f} s\n"
            )
            sys.stdout.flush()
            for text, fault in found.faults[:5]:
                sys.stdout.write(f"  {fault[:300]}\n  {text!r}\n")
            wrong += len(found.faults)
    return 1 if wrong else 0


def _memory() -> str | None:
    """Where files are memory, if there is such a place: nothing of this is to wear a disk out."""
    place = Path("/dev/shm")  # noqa: S108 (a folder of its own is made in it)
    return str(place) if place.is_dir() else None


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT, int(sys.argv[2]) if len(sys.argv) > 2 else 1))
