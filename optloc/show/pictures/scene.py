"""The scene of a picture of fixes: positions along the axes of the picture, covariances, alternatives and regions.

An ellipse is *valid* if it covers the true position with the stated probability.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array, Status
from optloc.linear.courses import course_at, elapsed
from optloc.problem.chart import CARTESIAN
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show.pictures.constraint_shapes import DrawnRegion, drawn_regions
from optloc.show.pictures.outlines import outlines_of
from optloc.uncertainty.outline import Outline

View = tuple[int, int]
"""Indices of the two axes of the scene that a panel shows."""

PLAN: View = (0, 1)
HEIGHT: View = (0, 2)
# Maximum number of fixes with alternatives and large marks, and of fixes with ellipses: with more fixes, only dots are
# readable.
FEW_FIXES, ELLIPSES = 12, 200
# Points of a path or track: finer than the pixels of a picture.
_POINTS = 200


@dataclass(frozen=True, slots=True)
class PictureScene:
    """The content of a picture of fixes, m, along the axes of the picture (east, north, up on Earth).

    Parameters
    ----------
    stations : array (s, d)
        Positions of the stations.
    names : tuple of s str
        Names of the stations.
    fixes : array (n, d)
        Estimated positions; NaN if unknown.
    covariances : array (n, d, d)
        Covariances of the estimates, m^2; NaN if unknown.
    clean : bool array (n,)
        Whether the status is `ok`.
    alternatives : array (q, d)
        Positions of the alternatives.
    gaps : array (q,)
        Cost gaps of the alternatives.
    axes : tuple of d str
        Names of the axes.
    regions : tuple of DrawnRegion
        Shapes of constraints in the plan.
    tracks : tuple of array (k, d)
        Tracks of the moving stations during the run.
    paths : tuple of array (k, d)
        Estimated paths of the moving targets.
    other_paths : tuple of array (k, d)
        Paths of the moving targets in the alternatives.
    known : tuple of array (k, d)
        Positions of known targets.
    outlines : tuple of n dicts of View to Outline
        95 % region of each fix without a valid ellipse, by view; empty for other fixes.
    local : bool array (n,), optional
        Whether the ellipse of a fix is not valid while its region is unknown.
    """

    stations: Array
    names: tuple[str, ...]
    fixes: Array
    covariances: Array
    clean: Array
    alternatives: Array
    gaps: Array
    axes: tuple[str, ...]
    regions: tuple[DrawnRegion, ...] = ()
    tracks: tuple[Array, ...] = ()
    paths: tuple[Array, ...] = ()
    other_paths: tuple[Array, ...] = ()
    known: tuple[Array, ...] = ()
    outlines: tuple[dict[View, Outline], ...] = ()
    local: Array | None = None

    def moved(self, change: Callable[[Array], Array]) -> PictureScene:
        """Return the scene with all positions changed; regions, covariances and outlines do not change."""
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


def scene_of(problem: Problem, fixes: Sequence[Fix], *, outlined: bool = False) -> PictureScene:
    """Return the scene of a problem and its fixes.

    With `outlined`, the scene has the outlines of the 95 % regions of fixes without a valid ellipse.
    """
    # Use the first epoch of moving stations and the first problem of a batch; tracks are drawn as lines.
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    parts = [part for fix in fixes for part in states_of(fix)]
    d = problem.dimension
    position = np.concatenate([p for p, _, _ in parts] or [np.zeros((0, d))])
    covariance = np.concatenate([c for _, c, _ in parts] or [np.zeros((0, d, d))])
    clean = np.concatenate([ok for _, _, ok in parts] or [np.zeros(0, dtype=bool)])
    others, gaps = _alternatives(fixes, d) if len(position) <= FEW_FIXES else (np.zeros((0, d)), np.zeros(0))
    axes = ("east", "north", "up") if problem.frame.geodetic else ("x", "y", "z")
    reach = np.concatenate([stations, position[np.isfinite(position).all(-1)]])[:, :2]
    # Shapes in space are cut at the fixes. In ECEF, a box of x and y has no shape in the plan.
    known = position[np.isfinite(position).all(-1)]
    centre = np.median(known if len(known) else stations, axis=0)
    regions = () if problem.frame.kind == "ecef" else drawn_regions(problem, reach, centre)
    paths, other = _paths(problem, fixes)
    known = tuple(m.known.reshape(-1, *m.known.shape[-2:])[:, 0] for m in problem.motions if m.known is not None)
    outlines = _outlines(problem, fixes, len(position)) if outlined else ()
    scene = PictureScene(
        *(stations, problem.stations.names, position, covariance, clean, others, gaps, axes[:d], regions),
        tracks=_tracks(problem),
        paths=paths,
        other_paths=other,
        known=tuple(thinned(place) for place in known),
        outlines=outlines,
        local=is_local(fixes, [bool(each) for each in outlines], len(position)),
    )
    return _along_local_axes(problem, scene) if problem.frame.kind == "ecef" else scene


def _outlines(problem: Problem, fixes: Sequence[Fix], count: int) -> tuple[dict[View, Outline], ...]:
    """Return the 95 % regions of fixes without a valid ellipse, by view: the plan and, in three dimensions, the height.

    Each fix has one dict, which is empty if its ellipse is valid. Without any dict, the regions are unknown
    (see `regions_of`); `count` is as there.
    """
    views = (PLAN, HEIGHT) if problem.dimension == 3 else (PLAN,)
    local = local_frame(problem)
    axes = np.eye(problem.dimension) if local is None else local.rotation_to_ecef().T
    found = regions_of(problem, fixes, count, [axes[list(view)] for view in views])
    return tuple(dict(zip(views, each, strict=False)) for each in found)


def regions_of(
    problem: Problem, fixes: Sequence[Fix], count: int, planes: Sequence[Array]
) -> tuple[list[Outline], ...]:
    """Return the 95 % regions of fixes in planes.

    The result is empty if there are too many fixes, or a fix has several positions.

    Parameters
    ----------
    problem : Problem
        Problem of the fixes.
    fixes : sequence of Fix
        Single fixes or batches.
    count : int
        Number of positions in the picture.
    planes : sequence of array (2, d) or (n, 2, d)
        Axes of each plane, the same for all fixes or one plane for each fix.
    """
    if count > ELLIPSES or count != sum(fix.code.size for fix in fixes):
        return ()
    found: list[list[Outline]] = []
    for fix in fixes:
        part = slice(len(found), len(found) + fix.code.size)
        found += outlines_of(problem, fix, [plane if plane.ndim == 2 else plane[part] for plane in planes])
    return tuple(found)


def is_local(fixes: Sequence[Fix], outlined: Sequence[bool], count: int) -> Array | None:
    """Return, for each fix (n,), whether its ellipse is not valid and it has no outline.

    If a fix has several positions, the result is None.
    """
    if count != sum(fix.code.size for fix in fixes):
        return None
    kinds = [np.zeros(fix.code.size) if fix.chart is None else np.ravel(fix.chart.kind) for fix in fixes]
    bare = np.array([not each for each in outlined] or [True] * count, dtype=bool)
    return np.asarray((np.concatenate([*kinds, np.zeros(0)]) != CARTESIAN) & bare)


def local_frame(problem: Problem) -> Frame | None:
    """Return the frame of pictures in ECEF: east, north and up at the centre of the stations; None for other frames."""
    if problem.frame.kind != "ecef":
        return None
    stations = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    lat, lon, height = problem.frame.to_geodetic(stations.mean(0))
    return Frame("enu", (float(lat), float(lon), float(height)))


def placed_points(problem: Problem, points: Array) -> tuple[Array, Array]:
    """Return points in the frame of the problem (n, d), m, and the axes of the picture (d, d) as rows in that frame.

    The argument `points` (n, d) is along the axes of the picture.
    """
    local = local_frame(problem)
    if local is None:
        return points, np.eye(problem.dimension)
    return local.to_ecef(points), local.rotation_to_ecef().T


def _along_local_axes(problem: Problem, scene: PictureScene) -> PictureScene:
    """Return a scene in ECEF along east, north and up at the centre of the stations."""
    local = local_frame(problem)
    assert local is not None
    turn = local.rotation_to_ecef().T
    moved = scene.moved(lambda place: local.from_ecef(place.reshape(-1, 3)))
    return replace(moved, covariances=turn @ scene.covariances @ turn.T)


def _tracks(problem: Problem) -> tuple[Array, ...]:
    """Return the tracks (k, d), m, of the moving stations of a single run."""
    position = problem.stations.position
    if position.ndim > 3:
        return ()
    tracks = (thinned(track) for track in np.swapaxes(position, 0, 1))
    return tuple(track for track in tracks if np.ptp(track, axis=0).max() > 0.0)


def thinned(track: Array) -> Array:
    """Return a track (k, d) with at most `_POINTS` points, including the first and the last point."""
    return np.asarray(track[np.unique(np.linspace(0, len(track) - 1, _POINTS).astype(int))])


def _paths(problem: Problem, fixes: Sequence[Fix]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return the paths (k, d), m, of the moving targets of a run: first of its only fix, then of the alternatives."""
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
                paths[number > 0].append(thinned(_path(problem, fixes[0], i, x)))
    return tuple(paths[0]), tuple(paths[1])


