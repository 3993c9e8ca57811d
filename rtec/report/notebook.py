"""A figure that a notebook displays even if pyplot is not imported."""

from io import BytesIO

from matplotlib.figure import Figure


class ShownFigure(Figure):
    """matplotlib's figure with a PNG for the cell of a notebook."""

    def _repr_png_(self) -> bytes:
        out = BytesIO()
        self.savefig(out, format="png", dpi=72)
        return out.getvalue()
