"""Starts for a whole run: the minima of its block averages, from a closed form, a relaxation, mirrors and a ring."""

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
"""Blocks that a run is averaged over: far more rows than unknowns, at a cost that does not grow with the run. Fewer and
longer ones bend more between stations and target: what an average leaves out of a curved course."""

# Which minima on block averages are refined on all epochs, the expensive part: four at most, the best two in any case
# (averaging may turn the order of a minimum and its mirror image). A difference in cost of a thousand is beyond what
# averaging blurs.
_RIVAL = 1e3
_KEPT = 4
# Spreads of the stations within which two minima are one: far above the tolerance of refinement, far below a rival.
_SAME = 1e-4
# An error of more than this share of the distance is a weak fix: then minima are sought on circles around the stations
# and along its valley, and so they are where its chi-square is improbable.
_WEAK = 1e-2
# Places on each circle: no azimuth is more than 30 degrees from one, which is near enough for blocks of little noise.
_AZIMUTHS = 6
# Radii in spreads of the stations: just outside and far out; without a closed form, also among the stations.
_RADII = (1.5, 5.0)
_ANYWHERE = (0.3, 0.8, 1.5, 5.0)
# Standard deviations along the valley, doubling from one: nearer places lead back to the fix.
_STEPS = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
# Fixes of whole runs with an error beyond this share of their distance may have another minimum within a few sigma,
# which block averages blur into one. Few steps: each is refined on all epochs.
_BLURRED = 2e-3
_BESIDE = (-6.0, -2.0, 2.0, 6.0)
# Images of the best minimum: turns by eighths of a circle about the axis of the stations, and images of what images led
# to, while that costs less by more than refinements of one minimum differ. Of 1 800 targets of any speed, with stations
# in space, 3 were lost with the mirror image alone. Rounds end by themselves.
_TURNS = 8
_ROUNDS = 10
_BETTER = 1e-3


