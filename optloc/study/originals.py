"""What the papers do between a guess and an answer, for any problem: baselines that never look for another minimum."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from formulations.backend import count
from optloc.base.status import Status
from optloc.base.threads import WORTH, mapped
from optloc.base.types import Array
from optloc.compute.sums import equations_at
from optloc.linear.evaluate import differentiate
from optloc.linear.normal import step
from optloc.linear.station_noise import weighed
from optloc.models import MODELS
from optloc.problem.epochs import tied, window
from optloc.problem.fix import Fix, Stage
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.solvers.pool import Candidates, given, unrefined
from optloc.solvers.stages import finished
from optloc.solvers.starts.position import spread_of, vectors
from optloc.solvers.starts.several_positions import one_position

_FIRST = 40


def single_step(problem: Problem, start: Array) -> Array:
    """Return where one Gauss-Newton step from a guess leads.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (N, size)
        Parameter vectors.

    Returns
    -------
    array (N, size)
        NaN where the normal equations are singular.
    """
    with np.errstate(all="ignore"):
        return _moved(problem, start)


def recursion(problem: Problem, start: Array, *, iterations: int = 2) -> Array:
    """Return where the registration paper's recursion leads: undamped steps over all data so far, epoch by epoch.

    It begins with the first forty epochs and never takes a step back.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs without unknowns of single epochs.
    start : array (N, size)
        Parameter vectors.
    iterations : int
        Steps at each epoch.

    Returns
    -------
    array (N, size)
        NaN where the steps ran away, and for problems that have unknowns of single epochs.
    """
    if problem.layout.n_local or tied(problem):
        return np.full_like(start, np.nan)
    x = start
    with np.errstate(all="ignore"):
        for last in range(min(_FIRST, problem.epochs), problem.epochs + 1):
            so_far = window(problem, 0, last) if last < problem.epochs else problem
            for _ in range(iterations):
                x = _moved(so_far, x)
    return x


def _moved(problem: Problem, x: Array) -> Array:
    move, ok = step(equations_at(problem, x), np.zeros(len(x)))
    return x + np.where(ok[:, None], move, np.nan)


# General tools on the same data, for comparison: SciPy's least squares from a guess, the plain lift of ranges.


def least_squares(problem: Problem, start: Array, limit: int = 200) -> Fix:
    """Return the fixes of `scipy.optimize.least_squares` with exact derivatives, one by one.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems without constraints.
    start : array (N, size)
        Where each begins.
    limit : int
        Evaluations at most.

    Returns
    -------
    Fix
        Judged like a refined one; what did not converge has the status of its ending.
    """
    from scipy import optimize

    began = perf_counter()
    plain = weighed(problem)
    pool = np.array(start, dtype=float)[:, None]
    cost, code = np.full(pool.shape[:2], np.inf), np.full(pool.shape[:2], int(Status.NUMERICAL), dtype=np.int8)
    for i in range(len(pool)):
        one = plain.take(np.array([i]))
        white = whiten(one.noise, one.weight)

        def residual(x: Array, one: Problem = one, white: tuple = white) -> Array:  # type: ignore[type-arg]
            values = differentiate(one, x[None])[0][..., None]
            return np.concatenate([w.apply(values)[0, :, 0] for w in white])

        def jacobian(x: Array, one: Problem = one, white: tuple = white) -> Array:  # type: ignore[type-arg]
            H = differentiate(one, x[None])[1]
            return -np.concatenate([w.apply(H)[0] for w in white])

        try:
            found = optimize.least_squares(residual, start[i], jacobian, method="lm", max_nfev=limit)
        except ValueError:  # values that are not finite, or fewer rows than unknowns
            continue
        pool[i, 0], cost[i, 0] = found.x, 2.0 * found.cost
        code[i, 0] = Status.OK if found.status > 0 else Status.MAX_ITERATIONS
        count("scipy", int(found.nfev))
    stage = Stage("scipy", f"{len(pool)} problems", perf_counter() - began)
    return finished(
        problem, given(problem, start), Candidates(pool, cost, code, np.zeros(cost.shape, dtype=int)), stage
    )


def claimed(problem: Problem, start: Array, x: Array) -> Fix:
    """Return points (N, size) as fixes that claim to be answers wherever they are finite.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    start : array (N, size)
        Where they come from.
    x : array (N, size)
        Points.
    """
    found = np.asarray(np.isfinite(x).all(-1))
    with np.errstate(all="ignore"):
        cost = np.where(found, equations_at(problem, np.where(found[:, None], x, start)).cost, np.inf)
    code = np.where(found, Status.OK, Status.NUMERICAL).astype(np.int8)
    pool = Candidates(x[:, None], cost[:, None], code[:, None], np.zeros((len(x), 1), dtype=int))
    return finished(problem, given(problem, start), pool, Stage("claimed", f"{found.sum()} points", 0.0))


def lifted_sdp(problem: Problem) -> Fix:
    """Return the points of the order-1 lift of ranges, unrefined; nowhere for rows that are not sums of ranges.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems of one epoch with one static target.

    References
    ----------
    K. Yang, G. Wang and Z.-Q. Luo (2009); see `formulations.lifted`.
    """
    from formulations.lifted import lifted_ranges

    began, problem = perf_counter(), weighed(problem)
    size, d = problem.batch_shape[0], problem.dimension
    position = np.full((size, 1, d), np.nan)
    models = [MODELS[rows.kind] for rows in problem.rows]
    if one_position(problem) and all(model.ranges is not None and not model.emission for model in models):
        centre, scale = spread_of(problem)

        def relaxed(i: int) -> None:
            K, z = _linear(problem.take(np.array([i])), float(scale[i]))
            stations = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))
            found = lifted_ranges(K, z, (stations[i, 0] - centre[i]) / scale[i])
            position[i, 0] = found.point * scale[i] + centre[i]

        mapped(relaxed, range(size), least=WORTH)
    return unrefined(problem, vectors(problem, position), None, "lifted-sdp", began)


def _linear(one: Problem, scale: float) -> tuple[Array, Array]:
    """Return the whitened rows K (m, s) and values (m,) of one problem whose rows are sums of ranges."""
    K, start = np.zeros((one.count, one.stations.count)), 0
    for rows in one.rows:
        ends = MODELS[rows.kind].ranges
        assert ends is not None
        for index, sign in zip((rows.a, rows.b), ends, strict=True):
            if sign:
                K[start + np.arange(rows.count), index] += sign
        start += rows.count
    stacked = np.concatenate([K, one.observed[0][:, None] / scale], axis=1)
    white = np.concatenate([w.apply(stacked[None])[0] for w in whiten(one.noise, one.weight)])
    return white[:, :-1] * scale, white[:, -1] * scale
