"""LinuxCNC judges the sign of its own compensation files: with them the simulated mill is right.

Oracle: LinuxCNC, which reads the files when it starts, and the plant in its HAL, which knows where the tool is.
"""

import numpy as np
import pytest

from rtec.correction.tables import FORMATS
from rtec.correction.tables.predict import checked, grids_mm, table_of
from rtec.machine import load_machine
from tests.support.linuxcnc_plant import true_model
from tests.support.linuxcnc_session import CONFIGS, Session, why_not

pytestmark = [pytest.mark.xdist_group("others"), pytest.mark.skipif(bool(why_not()), reason=why_not() or "")]

FORMAT_OF = {"X": "linuxcnc", "Y": "linuxcnc-type-1", "Z": "linuxcnc"}
DEGC = {"T_x": 26.0, "T_y": 25.0, "T_z": 24.0}
STEP_MM = 10.0
PLACES = (-80.0, -30.0, 20.0, 80.0)


def test_the_error_is_gone_at_the_points_of_the_table() -> None:
    """Both types, both directions of arrival."""
    machine = load_machine(CONFIGS / "mill-machine.toml")
    model = true_model(CONFIGS / "mill-plant.hal", machine)
    files, ini, plant, tables = {}, [], [], {}
    for j, axis in enumerate(machine.axes):
        at = {**DEGC, **{a.name: 0.0 for a in machine.axes if a.name != axis.name}}
        form = FORMATS[FORMAT_OF[axis.name]]
        tables[axis.name] = checked(table_of(model, axis, axis, grids_mm(form, axis, None, STEP_MM)[0], at), form)
        name = f"{axis.name.lower()}.comp"
        files[name] = form.text(tables[axis.name])
        kind = 1 if "type-1" in FORMAT_OF[axis.name] else 0
        home = f"HOME_SEQUENCE = {j}"
        ini.append((home, f"{home}\nCOMP_FILE = {name}\nCOMP_FILE_TYPE = {kind}"))
        heat = f"setp {axis.name.lower()}-degc.gain0 0.3"
        plant.append((heat, heat.replace("0.3", "0")))
    with Session("mill", {"mill.ini": ini, "mill-plant.hal": plant}, files) as mill:
        mill.state("estop_reset")
        mill.state("on")
        mill.home()
        mill.mdi("G0 X-90 Y-90 Z-90")
        for direction, places in ((1.0, PLACES), (-1.0, PLACES[-2::-1])):
            for q in places:
                mill.mdi(f"G1 F6000 X{q} Y{q} Z{q}")
                error_um = {a: 1e3 * (mill.gets(f"{a.lower()}-tip") - q) for a in machine.axis_names}
                before = {a: abs(tables[a].error_um(np.array([q]), direction)[0]) for a in machine.axis_names}
                assert max(before.values()) > 4.0
                assert all(abs(e) < 0.15 for e in error_um.values()), (direction, q, error_um, before)