def run_starts(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of a flat batch of runs, the cheapest first.

    Parameters
    ----------
    problem : Problem
        N runs of one target that lasts them.
    begin : callable
        Maps the block averages to starting vectors (N, C, size of theirs), or None where it cannot: the starts are
        then places around the stations.
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
    """Return the problems of a flat batch in groups that have the same rows: these have block averages in common."""
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    if problem.weight.ndim == 1 or (present == present[:1]).all():
        return [np.arange(len(present))]
    _, group = np.unique(present, axis=0, return_inverse=True)
    return [np.flatnonzero(group.reshape(-1) == i) for i in range(int(group.max()) + 1)]


def _start_group(problem: Problem, begin: Callable[[Problem], Array | None]) -> Array:
    """Return starting vectors (N, C, size) of runs that have the same rows."""
    # every candidate is refined on the averages, where a step costs next to nothing; few are on all epochs
    straight = _straighten(problem, local=False)
    blocks = average_blocks(straight, BLOCKS)
    x = _begin(blocks, begin)
    x = _around(blocks, _ANYWHERE) if x is None else x
    pool = _with_images(blocks, _minima(blocks, x))
    # ring and valley only where something calls for them: they are most of the candidates
    doubtful = np.flatnonzero(~_is_settled(blocks, pool))
    if len(doubtful):
        part = blocks.take(doubtful)
        wider = _minima(part, np.concatenate([_around(part, _RADII), _valley(part, pool[0][doubtful, 0])], axis=1))
        pool = _merge(pool, _scatter(_with_images(part, wider), doubtful, len(x)))
    x = complete(straight, _best(blocks, *pool)[..., : straight.layout.n_shared])
    return x if straight is problem else _bend(problem, straight, x)


def _begin(blocks: Problem, begin: Callable[[Problem], Array | None]) -> Array | None:
    """Return starting vectors of blocks; those whose biases walk begin as if these were offsets that drift."""
    steady = _straighten(blocks, local=True)
    x = begin(steady)
    return x if x is None or steady is blocks else _bend(blocks, steady, x)


def _straighten(problem: Problem, local: bool) -> Problem:
    """Return the problem with offsets and drifts for its walks, if `local`, or for its splines.

    A few dozen blocks determine no more of them. A problem without any is returned as it is.
    """
    biases: list[Bias] = []
    for bias in problem.biases:
        form = form_of(bias)
        lines = form.straight if (form.steps is not None) == local else None
        biases += [bias] if lines is None else lines(bias)
    same = all(one is two for one, two in zip(biases, problem.biases, strict=False))
    return problem if same else replace(problem, biases=tuple(biases))


def _bend(problem: Problem, straight: Problem, x: Array) -> Array:
    """Return vectors (N, C, size) of a problem from those of the same with straight biases; NaN stay NaN."""
    layout, out = problem.layout, np.zeros((*x.shape[:2], problem.layout.size))
    moments = {bias.name: at(bias) for bias in problem.biases if (at := form_of(bias).values_at) is not None}
    for slot in layout.shared:
        part, own = slice(slot.start, slot.start + slot.size), straight.layout.take(x, slot.name)
        if slot.name in moments and own.shape[-1] != slot.size:
            # a coefficient is the value of a straight line at its time
            slope = straight.layout.take(x, rate_name(slot.name))[..., None]
            own = own[..., None] + slope * (moments[slot.name] - problem.origin)
        out[..., part] = own.reshape(*x.shape[:2], -1)
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
    """Return the refined starts (N, C, size), the cheapest first, and their costs (N, C), infinite where lost."""
    cost, out = np.full(x.shape[:2], np.inf), x.copy()
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    if len(item):
        done = refine(blocks, x[item, slot], item=item)
        out[item, slot] = done.x
        # unfinished ones compete: they are refined again on all epochs
        cost[item, slot] = np.where(np.isin(done.status, (Status.OK, Status.MAX_ITERATIONS)), done.cost, np.inf)
    return _sort(out, cost)


def _with_images(blocks: Problem, pool: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return minima and those that images of the best lead to: of each better one, too, that is found so.

    Stations in a plane see the mirror image as well; a target that may have any speed in space is turned about the axis
    of the stations besides.
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
    """Return two sets of minima as one, the cheapest first."""
    x, cost = (np.concatenate(parts, axis=1) for parts in zip(one, two, strict=True))
    return _sort(x, cost)


def _sort(x: Array, cost: Array) -> tuple[Array, Array]:
    """Return minima (N, C, size) and their costs (N, C), the cheapest first."""
    order = np.argsort(cost, axis=1, kind="stable")
    return np.take_along_axis(x, order[..., None], axis=1), np.take_along_axis(cost, order, axis=1)


def _scatter(found: tuple[Array, Array], items: Array, count: int) -> tuple[Array, Array]:
    x = np.full((count, *found[0].shape[1:]), np.nan)
    cost = np.full((count, found[1].shape[1]), np.inf)
    x[items], cost[items] = found
    return x, cost


def _is_settled(blocks: Problem, pool: tuple[Array, Array]) -> Array:
    """Return where the best minimum (N,) fits the data and has a small error: where else to look is no question."""
    from scipy.special import gammaincc

    x, cost = pool[0][:, 0], pool[1][:, 0]
    found, dof = np.isfinite(cost), np.maximum(degrees_of_freedom(blocks), 1)
    # the chi-square of the averages, at the threshold at which a verdict calls residuals too large
    fits = found & (gammaincc(dof / 2.0, np.where(found, cost, np.inf) / 2.0) > P_SUSPECT)
    deviation = np.sqrt(np.trace(_covariance(blocks, x), axis1=-2, axis2=-1))
    with np.errstate(invalid="ignore"):
        return np.asarray(fits & (deviation < _WEAK * distance_of(blocks, blocks.layout.take(x, "position"))))


def _covariance(blocks: Problem, x: Array) -> Array:
    """Return the covariance of the position (N, d, d) in units of the spread of the stations."""
    usable = np.asarray(np.isfinite(x).all(-1))
    slot, _ = blocks.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    with np.errstate(all="ignore"):
        full, ok = covariance(equations_at(blocks, np.where(usable[:, None], x, 0.0)))
    return np.asarray(
        np.where((usable & ok)[:, None, None], full[:, part, part], np.nan) / _length(blocks)[:, None, None] ** 2
    )


def _length(blocks: Problem) -> Array:
    return np.asarray(spread_of(blocks)[1])


def _around(blocks: Problem, radii: tuple[float, ...]) -> Array:
    """Return vectors (N, C, size) of targets at rest on circles around the stations, and above and below."""
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
    """Return vectors (N, C, size) along the longest axis of the error ellipsoid of the best minimum."""
    return _along(blocks, x, _covariance(blocks, x) * _length(blocks)[:, None, None] ** 2, _STEPS)


def step_beside(problem: Problem, x: Array, covariance: Array) -> Array:
    """Return vectors (N, C, size) along the longest axis of badly determined fixes of runs; NaN for the others.

    Block averages blur minima that lie within a few standard deviations of each other.

    Parameters
    ----------
    problem : Problem
        N runs.
    x : array (N, size)
        Their fixes.
    covariance : array (N, d, d)
        Of the positions, square metres.
    """
    far = distance_of(problem, problem.layout.take(x, "position")) * _length(problem)
    with np.errstate(invalid="ignore"):
        weak = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)) > _BLURRED * far
    return np.where(weak[:, None, None], _along(problem, x, covariance, _BESIDE), np.nan)


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
    """Return the different minima (N, C, size) worth refining on all epochs; NaN in empty slots."""
    x, cost = _sort(x, cost)
    # cheapest first: of two at one place the dearer goes
    for i in np.flatnonzero(np.isfinite(cost).any(0))[1:]:
        for j in range(i):
            cost[:, i] = np.where(_at_one_place(blocks, x[:, i], x[:, j]) & np.isfinite(cost[:, j]), np.inf, cost[:, i])
    x, cost = (array[:, :_KEPT] for array in _sort(x, cost))
    with np.errstate(invalid="ignore"):
        cost[:, 2:] = np.where(cost[:, 2:] - cost[:, :1] > _RIVAL, np.inf, cost[:, 2:])
    used = np.isfinite(cost)
    return np.where(used[..., None], x, np.nan)[:, : max(1, int(used.sum(1).max()))]


