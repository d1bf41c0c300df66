"""Starts from Doppler shifts: a relaxation with a limited number of rows, range rows, and a known height.

A *node* is a pair of epoch and station: one position and velocity of a receiver. Letters: N problems, m rows in the
relaxation, M nodes, n shared unknowns, d coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.doppler_sdp import SIZE, doppler, lifted_size
from formulations.normal_points import blocks, normal_points
from formulations.range_height import Ellipsoid, ellipsoid
from optloc.base.linalg import whitening
from optloc.base.threads import WORTH, map_on_threads
from optloc.base.types import Array, Rows
from optloc.linear.evaluate import block_links
from optloc.linear.mirror import one_position
from optloc.linear.vectors import vectors
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.problem.noise import dense, variances
from optloc.problem.problem import Problem
from optloc.solvers.starts.position import known_height

_AXES = WGS84_A * np.array([1.0, 1.0, 1.0 - WGS84_F])


def has_doppler_of_rest(problem: Problem) -> bool:
    """Return whether the only target is a source at rest, and rows measure its range rates."""
    if len(problem.motions) != 1 or problem.stations.velocity is None:
        return False
    motion, measured = problem.motions[0], any(_rates(rows) != (0, 0) for rows in problem.rows)
    return measured and motion.known is None and motion.order == 0 and motion.span == "run"


def doppler_starts(problem: Problem) -> Array:
    """Return candidates of a flat batch of sources at rest from their Doppler shifts, one by one.

    The relaxation uses rows of range rates and of sums of ranges; the refinement uses all rows. If there are too many
    rows, rows of the same stations are averaged to normal points, or every other block is taken.

    Parameters
    ----------
    problem : Problem
        N problems, see `has_doppler_of_rest`.

    Returns
    -------
    array (N, q, d) or (N, q, size)
        Positions, metres, for problems of one position, else full vectors. NaN in empty slots.
    """
    size, d = problem.batch_shape[0], problem.dimension
    position = np.full((size, 1 + 2 * d, d), np.nan)
    height, every = _heights(problem), _gather(problem)

    def start(i: int) -> None:
        position[i] = _start(problem, i, every, _surface(height, i))

    if len(every.row):
        map_on_threads(start, range(size), least=WORTH)
    return position if one_position(problem) else vectors(problem, position)


@dataclass(frozen=True, slots=True)
class _DopplerRows:
    """The m rows in the relaxation, for all problems of a batch.

    Parameters
    ----------
    row : int array (m,)
        Number in the problem.
    epoch, a, b : int array (m,)
        Epoch and stations; b is -1 for a single station.
    group : int array (m,)
        Equal for rows of one kind at the same stations.
    rates, ranges : array (m, 2)
        Coefficients of the range rates and ranges of both stations.
    design : array (m, n)
        Coefficients of the shared unknowns.
    """

    row: Array
    epoch: Array
    a: Array
    b: Array
    group: Array
    rates: Array
    ranges: Array
    design: Array

    def take(self, index: Array) -> _DopplerRows:
        """Return some of the rows."""
        return _DopplerRows(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def _gather(problem: Problem) -> _DopplerRows:
    """Return the rows of all problems that the relaxation can use, with groups and coefficients."""
    shared, parts = problem.layout.n_shared, list(_parts(problem))
    row, epoch, a, b, kind, rates, ranges = (np.concatenate(values) for values in zip(*parts, strict=True))
    design = np.zeros((problem.count, shared))
    for links, start in zip(block_links(problem), problem.starts, strict=True):
        is_shared = links.adds.column < shared
        np.add.at(
            design, (start + links.adds.row[is_shared], links.adds.column[is_shared]), links.adds.coefficient[is_shared]
        )
    _, group = np.unique(np.stack([kind, a, b]), axis=1, return_inverse=True)
    return _DopplerRows(row, epoch, a, b, group.reshape(-1), rates, ranges, design[row])


def _parts(problem: Problem) -> Iterator[tuple[Array, ...]]:
    """Yield seven arrays for each kind: number, epoch, stations a and b, number of the kind, and coefficients.

    The last two arrays (m, 2) are the coefficients of the rates and of the ranges. Kinds that the relaxation does not
    use yield empty arrays.
    """
    for i, (rows, start) in enumerate(zip(problem.rows, problem.starts, strict=True)):
        rates, ranges = _rates(rows), _ranges(rows)
        count = rows.count if rates != (0, 0) or ranges != (0, 0) else 0
        one = np.ones((count, 1))
        part = slice(0, count)
        other = rows.b[part] if MODELS[rows.kind].stations > 1 else np.full(count, -1)
        kind = np.full(count, i)
        yield start + np.arange(count), rows.epoch[part], rows.a[part], other, kind, one * rates, one * ranges


def _rates(rows: Rows) -> tuple[int, int]:
    """Return the coefficients of the range rates at the first and second station of rows; (0, 0) without rates."""
    model = MODELS[rows.kind]
    return model.signs if model.signs is not None and model.nodes == ((1.0, "range_rate"),) else (0, 0)


def _ranges(rows: Rows) -> tuple[int, int]:
    """Return the coefficients of the ranges at the first and second station of rows; (0, 0) without ranges."""
    # rows with an unknown emission time in each epoch are used by the refinement only
    model = MODELS[rows.kind]
    return (0, 0) if model.ranges is None or model.emission else model.ranges


def _start(problem: Problem, i: int, every: _DopplerRows, surface: Ellipsoid | None) -> Array:
    """Return the points (1 + 2 d, d) of the relaxation of problem i, metres; NaN without usable rates.

    The first point is the mean of the relaxation, and the others are around it, the farthest first. `every` are the
    rows of all problems in the relaxation. `surface` is the ellipsoid of a known height, or None.
    """
    scene = _scene(problem.take(np.array([i])), every, surface)
    if scene is None:
        return np.full((1 + 2 * problem.dimension, problem.dimension), np.nan)
    found = doppler(**scene.given, surface=surface).point
    return found if surface is None else problem.frame.from_ecef(found)


@dataclass(frozen=True, slots=True)
class LimitedRows:
    """The rows of one problem that its relaxation uses.

    Parameters
    ----------
    given : dict of str to array
        Arguments of `formulations.doppler_sdp.doppler`.
    column : int array (p,)
        Columns of its linear unknowns in the shared unknowns.
    surface : Ellipsoid or None
        The ellipsoid of a known height, Earth-centred as the positions then are.
    """

    given: dict[str, Any]
    column: Array
    surface: Ellipsoid | None


def _heights(problem: Problem) -> Array | None:
    """Return the known heights (N,), metres, or None."""
    return known_height(problem) if problem.frame.geodetic and problem.dimension == 3 else None


def _surface(height: Array | None, i: int) -> Ellipsoid | None:
    """Return the ellipsoid of the height of problem i, or None without a known height."""
    return None if height is None or not np.isfinite(height[i]) else ellipsoid(_AXES, height[i])


def limited_rows(problem: Problem) -> LimitedRows | None:
    """Return the rows of a flat batch of one problem for its relaxation; None without usable rates."""
    every = _gather(problem)
    return _scene(problem, every, _surface(_heights(problem), 0)) if len(every.row) else None


def _scene(one: Problem, every: _DopplerRows, surface: Ellipsoid | None) -> LimitedRows | None:
    """Return the rows of one problem for its relaxation; the other arguments are as in `_start`."""
    z, weight = one.observed[0, every.row], np.broadcast_to(one.weight, (1, one.count))[0, every.row]
    present = (weight > 0.0) & np.isfinite(z)
    rows, z, weight = every.take(present), z[present], weight[present]
    if not rows.rates.any():
        return None
    pick, values, sigma = _limit_rows(one, rows, z, weight)
    chosen = rows.take(pick)
    nodes, ranges, rates = _nodes(one, chosen)
    if sigma is None:
        scale = np.sqrt(weight)
        covariance = dense(one.noise, chosen.row).reshape(-1, len(pick), len(pick))[0] / (scale[:, None] * scale)
        white = whitening(covariance[None])[0]
    else:
        white = np.diag(1.0 / sigma)
    place, speed = _motion_of_nodes(one, nodes, surface is not None)
    used = np.flatnonzero(chosen.design.any(axis=0))
    given = {"place": place, "speed": speed, "z": values, "whiten": white, "ranges": ranges, "rates": rates}
    return LimitedRows({**given, "design": chosen.design[:, used]}, used, surface)


def _limit_rows(problem: Problem, rows: _DopplerRows, z: Array, weight: Array) -> tuple[Array, Array, Array | None]:
    """Return the numbers of the rows used, their values and their standard deviations.

    The standard deviations are None if all original rows are used, which may be correlated. If the relaxation is too
    large, rows of one group are averaged to normal points, which are independent. `z` and `weight` (m,) are the values
    and weights of the rows.
    """
    if _size(problem, rows) <= SIZE:
        return np.arange(len(z)), z, None
    time = problem.times[rows.epoch]
    parts = [np.flatnonzero(rows.group == group) for group in np.unique(rows.group)]
    # the shortest blocks that are few enough; each row adds at least one entry
    for length in range(max(2, len(z) // SIZE), 1 + max(2, *map(len, parts))):
        cut = [part[block] for part in parts for block in blocks(time[part], length)]
        pick = np.array([block[len(block) // 2] for block in cut])
        if _size(problem, rows.take(pick)) <= SIZE:
            break
    # for too many stations: every other block, every third block, and so on
    steps = (step for step in range(1, len(cut)) if _size(problem, rows.take(pick[::step])) <= SIZE)
    sigma = np.sqrt(variances(problem.noise, problem.count)[..., rows.row].reshape(-1, len(z))[0] / weight)
    return normal_points(time, z, sigma, cut[:: next(steps, len(cut))])


def _size(problem: Problem, rows: _DopplerRows) -> int:
    """Return the size of the lifted matrix of the relaxation with these rows; its time grows steeply with this size."""
    _, ranges, rates = _nodes(problem, rows)
    return lifted_size(problem.dimension, ranges, rates, rows.design[:, rows.design.any(axis=0)])


def _nodes(problem: Problem, rows: _DopplerRows) -> tuple[Array, Array, Array]:
    """Return the nodes (M, 2) of rows, and the coefficients (m, M) of their ranges and of their rates.

    A node is a pair (epoch, station); if no station moves, all epochs count as epoch 0.
    """
    stations = problem.stations
    assert stations.velocity is not None
    stays = stations.position.shape[-3] == 1 and stations.velocity.shape[-3] == 1
    epoch = np.zeros_like(rows.epoch) if stays else rows.epoch
    ends = np.stack([np.stack([epoch, station], axis=1) for station in (rows.a, rows.b)], axis=1)
    known = ends[..., 1] >= 0
    nodes, at = np.unique(ends[known], axis=0, return_inverse=True)
    row, side = np.nonzero(known)
    out = np.zeros((2, len(rows.row), len(nodes)))
    np.add.at(out[0], (row, at.reshape(-1)), rows.ranges[row, side])
    np.add.at(out[1], (row, at.reshape(-1)), rows.rates[row, side])
    return nodes, out[0], out[1]


def _motion_of_nodes(problem: Problem, nodes: Array, geocentric: bool) -> tuple[Array, Array]:
    """Return positions and velocities (M, d) of nodes (M, 2), m and m/s; Earth-centred if `geocentric`."""
    stations = problem.stations
    assert stations.velocity is not None
    place, speed = (
        np.broadcast_to(values, (1, *values.shape[-3:]))[0][np.minimum(nodes[:, 0], values.shape[-3] - 1), nodes[:, 1]]
        for values in (stations.position, stations.velocity)
    )
    if not geocentric:
        return place, speed
    return problem.frame.to_ecef(place), speed @ problem.frame.rotation_to_ecef().T
