"""The example of the "try it" button: the machine of the tutorial, which has an effect that its model lacks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import rtec
from rtec.commission.example import SHIPPED
from rtec.errors import RtecError
from rtec.tasks.folder import Folder
from rtec.tasks.jobs import Reporter

MACHINE, MODEL = "turning-centre.toml", "model.toml"
EFFECTS: Final = "scale,axis_expansion:EXX:sensor=T_x_nut"
BEAMS: Final[Mapping[str, tuple[int, Mapping[str, Any]]]] = {
    "laser-x": (1, {}),
    "beside": (2, {"beam_offset_mm": [0, 0, 150]}),
}
"""Seed and set-up of the laser of each measurement."""


def write(line: Reporter, folder: Path) -> None:
    """Write the files of the example, as the commands of the tutorial do.

    Raises:
        RtecError: a file of that name exists in the folder.
    """
    names = [MACHINE, MODEL, *(f"{n}{end}" for n in BEAMS for end in (".csv", ".toml"))]
    there = [n for n in names if (folder / n).exists()]
    if there:
        raise RtecError(f"{', '.join(there)}: in the folder already; open an empty folder for the example")
    Folder(folder).write(MACHINE, (SHIPPED / "machines" / MACHINE).read_bytes())
    files = [folder / f"{name}.csv" for name in BEAMS]
    for k, (file, (seed, setup)) in enumerate(zip(files, BEAMS.values(), strict=True)):
        line.stage("measuring the example's machine", k, len(BEAMS))
        rtec.simulate(
            folder / MACHINE,
            "laser_linear",
            axis="X",
            setup=setup,
            truth=SHIPPED / "tutorial" / "hidden.toml",
            settings=SHIPPED / "tutorial" / "day.toml",
            seed=seed,
            out=file,
        )
    rtec.fit(folder / MACHINE, files[:1], effects=EFFECTS, out=folder / MODEL, progress=line.stage)
