"""The drivers that are installed: rtec's own, and those of other packages by the entry point `rtec.drivers`.

An entry point gives either the driver's class, then its own name is the driver's, or a table `name -> (module, class)`
as rtec's own registry; modules of a table are imported only when their driver is asked for. One package that cannot be
loaded hides no other.
"""

import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, entry_points
from typing import Any

from rtec.errors import ConfigError, DriverUnavailable
from rtec.tomlfile import nearest

GROUP = "rtec.drivers"
OWN = "rtec"


@dataclass(frozen=True)
class Installed:
    """Where a driver is.

    Attributes:
        name: as a run file calls it.
        module, kind: its module and the name of its class.
        package: installed package that it belongs to.
        trouble: why it cannot be used, found before its module was asked for; or "".
    """

    name: str
    module: str
    kind: str
    package: str
    trouble: str = ""

    def load(self) -> Any:
        """Import its module and give its class.

        Raises:
            DriverUnavailable: it cannot be used; the message says what to install, where that would help.
        """
        if self.trouble:
            raise DriverUnavailable(f"driver {self.name!r} {self.trouble}")
        try:
            found = getattr(importlib.import_module(self.module), self.kind, None)
        except ImportError as e:
            raise DriverUnavailable(f"driver {self.name!r} {_cannot(e, self.package)}") from e
        except Exception as e:  # another's code may fail in any way while it is imported
            raise DriverUnavailable(f"driver {self.name!r} cannot be imported: {type(e).__name__}: {e}") from e
        if found is None:
            raise DriverUnavailable(f"driver {self.name!r}: module {self.module} has no {self.kind}")
        return found


def installed() -> dict[str, Installed]:
    """All drivers by name, rtec's own first. Of two with one name the first stays; the other is listed with its fault.

    Its listed name then has its package behind it, which no run file can name.
    """
    out: dict[str, Installed] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda e: (_package(e) != OWN, e.name)):
        for driver in _of(entry):
            first = out.get(driver.name)
            if first is None:
                out[driver.name] = driver
                continue
            name = f"{driver.name} ({driver.package})"
            fault = f"is hidden: package {first.package} has a driver of the same name"
            out[name] = Installed(name, driver.module, driver.kind, driver.package, fault)
    return out


def find(name: str, where: str) -> Installed:
    """A driver by name.

    Raises:
        ConfigError: none of that name.
    """
    table = installed()
    if name not in table:
        raise ConfigError(f"{where}: no driver {name!r}{nearest(name, table)}")
    return table[name]


def _of(entry: EntryPoint) -> list[Installed]:
    """The drivers of one entry point."""
    package = _package(entry)
    try:
        value: Any = entry.load()
    except ImportError as e:
        return [Installed(entry.name, entry.module, entry.attr, package, _cannot(e, package))]
    except Exception as e:  # noqa: BLE001 - another's code may fail in any way while it is imported
        fault = f"cannot be imported: {type(e).__name__}: {e}"
        return [Installed(entry.name, entry.module, entry.attr, package, fault)]
    if isinstance(value, type):
        return [Installed(entry.name, entry.module, entry.attr, package)]
    if isinstance(value, Mapping) and all(isinstance(p, tuple) and len(p) == 2 for p in value.values()):
        return [Installed(str(name), str(place[0]), str(place[1]), package) for name, place in value.items()]
    fault = f"cannot be used: its entry point {entry.value!r} is neither a class nor a table of (module, class)"
    return [Installed(entry.name, entry.module, entry.attr, package, fault)]


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "?"


def _cannot(error: ImportError, package: str) -> str:
    """Say why an import failed, and what to install."""
    missing = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or not missing:
        return f"cannot be imported: {error}"
    return f"needs the Python package {missing!r}, which is not installed: {_how(missing, package)}"


def _how(missing: str, package: str) -> str:
    """The command that installs a module's package: by the extra of the driver's package where that names it."""
    try:
        requires = Distribution.from_name(package).requires or []
    except (ModuleNotFoundError, ValueError):  # no such package, or one without a name
        requires = []
    for requirement in requires:
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        if name is None or _plain(name[0]) != _plain(missing):
            continue
        extra = re.search(r"""extra\s*==\s*['"]([^'"]+)""", requirement)
        return f"pip install '{package}[{extra[1]}]'" if extra else f"pip install {name[0]}"
    return f"pip install the package that holds the module {missing!r} (often of the same name)"


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
