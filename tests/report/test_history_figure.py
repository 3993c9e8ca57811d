"""The staircase of the error: a logarithmic axis, each step's number, and the noise floor named beside its line."""

import numpy as np
import pytest
from matplotlib.text import Annotation, Text

from rtec.diagnosis.extend.add import Added, refused
from rtec.diagnosis.extend.history import Errors
from rtec.diagnosis.extend.improve import Improved
from rtec.model import Model
from rtec.model.history import History, steps_of
from rtec.report.history import Present, Stairs, _why_ended, history_page, staircase, stairs, stairs_to
from rtec.studio.parts.figures import staircase as on_page
from tests.support.diagnosis_examples import small_machine
from tests.support.figures import drawn, overlapping

NAMES = ["as it was", "angular_reversal(EBX, X)", "axis_expansion_nonuniform(EXX, X, T_x_nut)"]
LONG = ["as it was", *(["axis_expansion_nonuniform(EXX, X, T_x_nut)", "backlash(EXX, X)"] * 4)]

LATE = ["as it was", "axis_expansion(EZZ, Z, T_xnut)", "axis_expansion(EZZ, Z, T_znut), 11 min late",
        "spindle_growth(EZ0spindle, T_front, T_rear), 2.5 h late",
        "cyclic_screw(EZZ, Z), harmonics 2, pitch 10.02"]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "errors", "floor"),
    [
        (NAMES, [3.32, 0.588, 0.252], 0.245),
        (LONG, [33.2, 20.1, 9.5, 9.6, 4.1, 3.1, 2.1, 1.3, 1.02], 1.0),
        (NAMES[:2], [0.031, 0.029], 0.03),
        (NAMES[:2], [250.0, 3.0], None),
        (NAMES[:2], [120000.0, 3.0], 0.8),
        (LATE, [5.2, 3.1, 2.0, 1.4, 1.1], 1.0),
        (["as it was", *NAMES[2:] * 20], [100.0 * 0.8**k for k in range(21)], 0.5),
    ],
)
def test_steps_and_floor_have_room(names: list[str], errors: list[float], floor: float | None) -> None:
    """Oracle: boxes of the texts as laid out; heights of the steps as given."""
    figure = drawn(staircase, "µm", names, errors, floor)
    (ax,) = figure.axes
    assert ax.get_yscale() == "log"
    assert ax.get_ylabel() == "residual on held-out runs, rms, µm"
    steps = [np.asarray(line.get_ydata())[0] for line in ax.get_lines()][: len(errors)]
    assert steps == pytest.approx(errors)
    texts = [t for t in ax.texts if t.get_text()]
    assert not overlapping([*texts, ax.title])
    label = [t for t in texts if t.get_text().startswith("noise floor")]
    assert len(label) == (floor is not None)
    for text in label:
        # Beside the panel: neither its own line nor a step can run through it.
        assert text.get_window_extent().x0 > ax.get_window_extent().x1
    names_below: list[Text] = list(ax.get_xticklabels())
    assert 5 < len(names) < 10 or not overlapping(names_below)


@pytest.mark.parametrize("errors", [[0.33], [0.33, 1.52], [0.031, 0.029], [120.0, 90.0]])
def test_a_scale_has_at_least_two_numbers(errors: list[float]) -> None:
    """Oracle: the ticks as laid out, and those of the page; the floor is named in the page, too."""
    floor = 0.88 * min(errors)
    (ax,) = drawn(staircase, "µm", ["fit", "now, these measurements"][: len(errors)], errors, floor).axes
    low, high = ax.get_ylim()
    assert len([t for t in ax.get_yticks() if low <= t <= high]) >= 2
    page = on_page(Stairs(["fit", "now"][: len(errors)], errors, floor, "um", 0, ends_now=len(errors) > 1))["layout"]
    low, high = (10.0**v for v in page["yaxis"]["range"])
    assert len([t for t in page["yaxis"]["tickvals"] if low <= t <= high]) >= 2
    assert [a["text"] for a in page["annotations"]] == [f"noise floor {floor:.2f} µm"]


def test_the_present_residual_is_beside_the_steps() -> None:
    """Oracle: by hand: 1.52 µm of other measurements, the fit left 0.33; an undone step is not the present one."""
    steps = steps_of(Model(small_machine(), history=({"change": "fit", "rms_held_out": 0.33, "unit": "um"},)))
    other = stairs_to(Present(1.52, 0.29, "um"), steps)
    assert other == Stairs(["fit", "now, these measurements"], [0.33, 1.52], 0.29, "um", 0, ends_now=True)
    same = stairs_to(Present(0.34, 0.29, "um"), steps)
    assert same == Stairs(["fit"], [0.33], 0.29, "um", 0)
    angles = stairs_to(Present(2.0, None, "urad"), steps)
    assert angles == Stairs(["now, these measurements"], [2.0], None, "urad", 0, ends_now=True)
    assert stairs_to(None, []) is None


def test_an_arrow_for_each_fall_and_none_for_a_rise() -> None:
    """Oracle: counted by hand."""
    (ax,) = drawn(staircase, "µm", ["a", "b", "c", "d"], [4.0, 2.0, 2.1, 1.0], None).axes
    arrows = [t for t in ax.texts if isinstance(t, Annotation) and t.arrow_patch is not None]
    assert [(a.xy, a.xyann) for a in arrows] == [((1, 2.0), (1, 4.0)), ((3, 1.0), (3, 2.1))]


def entry(name: str, before: float | None, after: float, measurements: list[str]) -> dict[str, object]:
    """As a model keeps it."""
    out: dict[str, object] = {"effects": [name], "rms_after": after, "noise_floor": 0.25, "unit": "um",
                              "measurements": measurements}  # fmt: skip
    return out if before is None else {**out, "rms_before": before}


def test_stairs_begin_anew_where_other_measurements_begin() -> None:
    """Oracle: by hand: 1.62 µm of one laser and 3.32 µm of two cannot stand on one staircase."""
    history = [
        entry("fit", None, 1.62, ["x"]),
        entry("angular_reversal", 3.32, 0.57, ["beside", "x"]),
        entry("expansion", 0.57, 0.30, ["beside", "x"]),
    ]
    model = Model(small_machine(), history=tuple(history))
    lead = history_page(History(model=model), figures=False).lead
    assert lead == "3 changes: the residual on held-out runs fell from 3.32 to 0.30 µm."
    names, errors, floor = stairs(steps_of(model))
    assert names == ["before, same measurements", "angular_reversal", "expansion"]
    assert errors == pytest.approx([3.32, 0.57, 0.30])
    assert floor == 0.25
    names, errors, _ = stairs(steps_of(Model(small_machine(), history=tuple(history[:1]))))
    assert (names, errors) == (["fit"], [1.62])


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("a(EXX)", "b(EXX)"), "these readings determine only what a(EXX) and b(EXX) make together"),
        (("a(EXX)",), "these readings do not determine a(EXX) beside the other effects of the model"),
    ],
)
def test_what_is_not_determined_is_not_said_of_one_thing_together(names: tuple[str, ...], said: str) -> None:
    """Oracle: one thing makes nothing "together"; the other is in the model already."""
    model, errors = Model(small_machine()), Errors(1.0, 1.0, 1.0, 1.0)
    assert _why_ended(Improved(model, (), (), "no_gain", cancelling=names)) == said
    assert refused(Added(model, names, errors, errors, 1.0, "um", False, 1.0, undetermined=names)).startswith(said)
