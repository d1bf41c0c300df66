"""Simulated repeats of a measurement: how often the ellipse of a fix contains the true position.

A test of the likelihood three deviations away refuses many fixes whose 95 % ellipse covers. For these fixes, optloc
draws true positions from the Gaussian of the fix and simulates a measurement at each. It refines each repeat from its
true position. The share of ellipses that contain their true position decides.

Letters: N fixes, r = 48 repeats of each, M = N r, m rows, n shared unknowns, `size` numbers of a parameter vector. The
three results of a fix are the shares at the two `LEVELS`, 0 to 1, and an inflation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple
from zlib import crc32

import numpy as np

from optloc.base import arrays, linalg
from optloc.base.types import Array, Prior, Status
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import exact
from optloc.linear.evaluate import predict
from optloc.linear.mirror import one_position
from optloc.linear.normal import marginal, prior_parts
from optloc.linear.simulate import draw, samples
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.chart import quantile
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem

LEVELS = (0.95, 0.999)
"""Levels of the ellipses that are counted."""
ENOUGH = (0.88, 0.97)
"""Least shares of the repeats whose ellipses contain the truth: with 48 repeats most good covariances pass.

These shares keep 83 % of 6 423 fixes that were `ok` or `curved`. Of those kept, 7.2 % are outside 95 %, and 0.9 % are
outside 99.9 %. In geometries with more than 70 % kept, 6.0 % are outside 95 %.
"""

TOLERANCE = 1e-3
"""Length of the last refinement step of a repeat, in standard deviations: too small to change an ellipse."""

# Repeats per fix: they give the share of 95 % with a standard error of 3 %.
_REPEATS = 48
# Most steps of a refinement.
_STEPS = 30
# Vectors that are refined together: their rows take tens of megabytes.
_PART = 2**15


def is_repeatable(problem: Problem) -> bool:
    """Return whether a measurement can be simulated again: one position, no equality, priors on shared unknowns only.

    Inequalities are allowed if none is active at the fix.
    """
    free = not exact(problem) and not problem.stations.errors and problem.medium is None and not problem.fences
    walks = any(form_of(bias).steps is not None for bias in problem.biases)
    if not free or walks or not one_position(problem) or problem.motions[0].order > 0:
        return False
    return all(problem.layout.find(name)[1] for name, _, _ in prior_parts(problem))


def holds(found: Array) -> Array:
    """Return flags (N,) of fixes whose shares of repeats reach `ENOUGH`; `found` (N, 3) is a result of `repeat`.

    NaN gives False.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((found[:, :2] >= ENOUGH).all(-1))


def repeat(problem: Problem, x: Array, covariance: Array) -> Array:
    """Return the shares of repeats whose ellipses at `LEVELS` contain the truth, and an inflation, (N, 3).

    The inflation is the factor of the covariance at which 95 % of the ellipses contain the truth; it is 1 or more.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems for which `is_repeatable` is true.
    x : array (N, size)
        Fixes.
    covariance : array (N, n, n)
        Covariances of their shared unknowns.
    """
    return repeated(problem, x, covariance, _refine)


class Repeats(NamedTuple):
    """Fixes of M repeated measurements: vectors x (M, size), covariances `spread` (M, n, n), and flags `good` (M,).

    The flag of a finished fix is True.
    """

    x: Array
    spread: Array
    good: Array


def repeated(
    problem: Problem,
    x: Array,
    covariance: Array,
    refit: Callable[[Problem, Array], Repeats],
    wrong: Array | None = None,
) -> Array:
    """Return the shares and inflations (N, 3) of repeats that a given function fixes.

    Parameters
    ----------
    problem, x, covariance : Problem, array (N, size), array (N, n, n)
        See `repeat`.
    refit : callable
        Maps repeated measurements and their true vectors to fixes.
    wrong : array (N, m), optional
        Errors that are added to the rows of all repeats.
    """
    out, problem = np.empty((len(x), len(LEVELS) + 1)), replace(problem, constraints=())
    for items in _parts(len(x)):
        many, truth = _measured(
            problem.take(items), x[items], covariance[items], None if wrong is None else wrong[items]
        )
        out[items] = _shares(many, truth, refit(many, truth))
    return out


