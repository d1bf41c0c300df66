"""Starts for a whole run: minima of its block averages.

The minima are reached from a closed form or a relaxation, from mirror images, and from circles around the stations.

Letters: N runs, C candidates of a run, k epochs or blocks, s stations, d coordinates, q biases, `size` numbers of a
parameter vector. A *pool* is a pair here: vectors (N, C, size) and costs (N, C), the cheapest first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import factorial

import numpy as np

from formulations.registration import RegistrationCourse, candidates
from optloc.base import linalg
from optloc.base.types import Array, Bias, Status
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.courses import elapsed
from optloc.linear.evaluate import block_links
from optloc.linear.least_squares_ranges import Ranges, ranges
from optloc.linear.normal import covariance, prior_parts
from optloc.linear.redundancy import degrees_of_freedom
from optloc.linear.vectors import complete, vectors
from optloc.linear.walks import state_columns, walks
from optloc.problem.clocks import rate_name, state_of
from optloc.problem.epochs import by_epoch, without_epoch_correlation
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.solvers.policy import P_SUSPECT
from optloc.solvers.starts.block_averages import average_blocks
from optloc.solvers.starts.position import distance_of, spread_of

BLOCKS = 30
"""Blocks of a run: many more rows than unknowns, at a cost that does not grow with the run.

Fewer and longer blocks curve more between stations and target, and an average ignores this curvature.
"""

# Selection of the minima on block averages that are refined on all epochs, which is expensive. At most four are
# refined, and always the best two, since averaging may exchange a minimum and its mirror image. Averaging never changes
# a cost by a thousand.
_RIVAL = 1e3
_KEPT = 4
# Spreads of the stations within which two minima are one: far above the tolerance of refinement, far below a rival.
_SAME = 1e-4
# Share of the distance above which an error makes a fix weak. For weak fixes, and for improbable chi-squares, minima
# are also searched on circles around the stations and along the valley of the fix.
_WEAK = 1e-2
# Positions on each circle: every azimuth is within 30 degrees of one, which is enough for blocks with low noise.
_AZIMUTHS = 6
# Radii in spreads of the stations: just outside and far out; without a closed form, also between the stations.
_RADII = (1.5, 5.0)
_ANYWHERE = (0.3, 0.8, 1.5, 5.0)
# Standard deviations along the valley, doubling from one: nearer positions lead back to the fix.
_STEPS = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
# Share of the distance above which the error of a fix of a whole run allows another minimum within a few sigma. Block
# averages merge such minima. There are few steps, since each is refined on all epochs.
_WEAK_WHOLE = 2e-3
_WHOLE_STEPS = (-6.0, -2.0, 2.0, 6.0)
# Images of the best minimum: turns by eighths of a circle about the axis of the stations. Images of new minima follow
# as long as they lower the cost by more than two refinements of one minimum differ. Of 1 800 targets of any speed, with
# stations in space, 3 were lost with the mirror image only. Rounds normally end earlier than the limit.
_TURNS = 8
_ROUNDS = 10
_BETTER = 1e-3


def run_starts(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of a flat batch of runs, the cheapest first.

    Parameters
    ----------
    problem : Problem
        N runs of one target whose state lasts the run.
    begin : callable
        Maps the block averages to starting vectors (N, C, size of theirs), or to None if it does not apply. Positions
        around the stations are then the starts.
    """
    groups = group_alike(problem)
    if len(groups) == 1:
        return _start_group(problem, begin)
    parts = [(items, _start_group(problem.take(items), begin)) for items in groups]
    out = np.full((problem.batch_shape[0], max(part.shape[1] for _, part in parts), problem.layout.size), np.nan)
    for items, part in parts:
        out[items, : part.shape[1]] = part
    return out


def group_alike(problem: Problem) -> list[Array]:
    """Return groups of the runs of a flat batch that have the same rows, as arrays of their numbers.

    The runs of a group share their block averages.
    """
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    if problem.weight.ndim == 1 or (present == present[:1]).all():
        return [np.arange(len(present))]
    _, group = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(group.reshape(-1) == i) for i in range(int(group.max()) + 1)]