def _at_one_place(blocks: Problem, x: Array, y: Array) -> Array:
    """Return where the positions of two vectors (N, size) are one, as measured by the spread of the stations."""
    apart = blocks.layout.take(x, "position") - blocks.layout.take(y, "position")
    return np.asarray(np.sqrt((apart**2).sum(-1)) < _SAME * _length(blocks))


def mirror_courses(blocks: Problem, x: Array) -> Array:
    """Return courses (N, C, size) mirrored at every epoch in the plane (or line) that fits the stations best."""
    apart = _apart(blocks)
    # a plane for each epoch, as stations move; eigenvalues ascend, so the first vector is its normal
    _, vectors = np.linalg.eigh(np.swapaxes(apart, -1, -2) @ apart)
    normal = vectors[..., 0]
    return _map_courses(blocks, x, (np.eye(blocks.dimension) - 2.0 * normal[..., None] * normal[..., None, :])[:, None])


def turn_courses(blocks: Problem, x: Array) -> Array:
    """Return courses (N, C (_TURNS - 1), size) turned about the longest axis of the stations, which go along with it.

    A long array tells next to nothing of the angle about its axis: where a target may have any speed, there is a valley
    all around it, with several minima.
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
    """Return the places of the stations about their middle (N or 1, epochs, s, d)."""
    place = _places(blocks)
    return np.asarray(place - place.mean(-2, keepdims=True))


def _map_courses(blocks: Problem, x: Array, maps: Array) -> Array:
    """Return courses (N, C m, size) of which each place about the middle of the stations is mapped, at every epoch.

    Parameters
    ----------
    blocks : Problem
        N runs.
    x : array (N, C, size)
    maps : array (N or 1, m, epochs or 1, d, d)
        The mapped places are those of a course again where the maps are parallel; else the polynomial next to them.
    """
    order = blocks.motions[0].order
    # (k, order + 1): the course at epoch k is the sum of state_j t^j / j!
    powers = np.stack([elapsed(blocks, 0) ** j / factorial(j) for j in range(order + 1)], axis=-1)
    slots = [blocks.layout.find(name)[0] for name in ("position", "velocity", "acceleration")[: order + 1]]
    state = np.stack([x[..., slot.start : slot.start + slot.size] for slot in slots], axis=-2)
    centre = _places(blocks).mean(-2)[:, None, None]
    course = (powers @ state)[:, :, None]
    course = centre + ((course - centre)[..., None, :] @ np.swapaxes(maps, -1, -2)[:, None])[..., 0, :]
    # images in turning planes are no polynomial: the one with least squares next to them
    state = np.linalg.pinv(powers) @ course
    out = np.repeat(x[:, :, None], maps.shape[1], axis=2)
    for j, slot in enumerate(slots):
        out[..., slot.start : slot.start + slot.size] = state[..., j, :]
    return out.reshape(len(x), -1, x.shape[-1])


# Starts on the block averages: a run of range differences, one target that lasts it, and unknown biases.

# Blocks that the relaxation sees: the time of a semidefinite programme grows steeply with them.
_WINDOWS = 6
# It needs a prior: biases without one are taken for about this share of the largest range difference. Too loose a prior
# leaves the lifted biases free, too tight a one pulls the start; only a start hangs on it.
_LOOSE = 1e-2


@dataclass(frozen=True, slots=True)
class RegistrationRun:
    """The range offsets of a run in units of its own size.

    Parameters
    ----------
    course : RegistrationCourse
        N problems.
    column : int array (q,)
        Shared unknown of each bias.
    origin : array (d,)
        Metres.
    length, duration : float
        Units, metres and seconds.
    """

    course: RegistrationCourse
    column: Array
    origin: Array
    length: float
    duration: float


def closed_form(problem: Problem) -> Array | None:
    """Return starting vectors (N, C, size) of runs in closed form, or None where no rows make range differences.

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
    """Return vectors (N, C, size) of states (N, C, order + 1, d) and biases (N, C, q) in the units of a run."""
    state = state * (run.length / run.duration ** np.arange(state.shape[2])[:, None])
    state[:, :, 0] += run.origin
    x = np.repeat(vectors(problem, None)[:, None], state.shape[1], axis=1)
    for j, name in enumerate(("position", "velocity", "acceleration")[: state.shape[2]]):
        slot, _ = problem.layout.find(name)
        x[..., slot.start : slot.start + slot.size] = state[:, :, j]
    x[..., run.column] = bias * run.length
    return x


