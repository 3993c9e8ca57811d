"""The registry: every effect by name, literally; and those of installed plug-ins."""

from rtec.effects.base import Effect
from rtec.effects.bending import BedBending, ColumnTilt
from rtec.effects.cyclic import CouplingMisalignment, CyclicPole, CyclicScrew, InterpolationError
from rtec.effects.drift import AmbientDrift, CoolantExpansion, MountExpansion
from rtec.effects.expression import Expression
from rtec.effects.friction import AngularReversal, LostMotion, ReversalSpike, Stribeck
from rtec.effects.geometry import PiecewisePosition, PolynomialPosition, Scale
from rtec.effects.guides import AngularMotion, GuideCurvature, GuideTwist, Parallelism, Squareness, Straightness
from rtec.effects.load import CrossTalk, ForceDeflection, LoadDeformation, RamSag
from rtec.effects.motion import ChangeOver, GuideLift, Inertia, ServoLag, ServoPhase
from rtec.effects.plugins import plug_ins
from rtec.effects.reversal import Backlash, BacklashLoad, BacklashPosition, BacklashTemperature, BacklashWear
from rtec.effects.spindle import SpindleGrowth, SpindleSpeedShift, SpindleTilt
from rtec.effects.thermal import AxisExpansion, AxisExpansionNonuniform
from rtec.effects.time_data import NOT_EFFECTS, DailyDrift, MissedCounts, WearDrift
from rtec.errors import ModelError
from rtec.tomlfile import nearest

EFFECTS: dict[str, type[Effect]] = {
    "scale": Scale,
    "polynomial_position": PolynomialPosition,
    "piecewise_position": PiecewisePosition,
    "cyclic_screw": CyclicScrew,
    "coupling_misalignment": CouplingMisalignment,
    "interpolation_error": InterpolationError,
    "cyclic_pole": CyclicPole,
    "straightness": Straightness,
    "squareness": Squareness,
    "parallelism": Parallelism,
    "angular_motion": AngularMotion,
    "guide_curvature": GuideCurvature,
    "guide_twist": GuideTwist,
    "backlash": Backlash,
    "backlash_position": BacklashPosition,
    "backlash_wear": BacklashWear,
    "backlash_load": BacklashLoad,
    "backlash_temperature": BacklashTemperature,
    "angular_reversal": AngularReversal,
    "servo_lag": ServoLag,
    "servo_phase": ServoPhase,
    "change_over": ChangeOver,
    "lost_motion": LostMotion,
    "reversal_spike": ReversalSpike,
    "stribeck": Stribeck,
    "guide_lift": GuideLift,
    "inertia": Inertia,
    "axis_expansion": AxisExpansion,
    "axis_expansion_nonuniform": AxisExpansionNonuniform,
    "mount_expansion": MountExpansion,
    "spindle_growth": SpindleGrowth,
    "spindle_speed_shift": SpindleSpeedShift,
    "spindle_tilt": SpindleTilt,
    "column_tilt": ColumnTilt,
    "bed_bending": BedBending,
    "ambient_drift": AmbientDrift,
    "coolant_expansion": CoolantExpansion,
    "ram_sag": RamSag,
    "cross_talk": CrossTalk,
    "load_deformation": LoadDeformation,
    "force_deflection": ForceDeflection,
    "daily_drift": DailyDrift,
    "wear_drift": WearDrift,
    "missed_counts": MissedCounts,
    "expression": Expression,
}

FAMILIES: dict[str, tuple[str, ...]] = {
    "geometry": (
        "scale", "polynomial_position", "piecewise_position", "cyclic_screw", "coupling_misalignment",
        "interpolation_error", "cyclic_pole", "straightness", "squareness", "parallelism", "angular_motion",
        "guide_curvature", "guide_twist",
    ),
    "reversal": (
        "backlash", "backlash_position", "backlash_wear", "backlash_load", "backlash_temperature", "angular_reversal",
        "lost_motion", "reversal_spike", "stribeck",
    ),
    "motion": ("servo_lag", "servo_phase", "change_over", "guide_lift", "inertia"),
    "heat": (
        "axis_expansion", "axis_expansion_nonuniform", "mount_expansion", "spindle_growth", "spindle_speed_shift",
        "spindle_tilt", "column_tilt", "bed_bending", "ambient_drift", "coolant_expansion",
    ),
    "load": ("ram_sag", "cross_talk", "load_deformation", "force_deflection"),
    "time": ("daily_drift", "wear_drift", "missed_counts"),
    "your own": ("expression",),
}  # fmt: skip
"""The same names in the order in which people look for them."""

TAKEN = (*EFFECTS, *NOT_EFFECTS)
"""Names that a plug-in cannot have."""


def all_effects() -> dict[str, type[Effect]]:
    """Every effect by name: the built-in ones, then those of plug-ins that could be loaded."""
    return {**EFFECTS, **plug_ins(TAKEN).effects}


def plug_in_faults() -> dict[str, str]:
    """What is wrong with plug-ins that could not be loaded, in words, by name of the effect."""
    return dict(plug_ins(TAKEN).faults)


def effect_class(name: str, where: str) -> type[Effect]:
    """Give the class of an effect.

    Raises:
        ModelError: there is none of that name, and the message has the nearest; it is no effect but what an
            instrument or its readings do; or it is a plug-in's that could not be loaded, and the message says why.
    """
    if name in EFFECTS:  # plug-ins are not looked for where none is needed
        return EFFECTS[name]
    if name in NOT_EFFECTS:
        raise ModelError(
            f"{where}: {name!r} is no error of the machine, a model cannot hold it: {NOT_EFFECTS[name].reveal}"
        )
    found = plug_ins(TAKEN)
    if name in found.effects:
        return found.effects[name]
    if name in found.faults:
        raise ModelError(f"{where}: effect {name!r} of a plug-in: {found.faults[name]}")
    near = nearest(name, all_effects())
    installed = "" if "did you mean" in near else " (if it is of a plug-in, install its package here)"
    raise ModelError(f"{where}: no effect {name!r}{installed}{near}")
