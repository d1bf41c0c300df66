"""Pictures of a track in one axes, as the method `plot` returns them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.problem.problem import Problem
from optloc.show.pictures.notes import scale_bar, separate_notes
from optloc.show.pictures.style import SMALL, axes_or_new, fix_limits, grid, literal
from optloc.show.pictures.time_axes import time_scale
from optloc.show.pictures.track import TrackLine, draw_heights, draw_innovations, draw_plan, draw_sigmas, turned
from optloc.tracking.track import Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WHATS = ("plan", "height", "sigma", "nis")
"""Pictures of a track."""


def track_axes(
    track: Track, problem: Problem | None = None, *, what: str = "plan", ax: Axes | None = None, title: str = ""
) -> Axes:
    """Return a picture of a track: its plan, or its height, sigma or NIS against time.

    Parameters
    ----------
    track : Track
        A track, or a batch of tracks.
    problem : Problem, optional
        The run of the track. With it, the plan has stations, and a plan in the frame ECEF is along east and north.
    what : "plan", "height", "sigma" or "nis"
        Quantity of the picture.
    ax : matplotlib.axes.Axes, optional
        Where the picture is drawn; by default in a new figure.
    title : str
        Title of the picture.

    Raises
    ------
    InvalidProblem
        If matplotlib is missing, `what` is unknown, or a track in the plane has no height.
    """
    known = WHATS if track.dimension == 3 else ("plan", "sigma", "nis")
    if what not in known:
        raise InvalidProblem(f"a track has no picture {what!r}", "what", nearest(what, known))
    panel = axes_or_new(ax, *((6.4, 5.6) if what == "plan" else (6.4, 3.6)))
    lines, d = _lines(track), track.dimension
    stations, axes = np.zeros((0, d)), ("x", "y", "z")[:d]
    if problem is not None:
        lines, stations, axes = turned(lines, problem)
    scale = time_scale(track.times, dated=track.dated)
    if what == "plan":
        draw_plan(panel, lines, stations, axes, () if problem is None else problem.stations.names)
        place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
        panel.legend(frameon=False, fontsize=SMALL, **place)
        fix_limits(panel)
        scale_bar(panel, panel.get_xlabel().rpartition("(")[2].rstrip(")"))
        separate_notes(panel.figure, [panel])
    elif what == "height":
        draw_heights(panel, lines, axes[2], scale)
    else:
        (draw_sigmas if what == "sigma" else draw_innovations)(panel, lines, scale)
    if what != "plan":
        grid(panel)
        scale.name(panel)
    if title:
        panel.set_title(literal(title), wrap=True)
    return panel


def _lines(track: Track) -> list[TrackLine]:
    """Return the tracks of a batch as lines; the first known state of each track is its start."""
    d, k = track.dimension, len(track.times)
    size = track.mean.shape[-1]
    mean, cov = track.mean.reshape(-1, k, size)[..., :d], track.cov.reshape(-1, k, size, size)[..., :d, :d]
    nis, count, code = (each.reshape(-1, k) for each in (track.nis, track.count, track.code))
    found = []
    for i in range(len(mean)):
        known: Array = np.isfinite(mean[i]).all(-1)
        starts = np.arange(k) == (int(np.argmax(known)) if known.any() else -1)
        name = "target" if len(mean) == 1 else f"target {i + 1}"
        sigma = np.sqrt(np.trace(cov[i], axis1=-2, axis2=-1))
        found.append(TrackLine(name, track.times, mean[i], cov[i], sigma, nis[i], count[i], starts, code[i] != 0))
    return found
