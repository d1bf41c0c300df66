"""Pictures of tracks: the plan, the height, the standard deviation and the innovations against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.problem.problem import Problem
from optloc.show.pictures.notes import separate_notes
from optloc.show.pictures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    SMALL,
    WIDE,
    YELLOW,
    ellipse_line,
    figure_class,
    finish,
    grid,
    literal,
    note,
    unit_of,
)
from optloc.show.pictures.time_axes import TimeScale, time_scale
from optloc.tracking.entry import Entry

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CYCLE = (BLUE, GREEN, PURPLE, SKY, YELLOW)
# Maximum number of stations with names: more names would overlap.
_NAMED = 20
# Maximum number of ellipses along a track: more would merge to a band.
_ELLIPSES = 25
# A station is left out if its distance from the tracks is more than this many extents of the tracks, as for satellites.
_OUT = 100.0
# Share of scans whose NIS is below the line: by chance, one in a thousand is above.
_ALLOWED = 0.999
# 97.5 % quantile of a standard normal variable.
_95 = 1.96


@dataclass(frozen=True, slots=True)
class PlottedTrack:
    """The track of one target.

    Parameters
    ----------
    name : str
        Name of the target.
    problem : Problem
        Run of the target; gives the stations and the frame.
    entries : tuple of Entry
        Result of each scan.
    """

    name: str
    problem: Problem
    entries: tuple[Entry, ...]


@dataclass(frozen=True, slots=True)
class TrackLine:
    """A track as arrays over its k scans, along the axes of the picture.

    - name: name of the target.
    - times (k,): times, s.
    - position (k, d), cov (k, d, d): estimates, m, and their covariances, m^2.
    - sigma (k,): root of the trace of the covariance, m.
    - nis (k,): normalised innovation squared.
    - count (k,): number of rows in the scan.
    - starts (k,): True for scans at which the track started or restarted.
    - bad (k,): True for scans whose status is not ok.
    """

    name: str
    times: Array
    position: Array
    cov: Array
    sigma: Array
    nis: Array
    count: Array
    starts: Array
    bad: Array


def plot_tracks(drawn: Sequence[PlottedTrack], title: str = "") -> Figure:
    """Return a picture of tracks: the plan, and against time the height (in 3-D), sigma of the position and the NIS.

    Parameters
    ----------
    drawn : sequence of PlottedTrack
        At least one track. If the frame is ECEF, the axes are east, north and up at the first position; if no position
        is known, at the centre of the stations.
    title : str
        Title of the picture.

    Returns
    -------
    matplotlib.figure.Figure
        The picture; write it with `optloc.show.pictures.save`.
    """
    lines, stations, axes = _along_picture_axes(drawn)
    names = ["height", "sigma", "nis"][3 - stations.shape[-1] :]
    figure = figure_class()(figsize=(WIDE, 2.4 + 2.2 * len(names)), layout="constrained")
    panels = figure.subplot_mosaic([["plan", name] for name in names])
    dated = all(each.problem.dated for each in drawn)
    scale = time_scale(np.concatenate([line.times for line in lines]), dated=dated)
    draw_plan(panels["plan"], lines, stations, axes, drawn[0].problem.stations.names)
    if "height" in panels:
        draw_heights(panels["height"], lines, axes[2], scale)
    draw_sigmas(panels["sigma"], lines, scale)
    draw_innovations(panels["nis"], lines, scale)
    for name in names:
        grid(panels[name])
        if name != names[-1]:
            panels[name].sharex(panels[names[-1]])
            panels[name].tick_params(labelbottom=False)
            panels[name].xaxis.offsetText.set_visible(False)
    scale.name(panels[names[-1]])
    finish(figure, title, [panels["plan"]], 6)
    separate_notes(figure)
    return figure


def _along_picture_axes(drawn: Sequence[PlottedTrack]) -> tuple[list[TrackLine], Array, tuple[str, ...]]:
    """Return tracks and stations (s, d) of the first scan along the axes of the picture, and the names of the axes.

    `drawn` are at least one track; the first track gives the stations and the frame.
    """
    first = drawn[0].problem
    return turned([_track_arrays(each, first.dimension) for each in drawn], first)


def turned(lines: Sequence[TrackLine], first: Problem) -> tuple[list[TrackLine], Array, tuple[str, ...]]:
    """Return tracks and stations (s, d) along the axes of the picture, and the names of the axes.

    The problem `first` has the stations and the frame of the tracks.
    """
    d = first.dimension
    stations = first.stations.position.reshape(-1, first.stations.count, d)[0]
    axes = ("east", "north", "up") if first.frame.geodetic else ("x", "y", "z")
    if first.frame.kind != "ecef":
        return list(lines), stations, axes[:d]
    known = [line.position[np.isfinite(line.position).all(-1)] for line in lines]
    # The origin is the first position, because stations can be satellites far above the ground.
    lat, lon, height = first.frame.to_geodetic(next((p[0] for p in known if len(p)), stations.mean(0)))
    local = Frame("enu", (float(lat), float(lon), float(height)))
    turn = local.rotation_to_ecef().T
    moved = [replace(n, position=local.from_ecef(n.position), cov=turn @ n.cov @ turn.T) for n in lines]
    return moved, local.from_ecef(stations), axes


def _track_arrays(drawn: PlottedTrack, d: int) -> TrackLine:
    """Return a track as arrays in the frame of its problem; `d` is the number of coordinates."""
    entries = drawn.entries
    cov = np.stack([e.updated.cov[:d, :d] for e in entries])
    return TrackLine(
        drawn.name,
        np.array([e.time for e in entries]),
        np.stack([e.updated.mean[:d] for e in entries]),
        cov,
        np.sqrt(np.trace(cov, axis1=-2, axis2=-1)),
        np.array([float(e.updated.nis) for e in entries]),
        np.array([int(e.updated.count) for e in entries]),
        np.array([e.event in ("started", "restarted") for e in entries]),
        np.array([bool(e.code) for e in entries]),
    )


def _with_colours(lines: Sequence[TrackLine]) -> list[tuple[TrackLine, str]]:
    """Return each track with its colour; colours repeat after five tracks."""
    return [(line, _CYCLE[i % len(_CYCLE)]) for i, line in enumerate(lines)]


def draw_plan(
    panel: Axes, lines: Sequence[TrackLine], stations: Array, axes: Sequence[str], names: Sequence[str] = ()
) -> None:
    """Draw the plan: stations near the tracks, tracks with their starts and their bad scans, and ellipses.

    `lines` are the tracks, `axes` the names of the axes, and `names` the names of the stations.
    """
    position = np.concatenate([line.position for line in lines])[:, :2]
    known = position[np.isfinite(position).all(-1)]
    near = _is_near(stations[:, :2], known)
    spots = stations[near, :2]
    unit, size = unit_of(np.concatenate([spots, known]))
    if len(spots):
        panel.scatter(
            spots[:, 0] / size, spots[:, 1] / size, marker="^", s=50, color=BLACK, label="station, first scan", zorder=3
        )
    if len(spots) <= _NAMED:
        for i in np.flatnonzero(near)[: len(names)].tolist():
            note(panel, names[i], *(stations[i, :2] / size).tolist())
    for i, (line, colour) in enumerate(_with_colours(lines)):
        path = line.position[:, :2] / size
        panel.plot(
            *path.T, color=colour, linewidth=1.5, zorder=4, label=literal(line.name) if len(lines) > 1 else "track"
        )
        marks: dict[str, Any] = {"marker": "o", "s": 45, "color": colour, "edgecolors": BLACK, "zorder": 6}
        panel.scatter(path[line.starts, 0], path[line.starts, 1], label=None if i else "start, from a fix", **marks)
        if line.bad.any():
            panel.scatter(
                path[line.bad, 0], path[line.bad, 1], marker="x", s=22, color=ORANGE, zorder=5, label="status not ok"
            )
        _draw_ellipses(panel, line, size, None if i else "95 % ellipse")
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(f"{axes[0]} ({unit})")
    panel.set_ylabel(f"{axes[1]} ({unit})")
    panel.set_title("plan")
    grid(panel)


def _is_near(stations: Array, known: Array) -> Array:
    """Return a mask (s,) of the stations near enough to positions (n, 2), m, to be in the picture."""
    if not len(known):
        return np.ones(len(stations), dtype=bool)
    centre, extent = known.mean(0), max(float(np.ptp(known, axis=0).max()), 1.0)
    return np.asarray(np.linalg.norm(stations - centre, axis=-1) < _OUT * extent)


def _draw_ellipses(panel: Axes, line: TrackLine, size: float, label: str | None) -> None:
    """Draw the 95 % ellipses of some scans of a track in a plan with the unit `size`, m."""
    known = np.flatnonzero(np.isfinite(line.cov).all((-1, -2)))
    for i in known[:: max(1, len(known) // _ELLIPSES)]:
        edge = (line.position[i, :2] + ellipse_line(line.cov[i, :2, :2])) / size
        panel.plot(*edge.T, color=GREY, linewidth=0.8, zorder=2, label=label)
        label = None


def draw_heights(panel: Axes, lines: Sequence[TrackLine], name: str, scale: TimeScale) -> None:
    """Draw the height of each track against time with its 95 % interval.

    `name` is the name of the third axis, and `scale` converts the times.
    """
    for line, colour in _with_colours(lines):
        sigma = np.sqrt(line.cov[:, 2, 2])
        panel.plot(scale.values(line.times), line.position[:, 2], color=colour, linewidth=1.2)
        band = (line.position[:, 2] - _95 * sigma, line.position[:, 2] + _95 * sigma)
        panel.fill_between(scale.values(line.times), *band, color=colour, alpha=0.2, linewidth=0.0)
    panel.set_ylabel(f"{name} (m)")
    panel.set_title("height, with 95 % interval")


def draw_sigmas(panel: Axes, lines: Sequence[TrackLine], scale: TimeScale) -> None:
    """Draw the standard deviation of the position of each track, all axes together, against time."""
    for line, colour in _with_colours(lines):
        panel.plot(scale.values(line.times), line.sigma, color=colour, linewidth=1.2)
    _use_log_axis(panel, np.concatenate([line.sigma for line in lines]))
    panel.set_ylabel("sigma (m)")
    panel.set_title("sigma of the position, all axes together")


def draw_innovations(panel: Axes, lines: Sequence[TrackLine], scale: TimeScale) -> None:
    """Draw the NIS, and the 99.9 % quantile of chi-square for the number of rows of each scan.

    `lines` are the tracks; scans without a test have no point and no line.
    """
    from scipy.special import gammaincinv

    # The NIS of m rows is chi-square with m degrees of freedom, so the line depends on the number of rows of each scan.
    for i, (line, colour) in enumerate(_with_colours(lines)):
        tested = np.isfinite(line.nis) & (line.count > 0)
        panel.plot(
            scale.values(line.times)[tested], line.nis[tested], color=colour, linestyle="", marker=".", markersize=4
        )
        limit = 2.0 * gammaincinv(0.5 * np.maximum(line.count, 1), _ALLOWED)
        label = None if i else "99.9 % of the chi-square"
        panel.plot(scale.values(line.times), np.where(tested, limit, np.nan), color=ORANGE, linewidth=1.0, label=label)
    _use_log_axis(panel, np.concatenate([line.nis for line in lines]))
    panel.set_ylabel("NIS")
    panel.set_title("normalised innovation squared (NIS)")
    panel.legend(frameon=False, fontsize=SMALL, loc="lower right")


def _use_log_axis(panel: Axes, values: Array) -> None:
    """Make the vertical axis logarithmic, with plain numbers, if the values span more than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    known = values[np.isfinite(values) & (values > 0.0)]
    if not len(known) or known.max() < 10.0 * known.min():
        return
    panel.set_yscale("log")
    # Over more than three decades, put a tick at each decade; otherwise also at 2 and 5.
    wide = known.max() > 1e3 * known.min()
    panel.yaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())
