"""The files that come with rtec: machines, models, simulated devices, the tutorial's data, maps for imports."""

from pathlib import Path
from typing import Final

from rtec.commission.files import write_together

SHIPPED: Final = Path(__file__).parents[1] / "configs"
"""Where they are, in a clone and in an installed package alike."""
FOLDER: Final = "configs"
"""What the folder is called that they are copied to: the commands in the documentation name it."""


def write_example(folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Copy what is shipped into `configs` of a folder; all files or none.

    Raises:
        ConfigError: a file is there with another content and may not be replaced, or cannot be written.
    """
    files = sorted(file for file in SHIPPED.rglob("*.toml"))
    texts = {Path(FOLDER) / file.relative_to(SHIPPED): file.read_text(encoding="utf-8") for file in files}
    return write_together(folder, texts, overwrite=overwrite)
