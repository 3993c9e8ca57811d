"""What the drivers that are installed can do, and what may be said to them."""

from dataclasses import asdict, dataclass
from typing import Any, get_args

from rtec.errors import DriverUnavailable
from rtec.loop.driver_info import Installed, find, installed
from rtec.loop.driver_options import Option, options_of, summary_of
from rtec.loop.ports import Actuator, CountSource, SpindleSource, TemperatureSource

CAN_BE: dict[str, type] = {
    "counts": CountSource,
    "temperatures": TemperatureSource,
    "spindle": SpindleSource,
    "actuator": Actuator,
}
"""The keys of a run file's `[role]`, and the port that a driver must have for each."""


@dataclass(frozen=True)
class DriverFacts:
    """One driver.

    Attributes:
        name: as a run file calls it.
        module, package: where it is.
        summary: one sentence.
        roles: what it can be, by the keys of `[role]`.
        takes: kinds of output that it takes, where it is an actuator; empty where it does not say.
        takes_by: the option that says which of them, or "".
        resumes: does it stop where it would guess, until it is ordered to resume?
        options: the keys of its device's table.
        example: text of a device's table, or "".
        trouble: why it cannot be used, with a way on; or "".
    """

    name: str
    module: str
    package: str
    summary: str = ""
    roles: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    takes_by: str = ""
    resumes: bool = False
    options: tuple[Option, ...] = ()
    example: str = ""
    trouble: str = ""

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return asdict(self)


def all_drivers() -> list[DriverFacts]:
    """Every driver that is installed; those that cannot be used say why."""
    return [_facts(driver) for driver in installed().values()]


def driver_facts(name: str) -> DriverFacts:
    """One driver.

    Raises:
        ConfigError: none of that name.
    """
    return _facts(find(name, "rtec drivers"))


def _facts(driver: Installed) -> DriverFacts:
    try:
        kind = driver.load()
    except DriverUnavailable as e:
        return DriverFacts(driver.name, driver.module, driver.package, trouble=str(e))
    model = getattr(kind, "options_model", None)
    if model is None:
        trouble = f"driver {driver.name!r}: class {driver.kind} has no options_model; see docs/write-a-driver.md"
        return DriverFacts(driver.name, driver.module, driver.package, trouble=trouble)
    takes, by = _takes(kind)
    return DriverFacts(
        driver.name,
        driver.module,
        driver.package,
        summary_of(kind),
        tuple(role for role, port in CAN_BE.items() if issubclass(kind, port)),
        takes,
        by,
        hasattr(kind, "resume"),
        tuple(options_of(model)),
        str(getattr(kind, "EXAMPLE", "")),
    )


def _takes(kind: Any) -> tuple[tuple[str, ...], str]:
    """Kinds of output, and the option that chooses among them: what the class says, else its option `actuator`."""
    if not issubclass(kind, Actuator):
        return (), ""
    said = getattr(kind, "TAKES", None)
    if said is not None:
        return tuple(said), ""
    option = kind.options_model.model_fields.get("actuator")
    return (tuple(map(str, get_args(option.annotation))), "actuator") if option is not None else ((), "")
