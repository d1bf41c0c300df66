"""What a picture of fixes shows: positions along its axes, covariances, alternatives, regions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import factorial

import numpy as np

from optloc.fix import Fix
from optloc.frames import Frame
from optloc.layout import state_names
from optloc.problem import Problem
from optloc.status import Status
from optloc.types import Array, Band, Polygon


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn, metres along the picture's axes (east, north, up on Earth).

    Parameters
    ----------
    stations : array (s, d)
        Positions.
    names : tuple of s str
        Their names.
    fixes : array (n, d)
        Estimates; NaN where there is none.
    covariances : array (n, d, d)
        Theirs; NaN where there is none.
    clean : bool array (n,)
        Where the status is ok.
    alternatives : array (q, d)
        Other positions.
    gaps : array (q,)
        Their cost gaps.
    axes : tuple of d str
        Names of the axes.
    regions : tuple of array (v, 2)
        Corners of the polygons and boxes of the plan.
    tracks : tuple of array (k, d)
        Where moving stations are in the course of the run.
    paths : tuple of array (k, d)
        The same of moving targets, as they were fixed.
    other_paths : tuple of array (k, d)
        The same as the alternatives have it.
    known : tuple of array (k, d)
        Places of known targets.
    """

    stations: Array
    names: tuple[str, ...]
    fixes: Array
    covariances: Array
    clean: Array
    alternatives: Array
    gaps: Array
    axes: tuple[str, ...]
    regions: tuple[Array, ...] = ()
    tracks: tuple[Array, ...] = ()
    paths: tuple[Array, ...] = ()
    other_paths: tuple[Array, ...] = ()
    known: tuple[Array, ...] = ()

    def moved(self, change: Callable[[Array], Array]) -> Scene:
        """Return the scene with all positions changed; regions and covariances stay."""
        return replace(
            self,
            stations=change(self.stations),
            fixes=change(self.fixes),
            alternatives=change(self.alternatives),
            tracks=tuple(change(part) for part in self.tracks),
            paths=tuple(change(part) for part in self.paths),
            other_paths=tuple(change(part) for part in self.other_paths),
            known=tuple(change(part) for part in self.known),
        )


def scene_of(problem: Problem, fixes: Sequence[Fix]) -> Scene:
    """Return what is to be drawn of a problem and its fixes."""
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    parts = [part for fix in fixes for part in states_of(fix)]
    d = problem.dimension
    position = np.concatenate([p for p, _, _ in parts] or [np.zeros((0, d))])
    covariance = np.concatenate([c for _, c, _ in parts] or [np.zeros((0, d, d))])
    clean = np.concatenate([ok for _, _, ok in parts] or [np.zeros(0, dtype=bool)])
    others, gaps = _alternatives(fixes, d) if len(position) <= 12 else (np.zeros((0, d)), np.zeros(0))
    axes = ("east", "north", "up") if problem.frame.geodetic else ("x", "y", "z")
    reach = np.concatenate([stations, position[np.isfinite(position).all(-1)]])[:, :2]
    regions = () if problem.frame.kind == "ecef" else _regions(problem, reach)
    paths, other = _paths(problem, fixes)
    known = tuple(m.known.reshape(-1, *m.known.shape[-2:])[:, 0] for m in problem.motions if m.known is not None)
    scene = Scene(
        *(stations, problem.stations.names, position, covariance, clean, others, gaps, axes[:d], regions),
        tracks=_tracks(problem),
        paths=paths,
        other_paths=other,
        known=tuple(_thinned(place) for place in known),
    )
    return _local(problem, scene) if problem.frame.kind == "ecef" else scene


def local_frame(problem: Problem) -> Frame | None:
    """Return east, north and up at the centre of stations in ECEF, in which they are drawn; None in other frames."""
    if problem.frame.kind != "ecef":
        return None
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    lat, lon, height = problem.frame.to_geodetic(stations.mean(0))
    return Frame("enu", (float(lat), float(lon), float(height)))


def placed_points(problem: Problem, points: Array) -> tuple[Array, Array]:
    """Return points (n, d) along the picture's axes in the problem's frame, and the axes (d, d) in its rows."""
    local = local_frame(problem)
    if local is None:
        return points, np.eye(problem.dimension)
    return local.to_ecef(points), local.rotation_to_ecef().T


