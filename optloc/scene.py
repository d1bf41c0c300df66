"""What a picture of fixes shows: positions along its axes, covariances, alternatives, regions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.fix import Fix
from optloc.frames import Frame
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


def scene_of(problem: Problem, fixes: Sequence[Fix]) -> Scene:
    """Return what is to be drawn of a problem and its fixes."""
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    parts = [part for fix in fixes for part in _states(fix)]
    d = problem.dimension
    position = np.concatenate([p for p, _, _ in parts] or [np.zeros((0, d))])
    covariance = np.concatenate([c for _, c, _ in parts] or [np.zeros((0, d, d))])
    clean = np.concatenate([ok for _, _, ok in parts] or [np.zeros(0, dtype=bool)])
    others, gaps = _alternatives(fixes, d) if len(position) <= 12 else (np.zeros((0, d)), np.zeros(0))
    if problem.frame.kind == "ecef":
        local = Frame("enu", tuple(float(v) for v in problem.frame.to_geodetic(stations.mean(0))))  # type: ignore[arg-type]
        turn = local.rotation_to_ecef().T
        stations, position, others = (local.from_ecef(p) for p in (stations, position, others.reshape(-1, 3)))
        covariance = turn @ covariance @ turn.T
    axes = ("east", "north", "up") if problem.frame.geodetic else ("x", "y", "z")
    reach = np.concatenate([stations, position[np.isfinite(position).all(-1)]])[:, :2]
    regions = () if problem.frame.kind == "ecef" else _regions(problem, reach)
    return Scene(stations, problem.stations.names, position, covariance, clean, others, gaps, axes[:d], regions)


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


def _states(fix: Fix) -> list[tuple[Array, Array, Array]]:
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
