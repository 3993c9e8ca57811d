"""A doubt about the record: what to correct, or to measure differently, before an effect is blamed."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "wrong_scale", "wrong_gain", "wrong_channel", "swapped_sensors", "moved_origin", "wrong_pitch", "contradiction",
    "corrected", "moved_zero", "end_targets", "other_machine", "one_pass", "few_runs", "no_temperature", "other_sensor",
    "instrument_warm_up", "between_files", "dead_sensor", "turned_axis", "late_temperatures", "lost_sensor",
    "unexplained", "two_levels", "few_targets", "too_few", "cycle", "not_read", "swapped_axes", "wrong_direction",
    "wrong_rate", "far_temperatures", "outside_travel", "scatter", "beyond_materials", "swapped_readings",
    "beam_in_air", "sensor_offset", "warm_start", "changed_delay", "late_sensor",
    "pre_travel",
]  # fmt: skip
BLAMES_NO_EFFECT: frozenset[Kind] = frozenset(
    {
        "wrong_scale",
        "wrong_gain",
        "wrong_channel",
        "swapped_sensors",
        "moved_origin",
        "turned_axis",
        "late_temperatures",
        "lost_sensor",
        "contradiction",
        "corrected",
        "instrument_warm_up",
        "moved_zero",
        "two_levels",
        "between_files",
        "dead_sensor",
        "not_read",
        "swapped_axes",
        "swapped_readings",
        "wrong_direction",
        "wrong_rate",
        "far_temperatures",
        "outside_travel",
        "beyond_materials",
    }
)
"""Doubts beside which no effect of the machine is named."""
DECIDES_NOTHING: frozenset[Kind] = BLAMES_NO_EFFECT | {
    "no_temperature",
    "end_targets",
    "few_targets",
    "too_few",
    "cycle",
    "unexplained",
    "scatter",
}
"""Doubts beside which it is undetermined whether an effect is missing."""
BESIDE_A_NAME: frozenset[Kind] = frozenset({"beam_in_air", "not_read", "warm_start", "late_temperatures", "pre_travel"})
"""Doubts that the answer adds to a named effect: something else may cause the same."""
CHANGES_SLOWLY: frozenset[Kind] = frozenset({"instrument_warm_up", "no_temperature", "beyond_materials"})
"""Doubts about a change over hours, which moves the readings of both directions alike."""

ALONE = "If the machine changed between them, diagnose the newer file alone."


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt the record.

    Attributes:
        kind: kind of the doubt.
        message: in words.
        next_step: what the user should do.
        fatal: whether it precedes every answer.
    """

    kind: Kind
    message: str
    next_step: str
    fatal: bool = False

    @property
    def words(self) -> str:
        """Message and next step."""
        return f"{self.message} {self.next_step}".strip()

    @property
    def blames_no_effect(self) -> bool:
        """Whether no effect of the machine is named beside it."""
        return self.fatal and self.kind in BLAMES_NO_EFFECT

    @property
    def changes_slowly(self) -> bool:
        """Whether it is about a change over hours, which feigns no reversal."""
        return self.kind in CHANGES_SLOWLY

    @property
    def decides_nothing(self) -> bool:
        """Whether it is undetermined beside it if an effect is missing."""
        return self.kind in DECIDES_NOTHING and (self.fatal or self.kind != "outside_travel")