def run_of(problem: Problem) -> RegistrationRun | None:
    """Return the range offsets of a flat batch of runs; None where no epoch has any."""
    found = ranges(split_epochs(problem).flat())
    if found is None or not (found.free & (found.inside.sum(-1) > 1)).any():
        return None
    size, epochs = problem.batch_shape[0], problem.epochs
    # epochs may differ in who is heard: offsets to one reference, that of most, are compared over the run
    reference = _most_common(found.reference[found.free & (found.inside.sum(-1) > 1)])
    others = np.flatnonzero(np.arange(len(found.station)) != reference)
    sign = np.array([_most_common(found.sign[found.sign[:, i] != 0, i]) for i in others])
    heard = (found.reference == reference)[:, None] & found.inside[:, others] & (found.sign[:, others] == sign)
    centre, spread = spread_of(problem)
    origin, length, since = centre.mean(0), float(spread.max()), elapsed(problem, 0)
    # a run whose epochs are simultaneous has no duration: any unit does
    duration = float(np.abs(since).max()) or 1.0
    column, effect = _effects(problem, found)
    mean, sigma = _prior(problem, column)
    course = RegistrationCourse(
        since / duration,
        (_places(problem, found.station[[reference, *others]]) - origin) / length,
        np.where(heard, found.offset[:, others], 0.0).reshape(size, epochs, -1) / length,
        sign.astype(float),
        np.moveaxis(effect[..., others], 0, -1)[None],
        _whiten(found, others, heard).reshape(size, epochs, len(others), len(others)) * length,
        mean / length,
        sigma / length,
    )
    return RegistrationRun(course, column, origin, length, duration)


def split_epochs(problem: Problem) -> Problem:
    """Return the epochs of a run as a batch (N, k), without its biases, priors and constraints."""
    return by_epoch(without_epoch_correlation(replace(problem, biases=(), priors=(), constraints=())))


def _most_common(values: Array) -> int:
    """Return the most common of some integers; 0 of none."""
    found, count = np.unique(values, return_counts=True)
    return int(found[count.argmax()]) if len(found) else 0


def _places(problem: Problem, station: Array | slice = slice(None)) -> Array:
    """Return the positions (N or 1, k, s, d) of stations, all of them by default."""
    place = problem.stations.position[..., station, :]
    place = place if place.ndim == 4 else place[None]
    return np.broadcast_to(place, (len(place), problem.epochs, *place.shape[2:]))


