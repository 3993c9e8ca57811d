"""Register maps: the place of each number in a slave, its type, and the reads that fetch all numbers."""

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError
from rtec.tomlfile import Strict, nearest, read_toml, validated
from rtec_drivers.modbus.frame import HOLDING, INPUT, MAX_REGISTERS, ModbusRequest
from rtec_drivers.temperatures import Conversion, open_code_faults

LAST_ADDRESS = 65535
LEAST_FLOAT, LARGEST_FLOAT = 1e-12, 1e6
"""Magnitudes between which a measured number is; 20 °C with its registers in the wrong order is 2e-41."""
NumberType = Literal["int16", "uint16", "int32", "uint32", "float32", "float64"]
_STRUCT = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}


class Register(Conversion):
    """One number in a slave, and its conversion to a temperature.

    Attributes:
        address: address on the line, from 0: a manual's "40001" or "30001" is 0.
        function: "holding" (function 3) or "input" (function 4).
        type: type of the number.
        word_order: which of several registers comes first, the "high" or the "low" one.
    """

    address: Annotated[int, Field(ge=0, le=LAST_ADDRESS)]
    function: Literal["holding", "input"] = "holding"
    type: NumberType = "int16"
    word_order: Literal["high", "low"] = "high"

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.address + self.words > LAST_ADDRESS + 1:
            raise ValueError(
                f"address {self.address}: {self.type} takes {self.words} registers; {LAST_ADDRESS} is last"
            )
        if not self.type.startswith("float"):
            fault = open_code_faults(self.open_codes, 16 * self.words, self.type.startswith("int"), self.type)
            if fault:
                raise ValueError(fault)
        return self

    def absurd(self, number: float) -> bool:
        """Is it a float as registers in the wrong order give, rather than a measured number or an open code?"""
        if not self.type.startswith("float") or number == 0.0 or not math.isfinite(number):
            return False
        known = any(math.isclose(number, code, rel_tol=1e-6) for code in self.open_codes)
        return not known and not LEAST_FLOAT < abs(number) < LARGEST_FLOAT

    @property
    def words(self) -> int:
        """Number of registers of the number."""
        return struct.calcsize(_STRUCT[self.type]) // 2

    def number(self, words: Iterable[int]) -> float:
        """The raw number from its registers, in the order of their addresses."""
        ordered = list(words)
        if self.word_order == "low":
            ordered.reverse()
        return float(struct.unpack(_STRUCT[self.type], struct.pack(f">{len(ordered)}H", *ordered))[0])


class Profile(Strict):
    """A module's register map, as shipped in `profiles`.

    Attributes:
        module: maker and type.
        source: document, edition and page of the map.
        notes: required settings of the module, and gaps of the document.
        channel: registers by the channel's name on the module's terminals.
    """

    module: str
    source: str
    notes: str = ""
    channel: dict[str, Register]


@dataclass(frozen=True)
class Block:
    """Registers that one request fetches, and their numbers: name and register."""

    request: ModbusRequest
    numbers: tuple[tuple[str, Register], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers."""
        return tuple(name for name, _ in self.numbers)

    def raw(self, registers: tuple[int, ...]) -> Iterable[tuple[str, float, str]]:
        """Name and raw number of each, and why it is none that was measured, or ""."""
        for name, register in self.numbers:
            start = register.address - self.request.address
            number = register.number(registers[start : start + register.words])
            why = f"{number:.3g} is no temperature; look at word_order, type and address"
            yield name, number, why if register.absurd(number) else ""


def profile_names() -> list[str]:
    """Names of the shipped profiles."""
    return sorted(p.name.removesuffix(".toml") for p in _folder().iterdir() if p.name.endswith(".toml"))


def load_profile(name: str) -> Profile:
    """Read a shipped profile.

    Raises:
        ConfigError: no profile has that name.
    """
    if name not in profile_names():
        raise ConfigError(f"no profile {name!r}{nearest(name, profile_names())}")
    with resources.as_file(_folder() / f"{name}.toml") as path:
        return validated(Profile, read_toml(Path(path)), f"profile {name}")


def blocks_of(slave: int, registers: Mapping[str, Register], max_gap: int) -> list[Block]:
    """The fewest reads of neighbouring registers; gaps of up to `max_gap` unused registers are read, too."""
    out: list[Block] = []
    for function, code in (("holding", HOLDING), ("input", INPUT)):
        group: list[tuple[str, Register]] = []
        chosen = [(n, r) for n, r in registers.items() if r.function == function]
        for item in sorted(chosen, key=lambda item: item[1].address):
            if group and not _fits(group, item[1], max_gap):
                out.append(_block(slave, code, group))
                group = []
            group.append(item)
        if group:
            out.append(_block(slave, code, group))
    return out


def _fits(group: list[tuple[str, Register]], register: Register, max_gap: int) -> bool:
    end = _end(group)
    span = max(end, register.address + register.words) - group[0][1].address
    return register.address - end <= max_gap and span <= MAX_REGISTERS


def _end(group: list[tuple[str, Register]]) -> int:
    return max(r.address + r.words for _, r in group)


def _block(slave: int, code: int, group: list[tuple[str, Register]]) -> Block:
    first = group[0][1].address
    return Block(ModbusRequest(slave, code, first, _end(group) - first), tuple(group))


def _folder() -> resources.abc.Traversable:
    return resources.files("rtec_drivers.modbus") / "profiles"
