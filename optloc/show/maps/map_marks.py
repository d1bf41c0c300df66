"""Marks of fixes, tracks and stations on interactive maps, with the rows of the list of positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.answer_texts import latlon_texts, length_text, level_sigmas, place_rows, sigma_of, sure_rows
from optloc.show.columns import Columns, fix_columns, join_tables
from optloc.show.maps.canvas import MapRow
from optloc.show.pictures.outlines import level_planes
from optloc.show.pictures.scene import is_local, regions_of, states_of
from optloc.show.row_answer import state_table, use_rows, why_rows
from optloc.uncertainty.outline import Outline

# Corners of an ellipse: one for every five degrees; the last corner repeats the first.
_RING = 73
ELLIPSES = 200
"""Maximum number of ellipses on a map: more are unreadable, and each ellipse adds 70 corners to the file."""
SKY = 100e3
"""Height, m, at which space begins by convention. Satellites have no position on a map."""

LOOKS = {
    "ok": "ok",
    "started": "ok",
    "starting": "ok",
    "no redundancy": "alone",
    "ambiguous": "rival",
    "unproven": "care",
    "searched": "care",
    "curved": "care",
    "unchecked": "alone",
}
"""Classes of the style sheet by status. Each class has a colour and a shape; any other status has the class `bad`."""


def look_of(status: str, *, unchecked: bool = False) -> str:
    """Return the class of the style sheet for a status; `unchecked` means that the fix has no redundancy."""
    look = LOOKS.get(status, "bad")
    return "alone" if unchecked and look == "ok" else look


@dataclass(frozen=True, slots=True)
class Spots:
    """Marks on a map.

    Parameters
    ----------
    place : array (n, 2)
        Longitude and latitude, degrees, or x and y, m; NaN for a missing position.
    rings : tuple of n arrays (r, 2)
        95 % ellipse of each mark, degrees or metres. If no ellipse is valid, the outline of the 95 % region; if there
        is no covariance, or there are more than `ELLIPSES` marks, an empty array.
    clean : bool array (n,)
        Whether the status is `ok`.
    text : tuple of n str
        Text that the page shows for each mark.
    more : tuple of array (r, 2)
        Outlines of the other parts of regions that have several parts, degrees or metres.
    local : bool array (n,), optional
        Whether the ring is an ellipse that is not valid, while the valid region is unknown.
    rows : tuple of n MapRow
        Rows of the list; empty for stations.
    groups : tuple of n str
        Targets. The marks of one target form a trail. Empty if the marks form no trail.
    """

    place: Array
    rings: tuple[Array, ...]
    clean: Array
    text: tuple[str, ...]
    more: tuple[Array, ...] = ()
    local: Array | None = None
    rows: tuple[MapRow, ...] = ()
    groups: tuple[str, ...] = ()


NO_SPOTS = Spots(np.zeros((0, 2)), (), np.zeros(0, dtype=bool), ())
"""No marks."""


def spots(
    problem: Problem,
    position: Array,
    covariance: Array,
    clean: Array,
    text: Sequence[str],
    outlines: Sequence[Sequence[Outline]] = (),
) -> Spots:
    """Return positions in the frame of a problem as marks on a map.

    Parameters
    ----------
    problem : Problem
        Gives the frame.
    position, covariance : array (n, d), (n, d, d)
        Positions, m, and covariances, m^2.
    clean : bool array (n,)
        Whether the status is `ok`.
    text : sequence of n str
        Text that the page shows for each mark.
    outlines : sequence of n sequences of Outline, optional
        Outlines along east and north of the 95 % regions of fixes without a valid ellipse; empty for other fixes.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _RING)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings: list[Array] = []
    more: list[Array] = []
    for centre, spread, regions in zip(position, covariance, outlines or [()] * len(position), strict=True):
        if len(position) > ELLIPSES or not (np.isfinite(centre).all() and np.isfinite(spread).all()):
            rings.append(np.zeros((0, 2)))
            continue
        # Use the marginal covariance of east and north.
        axes = problem.frame.enu_axes(centre)[:2]
        if regions:
            lines = [map_places(problem, centre + line @ axes) for region in regions for line in region.lines]
            # The outline with most points is the ring of the mark; all other outlines go to `more`.
            lines.sort(key=len, reverse=True)
            rings.append(lines[0])
            more += lines[1:]
            continue
        semi_axes, directions = error_ellipse(axes @ spread @ axes.T)
        rings.append(map_places(problem, centre + circle * semi_axes @ directions.T @ axes))
    return Spots(map_places(problem, position), tuple(rings), clean, tuple(text), tuple(more))


