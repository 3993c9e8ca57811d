"""The figure of `rtec hil`: tip error over time, with the faults; style and colours as in `figures`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import GREY, KINDS, _figure, _png, _styled

Floats = NDArray[np.float64]
MOST_DOTS = 4000
FAULT = "#F0E442"


@_styled
def tip_errors(
    time_s: Floats, panels: Sequence[tuple[str, Floats, Floats]], faults: Sequence[tuple[str, float, float]]
) -> bytes:
    """One panel a direction, uncorrected and corrected; a band for every fault, with its name in the first panel.

    Args:
        time_s: (n,).
        panels: direction, then uncorrected and corrected error, µm, (n,); NaN where there is none.
        faults: name, begin, end, s.
    """
    figure, axes = _figure(len(panels), 4.2)
    thin = slice(None, None, max(1, len(time_s) // MOST_DOTS))
    for place, (ax, (direction, *both)) in enumerate(zip(axes, panels, strict=True)):
        for name, begin_s, end_s in faults:
            ax.axvspan(begin_s, end_s, color=FAULT, alpha=0.45, linewidth=0, zorder=0)
            if place == 0:
                ax.text(begin_s, 0.99, f" {name}", rotation=90, va="top", ha="left", color=GREY, fontsize=12,
                        transform=ax.get_xaxis_transform(),
                        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8})  # fmt: skip
        for values, style, name in zip(both, KINDS, ("uncorrected", "corrected"), strict=True):
            ax.plot(time_s[thin], values[thin], color=style["color"], linestyle=style["linestyle"], label=name)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(f"Tool-tip error in {direction}, behind real buses")
        ax.set_ylabel("error, µm")
        ax.set_xlim(0.0, float(time_s[-1]))
        ax.legend(frameon=True, facecolor="white", framealpha=0.9, fontsize=12, loc="best")
    axes[-1].set_xlabel(
        "seconds since the machine began; yellow: a fault is on" if faults else "seconds since the machine began"
    )
    return _png(figure)
