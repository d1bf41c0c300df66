"""Cost over the position for rows with unknown scales, as a sum of squares, at any distance and at infinity.

At a fixed position the rows are linear in all other unknowns. The column of an unknown scale is as long as the ranges.
For a distant position, normal equations lose the digits in which this column differs from the column of an emission
time. This module projects the rows instead, and it subtracts nothing from a cost.

An unknown scale e multiplies rows by the factor 1 + e. Arrays have N problems, r rows (with priors), n unknown scales,
and d coordinates of the position.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optloc.base import linalg
from optloc.base.linalg import span_of
from optloc.base.types import Array, Bias
from optloc.linear.evaluate import columns, differentiate
from optloc.linear.normal import prior_parts, whitener_at
from optloc.linear.walks import walks
from optloc.models import MODELS, Model
from optloc.problem.forms import form_of
from optloc.problem.noise import whiten_rows
from optloc.problem.problem import Problem

# Smallest share of a column that must remain after the projection. Rounding leaves a hundredth of this share; ranges at
# ten million spreads leave 1e-7.
_EXPLAINED = 1e-13
# Lower bound of the scale error of ranges and of levels. For ranges, the wave has no speed at the bound, and below it
# the wave would run backwards. For levels, power would increase with the distance.
_STILL = -1.0
# Largest exponent of a candidate: it increases with the distance, and differences of logarithms keep seven digits here.
# Beyond it, their rounding explains rows.
_STEEP = 1e9
# Thickness of coplanar stations, as a share of their width: rounding of coordinates.
_FLAT = 1e-9
# Starts of descents near coplanar stations: offsets from their centre along each tangent, in spreads; and number of
# steps.
_OFFSETS, _STEPS = (-1.0, 0.0, 1.0), 12
# Distance in spreads at which wave fronts are approximated by paraboloids. Higher orders are 1e-8 of the bend there,
# and so is the rounding of ranges.
_DISTANT = 1e4


def has_scales(problem: Problem) -> bool:
    """Return whether unknown scales multiply rows, in a problem without random walks."""
    return not walks(problem) and bool(_multiplying(problem))


def runs_backwards(problem: Problem, x: Array) -> Array:
    """Return a mask (...) of vectors `x` (..., size) with an unknown factor of ranges, times or levels of zero or less.

    For candidates (N, K, size), the mask also marks candidates whose exponent is rounding (`_STEEP`), unless all others
    are marked too.
    """
    out, steep = np.zeros(x.shape[:-1], dtype=bool), np.zeros(x.shape[:-1], dtype=bool)
    levels = _multiplies_kind(problem, _is_level)
    for column, least, level in zip(*_scales(problem), levels, strict=True):
        out |= x[..., column] <= least
        steep |= level & (x[..., column] > _STEEP)
    if x.ndim > 2 and steep.any():
        out |= steep & (~(out | steep) & np.isfinite(x).all(-1)).any(-1, keepdims=True)
    return out


def profile_by_rows(problem: Problem, x: Array, at: Array, passes: int) -> tuple[Array, Array, Array]:
    """Return the lowest cost over all unknowns except the position, with the information and gradient of the position.

    Arguments and results are as in `optloc.model_checks.shape.profile`. The derivative of a row by the position depends
    on the scales, so more passes make it exact. Factors of ranges, times and levels are not negative: their scales are
    at least `_STILL`.
    """
    slot, _ = problem.layout.find("position")
    part, (scale, least) = np.arange(slot.start, slot.start + slot.size), _scales(problem)
    rest = np.setdiff1d(np.arange(problem.layout.size), np.concatenate([part, scale]))
    for _ in range(passes):
        residual, design = _rows(problem, x, at)
        others = design[..., rest]
        basis, turned = span_of(others), np.linalg.pinv(others)
        left, slope, along = (
            _project_out(basis, residual[..., None]),
            _project_out(basis, design[..., part]),
            design[..., scale],
        )
        # a scale whose column the other unknowns explain completely is fixed: the remaining column is rounding
        column = _project_out(basis, along)
        usable = np.sqrt((column**2).sum(-2)) > _EXPLAINED * np.sqrt((along**2).sum(-2))
        move, left, at_bound = _bounded(column * usable[..., None, :], left, least - x[..., scale])
        # a scale at its bound does not react to the position, so its column is not projected out of the slope
        free_basis = span_of(column * (usable & ~at_bound)[..., None, :])
        slope = _project_out(free_basis, slope)
        x = np.array(x)
        x[..., scale] += move
        x[..., rest] += (turned @ (residual - (along @ move[..., None])[..., 0])[..., None])[..., 0]
    cost, back = (left[..., 0] ** 2).sum(-1), np.swapaxes(slope, -1, -2)
    return cost, back @ slope, (back @ left)[..., 0]


def cost_beyond_speed(problem: Problem, x: Array) -> Array:
    """Return the lowest cost (N,) of waves whose distance and unknown factor increase together, or infinity.

    Stations in a plane of space, or on a line of the plane, receive a wave from straight above as a paraboloid. Its
    bend and tilt stay finite if the factor increases with the distance. A prior on the factor gives these waves a high
    cost. `problem` is a flat batch of N problems with one position, and `x` (N, size) are fixes.
    """
    out, free = np.full(len(x), np.inf), _without_prior(problem)
    if problem.constraints or problem.fences or not len(free):
        return out
    # `items` are the problems with coplanar stations; only their waves are paraboloids
    centre, normal, tangents, spread, items = _planes_of(problem, len(x))
    if not len(items):
        return out
    slot, _ = problem.layout.find("position")
    part, some = np.arange(slot.start, slot.start + slot.size), problem.take(items)
    for side in (-_DISTANT, _DISTANT):
        there = np.array(x[items])
        there[:, part] = centre + side * spread[:, None] * normal
        if len(free) == 1:
            lowest = _above_any_place(some, there, x[items], part, tangents, free[0])
        else:
            lowest = _above_one_place(some, there, x[items], part, tangents * spread[:, None, None])
        out[items] = np.fmin(out[items], lowest)
    return out


def _above_any_place(problem: Problem, there: Array, at: Array, part: Array, tangents: Array, j: int) -> Array:
    """Return the lowest cost (N,) of waves from distant positions above the stations' plane, with one unknown factor.

    See `cost_beyond_speed`. The cost is minimised over the factor, a tilt of the wave front and the other unknowns. A
    step of the distant position along the plane only tilts the wave front, so the tilt replaces the position.
    `there` (N, size) are vectors with distant positions. `at` (N, size) are the fixes, at which the noise of station
    errors is computed. `part` (d,) are the columns of the position, and `j` is the column of the factor. `tangents`
    (N, d, d - 1) span the plane of the stations.
    """
    residual, design = _rows(problem, there, at)
    # Only rows that the factor multiplies receive a tilt.
    touched = (design[..., j] != 0.0)[..., None]
    tilt = np.where(touched, design[..., part] @ tangents, 0.0)
    rest = np.setdiff1d(np.arange(design.shape[-1]), np.append(part, j))
    basis = span_of(np.concatenate([design[..., rest], tilt], axis=-1))
    column, left = _project_out(basis, design[..., [j]]), _project_out(basis, residual[..., None])
    _, left, _ = _bounded(column, left, _STILL - there[:, [j]])
    return np.asarray((left[..., 0] ** 2).sum(-1))


def _above_one_place(problem: Problem, there: Array, at: Array, part: Array, tangents: Array) -> Array:
    """Return the lowest cost (N,) of distant waves with several free factors, which all come from one position.

    The method is Gauss-Newton along the tangents (N, d, d - 1), whose length is one spread. A step is at most one
    spread. The other arguments are as in `_above_any_place`. The centre of the starts is `there` (N, size).
    """
    count, along = tangents.shape[-1], np.swapaxes(tangents, -1, -2)
    first = np.stack(np.meshgrid(*[_OFFSETS] * count), axis=-1).reshape(-1, 1, count)
    y, best = np.broadcast_to(first, (len(first), len(there), count)), np.full(len(there), np.inf)
    for _ in range(_STEPS):
        x = np.array(np.broadcast_to(there, (len(y), *there.shape)))
        x[..., part] += (tangents @ y[..., None])[..., 0]
        cost, information, vector = profile_by_rows(problem, x, at, 2)
        best = np.fmin(best, cost.min(0))
        inner, pull = along @ information @ tangents, along @ vector[..., None]
        move = (np.linalg.pinv(inner, hermitian=True) @ pull)[..., 0]
        y = y + move / np.maximum(np.abs(move).max(-1, keepdims=True), 1.0)
    return np.asarray(best)


def _without_prior(problem: Problem) -> Array:
    """Return the columns of the unknown scales that multiply ranges and have no prior."""
    scale, least = _scales(problem)
    levels = scale[~_multiplies_kind(problem, lambda model: model.ranges is not None)]
    known = [columns(problem.layout, name, np.array([0]))[0] for name, _, _ in prior_parts(problem)]
    return np.asarray(scale[(least == _STILL) & ~np.isin(scale, np.concatenate([levels, *known]))])


def _planes_of(problem: Problem, count: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return the planes of the stations, for the problems whose stations are coplanar.

    The first two results are the centres (n, d), m, and the unit normals (n, d). They are followed by the unit tangents
    (n, d, d - 1), the spreads (n,), m, and the numbers (n,) of these problems. `count` is the number of all problems.
    """
    places = problem.stations.places
    places = np.broadcast_to(places, (count, *places.shape[-2:]))
    centre, spread = linalg.centre_and_spread(places)
    _, size, axes = np.linalg.svd(places - centre[:, None], full_matrices=True)
    d = places.shape[-1]
    flat = np.ones(count, dtype=bool) if size.shape[1] < d else size[:, -1] <= _FLAT * size[:, 0]
    items = np.flatnonzero(flat)
    axes = axes[items]
    return centre[items], axes[:, -1], np.swapaxes(axes[:, : d - 1], -1, -2), spread[items], items


