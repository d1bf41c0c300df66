"""Fixes and tracks as marks: the common input of all map formats, and the GeoJSON format.

A `Mark` is one position with covariance, status and alternatives. `Results` makes the marks from a table of fixes. A
covariance, an ellipse or a region is *valid* if it covers the true position with the stated probability. A level
covariance is along east, north and, in space, up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array, Status
from optloc.problem.chart import CARTESIAN, NAMES
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.columns import Columns, level_covariance, records
from optloc.show.knowledge import known_features
from optloc.show.origin_time import iso_of
from optloc.show.render import line_of_answer
from optloc.show.row_answer import RowSource, state_table
from optloc.tracking.entry import scan_sentence

if TYPE_CHECKING:
    from optloc.uncertainty.outline import Outline

# Statuses with a valid covariance: a fix with status `ok`, and a track that is followed or has just started.
_VALID_STATUSES = {Status.OK.label, "started"}
# Statuses with a valid 95 % region. For `curved`, the region is an outline instead of an ellipse.
_STATUSES_WITH_REGION = {*_VALID_STATUSES, Status.CURVED.label}
# Corners of an ellipse on a map, one for every 5 degrees: it looks smooth at any zoom that shows the whole ellipse.
_CORNERS = 72
# Dates in names have the digits of this standard deviation, s: milliseconds, as the time stamps of KML and GPX.
_SHOWN_TIME = 0.01


class Other(NamedTuple):
    """An alternative: another position that the data do not exclude.

    - position (d,): in the frame, m.
    - place (3,): longitude, latitude (degrees) and height (m).
    - gap: cost of the alternative minus cost of the fix.
    - probability: probability that the alternative is correct, given that either the alternative or the fix is correct.
    """

    position: Array
    place: Array
    gap: float
    probability: float


class Area(NamedTuple):
    """A 95 % region on a map.

    - role: "ellipse95" or "region95" (an outline).
    - geometry: GeoJSON geometry.
    - cut: True if the region continues beyond the drawn outline.
    """

    role: str
    geometry: dict[str, Any]
    cut: bool = False


@dataclass(frozen=True, slots=True)
class Mark:
    """One position of one target.

    Parameters
    ----------
    name : str
        Name of the target, with the name of the epoch if there are several epochs.
    target : str
        Name of the target.
    time : float
        Time, s; NaN if unknown.
    status : str
        Status of the fix, or label of the scan of a track.
    position : array (d,)
        Position in the frame, m; NaN if unknown.
    covariance : array (d, d)
        Covariance along the axes of the frame, m^2; NaN if unknown or not valid.
    place : array (3,)
        Longitude, latitude (degrees) and height (m); NaN if the frame is not on Earth.
    level : array (d, d)
        Covariance along east, north and up, m^2; NaN if unknown or not valid.
    velocity : array (d,), optional
        Velocity along east, north and up, m/s.
    row : RowSource
        Row of the table of the mark, for its texts.
    others : tuple of Other
        Alternatives.
    dated : bool
        Whether the time is since 1970, UTC.
    """

    name: str
    target: str
    time: float
    status: str
    position: Array
    covariance: Array
    place: Array
    level: Array
    velocity: Array | None
    row: RowSource
    others: tuple[Other, ...] = ()
    dated: bool = False

    @property
    def known(self) -> bool:
        """Return whether the mark has a position."""
        return bool(np.isfinite(self.position).all())

    @property
    def sure(self) -> bool:
        """Return whether the mark has a position and a status without doubt: `ok`, or a track that has just started."""
        return self.known and self.status in _VALID_STATUSES

    @property
    def covers(self) -> bool:
        """Return whether the mark has a covariance; `mark_of` removes covariances that are not valid."""
        return bool(np.isfinite(self.covariance).all())

    @property
    def date(self) -> datetime | None:
        """Return the time as a date, UTC; None if the time is unknown or does not count from 1970."""
        # A float of seconds since 1970 is accurate to less than a microsecond, the resolution of `timedelta`.
        known = self.dated and np.isfinite(self.time)
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=self.time) if known else None

    @property
    def words(self) -> str:
        """Return the answer of the mark in one line, in the words of a printed fix, and its number of alternatives."""
        count = len(self.others)
        others = f" {count} alternative{'s' if count > 1 else ''}." if count else ""
        return line_of_answer(self.row.answer) + others


def need_earth(frame: Frame, what: str, where: str) -> None:
    """Raise InvalidProblem if the positions of a frame are not on Earth."""
    if not frame.geodetic:
        advice = 'give a [frame] of kind "geodetic", "ecef" or "enu"'
        raise InvalidProblem(f"{what} needs positions on Earth, but the frame is cartesian", where, advice)


def mark_of(
    frame: Frame,
    position: Array,
    covariance: Array,
    status: str,
    *,
    velocity: Array | None = None,
    row: RowSource | None = None,
    sentence: str = "",
    texts: Mapping[str, Any] | None = None,
    **named: Any,
) -> Mark:
    """Return the mark of a state in a frame.

    If the status has no valid covariance, the covariance of the mark is NaN.

    Parameters
    ----------
    frame : Frame
        Frame of the position.
    position, velocity : array (d,)
        Position, m, and velocity, m/s.
    covariance : array (m, m)
        Covariance of the position, m = d, or of a state that begins with position and velocity, m >= 2 d.
    status : str
        Status of the fix, or label of the scan of a track.
    row : RowSource, optional
        Row of a table that has the state. By default, it is made of the other arguments.
    sentence : str
        Sentence of the status, without `row`; by default the sentence of `Status`.
    texts : mapping of str, optional
        Other entries of the row, without `row`: `reason`, `unchecked`, `undetermined`, `dof`.
    **named
        Other fields of `Mark`.
    """
    d = len(position)
    if row is None:
        about = {name: [value] for name, value in {"status": status, **(texts or {})}.items()}
        rates = None if velocity is None else velocity[None]
        row = RowSource(state_table(frame, position[None], covariance[None], rates, **about), 0, sentence)
    columns, i, place = row.columns, row.number, np.full(3, np.nan)
    if frame.geodetic and np.isfinite(position).all():
        place = np.array([columns[name][i] for name in ("lon_deg", "lat_deg", "height")], dtype=float)
    placed = covariance[:d, :d]
    level = level_covariance(columns, i)
    covers = status in _VALID_STATUSES and bool(np.isfinite(placed).all() and np.isfinite(level).all())
    axes = np.eye(d) if velocity is None or not np.isfinite(place).all() else frame.enu_axes(position)
    return Mark(
        position=position,
        covariance=placed if covers else np.full_like(placed, np.nan),
        status=status,
        place=place,
        level=level if covers else np.full_like(level, np.nan),
        velocity=None if velocity is None else axes @ velocity,
        row=row,
        **named,
    )


def ellipse(level: Array) -> tuple[float, float, float]:
    """Return the 1-sigma semi-axes of a level covariance, m, and the bearing of the major axis, degrees.

    The bearing counts from north towards east, 0 to 180. `level` (d, d) has the axes east, north and, in space, up; the
    vertical axis is not used.
    """
    values, vectors = np.linalg.eigh(level[:2, :2])
    minor, major = np.sqrt(np.maximum(values, 0.0))
    return float(major), float(minor), float(np.degrees(np.arctan2(vectors[0, 1], vectors[1, 1])) % 180.0)


def ellipse95(level: Array) -> tuple[float, float, float]:
    """Return the semi-axes of the 95 % ellipse of a level covariance, m, and the bearing of the major axis, degrees."""
    scale = float(error_ellipse(np.eye(2))[0][0])
    major, minor, bearing = ellipse(level)
    return scale * major, scale * minor, bearing


@dataclass(frozen=True, slots=True)
class Results:
    """Fixes or tracks, ready to write.

    Parameters
    ----------
    columns : dict of str to array
        Table of the fixes or scans, one row for each target and epoch.
    frame : Frame
        Frame of the positions.
    fixes : sequence of Fix
        Fixes in the order of the table; empty for tracks.
    problem : Problem, optional
        The problem of the fixes. It gives the stations, and it is needed for the 95 % regions.
    title : str
        Title inside the file.
    dated : bool
        Whether the column `time` is in seconds since 1970, UTC.
    """

    columns: Columns
    frame: Frame
    fixes: Sequence[Fix] = ()
    problem: Problem | None = None
    title: str = "optloc"
    dated: bool = False

    @property
    def undated(self) -> bool:
        """Return whether the results have times that are no dates: seconds without a time scale."""
        times = np.asarray(self.columns.get("time", np.zeros(0)), dtype=float)
        return not self.dated and bool(np.isfinite(times).any())

    @property
    def course(self) -> bool:
        """Return whether the results are tracks, so that the rows of a target form one line."""
        return not self.fixes

    @property
    def _count(self) -> int:
        """Return the number of rows of the table."""
        return len(self.columns["status"])

    @property
    def axes(self) -> str:
        """Return the axes of the frame: "xy" or "xyz"."""
        return "".join(axis for axis in "xyz" if axis in self.columns)

    def marks(self) -> list[Mark]:
        """Return one mark for each row of the table."""
        found, sources = self._others(), self._sources()
        rows = zip(records(self.columns), found, sources, strict=True)
        return [self._mark(row, others, source) for row, others, source in rows]

    def _sources(self) -> list[RowSource]:
        """Return the source of each row: with its fix if each row is a fix, and with the sentence of a scan of a track.

        The words of all marks come from these sources.
        """
        statuses = self.columns["status"].tolist()
        if self.course:
            return [RowSource(self.columns, i, scan_sentence(status)) for i, status in enumerate(statuses)]
        flat = self._flat()
        if sum(map(len, flat)) != self._count:
            return [RowSource(self.columns, i) for i in range(self._count)]
        items = [(fix, item) for fix in flat for item in range(len(fix))]
        return [RowSource(self.columns, i, "", fix, item) for i, (fix, item) in enumerate(items)]

    def _flat(self) -> list[Fix]:
        """Return the fixes as batches with one axis."""
        return [fix if len(fix.shape) == 1 else fix.flat() for fix in self.fixes]

    def stations(self) -> list[tuple[str, Array]]:
        """Return the name of each station with its longitude, latitude (degrees) and height (m) (3,)."""
        from optloc.show.pictures.outlines import earth_points

        if self.problem is None or not self.frame.geodetic:
            return []
        stations = self.problem.stations
        place = stations.position.reshape(-1, stations.count, self.problem.dimension)[0]
        return list(zip(stations.names, earth_points(self.frame, place), strict=True))

    def areas(self) -> list[Area | None]:
        """Return the 95 % region of each row; None if the row has no valid region, or the region is unknown."""
        outlines: dict[int, Outline] = {}
        if self.problem is not None and self.fixes:
            outlines = self._outlines(self.problem)
        return [self._area(row, outlines.get(i)) for i, row in enumerate(records(self.columns))]

    def known(self) -> list[list[tuple[dict[str, Any], dict[str, Any]]]]:
        """Return GeoJSON geometries with properties for each row without a valid position; see `known_features`."""
        flat = self._flat()
        # This needs fixes of one position each, so that each row is a fix.
        if not self.frame.geodetic or sum(map(len, flat)) != self._count:
            return [[] for _ in range(self._count)]
        return [known_features(fix[i], self.frame) for fix in flat for i in range(len(fix))]

    def _mark(self, row: dict[str, Any], others: tuple[Other, ...], source: RowSource) -> Mark:
        """Return the mark of a row of the table, with its alternatives `others` and its source.

        If the fix is Gaussian only in other coordinates than metres, its covariance is not valid and the mark gets NaN.
        """
        axes = self.axes
        number = {name: np.nan if row.get(name) is None else row[name] for name in row}
        # The table has the upper triangle only, so the letters of a column are in alphabetical order.
        pairs = [["cov_" + "".join(sorted(a + b)) for b in axes] for a in axes]
        other_chart = row.get("chart") not in (None, "", NAMES[CARTESIAN])
        covariance = np.array([[np.nan if other_chart else number[name] for name in line] for line in pairs])
        velocity = np.array([number.get(f"v{axis}", np.nan) for axis in axes])
        return mark_of(
            self.frame,
            np.array([number[axis] for axis in axes]),
            covariance,
            row["status"],
            velocity=velocity if np.isfinite(velocity).all() else None,
            name=self._name(row),
            target=str(row.get("target", "target")),
            time=float(number.get("time", np.nan)),
            others=others,
            row=source,
            dated=self.dated,
        )

    def _name(self, row: dict[str, Any]) -> str:
        """Return the name of a row: target, label or number, and epoch, each only if the table has several."""
        own = "label" if "label" in row else "number"
        several = [n for n in ("target", own, "epoch") if n in row and len(set(self.columns[n].tolist())) > 1]
        return " ".join(_label(row, name, self.dated) for name in several) or str(row.get("target", "fix"))

    def _others(self) -> list[tuple[Other, ...]]:
        """Return the alternatives of each row; empty unless each row is one estimated position."""
        found: list[tuple[Other, ...]] = []
        for fix in self.fixes:
            flat = fix if len(fix.shape) == 1 else fix.flat()
            slots = (*flat.layout.shared, *flat.layout.local)
            for name in (slot.name for slot in slots if slot.name.partition("[")[0] == "position"):
                places = flat.layout.take(flat.alternatives.x, name)
                for i in range(len(flat)):
                    # Alternatives are (q, k, d) if each epoch of a run has a position, else (q, d).
                    each = np.moveaxis(places[i], -2, 0) if places.ndim == 4 else places[i][None]
                    found += [self._alternatives_of(flat, i, position) for position in each]
        return found if len(found) == self._count else [()] * self._count

    def _alternatives_of(self, fix: Fix, i: int, position: Array) -> tuple[Other, ...]:
        """Return the alternatives of fix number `i` of a batch; `position` (q, d), m, are their positions.

        Entries with an infinite gap are padding and are omitted.
        """
        gap, doubt = fix.alternatives.gap[i], fix.alternatives.doubt[i]
        place = np.full((len(gap), 3), np.nan)
        if self.frame.geodetic and len(gap):
            from optloc.show.pictures.outlines import earth_points

            with np.errstate(invalid="ignore"):
                place = earth_points(self.frame, position)
        shown = np.flatnonzero(np.isfinite(gap))
        return tuple(Other(position[j], place[j], float(gap[j]), float(doubt[j])) for j in shown)

    def _area(self, row: dict[str, Any], region: Outline | None) -> Area | None:
        """Return the 95 % region of a row: the outline `region` if it is known, else the ellipse; None without either.

        A row has no region if its status or its covariance is not valid.
        """
        if row.get("lat_deg") is None or row["status"] not in _STATUSES_WITH_REGION:
            return None
        centre = np.array([row[axis] for axis in self.axes])
        if region is not None:
            return Area("region95", _region(self.frame, centre, region), region.cut)
        if (
            row["status"] not in _VALID_STATUSES
            or row["cov_ee"] is None
            or row.get("chart") not in (None, "", NAMES[CARTESIAN])
        ):
            return None
        level = np.array([[row["cov_ee"], row["cov_en"]], [row["cov_en"], row["cov_nn"]]])
        return Area("ellipse95", _ellipse(self.frame, centre, level))

    def _outlines(self, problem: Problem) -> dict[int, Outline]:
        """Return the horizontal outlines of known 95 % regions, by row, for rows whose ellipse is not valid."""
        from optloc.show.pictures.outlines import level_planes, outlines_of

        if not self.frame.geodetic:
            return {}
        charts = [fix.chart for fix in self.fixes]
        kinds = [np.ravel(chart.kind) for chart in charts if chart is not None]
        # This needs fixes of one position each, so that each row is a fix.
        if len(kinds) != len(charts) or sum(map(len, kinds)) != self._count:
            return {}
        found: list[list[Outline]] = []
        for fix in self.fixes:
            planes = level_planes(problem, fix.position.reshape(-1, problem.dimension))
            found += outlines_of(problem, fix, [planes])
        return {i: each[0] for i, each in enumerate(found) if each}


def _label(row: dict[str, Any], name: str, dated: bool) -> str:
    """Return the text of a column of a row; for an epoch without a label, whose text is its time, the date in UTC."""
    text, time = str(row[name]), row.get("time")
    if name != "epoch" or time is None or not dated or text != f"{time:.15g}":
        return text
    return iso_of(time, _SHOWN_TIME)


def _region(frame: Frame, centre: Array, region: Outline) -> dict[str, Any]:
    """Return the outline of a region along east and north, centred at a position (d,), as a GeoJSON geometry."""
    from optloc.show.pictures.outlines import earth_line, polygon_geometry

    axes = frame.enu_axes(centre)[:2]
    return polygon_geometry([[earth_line(frame, centre + line @ axes) for line in each] for each in region.polygons])


def _ellipse(frame: Frame, centre: Array, level: Array) -> dict[str, Any]:
    """Return the horizontal 95 % ellipse of a level covariance (2, 2), m^2, as a counter-clockwise GeoJSON geometry.

    The ellipse is centred at the position `centre` (d,), m, in the frame `frame`.
    """
    from optloc.show.pictures.outlines import earth_line, polygon_geometry

    semi_axes, directions = error_ellipse(level)
    # Eigenvectors can be left-handed: the sign of the determinant keeps the corners counter-clockwise.
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1) * np.sign(np.linalg.det(directions))
    plane = (np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes) @ directions.T
    plane[-1] = plane[0]
    return polygon_geometry([[earth_line(frame, centre + plane @ frame.enu_axes(centre)[:2])]])


def geojson(results: Results) -> dict[str, Any]:
    """Return stations, fixes, alternatives and 95 % regions as a GeoJSON feature collection (RFC 7946).

    If the ellipse of an `ok` fix is valid, it is the region; otherwise the outline is the region. Fixes that are not
    `ok` have no region, except `curved` fixes whose outline is known.
    """
    from optloc.show.pictures.outlines import feature, point_geometry

    need_earth(results.frame, "GeoJSON", results.title)
    features = [feature(point_geometry(place), {"role": "station", "name": name}) for name, place in results.stations()]
    # The geometry holds the position, and the region replaces the covariance.
    skipped = {"x", "y", "z", "lat_deg", "lon_deg", "height"}
    rows = records(results.columns)
    for row, mark, area, known in zip(rows, results.marks(), results.areas(), results.known(), strict=True):
        about: dict[str, Any] = {name: row[name] for name in ("label", "number", "epoch", "target") if name in row}
        sentence = {"sentence": mark.row.status_sentence}
        properties = {name: value for name, value in row.items() if name not in skipped and not name.startswith("cov_")}
        if mark.known:
            features.append(feature(point_geometry(mark.place), {"role": "fix", **properties, **sentence}))
        if area is not None:
            features.append(feature(area.geometry, {"role": area.role, **({"cut": True} if area.cut else {}), **about}))
        for other in mark.others:
            doubt = {"gap": other.gap, "probability": other.probability}
            features.append(feature(point_geometry(other.place), {"role": "alternative", **about, **doubt}))
        features += [feature(geometry, {**attributes, **about, **sentence}) for geometry, attributes in known]
    return {"type": "FeatureCollection", "features": features}
