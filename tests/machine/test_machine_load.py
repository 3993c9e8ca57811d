"""Machine files: every fault has a message that names file, section and key. Oracle: the texts written here."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from rtec.errors import ConfigError
from rtec.machine import load_machine, machine_from
from tests.support.machines import turning_centre

CONFIGS = Path(__file__).parents[2] / "configs" / "machines"
Table = dict[str, Any]


def good() -> Table:
    return {
        "machine": {"name": "m", "tool_chain": ["Z", "X", "tool"], "work_chain": ["spindle"]},
        "axis": {
            "X": {"direction": "X", "travel_mm": [0.0, 200.0], "counts_per_mm": 1000.0},
            "Z": {"direction": "Z", "travel_mm": [0.0, 400.0], "counts_per_mm": 1000.0},
        },
        "link": {"tool": {"offset_mm": [120.0, 0.0, 80.0]}},
        "temperature": {"T_bed": {"range_degc": [5.0, 50.0]}},
    }


def changed(change: Callable[[Table], object]) -> Table:
    data = deepcopy(good())
    change(data)
    return data


def put(*path: Any) -> Callable[[Table], None]:
    """Put the last of `path` at the place named by the others."""

    def change(data: Table) -> None:
        place: Any = data
        for key in path[:-2]:
            place = place.setdefault(key, {})
        place[path[-2]] = path[-1]

    return change


def drop(*path: str) -> Callable[[Table], None]:
    def change(data: Table) -> None:
        place = data
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


AXIS_Q = {"direction": "Y", "travel_mm": [0.0, 1.0], "counts_per_mm": 1000}
FAULTS: list[tuple[Callable[[Table], object], str]] = [
    (put("axes", {}), "unknown key 'axes'; did you mean 'axis'?"),
    (put("axis", "X", "travel", [0.0, 1.0]), "[axis.X] unknown key 'travel'; did you mean 'travel_mm'?"),
    (put("machine", "zzz", 1), "[machine] unknown key 'zzz'; allowed: name, tool_chain, work_chain"),
    (put("link", "tool", "ofset_mm", [0, 0, 0]), "[link.tool] unknown key 'ofset_mm'; did you mean 'offset_mm'?"),
    (
        put("temperature", "T_bed", "range", [0, 1]),
        "[temperature.T_bed] unknown key 'range'; did you mean 'range_degc'?",
    ),
    (drop("machine"), "key 'machine' is missing"),
    (drop("axis", "X", "counts_per_mm"), "[axis.X] key 'counts_per_mm' is missing"),
    (put("machine", "name", ""), "[machine] name: String should have at least 1 character, found ''"),
    (
        put("axis", "X", "counts_per_mm", "many"),
        "[axis.X] counts_per_mm: Input should be a valid number, found 'many'",
    ),
    (
        put("axis", "X", "counts_per_mm", "1000"),
        "[axis.X] counts_per_mm: Input should be a valid number, found '1000'",
    ),
    (put("axis", "X", "counts_per_mm", True), "[axis.X] counts_per_mm: Input should be a valid number, found True"),
    (put("machine", 3), "[machine] must be a table, found 3"),
    (put("axis", "X", 3), "[axis.X] must be a table, found 3"),
    (
        put("axis", "X", "travel_mm", [0.0, "b"]),
        "[axis.X] travel_mm[1]: Input should be a valid number, found 'b'",
    ),
    (put("axis", "X", "travel_mm", [0.0]), "[axis.X] travel_mm: has 1 value, and 2 are needed"),
    (
        put("link", "tool", "offset_mm", [0, 0, 0, 0]),
        "[link.tool] offset_mm: Tuple should have at most 3 items after validation, not 4",
    ),
    (put("axis", "X", "counts_per_mm", 0), "[axis.X] counts_per_mm: must be from 0.001 to 1e+08, found 0"),
    (put("axis", "X", "pitch_mm", -5.0), "[axis.X] pitch_mm: must be from 1e-06 to 100000, found -5.0"),
    (
        put("axis", "X", "counts_per_mm", float("nan")),
        "[axis.X] counts_per_mm: Input should be a finite number, found nan",
    ),
    (
        put("link", "tool", "offset_mm", [0.0, float("inf"), 0.0]),
        "[link.tool] offset_mm[1]: Input should be a finite number, found inf",
    ),
    (put("axis", "X", "direction", "x"), "[axis.X] direction: Input should be 'X', 'Y' or 'Z', found 'x'"),
    (
        put("axis", "C", {"direction": "C", "travel_mm": [0.0, 360.0], "counts_per_mm": 1000}),
        "[axis.C] direction: rotary axes are not modelled (leave it out, and keep it at one angle while measuring), "
        "found 'C'",
    ),
    (
        put("axis", "X", "kind", "rotary"),
        "[axis.X] kind: rotary axes are not modelled (leave it out, and keep it at one angle while measuring), "
        "found 'rotary'",
    ),
    (put("machine", "tool_chain", ["Z", "X", "tool", "X"]), "[machine] 'X' is twice in the chains"),
    (put("machine", "work_chain", ["spindle", "tool"]), "[machine] 'tool' is twice in the chains"),
    (put("axis", "Q", AXIS_Q), "[axis.Q] is in neither tool_chain nor work_chain; allowed: X, Z, spindle, tool"),
    (
        put("link", "spindel", {}),
        "[link.spindel] is in neither tool_chain nor work_chain; did you mean 'spindle'? That name in a chain has no "
        "table",
    ),
    (
        put("machine", "tool_chain", ["Z", "X", "tol"]),
        "[link.tool] is in neither tool_chain nor work_chain; did you mean 'tol'? That name in a chain has no table",
    ),
    (put("link", "X", {}), "[axis.X] and [link.X]: a link moves or is fixed, not both"),
    (
        put("machine", "tool_chain", []),
        "[machine] tool_chain is empty; it names the links from the base to the tool tip",
    ),
    (put("axis", {}), "[axis] no axis is described"),
    (put("axis", "X", "direction", "Z"), "[axis] X and Z both correct Z; set compensate = false for all but one"),
    (put("temperature", "x", {}), "[temperature.x] channel 'x' is already [axis.X]"),
    (put("temperature", "d_x", {}), "[temperature.d_x] channel 'd_x' is already [axis.X]"),
    (
        put("temperature", "spindle_rpm", {}),
        "[temperature.spindle_rpm] channel 'spindle_rpm' is already a channel of every machine",
    ),
    (put("temperature", "pi", {}), "[temperature.pi] channel 'pi' is already a channel of every machine"),
    (put("temperature", "T bed", {}), "[temperature.T bed] a name is letters, digits and _, and starts with a letter"),
    (
        put("machine", "work_chain", ["__import__('os')"]),
        "[machine] link name \"__import__('os')\" is letters, digits and _",
    ),
    (
        put("axis", "X", "travel_mm", [200.0, 0.0]),
        "[axis.X] travel_mm [200.0, 0.0]: the first must be below the second",
    ),
    (
        put("temperature", "T_bed", "range_degc", [5.0, 5.0]),
        "[temperature.T_bed] range_degc [5.0, 5.0]: the first must be below the second",
    ),
]


@pytest.mark.parametrize(("change", "message"), FAULTS, ids=[f[1][:60] for f in FAULTS])
def test_each_fault_has_its_message(change: Callable[[Table], object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        machine_from(changed(change), "f.toml")
    assert f"f.toml: {message}" in str(caught.value).splitlines()


def test_two_axes_whose_channels_are_one() -> None:
    data = changed(put("axis", "x", {"direction": "Y", "travel_mm": [0, 1], "counts_per_mm": 1}))
    data["machine"]["tool_chain"] = ["Z", "X", "x", "tool"]
    with pytest.raises(ConfigError, match=r"f.toml: \[axis.x\] channel 'x' is already \[axis.X\]"):
        machine_from(data, "f.toml")


def test_all_faults_of_a_file_at_once() -> None:
    """Those of the form come together, and those of the sense come together once the form is right."""
    data = changed(put("axis", "X", "travel", 1))
    put("machine", "nam", "a")(data)
    drop("axis", "Z", "travel_mm")(data)
    with pytest.raises(ConfigError) as caught:
        machine_from(data, "f.toml")
    assert len(str(caught.value).splitlines()) == 3
    data = changed(put("axis", "X", "travel_mm", [5.0, 1.0]))
    put("temperature", "x", {})(data)
    put("machine", "work_chain", ["spindle", "spindle"])(data)
    put("axis", "Q", AXIS_Q)(data)
    with pytest.raises(ConfigError) as caught:
        machine_from(data, "f.toml")
    assert len(str(caught.value).splitlines()) == 4
    assert all(line.startswith("f.toml: [") for line in str(caught.value).splitlines())


def write(folder: Path, content: bytes) -> Path:
    path = folder / "m.toml"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'[machine]\nname = "\xff"\n', "not UTF-8 text (byte 18)"),
        (b"[machine\n", "not valid TOML: Expected ']' at the end of a table declaration (at line 1, column 9)"),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"a = " + b"9" * 5000, "not valid TOML: Exceeds the limit"),
        (b"a = 1\na = 2\n", "not valid TOML: Cannot overwrite a value (at line 2, column 6)"),
        (
            b"a = 1\nb = -5,25  # mm\n",
            "not valid TOML: Expected newline or end of document after a statement (at line 2, column 7); a decimal "
            "mark is a point: -5.25",
        ),
        (b"", "key 'machine' is missing"),
    ],
    ids=["not utf-8", "not toml", "nested", "number", "twice", "comma", "empty"],
)
def test_files_that_are_no_machine(tmp_path: Path, content: bytes, message: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(ConfigError) as caught:
        load_machine(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone.toml: no such file$"):
        load_machine(tmp_path / "gone.toml")
    with pytest.raises(ConfigError, match=r"is a folder, not a file$"):
        load_machine(tmp_path)
    inside = write(tmp_path, b"") / "m.toml"
    with pytest.raises(ConfigError, match=r"m.toml/m.toml: cannot be read: Not a directory$"):
        load_machine(inside)


def test_a_file_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    with path.open("wb") as file:
        file.truncate(65 * 2**20)  # a hole; takes no room
    with pytest.raises(ConfigError, match="larger than 64 MiB, which no configuration is"):
        load_machine(path)


def test_a_file_is_the_machine_that_it_describes(tmp_path: Path) -> None:
    """Oracle: `machine_from` on the same tables; and the hash does not hang on formatting or on key order."""
    path = write(tmp_path, tomli_w.dumps(good()).encode())
    m = load_machine(path)
    assert m == machine_from(good(), "elsewhere")
    other = tmp_path / "other.toml"
    turned = {k: good()[k] for k in reversed(good())}
    other.write_text("# a comment\n" + tomli_w.dumps(turned), encoding="utf-8")
    assert load_machine(other).hash == m.hash
    assert machine_from(changed(put("axis", "X", "pitch_mm", 5.0)), "m").hash != m.hash
    assert machine_from(changed(put("link", "spindle", {"offset_mm": [0, 0, 1e-9]})), "m").hash != m.hash


def test_links_that_only_a_chain_names_stand_at_no_offset() -> None:
    m = machine_from(good(), "m")
    assert m.links["spindle"].offset_mm == (0.0, 0.0, 0.0)
    assert set(m.links) == {"spindle", "tool"}
    assert m.axis("X").dead_band_counts == 2
    assert m.axis("X").direction_channel == "d_x"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.name)
def test_shipped_machines_load(path: Path) -> None:
    m = load_machine(path)
    assert m.chain.terms.shape == (3, len(m.components), 1 + len(m.axes))
    assert len(m.hash) == 64


def test_there_are_shipped_machines() -> None:
    assert "turning-centre.toml" in {p.name for p in CONFIGS.glob("*.toml")}
    assert turning_centre().hash == turning_centre().hash
