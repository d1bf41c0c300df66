"""Fixes and tracks as marks on a map: what a format is given, what of it covers, and the same as GeoJSON."""

from __future__ import annotations

from collections.abc import Sequence
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
from optloc.show.columns import UNCHECKED, Columns, records
from optloc.show.knowledge import known_features

if TYPE_CHECKING:
    from optloc.uncertainty.outline import Outline

# What has a covariance that covers: a fix that is ok, and a track that is followed or has just begun.
_SURE = {Status.OK.label, "started"}
# What has a region that covers where its chart says so.
_SHAPED = {*_SURE, Status.CURVED.label}
# Corners of an ellipse on a map, one for every 5 degrees: no edge is seen at any zoom that shows the whole.
_CORNERS = 72
# Seconds that are a date since 1970: no run counts its time for three years.
_DATED = 1e8


class Other(NamedTuple):
    """Another position that the data allow: metres in the frame (d,), longitude, latitude (degrees), height (3,)."""

    position: Array
    place: Array
    gap: float
    probability: float


class Area(NamedTuple):
    """What holds 95 %: "ellipse95" or "region95", its plan as a geometry of GeoJSON, and whether that is cut off."""

    role: str
    geometry: dict[str, Any]
    cut: bool = False


@dataclass(frozen=True, slots=True)
class Mark:
    """One position of one target.

    Parameters
    ----------
    name : str
        Of the target and, of several, of its epoch.
    target : str
        Whose it is.
    time : float
        Seconds, NaN where there are none.
    status, reason : str
        As of the fix, or of the scan of a track.
    position : array (d,)
        Metres in the frame; NaN where there is none.
    covariance : array (d, d)
        Square metres along the axes of the frame; NaN where there is none, or where it does not cover.
    place : array (3,)
        Longitude, latitude (degrees) and height (metres); NaN where there is no Earth.
    level : array (d, d)
        The covariance along east, north and up; NaN likewise.
    velocity : array (d,), optional
        Metres per second along east, north and up.
    others : tuple of Other
        Positions that the data allow beside it.
    """

    name: str
    target: str
    time: float
    status: str
    position: Array
    covariance: Array
    place: Array
    level: Array
    velocity: Array | None = None
    others: tuple[Other, ...] = ()
    reason: str = ""

    @property
    def known(self) -> bool:
        """Return whether there is a position."""
        return bool(np.isfinite(self.position).all())

    @property
    def sure(self) -> bool:
        """Return whether nothing stands against the position."""
        return self.known and self.status in _SURE

    @property
    def covers(self) -> bool:
        """Return whether the covariance covers as it promises."""
        return bool(np.isfinite(self.covariance).all())

    @property
    def date(self) -> datetime | None:
        """Return the time as a date, UTC; None where seconds are not counted from 1970."""
        # Microseconds are added: a float of seconds since 1970 holds no more digits.
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=self.time) if self.time >= _DATED else None

    @property
    def words(self) -> str:
        """Return status, uncertainty and number of alternatives in words."""
        parts = [self.status + (f" ({self.reason})" if self.reason else "")]
        if self.covers:
            major, minor, bearing = ellipse(self.level)
            scale = float(error_ellipse(np.eye(2))[0][0])
            parts.append(f"95 % within {scale * major:.3g} m x {scale * minor:.3g} m, long axis at {bearing:.0f} deg")
            if len(self.level) == 3:
                parts.append(f"sigma of the height {np.sqrt(self.level[2, 2]):.3g} m")
        elif self.known:
            parts.append("no ellipse covers")
        parts += [f"{len(self.others)} alternatives"] if self.others else []
        return "; ".join(parts)


def need_earth(frame: Frame, what: str, where: str) -> None:
    """Raise InvalidProblem where positions of a frame are not on Earth."""
    if not frame.geodetic:
        advice = 'give a [frame] of kind "geodetic", "ecef" or "enu"'
        raise InvalidProblem(f"{what} needs positions on Earth, but the frame is cartesian", where, advice)


def mark_of(
    frame: Frame, position: Array, covariance: Array, status: str, *, velocity: Array | None = None, **named: Any
) -> Mark:
    """Return the mark of a position (d,) with its covariance (d, d) and velocity (d,) in a frame."""
    place, axes = np.full(3, np.nan), np.eye(len(position))
    covers = status in _SURE and bool(np.isfinite(covariance).all())
    if frame.geodetic and np.isfinite(position).all():
        lat, lon, height = frame.to_geodetic(position)
        place = np.array([np.degrees(lon), np.degrees(lat), height])
        axes = frame.enu_axes(position)
    kept = covariance if covers else np.full_like(covariance, np.nan)
    moving = None if velocity is None else axes @ velocity
    return Mark(
        position=position,
        covariance=kept,
        status=status,
        place=place,
        level=axes @ kept @ axes.T,
        velocity=moving,
        **named,
    )


