"""What all pictures share: colours, the figure, how it is written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from optloc.errors import InvalidProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLACK, BLUE, ORANGE, GREY = "#000000", "#0072B2", "#D55E00", "#999999"
GREEN, SKY, PURPLE, YELLOW = "#009E73", "#56B4E9", "#CC79A7", "#E69F00"


def figure_class() -> type[Figure]:
    """Return matplotlib's figure; raise InvalidProblem where it is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "plot", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure


def save(figure: Figure, path: Path) -> None:
    """Write a picture; the ending of the name decides the type."""
    figure.savefig(path, dpi=120)
