"""Machine, run and model file from answers, with comments on what to check next."""

import json
import tomllib
from pathlib import Path
from typing import Any, Final

import tomli_w

from rtec.commission.answers import FOLDER, Answers, AxisAnswer, template_tables
from rtec.correction.flags import CYCLES_OF_AGE
from rtec.loop.clock import RealClock
from rtec.loop.devices import driver_class, make_devices
from rtec.loop.run_file import Roles, setup_of
from rtec.machine import Machine, machine_from
from rtec.model import Model

MACHINE, RUN, MODEL = "machine.toml", "run.toml", "model.toml"
SLOW: Final = {"ascii_lines": (50.0, 0.25)}
"""Cycles per second, and the largest age of the counts, s, for devices that print their counts."""
FAST: Final = (1000.0, 0.005)
OUTPUT_PERIOD_S: Final = 0.2
ANSWERS: Final = """\
# Answers for `rtec init --answers FILE`. What is the template's own may be left out.
template = "{template}"
name = "{template}"
mode = "hold"                # nothing moves after a start, until the model was measured
{own}

# Which device does what; the devices are as in a run file, `rtec drivers` lists all of them.
[role]
counts = "encoders"
temperatures = ["thermocouples"]
actuator = "offsets"

[device.encoders]            # or serial_box, can_encoders, linuxcnc, …: see rtec drivers
driver = "ascii_lines"
port = "/dev/ttyUSB0"
baud = 115200
patterns = ['{pattern}']
units = {{{units}}}
max_speed_mm_s = {{{speeds}}}

[device.thermocouples]       # rtec drivers modbus
driver = "modbus"
serial = {{port = "/dev/ttyUSB1", baud = 19200, parity = "even"}}

[device.thermocouples.slave.module]
id = 1

[device.thermocouples.slave.module.register]
{registers}

[device.offsets]             # rtec drivers ascii_offset
driver = "ascii_offset"
serial = {{port = "/dev/ttyUSB2", baud = 19200}}
command = ["OFS {command}"]
unit = "mm"
resolution_um = 0.1
acknowledge = "OK"

[limits]                     # of the correction of every axis
stop_um = 50.0
slew_um_s = 20.0"""


def texts(answers: Answers) -> dict[str, str]:
    """The files by name; without devices there is no run file."""
    run = {} if answers.role is None else {RUN: run_text(answers, answers.role)}
    return {MACHINE: machine_text(answers), **run, MODEL: model_text(answers)}


def machine_of(answers: Answers) -> Machine:
    """The machine that `machine.toml` will describe.

    Raises:
        ConfigError: the chains and axes do not fit together.
    """
    return machine_from(tomllib.loads(machine_text(answers)), MACHINE)


def check(answers: Answers, folder: Path) -> None:
    """Check the machine, and the run that `run.toml` will describe with all its devices; nothing is written or opened.

    Raises:
        ConfigError: chains and axes that do not fit together, a role without a device, options that a driver refuses,
            an output that the actuator refuses.
    """
    machine = machine_of(answers)
    if answers.role is not None:
        data = tomllib.loads(run_text(answers, answers.role))
        make_devices(setup_of(data, folder / RUN, machine, Model(machine)), RealClock())


def answers_text(template: str) -> str:
    """An answers file to fill in: the template's own values, and a device for each role.

    Raises:
        ConfigError: no template has that name.
    """
    tables = template_tables(template)
    axes, sensors = list(tables["axis"]), tables["sensors"]
    return ANSWERS.format(
        template=template,
        own=(FOLDER / f"{template}.toml").read_text(encoding="utf-8").strip(),
        pattern=" ".join(f"{a}=(?P<{a}>\\S+)" for a in axes),
        units=", ".join(f'{a} = "mm"' for a in axes),
        speeds=", ".join(f"{a} = 400.0" for a in axes),
        registers="\n".join(f"{name} = {{address = {k}, scale = 0.1}}" for k, name in enumerate(sensors)),
        command=" ".join(f"{a}={{{a}:.4f}}" for a in axes),
    )


def machine_text(answers: Answers) -> str:
    """`machine.toml`."""
    links = [n for n in (*answers.tool_chain, *answers.work_chain) if n not in answers.axis]
    parts = [
        f"# Machine {answers.name!r}, made by rtec init from the template {answers.template!r}.\n"
        "# Every key: docs/files.md; `rtec machine show machine.toml` lists what follows from this file.\n",
        "# tool_chain: the links from the base to the tool tip; work_chain: from the base to the cutting point.\n"
        + _table("machine", {"name": answers.name, "tool_chain": answers.tool_chain, "work_chain": answers.work_chain}),
        *(_axis(name, axis) for name, axis in answers.axis.items()),
        "# Offsets of the fixed links, each from the link before it, mm. The lever arms follow from them:\n"
        "# measure those of the tool.\n"
        + "\n".join(_table(f"link.{n}", {"offset_mm": answers.link.get(n, (0.0, 0.0, 0.0))}) for n in links),
    ]
    if answers.sensors:
        ranges = (_table(f"temperature.{name}", {"range_degc": [0.0, 80.0]}) for name in answers.sensors)
        parts.append("# A reading outside its range is a broken sensor, not a temperature.\n" + "\n".join(ranges))
    return "\n".join(parts)