def _scales(problem: Problem) -> tuple[Array, Array]:
    """Return the columns (n,) of all unknown scales, and the lower bound of each; minus infinity for no bound."""
    bounded = _multiplies_kind(problem, lambda model: model.ranges is not None or _is_level(model))
    found = [columns(problem.layout, bias.name, np.array([0]))[0] for bias in _multiplying(problem)]
    return np.concatenate([np.zeros(0, dtype=int), *found]), np.where(bounded, _STILL, -np.inf)


def _multiplying(problem: Problem) -> list[Bias]:
    """Return the biases that multiply rows; their members are the unknown scales."""
    return [bias for bias in problem.biases if form_of(bias).enters == "scales"]


def _is_level(model: Model) -> bool:
    """Return whether a kind is a received power (a level), which depends on the logarithm of the range alone."""
    return {node for _, node in model.nodes} == {"log range"}


def _multiplies_kind(problem: Problem, of_kind: Callable[[Model], bool]) -> Array:
    """Return a mask (n,) of the unknown scales that multiply rows of the kinds that `of_kind` selects."""
    rows = np.concatenate([np.full(rows.count, of_kind(MODELS[rows.kind])) for rows in problem.rows])
    found = [np.bincount(bias.member, rows[bias.row], len(bias.members)) > 0 for bias in _multiplying(problem)]
    return np.concatenate([np.zeros(0, dtype=bool), *found])