def _path(problem: Problem, fix: Fix, target: int, x: Array) -> Array:
    """Return the path (k, d), m, of a moving target at the epochs of a run, from the parameter vector `x` (size,)."""
    motion = problem.motions[target]
    states = [fix.layout.take(x, name) for name in state_names(target, len(problem.motions), motion.order)]
    if motion.span == "epoch":
        return states[0]
    parts = [tuple(state[..., i] for i in range(state.shape[-1])) for state in states]
    rise = 0.0 if motion.rise is None else motion.rise[..., 0]
    return np.stack(course_at(problem, target, parts, elapsed(problem, target), rise), axis=-1)


def states_of(fix: Fix) -> list[tuple[Array, Array, Array]]:
    """Return positions (n, d), m, covariances (n, d, d), m^2, and whether the status is `ok` (n,), for each target."""
    flat = fix if len(fix.shape) == 1 else fix.flat()
    found = []
    for slots, shared in ((flat.layout.shared, True), (flat.layout.local, False)):
        for slot in slots:
            if slot.name.partition("[")[0] != "position":
                continue
            values = flat.take(slot.name)
            d = values.shape[-1]
            position = values.reshape(-1, d)
            # Positions of single epochs in a run have a covariance only if the solver was asked to compute it.
            covariance = np.full((len(position), d, d), np.nan)
            if shared:  # NaN removes the undetermined axes only.
                undetermined = flat.undetermined(slot.name)
                hidden = undetermined[:, :, None] | undetermined[:, None, :]
                covariance = np.where(hidden, np.nan, flat.covariance(slot.name))
            found.append((position, covariance, np.repeat(flat.code == Status.OK, len(position) // len(flat))))
    return found


def _alternatives(fixes: Sequence[Fix], d: int) -> tuple[Array, Array]:
    """Return the positions (q, d), m, and the cost gaps (q,) of the alternatives of all fixes."""
    points, gaps = [], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                points.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                gaps.append(flat.alternatives.gap[shown])
    return np.concatenate(points or [np.zeros((0, d))]), np.concatenate(gaps or [np.zeros(0)])
