"""The history of a model: every change, with the error on held-out runs before and after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from rtec.model.model import Model
from rtec.result import Result


@dataclass(frozen=True)
class History(Result):
    """Every change of a model.

    Attributes:
        model: the model.
    """

    page_maker: ClassVar[str] = "rtec.report.history:history_page"

    model: Model

    @property
    def steps(self) -> list[dict[str, Any]]:
        """The changes whose error on held-out runs is known, oldest first."""
        return steps_of(self.model)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {"model": self.model.name, "history": [dict(h) for h in self.model.history], "steps": self.steps}

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a step."""
        return self.steps


def steps_of(model: Model) -> list[dict[str, Any]]:
    """Entries of a model's history that have an error on held-out runs, oldest first."""
    out: list[dict[str, Any]] = []
    for entry in model.history:
        after = entry.get("rms_after", entry.get("rms_held_out"))
        if after is None:
            continue
        before = entry.get("rms_before")
        moved = bool(out) and before is not None and abs(float(before) / max(out[-1]["error"], 1e-12) - 1.0) > 0.05
        same = _same_data(entry, model, out)
        out.append(
            {
                "name": ", ".join(entry.get("effects", ())) or str(entry.get("change", "change")),
                "before": None if before is None else float(before),
                "error": float(after),
                "floor": entry.get("noise_floor"),
                "unit": str(entry.get("unit", "um")),
                "measurements": sorted(entry.get("measurements", ())),
                "inside": entry.get("rms_inside"),
                "beyond_drift": (entry.get("beyond_drift_before"), entry.get("beyond_drift_after")),
                "other_data": moved and not same,
                "noise_anew": moved and same,
                "passed_over": [dict(r) for r in entry.get("passed_over", ())],
            }
        )
    return out


def _same_data(entry: Mapping[str, Any], model: Model, before: Sequence[Mapping[str, Any]]) -> bool:
    """Whether an entry's errors are from the same measurements as those of the entry before."""
    if not before:
        return False
    if "same_measurements" in entry:
        return bool(entry["same_measurements"])
    now, last = sorted(entry.get("measurements", ())), before[-1]
    # A fit does not name its measurements; if the model has no others, they are those of this entry.
    return now == (last["measurements"] or sorted(model.measurements))


def rescaled(steps: Sequence[Mapping[str, Any]]) -> list[float]:
    """Errors after each step, all in the unit of the last one.

    Where errors are multiples of the noise, a step may re-estimate it: a model that lacks much takes part of its error
    for noise. The error before a step and the error after the previous one are the same, which gives the factor.
    """
    out = [float(s["error"]) for s in steps]
    for i in range(len(steps) - 1, 0, -1):
        s = steps[i]
        if s["unit"] == "noise" and s["noise_anew"] and steps[i - 1]["unit"] == "noise":
            factor = s["before"] / max(steps[i - 1]["error"], 1e-12)
            out[:i] = [v * factor for v in out[:i]]
    return out
