"""Registration without a guess: a run of range differences, one target that lasts it, and unknown biases."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from formulations.registration import Course, candidates
from optloc import linalg
from optloc.epochs import by_epoch, untied
from optloc.models import MODELS, Model
from optloc.plan import elapsed, plans
from optloc.priors import prior_parts
from optloc.problem import Problem
from optloc.solve.reduce import Ranges, ranges
from optloc.solve.scale import spread_of
from optloc.solve.start import vectors
from optloc.types import Array

_WINDOWS = 6
# The relaxation needs a prior: biases without one are taken for about this share of the largest range difference.
_LOOSE = 1e-2


def registrable(problem: Problem) -> bool:
    """Return whether a problem is a run of sums or ratios of ranges whose only target lasts it, and is not one fix."""
    if len(problem.motions) != 1 or problem.epochs < 2:
        return False
    motion, moving = problem.motions[0], problem.stations.position.shape[-3] > 1
    differences = any(_of_ranges(MODELS[rows.kind]) for rows in problem.rows)
    return differences and motion.known is None and motion.span == "run" and (moving or motion.order > 0)


def _of_ranges(model: Model) -> bool:
    """Return whether a kind is a sum or a ratio of ranges."""
    return model.ranges is not None or (model.lifted is not None and not model.axes)


@dataclass(frozen=True, slots=True)
class Run:
    """The range offsets of a run in units of its own size.

    Parameters
    ----------
    course : Course
        N problems.
    column : int array (q,)
        Shared unknown of each bias.
    origin : array (d,)
        Metres.
    length, duration : float
        Units, metres and seconds.
    """

    course: Course
    column: Array
    origin: Array
    length: float
    duration: float


def closed_form(problem: Problem) -> Array | None:
    """Return starting vectors (N, C, size) of runs in closed form, or None where no rows make range differences.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs of a few dozen epochs; see `optloc.blocks.averaged`.
    """
    run = run_of(problem)
    if run is None:
        return None
    state, bias = candidates(run.course, problem.motions[0].order)
    return started(problem, run, state, np.repeat(bias[:, None], state.shape[1], axis=1))


def started(problem: Problem, run: Run, state: Array, bias: Array) -> Array:
    """Return vectors (N, C, size) of states (N, C, order + 1, d) and biases (N, C, q) in the units of a run."""
    state = state * (run.length / run.duration ** np.arange(state.shape[2])[:, None])
    state[:, :, 0] += run.origin
    x = np.repeat(vectors(problem, None)[:, None], state.shape[1], axis=1)
    for j, name in enumerate(("position", "velocity", "acceleration")[: state.shape[2]]):
        slot, _ = problem.layout.find(name)
        x[..., slot.start : slot.start + slot.size] = state[:, :, j]
    x[..., run.column] = bias * run.length
    return x


def run_of(problem: Problem) -> Run | None:
    """Return the range offsets of a flat batch of runs; None where no epoch has any."""
    found = ranges(_alone(problem).flat())
    if found is None or not (found.free & (found.inside.sum(-1) > 1)).any():
        return None
    size, epochs = problem.batch_shape[0], problem.epochs
    reference = _usual(found.reference[found.free & (found.inside.sum(-1) > 1)])
    others = np.flatnonzero(np.arange(len(found.station)) != reference)
    sign = np.array([_usual(found.sign[found.sign[:, i] != 0, i]) for i in others])
    heard = (found.reference == reference)[:, None] & found.inside[:, others] & (found.sign[:, others] == sign)
    centre, spread = spread_of(problem)
    origin, length, since = centre.mean(0), float(spread.max()), elapsed(problem, 0)
    duration = float(np.abs(since).max()) or 1.0
    column, effect = _effects(problem, found)
    mean, sigma = _prior(problem, column)
    course = Course(
        since / duration,
        (_places(problem, found.station[[reference, *others]]) - origin) / length,
        np.where(heard, found.offset[:, others], 0.0).reshape(size, epochs, -1) / length,
        sign.astype(float),
        np.moveaxis(effect[..., others], 0, -1)[None],
        _whiten(found, others, heard).reshape(size, epochs, len(others), len(others)) * length,
        mean / length,
        sigma / length,
    )
    return Run(course, column, origin, length, duration)


def _alone(problem: Problem) -> Problem:
    """Return the epochs of a run as a batch (N, k), without its biases."""
    return by_epoch(untied(replace(problem, biases=(), priors=(), constraints=())))


def _usual(values: Array) -> int:
    """Return the most common of some integers; 0 of none."""
    found, count = np.unique(values, return_counts=True)
    return int(found[count.argmax()]) if len(found) else 0


def _places(problem: Problem, station: Array) -> Array:
    """Return the positions (N or 1, k, s, d) of some stations."""
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
        zero = tuple(replace(rows, correction=np.zeros(rows.count)) for rows in problem.rows)
        single = replace(problem.take(np.zeros(1, dtype=int)), rows=zero)
        same = ranges(_alone(single.with_rows(z=unit)).flat())
        assert same is not None
        effect = same.offset.reshape(effect.shape)
    return column, effect


def _units(problem: Problem) -> tuple[Array, Array]:
    """Return the columns (q,) of offsets and drifts of range rows, and the rows (q, m) that one unit of each makes."""
    size = problem.layout.n_shared
    unit = np.zeros((size, problem.count))
    for plan, start in zip(plans(problem), problem.starts, strict=True):
        shared = plan.adds.column < size
        if plan.model.ranges is not None:
            np.add.at(unit, (plan.adds.column[shared], start + plan.adds.row[shared]), plan.adds.coefficient[shared])
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
    with np.errstate(divide="ignore"):
        return mean[column], 1.0 / np.sqrt(information[column])


def relaxed(problem: Problem) -> Array | None:
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
    loose = _LOOSE * np.abs(course.offset).max() if course.offset.size else 1.0
    sigma = np.where(np.isfinite(course.sigma), course.sigma, loose)
    found: list[list[tuple[Array, Array]]] = []
    for i in range(size):
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
    return started(problem, run, state, delta)
