"""A figure of matplotlib that notebooks show without pyplot and without a magic command."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure

# Pixels per inch: the same as in picture files, so that small texts have nine pixels or more.
_RESOLUTION = 120


class NotebookFigure(Figure):
    """A figure with a PNG image for notebooks.

    A notebook shows figures of pyplot below their cell, and other figures only after pyplot is loaded. This figure
    makes its image itself, so a notebook shows it as the last value of a cell. pyplot does not store it, so a program
    need not close it.
    """

    def _repr_png_(self) -> bytes:
        """Return the PNG image that a notebook shows."""
        image = BytesIO()
        self.savefig(image, dpi=_RESOLUTION, format="png")
        return image.getvalue()