def _rows(problem: Problem, x: Array, at: Array) -> tuple[Array, Array]:
    """Return whitened residuals (..., r) and derivatives (..., r, size) of all rows and priors at vectors (..., size).

    The noise of the rows includes station errors of span "noise", which are new at each epoch. Their effect is computed
    at the vectors `at`. Column j of the derivatives belongs to unknown j of the vectors. `x` (..., size) are the
    vectors.
    """
    layout, (residual, folded) = problem.layout, differentiate(problem, x)
    n, length, total = layout.n_shared, layout.n_local, layout.size
    design = np.zeros((*folded.shape[:-1], total))
    design[..., :n] = folded[..., :n]
    for j in range(length):
        design[..., np.arange(problem.count), n + problem.epoch * length + j] = folded[..., n + j]
    both = whiten_rows(whitener_at(problem, at), np.concatenate([residual[..., None], design], axis=-1))
    parts = [both]
    for name, mean, precision in prior_parts(problem):
        shared = layout.find(name)[1]
        for epoch in range(1 if shared else problem.epochs):
            unknowns = columns(layout, name, np.array([epoch]))[0]
            root = np.swapaxes(np.linalg.cholesky(precision if shared else precision[..., 0, :, :]), -1, -2)
            known = np.zeros((*x.shape[:-1], len(unknowns), 1 + total))
            known[..., 1 + unknowns] = root
            difference = (mean if shared else mean[..., 0, :]) - x[..., unknowns]
            known[..., 0] = (root @ difference[..., None])[..., 0]
            parts.append(known)
    both = np.concatenate(parts, axis=-2)
    return both[..., 0], both[..., 1:]


def _project_out(basis: Array, values: Array) -> Array:
    """Return values (..., r, k) minus their projection onto an orthonormal basis (..., r, b).

    The projection is repeated, because rounding leaves a small part after one projection.
    """
    back = np.swapaxes(basis, -1, -2)
    once = values - basis @ (back @ values)
    return np.asarray(once - basis @ (back @ once))


def _bounded(column: Array, left: Array, least: Array) -> tuple[Array, Array, Array]:
    """Return the best steps (..., n) of the scales, the remaining residuals (..., r, 1), and a mask (..., n).

    `column` (..., r, n) are the derivatives by the scales, and `left` (..., r, 1) the residuals before the step. A step
    is at least `least` (..., n). The mask marks scales at this bound; the steps of the other scales are computed again.
    """
    at_bound = np.zeros(column.shape[:-2] + column.shape[-1:], dtype=bool)
    move = np.zeros(at_bound.shape)
    for _ in range(1 + at_bound.shape[-1]):
        fixed = np.where(at_bound, least, 0.0)
        rest = left - column @ np.where(at_bound, fixed, 0.0)[..., None]
        move = np.where(at_bound, fixed, (np.linalg.pinv(column * ~at_bound[..., None, :]) @ rest)[..., 0])
        below = ~at_bound & (move < least)
        if not below.any():
            break
        at_bound |= below
    return move, left - column @ move[..., None], at_bound
