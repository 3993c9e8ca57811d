"""Pages about drivers: the table of all, and one in full."""

from collections.abc import Sequence

from rtec.loop.driver_info import DriverFacts, Option
from rtec.report.page import Page, Section, Table


def drivers_page(drivers: Sequence[DriverFacts]) -> Page:
    """The table of all drivers; those that cannot be used are in a section of their own."""
    rows = [driver_row(d) for d in drivers if not d.trouble]
    lead = (
        'The drivers that are installed. A device\'s table in the run file names one: driver = "serial_box". '
        "`rtec drivers NAME` shows its options, with an example."
    )
    table = Table(("driver", "reads", "output", "what it is"), rows, words=(0, 1, 2, 3))
    sections = [Section("Drivers", (), table)]
    broken = [f"{d.trouble} (package {d.package})" for d in drivers if d.trouble]
    if broken:
        sections.append(Section("Cannot be used here", broken))
    return Page("Drivers", lead, (), sections)


def driver_row(driver: DriverFacts) -> tuple[str, str, str, str]:
    """Row of a driver: name, its readings, its outputs, description."""
    reads = ", ".join(role for role in driver.roles if role != "actuator")
    return driver.name, reads or "-", _takes(driver), driver.summary


def driver_page(driver: DriverFacts) -> Page:
    """One driver in full; the command prints its example below, unchanged."""
    if driver.trouble:
        return Page(driver.name, driver.trouble, (), ())
    text = [f"Roles in [role]: {', '.join(driver.roles) or 'nothing'}."]
    if "actuator" in driver.roles:
        by = f", by its option {driver.takes_by}" if driver.takes_by else ""
        text.append(f"Kinds of output: {_takes(driver)}{by}.")
    if driver.resumes:
        text.append("After a reset or a lost position it stops until it is ordered to resume.")
    if driver.scans:
        text.append("`rtec init` looks on its port or bus for the numbers, and only reads.")
    text.append(f"Code: {driver.module}, of package {driver.package}.")
    sections = [Section("What it can do", text), *(_options_section(*part) for part in _by_table(driver.options))]
    return Page(driver.name, f"{driver.name}: {driver.summary}", (), sections)


def _by_table(options: Sequence[Option]) -> list[tuple[str, list[Option]]]:
    """Options by their table: the device's own first, then nested tables in their order."""
    out: dict[str, list[Option]] = {}
    for option in options:
        out.setdefault(option.name.rpartition(".")[0], []).append(option)
    return sorted(out.items(), key=lambda item: item[0] != "")


def _options_section(table: str, options: Sequence[Option]) -> Section:
    heading = f"Options in its table {table}" if table else "Options"
    head = ("option", "value", "default", "meaning")
    return Section(heading, (), Table(head, [_option_row(o) for o in options], words=(0, 1, 2, 3)))


def _option_row(option: Option) -> tuple[str, str, str, str]:
    default = "required" if option.required else option.default or "-"
    return option.name.rpartition(".")[2], option.kind, default, option.meaning.replace("`", "")


def _takes(driver: DriverFacts) -> str:
    if "actuator" not in driver.roles:
        return "-"
    return ", ".join(driver.takes) or "asked when it is opened"