def _local(problem: Problem, scene: Scene) -> Scene:
    """Return a scene in ECEF along east, north and up at the stations' centre."""
    local = local_frame(problem)
    assert local is not None
    turn = local.rotation_to_ecef().T
    moved = scene.moved(lambda place: local.from_ecef(place.reshape(-1, 3)))
    return replace(moved, covariances=turn @ scene.covariances @ turn.T)


def _tracks(problem: Problem) -> tuple[Array, ...]:
    """Return the tracks (k, d) of the stations of a single run that move."""
    position = problem.stations.position
    if position.ndim > 3:
        return ()
    tracks = (_thinned(track) for track in np.swapaxes(position, 0, 1))
    return tuple(track for track in tracks if np.ptp(track, axis=0).max() > 0.0)


def _thinned(track: Array, most: int = 200) -> Array:
    """Return a track (k, d) with no more points than a picture needs, the first and the last among them."""
    return np.asarray(track[np.unique(np.linspace(0, len(track) - 1, most).astype(int))])


def _paths(problem: Problem, fixes: Sequence[Fix]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the paths (k, d) of the moving targets of a run, as fixed and as its alternatives have them."""
    if len(fixes) != 1 or fixes[0].shape or problem.epochs == 1:
        return (), ()
    others = fixes[0].alternatives
    vectors = [fixes[0].x, *others.x[np.isfinite(others.gap)]]
    paths: list[list[Array]] = [[], []]
    for number, x in enumerate(vectors):
        if not np.isfinite(x).all():
            continue
        for i, motion in enumerate(problem.motions):
            if motion.known is None and (motion.order or motion.span == "epoch"):
                paths[number > 0].append(_thinned(_path(problem, fixes[0], i, x)))
    return tuple(paths[0]), tuple(paths[1])


def _path(problem: Problem, fix: Fix, target: int, x: Array) -> Array:
    motion = problem.motions[target]
    states = [fix.layout.take(x, name) for name in state_names(target, len(problem.motions), motion.order)]
    if motion.span == "epoch":
        return states[0]
    since = problem.times - (problem.times[0] if motion.reference is None else motion.reference)
    return np.asarray(sum(since[:, None] ** i / factorial(i) * state for i, state in enumerate(states)))


def _regions(problem: Problem, reach: Array) -> tuple[Array, ...]:
    """Return the corners (v, 2) of polygons and boxes; an open box ends a little beyond the points (n, 2) to reach."""
    rim = 0.1 * np.ptp(reach, axis=0)
    sides: dict[int, tuple[Array, Array]] = {}
    for c in problem.constraints:
        if isinstance(c, Band) and c.kind == "plane" and np.ndim(c.lower) == np.ndim(c.upper) == 0:
            along = np.flatnonzero(c.coefficients)
            if len(along) == 1 and along[0] < 2 and c.coefficients[along[0]] == 1.0:
                box = sides.setdefault(c.target, (reach.min(0) - rim, reach.max(0) + rim))
                for corner, bound in zip(box, (c.lower, c.upper), strict=True):
                    corner[along[0]] = bound if np.isfinite(bound) else corner[along[0]]
    boxes = [np.array([[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]]) for a, b in sides.values()]
    return (*boxes, *(c.vertices for c in problem.constraints if isinstance(c, Polygon)))


def states_of(fix: Fix) -> list[tuple[Array, Array, Array]]:
    """Return positions (n, d), covariances (n, d, d) and whether they are clean (n,) of every target."""
    flat = fix if len(fix.shape) == 1 else fix.flat()
    found = []
    for slots, shared in ((flat.layout.shared, True), (flat.layout.local, False)):
        for slot in slots:
            if slot.name.partition("[")[0] != "position":
                continue
            values = flat.take(slot.name)
            d = values.shape[-1]
            position = values.reshape(-1, d)
            covariance = flat.covariance(slot.name) if shared else np.full((len(position), d, d), np.nan)
            found.append((position, covariance, np.repeat(flat.code == Status.OK, len(position) // len(flat))))
    return found


def _alternatives(fixes: Sequence[Fix], d: int) -> tuple[Array, Array]:
    points, gaps = [], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                points.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                gaps.append(flat.alternatives.gap[shown])
    return np.concatenate(points or [np.zeros((0, d))]), np.concatenate(gaps or [np.zeros(0)])
