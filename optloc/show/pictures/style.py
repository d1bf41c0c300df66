"""Common parts of all pictures: colours, units of axes, parts of plans, alternative texts and image files.

A plan is drawn in a unit of `size` metres: coordinates in metres are divided by `size`.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.linalg import error_ellipse
from optloc.base.outputs import visible, written
from optloc.base.types import Array
from optloc.show.pictures.scene import ELLIPSES, FEW_FIXES, PictureScene, View

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Palette of Okabe and Ito: distinct with any colour vision, and by lightness in grey print.
BLACK, BLUE, ORANGE, GREY = "#000000", "#0072B2", "#D55E00", "#999999"
GREEN, SKY, PURPLE, YELLOW = "#009E73", "#56B4E9", "#CC79A7", "#E69F00"

# Largest width of a picture, inches, and size of its small texts, points. On a page of 700 pixels such a picture has
# texts of 9 pixels or more.
WIDE, SMALL = 9.6, 9.0
# Maximum number of stations with names: more names would overlap.
_NAMED = 20
# A cost gap below this is printed as "+0": both positions fit the data equally well.
_NO_GAP = 1e-3
# Corners of an ellipse: finer than the pixels of a picture.
_CORNERS = 181
# A plan is in kilometres if its largest coordinate is at least this, m.
_FAR = 5e3


def figure_class() -> type[Figure]:
    """Return the class of figures, which notebooks show; raise InvalidProblem if matplotlib is not installed."""
    try:
        from optloc.show.pictures.notebook_figure import NotebookFigure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "plot", "install it with: pip install 'optloc[plot]'"
        ) from None
    return NotebookFigure


def axes_or_new(ax: Axes | None, width: float = 6.4, height: float = 5.6) -> Axes:
    """Return `ax`, or the axes of a new figure of pyplot, which notebooks show below their cell.

    `width` and `height` of the figure are in inches.
    """
    figure_class()  # raises one clear error without matplotlib
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    _, made = plt.subplots(figsize=(width, height), layout="constrained")
    return made


def fix_limits(panel: Axes) -> None:
    """Lay out the figure of a plan, and keep its limits: notes and insets depend on them."""
    part: Any = panel.figure
    # The figure of a part of a figure is the whole figure.
    part.figure.draw_without_rendering()
    panel.set(xlim=panel.get_xlim(), ylim=panel.get_ylim())
    panel.set_aspect("equal", adjustable="box")


def panels_for(count: int, most: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels, at most `most` side by side; `width` and `height` of a panel in inches."""
    columns = min(count, most)
    rows = -(-count // columns)
    size = (min(0.6 + width * columns, WIDE), 0.4 + height * rows)
    figure = figure_class()(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels[:count]


# Width of a letter of a legend, inches, and the width of its handle in letters.
_LETTER, _HANDLE = 0.07, 6


def finish(figure: Figure, title: str, panels: Sequence[Axes] = (), ncols: int = 5, **style: Any) -> Figure:
    """Return the figure after adding its title and a legend below the panels, with each label of `panels` once.

    The legend has at most `ncols` columns, or fewer if they do not fit. `style` holds further options of the legend.
    """
    shown: dict[str, Any] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        for label, handle in zip(labels, handles, strict=True):
            shown.setdefault(label, handle)
    if shown:
        fit = int(figure.get_figwidth() / (_LETTER * (max(map(len, shown)) + _HANDLE)))
        ncols = max(1, min(ncols, fit))
        figure.legend(shown.values(), shown, loc="outside lower center", ncols=ncols, frameon=False, **style)
    if title:
        figure.suptitle(literal(title), wrap=True)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a picture; the ending of the file name selects the type, and without an ending the type is PNG.

    Raises
    ------
    InvalidProblem
        If the type is unknown, or the file cannot be written.
    """
    known = sorted(figure.canvas.get_supported_filetypes())
    ending = path.suffix.lower().removeprefix(".") or "png"
    if ending not in known:
        raise InvalidProblem(f"pictures of type {path.suffix!r} are unknown", str(path), nearest(ending, known))
    # Draw into memory first: then only the write below can raise an error of the disk, and that error is handled.
    drawn, title, text = BytesIO(), _title_of(figure), description(figure)
    keys = {"png": ("Title", "Description"), "svg": ("Title", "Description"), "pdf": ("Title", "Subject")}
    metadata = dict(zip(keys[ending], (title, text), strict=True)) if ending in keys else None
    figure.savefig(drawn, dpi=120, format=ending, metadata=metadata)
    image = drawn.getvalue()
    if ending == "svg":
        # Screen readers read the element `desc` after the title; matplotlib writes the text into the metadata only.
        image = image.replace(b"</title>", f"</title>\n <desc>{escape(text)}</desc>".encode(), 1)
    with written(path) as file:
        file.write_bytes(image)


def description(figure: Figure) -> str:
    """Return the alternative text of a picture: its title, and for each panel its title, axes and legend."""
    parts = [f"{_title_of(figure)}."]
    for panel in figure.axes:
        x, y, words = panel.get_xlabel(), panel.get_ylabel(), panel.get_legend_handles_labels()[1]
        text = ": ".join(each for each in (panel.get_title(), " and ".join(each for each in (x, y) if each)) if each)
        text += f" shows {', '.join(dict.fromkeys(words))}" if words else ""
        parts += [f"Panel {text}."] if text else []
    return " ".join(" ".join(parts).replace(r"\$", "$").split())


def _title_of(figure: Figure) -> str:
    """Return the title of a picture, or of its first panel with a title."""
    titles = [figure.get_suptitle(), *(panel.get_title() for panel in figure.axes)]
    return next((title for title in titles if title), "picture")


# Maximum number of letters of a title or a name in a picture.
_LETTERS = 120


def literal(text: str) -> str:
    """Return a text that matplotlib prints literally: `$` starts no formula, and a leading `_` hides no label."""
    text = visible(" ".join(text.split()))
    text = text if len(text) <= _LETTERS else f"{text[: _LETTERS - 1]}…"
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def unit_of(points: Array) -> tuple[str, float]:
    """Return the unit for axes around points (n, 2), m, and the size of the unit, m."""
    reach = np.nanmax(np.abs(points), initial=1e-3)
    return ("km", 1e3) if reach >= _FAR else ("m", 1.0) if reach >= 1.0 else ("mm", 1e-3)


def grid(panel: Axes) -> None:
    """Draw the grid of a panel."""
    panel.grid(color=GREY, alpha=0.35, linewidth=0.6)
    panel.set_axisbelow(True)


# Parts of plans: stations, fixes, alternatives, ellipses, axes with units.


def xy(points: Array, view: View, size: float) -> tuple[Array, Array]:
    """Return the two coordinates of points (n, d), m, that a panel shows, in the unit of the panel (`size` metres)."""
    return points[:, view[0]] / size, points[:, view[1]] / size


def stations(panel: Axes, scene: PictureScene, view: View, size: float, *, named: bool = True, **style: Any) -> None:
    """Draw the stations; if they are few, write their names."""
    label = "station, first epoch" if scene.tracks else "station"
    look: dict[str, Any] = {"marker": "^", "s": 60, "color": BLACK, "label": label, "zorder": 3} | style
    panel.scatter(*xy(scene.stations, view, size), **look)
    if named and scene.stations.shape[0] <= _NAMED:
        for name, x, y in zip(scene.names, *xy(scene.stations, view, size), strict=True):
            note(panel, name, x, y)


def note(panel: Axes, text: str, x: float, y: float, colour: str = BLACK) -> None:
    """Write a note next to the point x, y, in the unit of the axes, readable over lines and colours."""
    from matplotlib.patheffects import withStroke

    style: dict[str, Any] = {"fontsize": SMALL, "color": colour, "zorder": 6, "annotation_clip": True}
    made = panel.annotate(literal(text), (x, y), xytext=(5, 5), textcoords="offset points", **style)
    # A white outline keeps the text readable over lines and colours.
    made.set_path_effects([withStroke(linewidth=3.0, foreground="white")])


def points(panel: Axes, scene: PictureScene, view: View, size: float) -> None:
    """Draw fixes, and alternatives with their cost gaps."""
    many = len(scene.fixes) > FEW_FIXES
    for clean, colour, mark, label in ((True, BLUE, "o", "fix"), (False, ORANGE, "X", "fix, status not ok")):
        chosen = scene.fixes[scene.clean == clean]
        if len(chosen):
            look: dict[str, Any] = {"marker": mark, "s": 12 if many else 70, "color": colour, "zorder": 4}
            panel.scatter(*xy(chosen, view, size), label=label, **look)
    if len(scene.alternatives):
        style: dict[str, Any] = {"marker": "D", "s": 70, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.8}
        panel.scatter(*xy(scene.alternatives, view, size), label="alternative, with its cost gap", zorder=4, **style)
    for gap, x, y in zip(scene.gaps, *xy(scene.alternatives, view, size), strict=True):
        note(panel, f"+{gap:.3g}" if gap >= _NO_GAP else "+0", x, y, ORANGE)


def ellipses(panel: Axes, scene: PictureScene, view: View, size: float, **style: Any) -> None:
    """Draw the 95 % ellipses of the fixes, or the outlines of the 95 % regions if ellipses are not valid."""
    if len(scene.fixes) > ELLIPSES:
        return
    look: dict[str, Any] = {"color": BLUE, "linewidth": 1.5, "zorder": 2} | style
    seen: set[str] = set()
    outlines = scene.outlines or ({},) * len(scene.fixes)
    local = np.zeros(len(scene.fixes), dtype=bool) if scene.local is None else scene.local
    for i, (centre, covariance, regions) in enumerate(zip(scene.fixes, scene.covariances, outlines, strict=True)):
        region, place = regions.get(view), centre[list(view)]
        around = [] if region is None else [np.append(place + line, [[np.nan] * 2], axis=0) for line in region.lines]
        label = "local ellipse: not valid as 95 % region" if local[i] else "95 % ellipse"
        if region is not None:
            label = "95 % region, cut off" if region.cut else "95 % region"
        dashes = {"linestyle": ":"} if local[i] else {}
        line = np.concatenate(around) if around else place + ellipse_line(covariance[np.ix_(view, view)])
        if around or np.isfinite(line).all():
            panel.plot(*(line.T / size), **(look | dashes | {"label": None if label in seen else label}))
            seen.add(label)


def ellipse_line(covariance: Array) -> Array:
    """Return the 95 % ellipse of a covariance (2, 2), m^2, about the origin as a closed line (p, 2), m; NaN for NaN."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    semi_axes, directions = error_ellipse(covariance)
    return np.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes @ directions.T)


def name_axes(panel: Axes, scene: PictureScene, view: View, unit: str) -> None:
    """Give both axes of a plan the same scale, and write their names and their unit; `view` selects the axes."""
    panel.margins(0.12)
    # With different scales, an ellipse would have a wrong shape.
    panel.set_aspect("equal", adjustable="datalim")
    grid(panel)
    panel.set_xlabel(f"{scene.axes[view[0]]} ({unit})")
    panel.set_ylabel(f"{scene.axes[view[1]]} ({unit})")