def run_text(answers: Answers, role: Roles) -> str:
    """`run.toml`."""
    driver = str(answers.device.get(role.counts, {}).get("driver", ""))
    usual_hz, max_age_s = SLOW.get(driver, FAST)
    rate_hz = answers.rate_hz or usual_hz
    corrected = [name for name, axis in answers.axis.items() if axis.compensate]
    limits, sink = answers.limits.of_axis.model_dump(), sink_of(answers, role)
    run: dict[str, Any] = {
        "machine": MACHINE,
        "model": MODEL,
        "rate_hz": rate_hz,
        "mode": answers.mode,
        "log_folder": str(answers.log_folder),
    }
    incremental = driver and hasattr(driver_class(driver, RUN), "supply")
    if incremental:
        run["zero"] = "ordered"
    parts = [
        f"# Run file of {answers.name!r}, made by rtec init. Every key: docs/files.md.\n"
        "#   rtec doctor run.toml           what the devices read\n"
        "#   rtec run run.toml --dry-run    reads everything, commands nothing\n"
        "#   rtec run run.toml --step X=20um    checks the sign with an indicator, see docs/runbook.md\n",
        '# mode: "hold" moves nothing after a start; "on" corrects, once the model was measured.\n'
        + ("# zero: incremental encoders need `rtec ctl home`, see docs/encoder-box.md.\n" if incremental else "")
        + _table("run", run),
        "# Which device reads the counts and the temperatures, and which takes the correction.\n"
        + _table("role", role.model_dump(exclude_none=True, exclude_defaults=True)),
        "# Devices. `rtec drivers NAME` lists the options of a driver.\n"
        + tomli_w.dumps({"device": answers.device}).replace("[device]\n", "", 1).lstrip(),
        "# Limits of each axis' correction: beyond warning_um it is flagged, beyond stop_um not followed.\n"
        + "\n".join(_table(f"limits.{name}", limits) for name in corrected),
        *(_table(f"output.{name}", sink) for name in corrected if sink is not None),
        "# Older counts or temperatures hold the correction where it is.\n"
        + _table(
            "guard",
            {
                "counts_max_age_s": answers.counts_max_age_s or max(max_age_s, float(f"{CYCLES_OF_AGE / rate_hz:.3g}")),
                "temperature_max_age_s": answers.temperature_max_age_s,
            },
        ),
    ]
    return "\n".join(parts)


def model_text(answers: Answers) -> str:
    """`model.toml`, without effects."""
    head = {
        "format": 1,
        "name": answers.name,
        "machine": answers.name,
        "machine_hash": "",
        "machine_file": MACHINE,
        "reference_degc": 20.0,
        "effects": 0,
    }
    return (
        "# An empty model: it asks for no correction. A measurement and `rtec fit machine.toml FILE -o model.toml`\n"
        "# put effects into it. An empty machine_hash stands for this machine.\n" + _table("model", head)
    )


def sink_of(answers: Answers, role: Roles) -> dict[str, Any] | None:
    """`[output.X]` of the corrected axes; None where the actuator takes counts, which needs no table."""
    if answers.output is not None:
        return answers.output
    device = answers.device.get(role.actuator or "", {})
    unit_um = device.get("resolution_um", device.get("unit_um"))
    kind = device.get("actuator", "origin_offset" if unit_um is not None else "pulse")
    if kind == "pulse":
        return None
    return {"kind": kind, "resolution_um": unit_um, "period_s": OUTPUT_PERIOD_S}


def _axis(name: str, axis: AxisAnswer) -> str:
    table: dict[str, Any] = {
        "direction": axis.direction,
        "travel_mm": axis.travel_mm,
        "counts_per_mm": axis.per_mm,
    }
    table |= {} if axis.pitch_mm is None else {"pitch_mm": axis.pitch_mm}
    table |= {} if axis.compensate else {"compensate": False}
    return f"# One count is {1e3 / axis.per_mm:g} µm.\n" + _table(f"axis.{name}", table)


def _table(name: str, content: dict[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {_value(value)}\n" for key, value in content.items())


def _value(value: Any) -> str:
    """A value as TOML, lists on one line as people write them."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)