def _whiten(found: Ranges, others: Array, heard: Array) -> Array:
    """Return whitening matrices (N k, s - 1, s - 1) of the offsets, without those not heard."""
    covariance = found.covariance[:, others][:, :, others]
    return linalg.whitening(np.where(heard[:, :, None] & heard[:, None, :], covariance, 0.0))


def _effects(problem: Problem, found: Ranges) -> tuple[Array, Array]:
    """Return the columns (q,) of the biases that add to the offsets, and what each adds, (q, k, s).

    The offsets are linear in the rows: they are those of rows that hold nothing but one bias.
    """
    column, unit = _units(problem)
    effect = np.zeros((len(column), problem.epochs, len(found.station)))
    if len(column):
        # a batch whose items are the biases: each item's rows hold one unit of its bias and nothing else
        zero = tuple(replace(rows, correction=np.zeros(rows.count)) for rows in problem.rows)
        single = replace(problem.take(np.zeros(1, dtype=int)), rows=zero)
        same = ranges(split_epochs(single.with_rows(z=unit)).flat())
        assert same is not None
        effect = same.offset.reshape(effect.shape)
    return column, effect


def _units(problem: Problem) -> tuple[Array, Array]:
    """Return the columns (q,) of offsets and drifts of range rows, and the rows (q, m) that one unit of each makes."""
    size = problem.layout.n_shared
    unit = np.zeros((size, problem.count))
    for links, start in zip(block_links(problem), problem.starts, strict=True):
        shared = links.adds.column < size
        if links.model.ranges is not None:
            np.add.at(unit, (links.adds.column[shared], start + links.adds.row[shared]), links.adds.coefficient[shared])
    column = np.flatnonzero(unit.any(1))
    return column, unit[column]


def _prior(problem: Problem, column: Array) -> tuple[Array, Array]:
    """Return prior means and standard deviations (q,) of some shared unknowns; infinite where there is none."""
    mean, information = np.zeros(problem.layout.n_shared), np.zeros(problem.layout.n_shared)
    for name, value, precision in prior_parts(problem):
        slot, shared = problem.layout.find(name)
        if shared:
            part = slice(slot.start, slot.start + slot.size)
            mean[part] = value.reshape(-1, slot.size)[0]
            information[part] = np.diagonal(precision.reshape(-1, slot.size, slot.size)[0])
    # no information is an infinite standard deviation
    with np.errstate(divide="ignore"):
        return mean[column], 1.0 / np.sqrt(information[column])


def relax_run(problem: Problem) -> Array | None:
    """Return starting vectors (N, C, size) of runs from the semidefinite relaxation, or None where it does not apply.

    A few blocks over the whole run are used, of those in which every station is heard.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs of a few dozen epochs, fixed targets or constant velocity.
    """
    from formulations.registration_sdp import registration

    run, order = run_of(problem), problem.motions[0].order
    if run is None or order > 1 or (run.course.sign < 0).any():
        return None
    course = run.course
    size, d = len(course.offset), problem.dimension
    station, bias = (np.broadcast_to(a, (size, *a.shape[1:])) for a in (course.station, course.bias))
    whiten = np.broadcast_to(course.whiten, (size, *course.offset.shape[1:], course.offset.shape[2]))
    # offsets are scaled: so is what they are compared with
    loose = _LOOSE * np.abs(course.offset).max() if course.offset.size else 1.0
    sigma = np.where(np.isfinite(course.sigma), course.sigma, loose)
    found: list[list[tuple[Array, Array]]] = []
    for i in range(size):
        # blocks in which every station is heard, spread evenly over the run
        whole = np.flatnonzero((whiten[i] != 0.0).any(-1).all(-1))
        k = whole[np.unique(np.linspace(0, len(whole) - 1, _WINDOWS).round().astype(int))] if len(whole) else whole
        time = course.time[k] if order else None
        answers = (
            registration(
                station[i, k],
                course.offset[i, k],
                whiten[i, k],
                sigma,
                design=bias[i, k[0]],
                mean=course.mean,
                time=time,
            )
            if len(k) > 1
            else ()
        )
        found.append([(one.target, one.bias) for one in answers])
    width = max(1, *(len(pairs) for pairs in found))
    state, delta = np.full((size, width, order + 1, d), np.nan), np.zeros((size, width, len(run.column)))
    for i, pairs in enumerate(found):
        for j, (target, own) in enumerate(pairs):
            state[i, j], delta[i, j] = target, own
    return place_states(problem, run, state, delta)