def map_places(problem: Problem, position: Array) -> Array:
    """Return longitude and latitude (n, 2), degrees, of positions (n, d), m; x and y, m, if the frame is not on Earth.

    A position that is NaN gives NaN.
    """
    out = np.full((len(position), 2), np.nan)
    known = np.isfinite(position).all(-1)
    if not problem.frame.geodetic:
        out[known] = position[known, :2]
    elif known.any():
        lat, lon, _ = problem.frame.to_geodetic(position[known])
        out[known] = np.degrees(np.stack([lon, lat], axis=-1))
    return out


def fixed_spots(
    problem: Problem,
    fixes: Sequence[Fix],
    labels: Sequence[str] = (),
    times: Sequence[float] = (),
    targets: Sequence[str] = (),
    *,
    dated: bool = False,
) -> Spots:
    """Return the marks of fixes.

    Parameters
    ----------
    problem : Problem
        Gives the frame.
    fixes : sequence of Fix
        Single fixes or batches.
    labels : sequence of str
        Names of the positions; ignored if their number is another.
    times : sequence of float
        Times of the positions, s; ignored if their number is another.
    targets : sequence of str
        Targets of the positions, each of which has its trail; by default one target.
    dated : bool
        Whether the times are since 1970, UTC.
    """
    parts = [part for fix in fixes for part in states_of(fix)]
    position, covariance, clean = (np.concatenate(each) for each in zip(*parts, strict=True))
    columns = join_tables([fix_columns(fix) for fix in fixes])
    count = len(position)
    names = list(labels) if len(labels) == count else [""] * count
    when = list(times) if len(times) == count else [np.nan] * count
    rows = tuple(map_row(problem.frame, columns, i, names[i], when[i], dated=dated) for i in range(count))
    sentences = [row_text(row if count > 1 else replace(row, name="", time="")) for row in rows]
    outlines = regions_of(problem, fixes, count, [level_planes(problem, position)])
    for i, regions in enumerate(outlines):
        sentences[i] += ", 95 % region larger than drawn" if any(region.cut for region in regions) else ""
    found = spots(problem, position, covariance, clean, sentences, outlines)
    # Mark ellipses that are not valid, if no outline of the valid region replaces them.
    local = is_local(fixes, [bool(each) for each in outlines], count)
    # The positions of a run form a trail. Fixes that are independent of each other form one if their times are known.
    together = len(fixes) == 1 and fixes[0].code.size == 1
    owners = tuple(targets) if len(targets) == count else ("",) * count
    trail = owners if together or np.isfinite(when).all() else ()
    return replace(found, local=local, rows=rows, groups=trail)


def map_row(
    frame: Frame, columns: Columns, i: int, name: str = "", time: float = np.nan, *, dated: bool = False
) -> MapRow:
    """Return the row of the list for row `i` of a table of fixes or scans, in the words of a printed fix.

    Parameters
    ----------
    frame : Frame
        Frame of the positions.
    columns : dict of str to array
        Table of the fixes, see `optloc.show.columns.fix_columns` and `optloc.show.row_answer.state_table`.
    i : int
        Number of the row.
    name : str
        Name of the row.
    time : float
        Time, s; NaN if it is unknown.
    dated : bool
        Whether the time is since 1970, UTC.
    """
    status, noted = str(columns["status"][i]), use_rows(columns, i)[0][1].partition("; ")[2]
    note = "; ".join(part for part in (*(text for _, text in why_rows(columns, i)), noted) if part)
    unchecked = "unchecked" in columns and bool(columns["unchecked"][i])
    row = MapRow(name, time_text(time, dated=dated), status, look_of(status, unchecked=unchecked), note=note)
    position = np.array([columns[axis][i] for axis in "xyz" if axis in columns], dtype=float)
    if not np.isfinite(position).all():
        return replace(row, place="", size="no position")
    sizes = [f"{label}: {text}" for label, text in sure_rows(columns, i)]
    if not frame.geodetic:
        axes = "xyz"[: len(position)]
        values = [length_text(value, sigma_of(columns, axis, i)) for axis, value in zip(axes, position, strict=True)]
        shown = ", ".join(f"{axis} {value} m" for axis, value in zip(axes, values, strict=True))
        return replace(row, place=shown, copied=", ".join(values), size="; ".join(sizes))
    places = dict(place_rows(columns, i))
    place = ", ".join(latlon_texts(columns["lat_deg"][i], columns["lon_deg"][i], level_sigmas(columns, i)[:2]))
    tall = [f"height: {places['height']}"] if len(position) > 2 else []
    return replace(row, place=place, copied=place, size="; ".join([*tall, *sizes]))