def ellipse(level: Array) -> tuple[float, float, float]:
    """Return the standard deviations along the axes of a level covariance, and the bearing of the longer one, degrees.

    The bearing counts from north towards east, 0 to 180.
    """
    values, vectors = np.linalg.eigh(level[:2, :2])
    minor, major = np.sqrt(np.maximum(values, 0.0))
    return float(major), float(minor), float(np.degrees(np.arctan2(vectors[0, 1], vectors[1, 1])) % 180.0)


@dataclass(frozen=True, slots=True)
class Results:
    """Fixes or tracks that are to be written.

    Parameters
    ----------
    columns : dict of str to array
        Their long table.
    frame : Frame
        Of their positions.
    fixes : sequence of Fix
        In the order of the table; none of tracks.
    problem : Problem, optional
        Whose stations are told, and by which regions are known.
    title : str
        What it is of.
    """

    columns: Columns
    frame: Frame
    fixes: Sequence[Fix] = ()
    problem: Problem | None = None
    title: str = "optloc"

    @property
    def course(self) -> bool:
        """Return whether the rows of a target are one track."""
        return not self.fixes

    @property
    def _count(self) -> int:
        return len(self.columns["status"])

    @property
    def axes(self) -> str:
        """Return the axes of the frame: "xy" or "xyz"."""
        return "".join(axis for axis in "xyz" if axis in self.columns)

    def marks(self) -> list[Mark]:
        """Return a mark for each row of the table."""
        found = self._others()
        return [self._mark(row, others) for row, others in zip(records(self.columns), found, strict=True)]

    def stations(self) -> list[tuple[str, Array]]:
        """Return names of the stations, and their longitudes, latitudes (degrees) and heights (3,)."""
        from optloc.show.pictures.outlines import earth_points

        if self.problem is None or not self.frame.geodetic:
            return []
        stations = self.problem.stations
        place = stations.position.reshape(-1, stations.count, self.problem.dimension)[0]
        return list(zip(stations.names, earth_points(self.frame, place), strict=True))

    def areas(self) -> list[Area | None]:
        """Return what holds 95 % of each row; None where nothing does, or nothing is known of it."""
        outlines: dict[int, Outline] = {}
        if self.problem is not None and self.fixes:
            outlines = self._outlines(self.problem)
        return [self._area(row, outlines.get(i)) for i, row in enumerate(records(self.columns))]

    def known(self) -> list[list[tuple[dict[str, Any], dict[str, Any]]]]:
        """Return geometries and their properties of what each row determines without a place; see `known_features`."""
        flat = [fix if len(fix.shape) == 1 else fix.flat() for fix in self.fixes]
        # fixes of one position each: a row is a fix
        if not self.frame.geodetic or sum(map(len, flat)) != self._count:
            return [[] for _ in range(self._count)]
        return [known_features(fix[i], self.frame) for fix in flat for i in range(len(fix))]

    def _mark(self, row: dict[str, Any], others: tuple[Other, ...]) -> Mark:
        axes = self.axes
        number = {name: np.nan if row.get(name) is None else row[name] for name in row}
        pairs = [["cov_" + "".join(sorted(a + b)) for b in axes] for a in axes]
        shaped = row.get("chart") not in (None, "", NAMES[CARTESIAN])
        spread = np.array([[np.nan if shaped else number[name] for name in line] for line in pairs])
        moving = np.array([number.get(f"v{axis}", np.nan) for axis in axes])
        return mark_of(
            self.frame,
            np.array([number[axis] for axis in axes]),
            spread,
            row["status"],
            velocity=moving if np.isfinite(moving).all() else None,
            name=self._name(row),
            target=str(row.get("target", "target")),
            time=float(number.get("time", np.nan)),
            others=others,
            reason="; ".join(part for part in (row["reason"], UNCHECKED if row.get("unchecked") else "") if part),
        )

    def _name(self, row: dict[str, Any]) -> str:
        """Return the target where there are several, and the epoch where there are several."""
        told = [n for n in ("target", "number", "epoch") if n in row and len(set(self.columns[n].tolist())) > 1]
        return " ".join(str(row[name]) for name in told) or str(row.get("target", "fix"))

    def _others(self) -> list[tuple[Other, ...]]:
        """Return the alternatives of each row; none where rows are not one each of a position that was estimated."""
        found: list[tuple[Other, ...]] = []
        for fix in self.fixes:
            flat = fix if len(fix.shape) == 1 else fix.flat()
            slots = (*flat.layout.shared, *flat.layout.local)
            for name in (slot.name for slot in slots if slot.name.partition("[")[0] == "position"):
                places = flat.layout.take(flat.alternatives.x, name)
                for i in range(len(flat)):
                    # Of each epoch of a run (q, k, d), else one (q, d).
                    each = np.moveaxis(places[i], -2, 0) if places.ndim == 4 else places[i][None]
                    found += [self._of(flat, i, position) for position in each]
        return found if len(found) == self._count else [()] * self._count

    def _of(self, fix: Fix, i: int, position: Array) -> tuple[Other, ...]:
        gap, doubt = fix.alternatives.gap[i], fix.alternatives.doubt[i]
        place = np.full((len(gap), 3), np.nan)
        if self.frame.geodetic and len(gap):
            from optloc.show.pictures.outlines import earth_points

            with np.errstate(invalid="ignore"):
                place = earth_points(self.frame, position)
        shown = np.flatnonzero(np.isfinite(gap))
        return tuple(Other(position[j], place[j], float(gap[j]), float(doubt[j])) for j in shown)

    def _area(self, row: dict[str, Any], region: Outline | None) -> Area | None:
        if row.get("lat_deg") is None or row["status"] not in _SHAPED:
            return None
        centre = np.array([row[axis] for axis in self.axes])
        if region is not None:
            return Area("region95", _region(self.frame, centre, region), region.cut)
        if row["status"] not in _SURE or row["cov_ee"] is None or row.get("chart") not in (None, "", NAMES[CARTESIAN]):
            return None
        level = np.array([[row["cov_ee"], row["cov_en"]], [row["cov_en"], row["cov_nn"]]])
        return Area("ellipse95", _ellipse(self.frame, centre, level))

    def _outlines(self, problem: Problem) -> dict[int, Outline]:
        """Return the plans of the regions of rows whose ellipses do not cover; of those that are known."""
        from optloc.show.pictures.outlines import level_planes, outlines_of

        if not self.frame.geodetic:
            return {}
        charts = [fix.chart for fix in self.fixes]
        kinds = [np.ravel(chart.kind) for chart in charts if chart is not None]
        # Fixes of one position each: a row is a fix.
        if len(kinds) != len(charts) or sum(map(len, kinds)) != self._count:
            return {}
        found: list[list[Outline]] = []
        for fix in self.fixes:
            planes = level_planes(problem, fix.position.reshape(-1, problem.dimension))
            found += outlines_of(problem, fix, [planes])
        return {i: each[0] for i, each in enumerate(found) if each}


