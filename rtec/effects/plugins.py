"""Effects of other packages, found by the entry point `rtec.effects`: name of the effect -> its class.

They are loaded when the first name that is not built in is asked for. A plug-in that cannot be loaded takes nothing
else with it: what is wrong is kept as text, told by `rtec effects`, and told again where its effect is wanted.
"""

import functools
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points

from rtec.effects.base import About, Effect

GROUP = "rtec.effects"


@dataclass(frozen=True)
class PlugIns:
    """What other packages bring.

    Attributes:
        effects: class by name.
        faults: what is wrong, by name of the effect, in words.
    """

    effects: Mapping[str, type[Effect]]
    faults: Mapping[str, str]


def plug_ins(taken: tuple[str, ...]) -> PlugIns:
    """Give the effects of other packages.

    Args:
        taken: names that a plug-in cannot have.
    """
    return _found(tuple(sys.path), taken)


@functools.lru_cache(maxsize=4)
def _found(path: tuple[str, ...], taken: tuple[str, ...]) -> PlugIns:
    del path  # a key: another path may hold other packages
    effects: dict[str, type[Effect]] = {}
    faults: dict[str, str] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda e: (e.name, _package(e))):
        if entry.name in taken:
            faults[entry.name] = f"{_told(entry)}: {entry.name!r} is a name of rtec's own; a plug-in needs another"
        elif entry.name in effects:
            faults[entry.name] = f"{_told(entry)}: another package has an effect {entry.name!r}; its own is used"
        else:
            loaded = _load(entry)
            if isinstance(loaded, str):
                faults[entry.name] = f"{_told(entry)}: {loaded}"
            else:
                effects[entry.name] = loaded
    return PlugIns(effects, faults)


def _load(entry: EntryPoint) -> type[Effect] | str:
    """The class, or what is wrong with it."""
    try:
        kind = entry.load()
    except Exception as e:  # noqa: BLE001 - somebody else's module may fail in any way, and only its effect is lost
        return f"cannot be loaded: {type(e).__name__}: {e}"
    return _fault(kind, entry.name) or kind


def _fault(kind: object, name: str) -> str:
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        return f"{kind!r} is not a class derived from rtec.effects.Effect"
    if inspect.isabstract(kind):
        return f"{kind.__name__} lacks {', '.join(sorted(kind.__abstractmethods__))}"
    if not isinstance(getattr(kind, "about", None), About):
        return f"{kind.__name__} has no `about = About(…)`"
    own = kind.model_fields["effect"].default
    if own != name:
        return f"the entry point is named {name!r}, but `effect` of {kind.__name__} is {own!r}; they must be one word"
    return ""


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else ""


def _told(entry: EntryPoint) -> str:
    return f"package {_package(entry) or '?'}, entry point {GROUP}: {entry.name} = {entry.value}"
