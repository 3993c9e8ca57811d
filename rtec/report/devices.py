"""Pages about devices: the installed drivers; what the doctor found in the devices and in this computer."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rtec.report.page import Page, Section, Table
from rtec.wording import significant

if TYPE_CHECKING:
    from rtec.doctor.found import DeviceFault, DeviceFound, Examination, PcFinding, PcFound, Value
    from rtec.loop.driver_info import DriverFacts, Option


def drivers_page(drivers: "Sequence[DriverFacts]") -> Page:
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


def driver_row(driver: "DriverFacts") -> tuple[str, str, str, str]:
    """Row of a driver: name, its readings, its outputs, description."""
    reads = ", ".join(role for role in driver.roles if role != "actuator")
    return driver.name, reads or "-", _takes(driver), driver.summary


def driver_page(driver: "DriverFacts") -> Page:
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


def _by_table(options: "Sequence[Option]") -> "list[tuple[str, list[Option]]]":
    """Options by their table: the device's own first, then nested tables in their order."""
    out: dict[str, list[Option]] = {}
    for option in options:
        out.setdefault(option.name.rpartition(".")[0], []).append(option)
    return sorted(out.items(), key=lambda item: item[0] != "")


def _options_section(table: str, options: "Sequence[Option]") -> Section:
    heading = f"Options in its table {table}" if table else "Options"
    head = ("option", "value", "default", "meaning")
    return Section(heading, (), Table(head, [_option_row(o) for o in options], words=(0, 1, 2, 3)))


def _option_row(option: "Option") -> tuple[str, str, str, str]:
    default = "required" if option.required else option.default or "-"
    return option.name.rpartition(".")[2], option.kind, default, option.meaning.replace("`", "")


def _takes(driver: "DriverFacts") -> str:
    if "actuator" not in driver.roles:
        return "-"
    return ", ".join(driver.takes) or "asked when it is opened"


HEAD = ("device", "driver", "value", "now", "age", "rate", "")
WORDS = (0, 1, 2, 6)


def doctor_page(found: "Examination") -> Page:
    """Values of all devices in one table; then, device by device, faults and remedies."""
    sick = [d for d in found.devices if d.wrong]
    verdict = f"Of {_devices(len(found.devices))} {_are(len(sick))} not well." if sick else "All devices are well."
    if found.wrong:
        verdict = f"{verdict.removesuffix('.')}{', and' if sick else '; but'} the run file is wrong."
    sections = [Section("What they read", (), doctor_table(found.devices))]
    sections += [Section(f"Wrong: {d.name} ({d.driver})", _fault_lines(d.wrong)) for d in sick]
    if found.wrong:
        sections.append(Section("Wrong: the run file", _fault_lines(found.wrong)))
    told = [f"{d.name}: {text}" for d in found.devices for text in d.told]
    if told:
        sections.append(Section("Notes", told))
    many, how = _devices(len(found.devices)), f"read for {found.seconds:g} s; nothing was commanded"
    return Page("Doctor", f"{found.machine}: {many}, {how}. {verdict}", (), sections)


def doctor_table(devices: "Sequence[DeviceFound]") -> Table:
    """One row a value; a device without values has one row with its state."""
    return Table(HEAD, [row for device in devices for row in _rows(device)], words=WORDS)


def _rows(device: "DeviceFound") -> list[tuple[str, ...]]:
    state = device.doing if device.doing != "done" else "wrong" if device.wrong else "good"
    first = (device.name, device.driver)
    rows = [_value(v) for v in device.values] or [("-", "-", "-", "-")]
    return [(*(first if k == 0 else ("", "")), *row, state if k == 0 else "") for k, row in enumerate(rows)]


def _value(value: "Value") -> tuple[str, str, str, str]:
    number = f"{value.value:.{value.digits}f} {value.unit}"
    return value.name, number, _age(value.age_s), "-" if value.rate_hz is None else f"{significant(value.rate_hz)} /s"


def _age(age_s: float | None) -> str:
    if age_s is None:
        return "-"
    return f"{age_s * 1e3:.1f} ms" if age_s < 0.1 else f"{age_s:.1f} s"


def _fault_lines(faults: "Sequence[DeviceFault]") -> list[str]:
    """Lines of faults, each followed by its remedies."""
    return ["\n    → ".join((f.what, *f.mend)) for f in faults]


def _devices(n: int) -> str:
    return "1 device" if n == 1 else f"{n} devices"


def _are(n: int) -> str:
    return f"{n} is" if n == 1 else f"{n} are"


STATES = {"good": "good", "better": "could be better", "wrong": "wrong", "unknown": "not known"}


def pc_page(found: "PcFound") -> Page:
    """Findings in one table; then the settings to change, with their files."""
    wrong = [f for f in found.findings if f.state == "wrong"]
    better = [f for f in found.findings if f.state == "better"]
    lead = "This computer: " + _verdict(wrong, better)
    rows = [(f.topic, STATES[f.state], f.found) for f in found.findings]
    sections = [Section("This computer", (), Table(("what", "", "found"), rows, words=(0, 1, 2)))]
    why = [f"{f.topic}: {f.why}" for f in found.findings if f.why]
    if why:
        sections.append(Section("What that does", why))
    how = _how(found)
    if how:
        sections.append(Section("How to get what it lacks, the most needed first", how))
    return Page("This computer", lead, (), sections)


def _verdict(wrong: "list[PcFinding]", better: "list[PcFinding]") -> str:
    if wrong:
        return f"not fit for real time yet: {', '.join(f.topic for f in wrong)}."
    return (
        f"fit for real time; could be better: {', '.join(f.topic for f in better)}." if better else "fit for real time."
    )


def _how(found: "PcFound") -> list[str]:
    out = []
    limits, unit, kernel = found.lines("limits"), found.lines("unit"), found.lines("kernel")
    if limits:
        out.append(_block("into /etc/security/limits.d/rtec.conf:", limits))
    if unit:
        out.append(_block("or, started by systemd, into the unit's [Service] section:", unit))
    out += found.lines("commands")
    if kernel:
        line = f'GRUB_CMDLINE_LINUX="{" ".join(kernel)}"'
        out.append(_block("into /etc/default/grub (keep what is there), then sudo update-grub and restart:", [line]))
    return out


def _block(head: str, lines: list[str]) -> str:
    return "\n    ".join([head, *lines])
