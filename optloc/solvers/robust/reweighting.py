"""Iteratively reweighted least squares: the minima of a robust cost next to given starts, for a batch.

Letters: N or M problems, m rows, r residuals, sigma their standard deviations, u residuals in sigma. R is the
covariance of the noise, and rho the cost of a residual under the loss. A *weight of the loss* is a factor from 0 to 1
for a row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at, summed
from optloc.linear.constraints import Face
from optloc.linear.evaluate import predict
from optloc.linear.normal import Normal, marginal, with_priors, with_station_noise
from optloc.models import MODELS, wrap
from optloc.problem.loss import LATE, Loss
from optloc.problem.noise import Noise, variances, whiten
from optloc.problem.problem import Problem
from optloc.solvers.layered import refine_in_layers, strata_of

# Least weight of a row in a correlated group during the iteration, so that its partners still predict it. At a
# millionth of its weight the row has no effect on the sums, and the inverse of the weight does not overflow.
_LEAST = 1e-6
# Gauss-Newton steps between two updates of the weights, enough for convergence from far away; and the largest change of
# a weight that counts as none, too small to show in a fix.
_STEPS, _SETTLED = 12, 1e-4
# If weights and position affect each other, steps shrink by a ratio near one. After eight updates every third point is
# extrapolated, so that two plain steps give the ratio again. The ratio is limited to 0.98, fifty steps ahead.
_PATIENCE, _OFTEN, _SLOWEST = 8, 3, 0.98
# A step that raises the cost is halved. After eight halvings, at 1/256 of the step, the iteration has stalled.
_HALVINGS = 8
# Relative rounding error of a robust cost, by which a step may raise it.
_ROUNDING = 1e-12
# Length of a step, in standard deviations, that ends the iteration: a millionth has no practical effect.
_TOLERANCE = 1e-6
# Tolerance of the least squares between two updates, as a share of that length, so that its error does not count.
_SHARE = 0.1
# Length of an unfinished step: above any tolerance, but finite, because a length that is not finite means failure.
_LONG = 1e300


# Residuals in sigma, and the weights from a loss, for rows with any noise.


@dataclass(frozen=True, slots=True)
class Doubt:
    """Variances and weights of the rows of a flat batch of N problems, which are constant during an iteration.

    A loss adds an error with variance ``t_i = s_i (1 / weight_i - 1)`` to row i. Here s_i is the variance of the row
    given all other rows, which is the variance of the row if rows are independent. Residuals r and weights then are a
    stationary point of

        r' (R + diag t)^-1 r  +  sum of rho(u_i) - weight_i u_i^2,

    which for independent rows is the sum of rho(r_i / sigma_i). This is the line process of a loss (M. J. Black, A.
    Rangarajan, "On the unification of line processes, outlier rejection, and robust statistics", Int. J. Comput. Vis.
    19 (1996), section 3), with a covariance R.

    Parameters
    ----------
    noise : Noise
        Noise of the rows, including the station errors that the problem treats as noise.
    base : array (N, m)
        Weights of the rows before the loss; 0 = absent.
    own, given : array (N, m)
        Variance of each row, and its variance given all other rows present; squared units of the row.
    sided : bool array (m,)
        True for rows whose gross errors are positive only, because signals can only be late.
    """

    noise: Noise
    base: Array
    own: Array
    given: Array
    sided: Array

    @classmethod
    def of(cls, problem: Problem, at: Array) -> Doubt:
        """Return the variances and weights of N problems, for noise at x (N, size)."""
        noise, size = with_station_noise(problem, at).noise, len(at)
        base = np.broadcast_to(problem.weight, (size, problem.count))
        own = np.broadcast_to(variances(noise, problem.count), base.shape)
        given = own / np.where(base > 0.0, base, 1.0)
        for whitener in whiten(noise, problem.weight):
            if whitener.row.shape[1] > 1:
                rows = whitener.row
                present = base[:, rows] > 0.0
                # W'W is the inverse covariance. One over its diagonal is the variance given the partners, if no partner
                # is missing.
                full = np.broadcast_to((whitener.matrix != 0.0).any(-1).sum(-1), present.shape[:-1]) == present.sum(-1)
                precision = (whitener.matrix**2).sum(-2)
                known = present & full[..., None] & (precision > 0.0)
                given[:, rows] = np.where(known, 1.0 / np.where(known, precision, 1.0), given[:, rows])
        kinds = np.concatenate([np.full(rows.count, rows.kind in LATE) for rows in problem.rows])
        return cls(noise, base, own, given, kinds)

    def take(self, index: Array) -> Doubt:
        """Return the entries of some of the problems."""
        blocks = tuple(
            b if b.covariance.ndim == 3 or len(b.covariance) == 1 else replace(b, covariance=b.covariance[index])
            for b in self.noise.blocks
        )
        return Doubt(Noise(blocks), self.base[index], self.own[index], self.given[index], self.sided)

    def row_weight(self, weight: Array) -> Array:
        """Return the weights (N, m) for `Problem.with_rows` from the weights (N, m) of a loss; 0 for absent rows."""
        # own + given (1 / weight - 1) is the variance with the added error; base is the weight without it
        ratio = self.given / self.own
        with np.errstate(divide="ignore", over="ignore"):
            total = 1.0 / self.base + ratio * (1.0 / weight - 1.0)
            return np.where((self.base > 0.0) & (weight > 0.0), 1.0 / total, 0.0)

    def residual(self, problem: Problem, x: Array, weight: Array) -> Array:
        """Return residuals in sigma (N, m) at vectors x (N, size), zero for absent rows.

        For correlated rows it is the residual of a row given its partners, which count by their weights (N, m) of the
        loss.
        """
        residual = np.where(self.base > 0.0, residuals(problem, x), 0.0)
        u = residual / np.sqrt(self.given)
        # for independent rows `given` equals `own`, and weights of other rows have no effect
        if all(block.row.shape[1] == 1 for block in self.noise.blocks):
            return u
        least = np.maximum(weight, _LEAST)
        for whitener in whiten(self.noise, self.row_weight(least)):
            rows = whitener.row
            if rows.shape[1] > 1:
                white = whitener.matrix @ residual[:, rows][..., None]
                # with weights w, (R^-1 r)_i is the residual of row i given its partners, over its variance given / w_i
                share = (np.swapaxes(whitener.matrix, -1, -2) @ white)[..., 0]
                u[:, rows] = share * np.sqrt(self.given[:, rows]) / least[:, rows]
        return u


def residuals(problem: Problem, x: Array) -> Array:
    """Return residuals (N, m) of a flat batch at vectors x (N, size), in units of the rows; angles are wrapped."""
    residual = problem.observed - predict(problem, x)
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        if MODELS[rows.kind].period is not None:
            part = slice(start, start + rows.count)
            residual[..., part] = wrap(residual[..., part])
    return np.asarray(residual)


def fold_signs(loss: Loss, u: Array, sided: Array) -> Array:
    """Return residuals u (N, m), in sigma, as arguments of a loss: absolute, or signed for `sided` rows (m,).

    A one-sided loss limits late signals only. Rows that are not sided may have gross errors of either sign, so their
    absolute residuals count. For a loss of both signs all residuals are returned unchanged.
    """
    return np.where(sided, u, np.abs(u)) if loss.one_sided else u


# Iteration.


@dataclass(frozen=True, slots=True)
class LossMinima:
    """Results of reweighting for M starts.

    Parameters
    ----------
    x : array (M, size)
        Parameter vectors.
    cost : array (M,)
        Robust cost, priors included.
    status : int array (M,)
        `Status` of each.
    weight : array (M, m)
        Factor of the weight of each row under the loss.
    """

    x: Array
    cost: Array
    status: Array
    weight: Array


def reweight(
    problem: Problem,
    start: Array,
    loss: Loss,
    doubt: Doubt,
    *,
    limit: int = 50,
    tolerance: float = _TOLERANCE,
    face: Face = (),
) -> LossMinima:
    """Return the minima of a robust cost next to starts.

    Each step is least squares with the weights of the loss at the previous point. For independent rows the weighted
    cost equals the robust cost there, and for an even loss it is larger elsewhere. So no step raises the robust cost
    (P. J. Huber, "Robust Statistics" (1981), section 7.8). In all other cases a step that raises the cost is halved:
    its direction is downhill.

    Parameters
    ----------
    problem : Problem
        Flat batch of M problems.
    start : array (M, size)
        Starting vectors.
    loss : Loss
        Its sigma is the sigma of the rows.
    doubt : Doubt
        Variances and weights of the same problems.
    limit : int
        Most updates of the weights.
    tolerance : float
        A step shorter than this many standard deviations ends the iteration, once the weights have converged too. The
        weights have converged if they change by less than the tolerance or 1e-4, the larger of the two.
    face : Face
        Constraints that are satisfied with equality.
    """
    # more than fifty updates mean slow progress along a flat valley, and the status shows it
    x, weight = np.array(start), np.ones(doubt.base.shape)
    last = np.zeros(x.shape)  # the step before, from which the extrapolation follows
    status = np.full(len(x), int(Status.MAX_ITERATIONS), dtype=np.int8)
    active = np.arange(len(x))
    # the weighted cost is no upper bound of the robust cost, so steps are checked
    must_check = loss.one_sided or any(block.row.shape[1] > 1 for block in doubt.noise.blocks)
    with np.errstate(all="ignore"):
        for iteration in range(limit):
            # the batch is not copied before some starts have finished
            whole = len(active) == len(x)
            part, part_doubt = (problem, doubt) if whole else (problem.take(active), doubt.take(active))
            here, old_weight = x[active], weight[active]
            new_weight = weigh_by(loss, part, part_doubt, here, old_weight)
            step = _step(part.with_rows(weight=part_doubt.row_weight(new_weight)), here, last[active], face, tolerance)
            moved = _backtrack(loss, part, part_doubt, here, step.x, new_weight) if must_check else step.x
            # extrapolation leaves a face of constraints, so there only plain steps are taken
            if iteration >= _PATIENCE and iteration % _OFTEN == 0 and not face:
                moved = _extrapolate(loss, part, part_doubt, step, new_weight)
            x[active], weight[active], last[active] = moved, new_weight, step.x - here
            # converged: weights and position are constant; stalled: no step lowers the cost, although the gradient is
            # not zero
            constant = np.abs(new_weight - old_weight).max(-1, initial=0.0) <= max(_SETTLED, tolerance)
            settled = constant & (step.length <= tolerance)
            status[active[settled]] = step.status[settled]
            status[active[constant & ~settled & (moved == here).all(-1)]] = Status.STALLED
            status[active[~np.isfinite(step.length)]] = Status.NUMERICAL
            active = active[status[active] == Status.MAX_ITERATIONS]
            if not len(active):
                break
        weight = weigh_by(loss, problem, doubt, x, weight)
        cost = robust_cost(loss, problem, doubt, x, weight)
    status[~np.isfinite(cost)] = Status.NUMERICAL
    return LossMinima(x, np.where(np.isfinite(cost), cost, np.inf), status, weight)


@dataclass(frozen=True, slots=True)
class _Step:
    """A least-squares step of M starts.

    `x` (M, size) are the end points, `length` (M,) the lengths in sigma, and `status` (M,) the status of the
    refinement. `tried` (M, size) is the limit of a geometric series of such steps.
    """

    x: Array
    length: Array
    status: Array
    tried: Array


def _step(problem: Problem, x: Array, last: Array, face: Face, tolerance: float) -> _Step:
    """Return one least-squares step with fixed weights from x (M, size).

    `last` (M, size) is the step before, and `tolerance` the length of a last step in sigma. `face` are the constraints
    that are satisfied with equality.
    """
    strata = strata_of(problem, face)
    # in layers a point may cross a border, since the next step refines it again
    if strata is None:
        done = refine(problem, x, tolerance=_SHARE * tolerance, limit=_STEPS, face=face)
    else:
        done = refine_in_layers(problem, strata, x, np.arange(len(x)), face, _STEPS, cross=True)
    information, _, _ = marginal(done.equations)
    n, apart = problem.layout.n_shared, done.x - x

    def product(a: Array, b: Array) -> Array:
        return np.asarray((a[:, None, :n] @ information @ b[:, :n, None])[:, 0, 0])

    length = np.sqrt(np.maximum(product(apart, apart), 0.0))
    # ratio of a geometric series, in the metric of the fix; a negative ratio (zigzag) is not extrapolated
    ratio = product(apart, last) / product(last, last)
    ratio = np.where(np.isfinite(ratio), np.clip(ratio, 0.0, _SLOWEST), 0.0)
    unfinished = done.status == Status.MAX_ITERATIONS
    return _Step(
        done.x,
        np.where(unfinished, _LONG, length),
        done.status,
        done.x + apart * (ratio / (1.0 - ratio))[:, None],
    )


def _backtrack(loss: Loss, problem: Problem, doubt: Doubt, here: Array, there: Array, weight: Array) -> Array:
    """Return points (M, size) between `here` and `there` (M, size) that cost no more than `here`.

    `weight` (M, m) are the current weights of the loss. After `_HALVINGS` halvings a point may still cost more, and it
    is almost at `here`.
    """
    least = robust_cost(loss, problem, doubt, here, weight)
    share = np.ones(len(here))
    for _ in range(_HALVINGS):
        x = here + share[:, None] * (there - here)
        now = weigh_by(loss, problem, doubt, x, weight)
        worse = ~(robust_cost(loss, problem, doubt, x, now) <= least + _ROUNDING * (1.0 + np.abs(least)))
        if not worse.any():
            break
        share = np.where(worse, 0.5 * share, share)
    return np.asarray(here + share[:, None] * (there - here))


def _extrapolate(loss: Loss, problem: Problem, doubt: Doubt, step: _Step, weight: Array) -> Array:
    """Return the limits (M, size) of the steps if each shrinks by the same ratio (Aitken 1926).

    If the limit does not cost less, the end point of the step is returned. `weight` (M, m) are the weights of the loss.
    """
    cost = []
    for x in (step.x, step.tried):
        now = weigh_by(loss, problem, doubt, x, weight)
        cost.append(robust_cost(loss, problem, doubt, x, now))
    return np.where((cost[1] < cost[0])[:, None], step.tried, step.x)


def weigh_by(loss: Loss, problem: Problem, doubt: Doubt, x: Array, weight: Array, scale: Array | float = 1.0) -> Array:
    """Return the factors (N, m) that a loss applies to the weights of rows at vectors x, with sigma times a scale.

    Parameters
    ----------
    loss, problem, doubt : Loss, Problem, Doubt
        N problems.
    x : array (N, size)
        Parameter vectors.
    weight : array (N, m)
        Current weights, used for the partners of correlated rows.
    scale : array (N, 1) or float
        Above 1 fewer rows get a reduced weight.
    """
    u = fold_signs(loss, doubt.residual(problem, x, weight) / scale, doubt.sided)
    return np.where(np.isfinite(u), loss.weight(u), 0.0)


def robust_cost(loss: Loss, problem: Problem, doubt: Doubt, x: Array, weight: Array) -> Array:
    """Return the robust cost (N,) at vectors x (N, size) with the weights (N, m) of the loss there, priors included."""
    u = fold_signs(loss, doubt.residual(problem, x, weight), doubt.sided)
    quadratic = equations_at(problem.with_rows(weight=doubt.row_weight(weight)), x).cost
    excess = np.where(doubt.base > 0.0, loss.rho(u) - weight * u**2, 0.0)
    return np.asarray(quadratic + excess.sum(-1))


def robust_equations(loss: Loss, problem: Problem, doubt: Doubt, x: Array, weight: Array) -> Normal:
    """Return normal equations of N estimates x (N, size), whose inverse is the covariance of the estimates.

    `weight` (N, m) are the weights of the loss. The equations are the weighted normal matrix of the rows over
    ``loss.spread``, plus the priors. The right-hand side is not scaled: it is half the downhill gradient of the robust
    cost, from which the multipliers follow.
    """
    rows = summed(problem.with_rows(weight=doubt.row_weight(weight)), x)
    information = {name: getattr(rows, name) / loss.spread for name in ("shared", "local", "cross")}
    return with_priors(problem, x, replace(rows, **information))