def time_text(time: float, *, dated: bool = False) -> str:
    """Return a time, s, as text: a date if it is since 1970, UTC (`dated`), else seconds; empty if it is NaN."""
    if not np.isfinite(time):
        return ""
    if not dated:
        return f"{time:.10g} s"
    date = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=float(time))
    return date.isoformat(sep=" ", timespec="milliseconds").replace(".000+00:00", "+00:00").replace("+00:00", " UTC")


def row_text(row: MapRow) -> str:
    """Return a row of the list as one line: name, time, status, coordinates and standard deviations."""
    parts = [row.name, row.time, row.status + (f" ({row.note})" if row.note else ""), row.place, row.size]
    return ", ".join(part for part in parts if part)


def other_spots(problem: Problem, fixes: Sequence[Fix]) -> Spots:
    """Return the marks of the alternatives of fixes, without ellipses: positions of other minima of the cost.

    Positions that change from epoch to epoch have no marks.
    """
    places, gaps = [np.zeros((0, problem.dimension))], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                places.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                gaps += flat.alternatives.gap[shown].tolist()
    position = np.concatenate(places)
    count, d = position.shape
    unknown = np.full((count, d, d), np.nan)
    columns = state_table(problem.frame, position, unknown, status=[f"alternative, cost gap {gap:.3g}" for gap in gaps])
    rows = tuple(replace(map_row(problem.frame, columns, i), look="rival other") for i in range(count))
    found = spots(problem, position, unknown, np.zeros(count, dtype=bool), [row_text(row) for row in rows])
    return replace(found, rows=rows)


def scan_spots(problem: Problem, columns: Columns, names: Sequence[str], clean: Array, *, dated: bool = False) -> Spots:
    """Return the marks of the scans of tracks.

    Parameters
    ----------
    problem : Problem
        Gives the frame.
    columns : dict of str to array
        Table of the scans (n rows) with the columns `time`, `target` and `status`; NaN before the start of a track.
    names : sequence of n str
        Name of each scan.
    clean : bool array (n,)
        Whether the status is ok.
    dated : bool
        Whether the times are since 1970, UTC.
    """
    axes = "xyz"[: problem.dimension]
    position = np.stack([columns[axis] for axis in axes], axis=-1)
    covariance = np.stack([np.stack([columns[f"cov_{min(a, b)}{max(a, b)}"] for b in axes], -1) for a in axes], -2)
    times = columns["time"]
    rows = tuple(map_row(problem.frame, columns, i, name, times[i], dated=dated) for i, name in enumerate(names))
    found = spots(problem, position, covariance, clean, [row_text(row) for row in rows])
    return replace(found, rows=rows, groups=tuple(columns["target"].tolist()))


def station_spots(problem: Problem) -> Spots:
    """Return the marks of the stations in the first epoch; a station in space has the place NaN and is not drawn."""
    position = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    place = map_places(problem, position)
    if problem.frame.geodetic:
        place[problem.frame.to_geodetic(position)[2] > SKY] = np.nan
    nothing = tuple(np.zeros((0, 2)) for _ in position)
    return Spots(place, nothing, np.ones(len(position), dtype=bool), problem.stations.names)
