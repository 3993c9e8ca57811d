"""The hidden effects: every effect of the catalogue that a measurement of nine hours can show.

None is shaped as the program's formulas are (`shapes.py`). Those with a `same` are told by more than one name, for
the reason written there.

Left out, because no such measurement can show them: servo_phase and change_over (two axes on a circle),
force_deflection (no force was recorded), daily_drift and wear_drift (in one record of nine hours a day's swing or a
straight line in time cannot be told from the drift of instrument and machine), the nuisances of other instruments.
"""

from tests.discovery.generator import shapes
from tests.discovery.generator.truth import Same, Truth

LEGENDRE = "a curve over one position: the same polynomials under another name"
GROWTH = "k·ΔT of one sensor: the same formula for a fixed link"
ANGLE = "an angle over one position: straight or curved line, the same polynomials"
LINE = "a constant angle of a line of travel is a straightness error growing along it"

POLYNOMIAL = Same("polynomial_position", LEGENDRE)

TRUTHS: tuple[Truth, ...] = (
    Truth(
        "scale", "laser", "E{a}{a}", shapes.scale, ("scale",), (Same("polynomial_position", "degree one is the scale"),)
    ),
    Truth("polynomial_position", "laser", "E{a}{a}", shapes.curve, ("curve",)),
    Truth("piecewise_position", "laser", "E{a}{a}", shapes.bumpy),
    Truth("cyclic_screw", "laser", "E{a}{a}", shapes.revolution),
    Truth("coupling_misalignment", "laser", "E{a}{a}", shapes.half_revolution),
    Truth("interpolation_error", "laser", "E{a}{a}", shapes.fine),
    Truth("cyclic_pole", "laser", "E{a}{a}", shapes.tooth),
    Truth("straightness", "straightness", "E{c}{a}", shapes.bow, ("curve",), (POLYNOMIAL,)),
    Truth(
        "squareness",
        "tool_tip",
        "EC0Y",
        shapes.constant,
        ("EC0Y",),
        (
            Same("parallelism", LINE),
            Same("polynomial_position", LINE, "EXY"),
            Same("straightness", LINE, "EXY"),
        ),
    ),
    Truth(
        "parallelism",
        "tool_tip",
        "EB0Z",
        shapes.constant,
        ("EB0Z",),
        (
            Same("squareness", LINE),
            Same("polynomial_position", LINE, "EXZ"),
            Same("straightness", LINE, "EXZ"),
        ),
    ),
    Truth("angular_motion", "angular", "E{c}{a}", shapes.tilt, ("curve",), (Same("polynomial_position", ANGLE),)),
    Truth(
        "guide_curvature",
        "angular",
        "E{c}{a}",
        shapes.bent_guide,
        ("slope",),
        (Same("angular_motion", ANGLE), Same("polynomial_position", ANGLE), Same("guide_twist", ANGLE)),
    ),
    Truth(
        "guide_twist",
        "tool_tip",
        "EAX",
        shapes.twisted,
        (),
        (Same("angular_motion", ANGLE), Same("polynomial_position", ANGLE), Same("guide_curvature", ANGLE)),
    ),
    Truth("backlash", "laser", "E{a}{a}", shapes.lost, ("backlash",)),
    Truth(
        "backlash_position",
        "laser",
        "E{a}{a}",
        shapes.worn_zone,
        (),
        (Same("backlash_zone", "both describe play that is larger in one length of the axis"),),
    ),
    Truth("backlash_wear", "laser", "E{a}{a}", shapes.backlash_grows),
    Truth("backlash_load", "laser", "E{a}{a}", shapes.backlash_loaded),
    Truth("backlash_temperature", "laser", "E{a}{a}", shapes.backlash_warm),
    Truth(
        "angular_reversal",
        "angular",
        "E{c}{a}",
        shapes.rocking,
        (),
        (Same("backlash", "a reversal value of an angle"),),
    ),
    Truth("servo_lag", "laser", "E{a}{a}", shapes.lagging),
    Truth("lost_motion", "laser", "E{a}{a}", shapes.presliding),
    Truth("reversal_spike", "laser", "E{a}{a}", shapes.spike),
    Truth("stribeck", "laser", "E{a}{a}", shapes.friction),
    Truth("guide_lift", "straightness", "EZ{a}", shapes.floats_up, axes="XY"),
    Truth("inertia", "laser", "E{a}{a}", shapes.heavy),
    Truth("axis_expansion", "laser", "E{a}{a}", shapes.screw_grows, ("expansion",)),
    Truth(
        "mount_expansion",
        "straightness",
        "E{c}{a}",
        shapes.mount_grows,
        ("mount",),
        (Same("spindle_growth", GROWTH, "E{c}0spindle"),),
    ),
    Truth("axis_expansion_nonuniform", "laser", "E{a}{a}", shapes.screw_bulges),
    Truth(
        "spindle_growth",
        "drift",
        "EZ0spindle",
        shapes.spindle_grows,
        ("growth",),
        (Same("mount_expansion", GROWTH, "", ("T_spindle",)),),
    ),
    Truth("spindle_speed_shift", "drift", "EZ0spindle", shapes.spindle_shifts),
    Truth(
        "spindle_tilt",
        "drift",
        "EB0spindle",
        shapes.spindle_tilts,
        (),
        (Same("mount_expansion", GROWTH, "", ("T_spindle",)),),
    ),
    Truth(
        "column_tilt",
        "tool_tip",
        "EA0column",
        shapes.column_leans,
        (),
        tuple(
            Same("column_tilt", "a turn about X, wherever its centre: the arms differ by a constant", c)
            for c in ("EA0spindle", "EA0Z", "EAX", "EAY", "EAZ")
        ),
    ),
    Truth("bed_bending", "straightness", "EZ{a}", shapes.bed_bends, axes="XY"),
    Truth(
        "ambient_drift",
        "drift",
        "EX0spindle",
        shapes.shop,
        (),
        (
            Same("mount_expansion", "the same lag of the same sensor", "", ("T_air",)),
            Same("spindle_growth", "the same lag of the same sensor", "", ("T_air",)),
        ),
    ),
    Truth(
        "coolant_expansion",
        "drift",
        "EZ0spindle",
        shapes.coolant,
        (),
        (
            Same("mount_expansion", GROWTH, "", ("T_coolant",)),
            Same("spindle_growth", GROWTH, "", ("T_coolant",)),
        ),
    ),
    Truth(
        "ram_sag",
        "straightness",
        "E{c}Z",
        shapes.ram,
        ("curve",),
        (POLYNOMIAL, Same("straightness", LEGENDRE)),
        axes="Z",
    ),
    Truth("cross_talk", "angular", "E{c}{a}", shapes.crossed),
    Truth("load_deformation", "straightness", "EZ{a}", shapes.bends_under, axes="XY"),
    Truth("missed_counts", "laser", "E{a}{a}", shapes.slipped),
)