def _parts(count: int) -> Iterator[Array]:
    """Yield arrays with the numbers of the fixes whose repeats are refined together; `count` fixes exist."""
    size = max(1, _PART // _REPEATS)
    for first in range(0, count, size):
        yield np.arange(first, min(first + size, count))


def _measured(problem: Problem, x: Array, covariance: Array, wrong: Array | None) -> tuple[Problem, Array]:
    """Return repeated measurements, N r problems for r repeats, and their true vectors (N r, size).

    `covariance` (N, n, n) belongs to the fixes x (N, size). `wrong` (N, m) are errors that are added to the rows of all
    repeats, or None.
    """
    each = np.repeat(np.arange(len(x)), _REPEATS)
    truth, noise, means = _drawn(problem, x, covariance)
    many = _with_priors(problem.take(each), means)
    z = noise + np.asarray(predict(many, truth.view(arrays.Portable)))
    z = z if wrong is None else z + wrong[each]
    for rows, start in zip(many.rows, many.starts, strict=True):
        part = slice(start, start + rows.count)
        if MODELS[rows.kind].period is not None:
            z[:, part] = np.asarray(wrap(z[:, part].view(arrays.Portable)))
        z[:, part] += rows.correction
    return many.with_rows(z=np.where(many.weight > 0.0, z, 0.0)), truth


def _refine(problem: Problem, truth: Array) -> Repeats:
    """Return the least-squares fixes of M repeated measurements that start at the true vectors (M, size)."""
    with np.errstate(all="ignore"):
        done = refine(problem, truth, tolerance=TOLERANCE, limit=_STEPS)
        information, _, ok = marginal(done.equations)
        spread, regular = linalg.inverse(information)
    return Repeats(done.x, spread, ok & regular & (done.status == Status.OK))


def _shares(problem: Problem, truth: Array, found: Repeats) -> Array:
    """Return the shares of repeats whose ellipses contain the truth, and inflations, (N, 3); see `repeat`."""
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    away = found.x[:, part] - truth[:, part]
    with np.errstate(all="ignore"):
        # squared distance from the truth, in standard deviations of the repeat
        form = (away * linalg.solve(found.spread[:, part, part], away[..., None])[0][..., 0]).sum(-1)
    # an unfinished repeat counts as one outside every ellipse
    form = np.where(found.good & np.isfinite(form), form, np.inf).reshape(-1, _REPEATS)
    limits = [quantile(level, problem.dimension) for level in LEVELS]
    shares = [(form <= limit).mean(1) for limit in limits]
    # index of the 95 % quantile of 48 sorted values
    last = np.sort(form, axis=1)[:, int(np.ceil(LEVELS[0] * _REPEATS)) - 1]
    return np.stack([*shares, np.maximum(1.0, last / limits[0])], axis=-1)


def _with_priors(problem: Problem, means: dict[str, Array]) -> Problem:
    """Return problems with the drawn means (N, p) of their priors; priors of biases become separate priors."""
    spreads = {name: linalg.inverse(precision)[0] for name, _, precision in prior_parts(problem)}
    priors = tuple(Prior(name, means[name], spread) for name, spread in spreads.items())
    return replace(problem, biases=tuple(replace(bias, sigma=None) for bias in problem.biases), priors=priors)


def _drawn(problem: Problem, x: Array, covariance: Array) -> tuple[Array, Array, dict[str, Array]]:
    """Return true vectors (N r, size) drawn about fixes, noise (N r, m) of their rows, and means of their priors.

    A prior acts as a measurement, so its mean is drawn about each true vector. A checksum of the measurements seeds the
    draws of each fix.
    """
    n, count = problem.layout.n_shared, problem.count
    truth, noise = np.repeat(x, _REPEATS, axis=0), np.empty((len(x) * _REPEATS, count))
    z = np.broadcast_to(problem.z, (len(x), count))
    slots = {name: problem.layout.find(name)[0] for name, _, _ in prior_parts(problem)}
    means = {name: np.empty((len(truth), slot.size)) for name, slot in slots.items()}
    for i in range(len(x)):
        rng = np.random.default_rng(crc32(np.ascontiguousarray(z[i]).tobytes()))
        part, one = slice(i * _REPEATS, (i + 1) * _REPEATS), problem.take(np.array([i]))
        truth[part, :n] += samples(covariance[i], (_REPEATS,), rng)
        noise[part] = draw(one.noise, count, (_REPEATS,), rng)
        for name, _, precision in prior_parts(one):
            spread = linalg.inverse(np.reshape(precision, precision.shape[-2:]))[0]
            columns = slice(slots[name].start, slots[name].start + slots[name].size)
            means[name][part] = truth[part, columns] + samples(spread, (_REPEATS,), rng)
    return truth, noise, means