def _start_group(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of runs that have the same rows; `begin` is as of `run_starts`."""
    # on the averages a step is cheap, so every candidate is refined there; few are refined on all epochs
    straight = _straighten(problem, local=False)
    blocks = average_blocks(straight, BLOCKS)
    x = _starts_of_blocks(blocks, begin)
    x = _around(blocks, _ANYWHERE) if x is None else x
    pool = _with_images(blocks, _minima(blocks, x))
    # circles and valley give most of the candidates, so they are used only for doubtful minima
    doubtful = np.flatnonzero(~_is_settled(blocks, pool))
    if len(doubtful):
        part = blocks.take(doubtful)
        wider = _minima(part, np.concatenate([_around(part, _RADII), _valley(part, pool[0][doubtful, 0])], axis=1))
        pool = _merge(pool, _scatter(_with_images(part, wider), doubtful, len(x)))
    x = complete(straight, _best(blocks, *pool)[..., : straight.layout.n_shared])
    return x if straight is problem else _bend(problem, straight, x)


def _starts_of_blocks(blocks: Problem, begin: Callable[[Problem], Array | None]) -> Array | None:
    """Return starting vectors (N, C, size) of blocks; None if `begin` does not apply.

    For the start, biases that walk become offsets that drift.
    """
    steady = _straighten(blocks, local=True)
    x = begin(steady)
    return x if x is None or steady is blocks else _bend(blocks, steady, x)


def steady_blocks(problem: Problem) -> Problem:
    """Return the block averages of a flat batch of runs, with steady biases, for which `run_starts` begins."""
    return _straighten(average_blocks(_straighten(problem, local=False), BLOCKS), local=True)


def _straighten(problem: Problem, local: bool) -> Problem:
    """Return the problem with offsets and drifts instead of its walks, if `local`, or instead of its splines.

    A few dozen blocks determine only offsets and drifts. A problem without such biases is returned unchanged.
    """
    biases: list[Bias] = []
    for bias in problem.biases:
        form = form_of(bias)
        lines = form.straight if (form.steps is not None) == local else None
        biases += [bias] if lines is None else lines(bias)
    same = all(one is two for one, two in zip(biases, problem.biases, strict=False))
    return problem if same else replace(problem, biases=tuple(biases))


def _bend(problem: Problem, straight: Problem, x: Array) -> Array:
    """Return vectors (N, C, size) of a problem from vectors x of its form with straight biases; NaN vectors stay NaN.

    `straight` is the result of `_straighten` for the problem.
    """
    layout, out = problem.layout, np.zeros((*x.shape[:2], problem.layout.size))
    moments = {bias.name: at(bias) for bias in problem.biases if (at := form_of(bias).values_at) is not None}
    for slot in layout.shared:
        part, value_in = slice(slot.start, slot.start + slot.size), straight.layout.take(x, slot.name)
        if slot.name in moments and value_in.shape[-1] != slot.size:
            # a coefficient of a spline is the value of the straight line at its time
            slope = straight.layout.take(x, rate_name(slot.name))[..., None]
            value_in = value_in[..., None] + slope * (moments[slot.name] - problem.origin)
        out[..., part] = value_in.reshape(*x.shape[:2], -1)
    local = out[..., layout.n_shared :].reshape(*x.shape[:2], layout.epochs, layout.n_local)
    since = (problem.times - problem.origin)[:, None]
    for bias in walks(problem):
        parts = [straight.layout.take(x, name) for name in state_of(bias)]
        place = state_columns(layout, bias)
        if not straight.layout.shares(bias.name):  # only splines are straight
            local[..., place] = np.stack(parts, axis=-1)
            continue
        value, *rate = (part[:, :, None] for part in parts)
        local[..., place[:, 0]] = value + (rate[0] * since if rate else 0.0)
        for each in rate:
            local[..., place[:, 1]] = each
    out[..., layout.n_shared :] = local.reshape(*x.shape[:2], -1)
    out[np.isnan(x).any(-1)] = np.nan
    return out


def _minima(blocks: Problem, x: Array) -> tuple[Array, Array]:
    """Return the refined starts (N, C, size), the cheapest first, and their costs (N, C); infinite for failures."""
    cost, out = np.full(x.shape[:2], np.inf), x.copy()
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        done = refine(blocks, x[item, slot], item=item)
        out[item, slot] = done.x
        # unfinished ones compete too, since they are refined again on all epochs
        cost[item, slot] = np.where(np.isin(done.status, (Status.OK, Status.MAX_ITERATIONS)), done.cost, np.inf)
    return _sort(out, cost)


def _with_images(blocks: Problem, pool: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return a pool of minima, extended by the minima that images of the best minimum lead to.

    The images of a better minimum follow in turn. Images are mirror images in the plane of the stations. In space, if
    the target may have any speed, turns about the axis of the stations are images too.
    """
    turns, items = blocks.dimension == 3 and blocks.motions[0].order > 0, np.arange(len(pool[0]))
    for _ in range(_ROUNDS):
        part, best, cost = blocks.take(items), pool[0][items, :1], pool[1][items, 0]
        images = mirror_courses(part, best)
        if turns:
            images = np.concatenate([images, turn_courses(part, best)], axis=1)
        pool = _merge(pool, _scatter(_minima(part, images), items, len(pool[0])))
        items = items[pool[1][items, 0] < cost - _BETTER]
        if not len(items):
            break
    return pool


def _merge(one: tuple[Array, Array], two: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the union of two pools of minima of the same runs, the cheapest first."""
    x, cost = (np.concatenate(parts, axis=1) for parts in zip(one, two, strict=True))
    return _sort(x, cost)


def _sort(x: Array, cost: Array) -> tuple[Array, Array]:
    """Return minima (N, C, size) and their costs (N, C), sorted by cost."""
    order = np.argsort(cost, axis=1, kind="stable")
    return np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _scatter(found: tuple[Array, Array], items: Array, count: int) -> tuple[Array, Array]:
    """Return a pool for all `count` runs from the minima of runs `items`; the other runs have empty slots."""
    x = np.full((count, *found[0].shape[1:]), np.nan)
    cost = np.full((count, found[1].shape[1]), np.inf)
    x[items], cost[items] = found
    return x, cost


def _is_settled(blocks: Problem, pool: tuple[Array, Array]) -> Array:
    """Return flags (N,) of problems whose best minimum fits and has a small error, so that no search is needed."""
    from scipy.special import gammaincc

    x, cost = pool[0][:, 0], pool[1][:, 0]
    found, dof = np.isfinite(cost), np.maximum(degrees_of_freedom(blocks), 1)
    # chi-square test of the averages, with the threshold of the verdict for large residuals
    fits = found & (gammaincc(dof / 2.0, np.where(found, cost, np.inf) / 2.0) > P_SUSPECT)
    deviation = np.sqrt(np.trace(_covariance(blocks, x), axis1=-2, axis2=-1))
    with np.errstate(invalid="ignore"):
        return np.asarray(fits & (deviation < _WEAK * distance_of(blocks, blocks.layout.take(x, "position"))))


def _covariance(blocks: Problem, x: Array) -> Array:
    """Return the covariance of the position (N, d, d), in squared spreads of the stations; NaN if unknown."""
    usable = np.asarray(np.isfinite(x).all(-1))
    slot, _ = blocks.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    with np.errstate(all="ignore"):
        full, ok = covariance(equations_at(blocks, np.where(usable[:, None], x, 0.0)))
    return np.asarray(
        np.where((usable & ok)[:, None, None], full[:, part, part], np.nan) / _length(blocks)[:, None, None] ** 2
    )


def _length(blocks: Problem) -> Array:
    """Return the spread of the stations (N or 1,), metres."""
    return np.asarray(spread_of(blocks)[1])


def _around(blocks: Problem, radii: tuple[float, ...]) -> Array:
    """Return vectors (N, C, size) of targets at rest on circles around the stations, and above and below them.

    `radii` are in spreads of the stations.
    """
    d, centre = blocks.dimension, spread_of(blocks)[0]
    angle = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    # in space circles are level and the poles (up and down) are added; in the plane there are no poles
    level = np.stack([np.cos(angle), np.sin(angle), *([0.0 * angle] * (d - 2))], axis=-1)
    poles = np.eye(d)[2:]
    direction = np.concatenate([level, poles, -poles])
    away = (np.array(radii)[:, None, None] * direction).reshape(-1, d)
    x = np.repeat(vectors(blocks, None)[:, None], len(away), axis=1)
    slot, _ = blocks.layout.find("position")
    x[..., slot.start : slot.start + slot.size] = centre[:, None] + _length(blocks)[:, None, None] * away
    return x


def _valley(blocks: Problem, x: Array) -> Array:
    """Return vectors (N, C, size) along the longest axis of the error ellipsoid of the best minimum x (N, size)."""
    return _along(blocks, x, _covariance(blocks, x) * _length(blocks)[:, None, None] ** 2, _STEPS)


def step_beside(problem: Problem, x: Array, covariance: Array) -> Array:
    """Return vectors (N, C, size) along the longest axis of weak fixes of runs; NaN for the others.

    Block averages merge minima that are within a few standard deviations of each other.

    Parameters
    ----------
    problem : Problem
        N runs.
    x : array (N, size)
        Their fixes.
    covariance : array (N, d, d)
        Covariances of the positions, square metres.
    """
    far = distance_of(problem, problem.layout.take(x, "position")) * _length(problem)
    with np.errstate(invalid="ignore"):
        weak = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) > _WEAK_WHOLE * far
    return np.where(weak[:, None, None], _along(problem, x, covariance, _WHOLE_STEPS), np.nan)


def _along(problem: Problem, x: Array, covariance: Array, steps: tuple[float, ...]) -> Array:
    """Return vectors (N, C, size) moved by steps in standard deviations along the longest axis of their covariances."""
    usable = np.asarray(np.isfinite(covariance).all((-1, -2)) & np.isfinite(x).all(-1))
    values, axes = np.linalg.eigh(np.where(usable[:, None, None], covariance, 0.0))
    longest = np.sqrt(np.maximum(values[:, -1:], 0.0)) * axes[..., -1]
    out = np.repeat(np.where(usable[:, None], x, np.nan)[:, None], len(steps), axis=1)
    slot, _ = problem.layout.find("position")
    out[..., slot.start : slot.start + slot.size] += np.array(steps)[:, None] * longest[:, None]
    return out


def _best(blocks: Problem, x: Array, cost: Array) -> Array:
    """Return the distinct minima (N, C, size) to refine on all epochs; NaN in empty slots."""
    x, cost = _sort(x, cost)
    # sorted by cost: of two minima at one position the costlier one is dropped
    for i in np.flatnonzero(np.isfinite(cost).any(0))[1:]:
        for j in range(i):
            cost[:, i] = np.where(_at_one_place(blocks, x[:, i], x[:, j]) & np.isfinite(cost[:, j]), np.inf, cost[:, i])
    x, cost = (array[:, :_KEPT] for array in _sort(x, cost))
    with np.errstate(invalid="ignore"):
        cost[:, 2:] = np.where(cost[:, 2:] - cost[:, :1] > _RIVAL, np.inf, cost[:, 2:])
    used = np.isfinite(cost)
    return np.where(used[..., None], x, np.nan)[:, : max(1, int(used.sum(1).max()))]


def _at_one_place(blocks: Problem, x: Array, y: Array) -> Array:
    """Return flags (N,) of vectors x and y (N, size) with equal positions, within 1e-4 spreads of the stations."""
    apart = blocks.layout.take(x, "position") - blocks.layout.take(y, "position")
    return np.asarray(np.sqrt((apart**2).sum(-1)) < _SAME * _length(blocks))


def mirror_courses(blocks: Problem, x: Array) -> Array:
    """Return courses (N, C, size) mirrored at every epoch in the plane (or line) that fits the stations best."""
    apart = _apart(blocks)
    # stations move, so each epoch has a plane; eigenvalues ascend, so the first vector is its normal
    _, vectors = np.linalg.eigh(np.swapaxes(apart, -1, -2) @ apart)
    normal = vectors[..., 0]
    return _map_courses(blocks, x, (np.eye(blocks.dimension) - 2.0 * normal[..., None] * normal[..., None, :])[:, None])


def turn_courses(blocks: Problem, x: Array) -> Array:
    """Return courses (N, C (_TURNS - 1), size) turned about the longest axis of the stations, relative to their centre.

    A long array hardly determines the angle about its axis. If the target may have any speed, the cost has a valley
    around the axis, with several minima.
    """
    apart = _apart(blocks)
    _, vectors = np.linalg.eigh((np.swapaxes(apart, -1, -2) @ apart).sum(1))
    axis = vectors[..., -1]
    angle = 2.0 * np.pi * np.arange(1, _TURNS)[:, None, None] / _TURNS
    along = axis[:, None, :, None] * axis[:, None, None, :]
    # Rodrigues' formula
    across = np.cross(np.eye(3), axis[:, None, None, :])
    maps = along + np.cos(angle) * (np.eye(3) - along) - np.sin(angle) * across
    return _map_courses(blocks, x, maps[:, :, None])


def _apart(blocks: Problem) -> Array:
    """Return the positions of the stations relative to their centre (N or 1, epochs, s, d), metres."""
    place = _places(blocks)
    return np.asarray(place - place.mean(-2, keepdims=True))


def _map_courses(blocks: Problem, x: Array, maps: Array) -> Array:
    """Return courses (N, C m, size) with each position, relative to the centre of the stations, mapped at every epoch.

    Parameters
    ----------
    blocks : Problem
        N runs.
    x : array (N, C, size)
        Vectors with the courses to map.
    maps : array (N or 1, m, epochs or 1, d, d)
        m linear maps. If a map is equal at all epochs, the result is a course; else it is the nearest polynomial.
    """
    order = blocks.motions[0].order
    # (k, order + 1): the course at epoch k is the sum of state_j t^j / j!
    powers = np.stack([elapsed(blocks, 0) ** j / factorial(j) for j in range(order + 1)], axis=-1)
    slots = [blocks.layout.find(name)[0] for name in ("position", "velocity", "acceleration")[: order + 1]]
    state = np.stack([x[..., slot.start : slot.start + slot.size] for slot in slots], axis=-2)
    centre = _places(blocks).mean(-2)[:, None, None]
    course = (powers @ state)[:, :, None]
    course = centre + ((course - centre)[..., None, :] @ np.swapaxes(maps, -1, -2)[:, None])[..., 0, :]
    # images in turning planes are not polynomials, so a polynomial is fitted by least squares
    state = np.linalg.pinv(powers) @ course
    out = np.repeat(x[:, :, None], maps.shape[1], axis=2)
    for j, slot in enumerate(slots):
        out[..., slot.start : slot.start + slot.size] = state[..., j, :]
    return out.reshape(len(x), -1, x.shape[-1])


# Starts on the block averages: runs of range differences, one target whose state lasts the run, and unknown biases.


@dataclass(frozen=True, slots=True)
class RegistrationRun:
    """The range offsets of a run in scaled units.

    Parameters
    ----------
    course : RegistrationCourse
        N problems.
    column : int array (q,)
        Column of each bias in the shared unknowns.
    origin : array (d,)
        Origin of the scaled coordinates, metres.
    length, duration : float
        Units, metres and seconds.
    """

    course: RegistrationCourse
    column: Array
    origin: Array
    length: float
    duration: float


def closed_form(problem: Problem) -> Array | None:
    """Return starting vectors (N, C, size) of runs in closed form, or None if no rows make range differences.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs of a few dozen epochs; see `optloc.solvers.starts.block_averages.average_blocks`.
    """
    run = run_of(problem)
    if run is None:
        return None
    state, bias = candidates(run.course, problem.motions[0].order)
    return place_states(problem, run, state, np.repeat(bias[:, None], state.shape[1], axis=1))


def place_states(problem: Problem, run: RegistrationRun, state: Array, bias: Array) -> Array:
    """Return vectors (N, C, size) from states (N, C, order + 1, d) and biases (N, C, q), both in the units of a run."""
    state = state * (run.length / run.duration ** np.arange(state.shape[2])[:, None])
    state[:, :, 0] += run.origin
    x = np.repeat(vectors(problem, None)[:, None], state.shape[1], axis=1)
    for j, name in enumerate(("position", "velocity", "acceleration")[: state.shape[2]]):
        slot, _ = problem.layout.find(name)
        x[..., slot.start : slot.start + slot.size] = state[:, :, j]
    x[..., run.column] = bias * run.length
    return x


def run_of(problem: Problem) -> RegistrationRun | None:
    """Return the range offsets of a flat batch of runs; None if no epoch has any."""
    found = ranges(split_epochs(problem).flat())
    if found is None or not (found.free & (found.inside.sum(-1) > 1)).any():
        return None
    size, epochs = problem.batch_shape[0], problem.epochs
    # Epochs may have different stations. The offsets to the most common reference are compared over the run.
    reference = _most_common(found.reference[found.free & (found.inside.sum(-1) > 1)])
    others = np.flatnonzero(np.arange(len(found.station)) != reference)
    sign = np.array([_most_common(found.sign[found.sign[:, i] != 0, i]) for i in others])
    present = (found.reference == reference)[:, None] & found.inside[:, others] & (found.sign[:, others] == sign)
    centre, spread = spread_of(problem)
    origin, length, since = centre.mean(0), float(spread.max()), elapsed(problem, 0)
    # simultaneous epochs have no duration, so the unit is arbitrary
    duration = float(np.abs(since).max()) or 1.0
    column, effect = _effects(problem, found)
    mean, sigma = _prior(problem, column)
    course = RegistrationCourse(
        since / duration,
        (_places(problem, found.station[[reference, *others]]) - origin) / length,
        np.where(present, found.offset[:, others], 0.0).reshape(size, epochs, -1) / length,
        sign.astype(float),
        np.moveaxis(effect[..., others], 0, -1)[None],
        _whiten(found, others, present).reshape(size, epochs, len(others), len(others)) * length,
        mean / length,
        sigma / length,
    )
    return RegistrationRun(course, column, origin, length, duration)


def split_epochs(problem: Problem) -> Problem:
    """Return the epochs of a run as a batch (N, k), without its biases, priors and constraints."""
    return by_epoch(without_epoch_correlation(replace(problem, biases=(), priors=(), constraints=())))


def _most_common(values: Array) -> int:
    """Return the most common of some integers; 0 for an empty array."""
    found, count = np.unique(values, return_counts=True)
    return int(found[count.argmax()]) if len(found) else 0


def _places(problem: Problem, station: Array | slice = slice(None)) -> Array:
    """Return the positions (N or 1, k, s, d) of stations, all of them by default."""
    place = problem.stations.position[..., station, :]
    place = place if place.ndim == 4 else place[None]
    return np.broadcast_to(place, (len(place), problem.epochs, *place.shape[2:]))


def _whiten(found: Ranges, others: Array, present: Array) -> Array:
    """Return whitening matrices (N k, s - 1, s - 1) of the offsets, 1/metres; zero for stations without an offset.

    `found` are the ranges. `others` are the numbers of the s - 1 stations without the reference, and `present` (N k,
    s - 1) flags their offsets.
    """
    covariance = found.covariance[:, others][:, :, others]
    return linalg.whitening(np.where(present[:, :, None] & present[:, None, :], covariance, 0.0))


def _effects(problem: Problem, found: Ranges) -> tuple[Array, Array]:
    """Return the columns (q,) of the biases that add to the offsets, and the effect of one unit of each, (q, k, s).

    The offsets are linear in the rows. So the effect of a bias is the offsets of rows that contain only this bias.
    """
    column, unit = _units(problem)
    effect = np.zeros((len(column), problem.epochs, len(found.station)))
    if len(column):
        # a batch with one item per bias: its rows contain one unit of the bias
        zero = tuple(replace(rows, correction=np.zeros(rows.count)) for rows in problem.rows)
        single = replace(problem.take(np.zeros(1, dtype=int)), rows=zero)
        offsets = ranges(split_epochs(single.with_rows(z=unit)).flat())
        assert offsets is not None
        effect = offsets.offset.reshape(effect.shape)
    return column, effect


def _units(problem: Problem) -> tuple[Array, Array]:
    """Return the columns (q,) of offsets and drifts of range rows, and the rows (q, m) for one unit of each."""
    size = problem.layout.n_shared
    unit = np.zeros((size, problem.count))
    for links, start in zip(block_links(problem), problem.starts, strict=True):
        shared = links.adds.column < size
        if links.model.ranges is not None:
            np.add.at(unit, (links.adds.column[shared], start + links.adds.row[shared]), links.adds.coefficient[shared])
    column = np.flatnonzero(unit.any(1))
    return column, unit[column]


def _prior(problem: Problem, column: Array) -> tuple[Array, Array]:
    """Return prior means and standard deviations (q,) of unknowns in columns (q,); infinite without a prior."""
    mean, information = np.zeros(problem.layout.n_shared), np.zeros(problem.layout.n_shared)
    for name, value, precision in prior_parts(problem):
        slot, shared = problem.layout.find(name)
        if shared:
            part = slice(slot.start, slot.start + slot.size)
            mean[part] = value.reshape(-1, slot.size)[0]
            information[part] = np.diagonal(precision.reshape(-1, slot.size, slot.size)[0])
    # zero information is an infinite standard deviation
    with np.errstate(divide="ignore"):
        return mean[column], 1.0 / np.sqrt(information[column])