def _region(frame: Frame, centre: Array, region: Outline) -> dict[str, Any]:
    """Return the plan of a region along east and north as a geometry."""
    from optloc.show.pictures.outlines import earth_line, polygon_geometry

    axes = frame.enu_axes(centre)[:2]
    return polygon_geometry([[earth_line(frame, centre + line @ axes) for line in each] for each in region.polygons])


def _ellipse(frame: Frame, centre: Array, level: Array) -> dict[str, Any]:
    """Return the horizontal 95 % ellipse of a level covariance (2, 2) as a geometry, counter-clockwise."""
    from optloc.show.pictures.outlines import earth_line, polygon_geometry

    semi_axes, directions = error_ellipse(level)
    # Eigenvectors may be left-handed: the sign of the turn makes up for it.
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1) * np.sign(np.linalg.det(directions))
    plane = (np.stack([np.cos(angle), np.sin(angle)], axis=-1) * semi_axes) @ directions.T
    plane[-1] = plane[0]
    return polygon_geometry([[earth_line(frame, centre + plane @ frame.enu_axes(centre)[:2])]])


def geojson(results: Results) -> dict[str, Any]:
    """Return stations, fixes, alternatives and what holds 95 % as a GeoJSON feature collection (RFC 7946).

    An ellipse where it covers, else the outline of the region; what is not ok, or curved without a region, has neither.
    """
    from optloc.show.pictures.outlines import feature, point_geometry

    need_earth(results.frame, "GeoJSON", results.title)
    features = [feature(point_geometry(place), {"role": "station", "name": name}) for name, place in results.stations()]
    skipped = {"x", "y", "z", "lat_deg", "lon_deg", "height"}
    rows = records(results.columns)
    for row, mark, area, known in zip(rows, results.marks(), results.areas(), results.known(), strict=True):
        about: dict[str, Any] = {name: row[name] for name in ("number", "epoch", "target") if name in row}
        told = {name: value for name, value in row.items() if name not in skipped and not name.startswith("cov_")}
        if mark.known:
            features.append(feature(point_geometry(mark.place), {"role": "fix", **told}))
        if area is not None:
            features.append(feature(area.geometry, {"role": area.role, **({"cut": True} if area.cut else {}), **about}))
        for other in mark.others:
            doubt = {"gap": other.gap, "probability": other.probability}
            features.append(feature(point_geometry(other.place), {"role": "alternative", **about, **doubt}))
        features += [feature(geometry, {**own, **about}) for geometry, own in known]
    return {"type": "FeatureCollection", "features": features}
