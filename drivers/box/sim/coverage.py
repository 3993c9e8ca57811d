#!/usr/bin/env python3
"""Coverage of the gateware by the simulation's tests, from the files of Verilator's chips.

`coverage.py FOLDER` prints lines, branches and toggles of each file and names all that is not covered, with the reason
if there is one. A place of the source counts once, whatever chip, size or axis covered it. Exit status 1: less than
95 % of the lines or toggles, or a place without a reason.
"""

import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

BOX = Path(__file__).parents[1]
LEAST = 0.95
KINDS = ("line", "branch", "toggle")
REASONS = {
    ("link.v", "status"): "bits 4 to 7 are constant: the link knows four flags",
    ("link.v", "default: state <= WAIT;"): "the states that three bits have beyond those in use: never entered",
    ("frame_out.v", "default: state <= IDLE;"): "the states that four bits have beyond those in use: never entered",
    ("frame_out.v", "unused"): "of the CRC of a frame that comes; the one that goes out does not use it",
    ("frame_out.v", "if (free) begin"): "the head never waits: an answer takes longer to fill than a byte to go",
}
Place = tuple[str, int, str, str]
"""File, line, kind, and signal or branch."""


def points(data: Path) -> Iterator[tuple[Place, int]]:
    """Every place in a file of Verilator, and how often it was covered."""
    for line in data.read_text(encoding="utf-8").splitlines():
        if line.startswith("C '"):
            body, times = line[3:].rsplit("' ", 1)
            keys = dict(word.split("\x02", 1) for word in body.split("\x01")[1:])
            kind = keys["page"].split("/")[0].removeprefix("v_")
            yield (Path(keys["f"]).name, int(keys["l"]), kind, f"{keys['o']} {keys['n']}"), int(times)


def covered(folder: Path) -> dict[Place, int]:
    """Counts of all chips together."""
    out: dict[Place, int] = defaultdict(int)
    for data in sorted(folder.glob("*.dat")):
        for place, times in points(data):
            out[place] += times
    return out


def share(places: dict[Place, int], kind: str, file: str = "") -> tuple[int, int]:
    """Number of covered places of a kind, and of all."""
    mine = [times for place, times in places.items() if place[2] == kind and file in ("", place[0])]
    return sum(times > 0 for times in mine), len(mine)


def open_places(places: dict[Place, int]) -> dict[tuple[str, str], list[int]]:
    """Bits or lines that are not covered, by file and by signal or text of the line."""
    out: dict[tuple[str, str], list[int]] = defaultdict(list)
    for (file, line, kind, what), times in sorted(places.items()):
        if times:
            continue
        bit = re.match(r"(\w+)(?:\[(\d+)\])? ", what) if kind == "toggle" else None
        if bit:
            out[file, bit[1]].append(int(bit[2] or 0))
        else:
            text = (BOX / "gateware" / file).read_text(encoding="utf-8").splitlines()[line - 1].strip()
            out[file, text].append(line)
    return out


def percent(done: int, of: int) -> str:
    """A share in the words of a table."""
    return f"{100.0 * done / of:6.1f} %" if of else "       -"


def main(folder: Path) -> int:
    """Print the coverage; give the exit status."""
    places = covered(folder)
    if not places:
        sys.exit(f"{folder}: no *.dat of a chip; `make coverage` in the top folder leaves some")
    rows = sorted({place[0] for place in places})
    sys.stdout.write("file          " + "".join(f"{kind:>9}" for kind in KINDS) + "\n")
    for file in [*rows, ""]:
        cells = "".join(f"{percent(*share(places, kind, file)):>9}" for kind in KINDS)
        sys.stdout.write(f"{file or 'all':14}{cells}\n")
    bad = [kind for kind in ("line", "toggle") if (s := share(places, kind))[0] < LEAST * s[1]]
    unknown = 0
    for (file, what), at in open_places(places).items():
        reason = REASONS.get((file, what))
        unknown += reason is None
        sys.stdout.write(f"not covered: {file} {what} {at}: {reason or 'NO REASON IS KNOWN'}\n")
    return 1 if bad or unknown else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
