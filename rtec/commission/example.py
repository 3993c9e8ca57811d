"""The files that come with rtec: machines, models, simulated devices, the tutorial's data, maps for imports."""

from pathlib import Path
from typing import Final

from rtec.commission.files import write_together

SHIPPED: Final = Path(__file__).parents[1] / "configs"
"""Their folder, in a clone and in an installed package alike."""
FOLDER: Final = "configs"
"""Name of the folder for the copies, as in the commands of the documentation."""


def write_example(folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Copy the shipped files into `configs` of a folder; all files or none.

    Raises:
        ConfigError: a file exists with another content and may not be replaced, or cannot be written.
    """
    files = sorted(file for file in SHIPPED.rglob("*.toml"))
    texts = {Path(FOLDER) / file.relative_to(SHIPPED): file.read_text(encoding="utf-8") for file in files}
    return write_together(folder, texts, overwrite=overwrite)
