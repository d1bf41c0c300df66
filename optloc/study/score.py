"""What is written about the fixes of trials: errors against truth and bound, consistency, cost, certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base import linalg
from optloc.base.status import Status
from optloc.base.types import Array
from optloc.bounds.crlb import crlb
from optloc.compute.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.normal import covariance, eliminated
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.study.cases import Case
from optloc.study.draws import Drawn

Values = dict[str, Any]
"""Columns of some trials: arrays (n,), or one value for all."""


@dataclass(frozen=True, slots=True)
class Exact:
    """What holds for trials whatever the method.

    Parameters
    ----------
    drawn : Drawn
        The trials.
    bound : array (n, p, p)
        Cramer-Rao bound of the shared unknowns at the truth; NaN where the geometry is singular.
    cost : array (n,)
        Cost at the truth.
    """

    drawn: Drawn
    bound: Array
    cost: Array


def exact_of(drawn: Drawn) -> Exact:
    """Return bound and cost at the truth of trials."""
    problem, size = drawn.problem, len(drawn.truth)
    with np.errstate(all="ignore"):
        equations = equations_at(problem, drawn.truth)
        bound = crlb(problem, drawn.truth) if exact(problem) else covariance(equations)[0]
        cost = eliminated(equations).cost
    return Exact(drawn, np.broadcast_to(bound, (size, *bound.shape[-2:])), np.broadcast_to(cost, (size,)))


def truth_values(case: Case, known: Exact) -> Values:
    """Return the columns that do not depend on the method."""
    problem, truth = known.drawn.problem, known.drawn.truth
    names = case.state
    place = _take(problem, truth, names[0])
    values: Values = {f"truth_{axis}": _component(place, i) for i, axis in enumerate("xyz")}
    values["outliers"] = known.drawn.bad
    values |= {"crlb": _root_trace(_block(problem, known.bound, names[0])), "cost_truth": known.cost}
    moving = len(names) > 1
    values["crlb_velocity"] = _root_trace(_block(problem, known.bound, names[1])) if moving else np.nan
    entries = _lengths(problem)
    variance = np.diagonal(known.bound, axis1=-2, axis2=-1)[:, entries]
    values["crlb_bias"] = np.sqrt(variance.mean(-1)) if len(entries) else np.nan
    return values


def fix_values(case: Case, known: Exact, fix: Fix) -> Values:
    """Return the columns of fixes (n,) of trials."""
    problem, truth, names = known.drawn.problem, known.drawn.truth, case.state
    size = len(truth)
    x = np.where(np.isfinite(fix.x).all(-1, keepdims=True), fix.x, np.nan)
    error = _take(problem, x - truth, names[0])
    claimed = _block(problem, fix.cov, names[0])
    values: Values = {f"error_{axis}": _component(error, i) for i, axis in enumerate("xyz")}
    values |= {
        "answered": fix.answered,
        "located": np.asarray(np.isfinite(error).all(-1)),
        "error": np.linalg.norm(error, axis=-1),
        "error_nearest": _nearest(problem, fix, truth, names[0], error),
        "deviation": np.sqrt(_squared(error, _block(problem, known.bound, names[0]))),
        "sigma": _root_trace(claimed),
        "nees": _squared(error, claimed),
        "cost": _cost(problem, fix, x),
        "dof": np.broadcast_to(fix.dof, (size,)),
        "rejected": np.broadcast_to((fix.weights < 0.5 * problem.weight).sum(-1), (size,)),
        "alternatives": np.isfinite(fix.alternatives.gap).sum(-1),
    }
    moving = len(names) > 1
    values["error_velocity"] = np.linalg.norm(_take(problem, x - truth, names[1]), axis=-1) if moving else np.nan
    entries = _lengths(problem)
    values["error_bias"] = np.sqrt(((x - truth)[:, entries] ** 2).mean(-1)) if len(entries) else np.nan
    labels = np.array([status.label for status in Status], dtype=object)
    values |= {"status": labels[fix.code], "reason": fix.reason}
    values |= {"proof": [c.proof for c in fix.certificate], "certificate": [c.method for c in fix.certificate]}
    values["bound"] = np.array([c.bound for c in fix.certificate], dtype=float)
    return values


def _component(place: Array, i: int) -> Any:
    return place[:, i] if i < place.shape[-1] else np.nan


def _take(problem: Problem, x: Array, name: str) -> Array:
    return problem.layout.take(x, name)


def _block(problem: Problem, matrix: Array, name: str) -> Array:
    slot, _ = problem.layout.find(name)
    part = slice(slot.start, slot.start + slot.size)
    return np.asarray(matrix[:, part, part])


def _lengths(problem: Problem) -> Array:
    """Return the entries of the shared unknowns that are biases in metres."""
    found = [np.arange(s.start, s.start + s.size) for s in problem.layout.shared if s.members and s.unit == "m"]
    return np.concatenate([*found, np.zeros(0, dtype=np.int64)])


def _root_trace(matrix: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.trace(matrix, axis1=-2, axis2=-1)))


def _squared(error: Array, matrix: Array) -> Array:
    """Return e' M^-1 e (n,); NaN where there is no error or no regular matrix."""
    usable = np.asarray(np.isfinite(matrix).all((-1, -2)) & np.isfinite(error).all(-1))
    kept = np.where(usable[:, None, None], matrix, np.eye(matrix.shape[-1]))
    solved, ok = linalg.solve(kept, np.where(usable[:, None], error, 0.0)[..., None])
    return np.asarray(np.where(usable & ok, (error * solved[..., 0]).sum(-1), np.nan))


def _nearest(problem: Problem, fix: Fix, truth: Array, name: str, error: Array) -> Array:
    best = np.linalg.norm(error, axis=-1)
    for i in range(fix.alternatives.x.shape[1]):
        with np.errstate(invalid="ignore"):
            best = np.fmin(best, np.linalg.norm(_take(problem, fix.alternatives.x[:, i] - truth, name), axis=-1))
    return np.asarray(best)


def _cost(problem: Problem, fix: Fix, x: Array) -> Array:
    """Return the cost of every estimate, that of unrefined ones evaluated here."""
    cost = np.where(np.isfinite(fix.cost), fix.cost, np.nan)
    items = np.flatnonzero(~np.isfinite(cost) & np.isfinite(x).all(-1))
    if len(items):
        with np.errstate(all="ignore"):
            found = eliminated(equations_at(problem.take(items), x[items])).cost
        cost[items] = np.where(np.isfinite(found), found, np.nan)
    return cost


# Numbers that judge methods: shares with intervals, errors against the bound, profiles, shifted means.

LEVEL = 0.95
"""Confidence of all intervals."""


def wilson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return Wilson's score interval of shares.

    Parameters
    ----------
    hits, count : array (...)
        How many of how many; NaN comes back where there are none.
    level : float
        Confidence.

    Returns
    -------
    low, high : array (...)
        Ends of the interval, between 0 and 1.

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    from scipy.special import ndtri

    z = ndtri(0.5 + level / 2.0)
    k, n = np.asarray(hits, dtype=float), np.asarray(count, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = k / n
        middle = share + z**2 / (2.0 * n)
        width = z * np.sqrt(share * (1.0 - share) / n + z**2 / (4.0 * n**2))
        scale = 1.0 + z**2 / n
        low, high = (middle - width) / scale, (middle + width) / scale
    # At the ends the formula is exact, but rounding is not.
    return np.where(k <= 0.0, np.where(n > 0.0, 0.0, np.nan), low), np.where((k >= n) & (n > 0.0), 1.0, high)


def clopper_pearson(hits: Array | float, count: Array | float, level: float = LEVEL) -> tuple[Array, Array]:
    """Return the exact interval of shares, which never covers less than its level; arguments as `wilson`.

    References
    ----------
    C. J. Clopper and E. S. Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934).
    """
    from scipy.special import betaincinv

    k, n = np.asarray(hits, dtype=float), np.asarray(count, dtype=float)
    tail = (1.0 - level) / 2.0
    some = n > 0.0
    low = np.where(k > 0.0, betaincinv(np.maximum(k, 1.0), n - k + 1.0, tail), 0.0)
    high = np.where(k < n, betaincinv(k + 1.0, np.maximum(n - k, 1.0), 1.0 - tail), 1.0)
    return np.where(some, low, np.nan), np.where(some, high, np.nan)


def over_bound(error: Array, bound: Array) -> tuple[float, float]:
    """Return the root mean square error over that of the bound, and the half width of its 95 % interval.

    Parameters
    ----------
    error, bound : array (n,)
        Lengths of errors and roots of the traces of their bounds, metres; pairs that are not finite do not count.

    Returns
    -------
    ratio, half : float
        NaN where no pair counts; the half width is that of the delta method, NaN of a single pair.
    """
    good = np.isfinite(error) & np.isfinite(bound)
    count = int(good.sum())
    if not count:
        return float("nan"), float("nan")
    squares = error[good] ** 2 / np.mean(bound[good] ** 2)
    ratio = float(np.sqrt(squares.mean()))
    spread = float(squares.std(ddof=1)) if count > 1 else float("nan")
    return ratio, 1.96 * spread / (2.0 * max(ratio, 1e-300) * np.sqrt(count))


def shifted_mean(times: Array, shift: float) -> float:
    """Return the shifted geometric mean exp(mean(log(t + s))) - s of times; NaN of none.

    Large times count less than in a mean, and times far below the shift are all alike.

    References
    ----------
    T. Achterberg, "Constraint Integer Programming", thesis (2007), section A.3.
    """
    values = np.asarray(times, dtype=float)
    return float(np.exp(np.mean(np.log(values + shift))) - shift) if len(values) else float("nan")


def performance_profile(times: Array, solved: Array, ratios: Array) -> Array:
    """Return the share of instances that each method solves within a multiple of the fastest time.

    Parameters
    ----------
    times : array (methods, n)
        Seconds.
    solved : bool array (methods, n)
        Where the method found what was sought; elsewhere its time does not matter.
    ratios : array (q,)
        Multiples of the time of the fastest method that solved the instance.

    Returns
    -------
    array (methods, q)
        Shares of all n instances, those among them that no method solves.

    References
    ----------
    E. D. Dolan and J. J. More, "Benchmarking optimization software with performance profiles",
    Mathematical Programming 91 (2002).
    """
    spent = np.where(solved, times, np.inf)
    if not spent.shape[-1]:
        return np.full((len(spent), len(ratios)), np.nan)
    with np.errstate(invalid="ignore"):
        slower = np.where(solved, spent / spent.min(0), np.inf)
    return np.stack([np.searchsorted(np.sort(row), ratios, side="right") / len(row) for row in slower])


def distribution(values: Array, count: int, points: int = 200) -> tuple[Array, Array]:
    """Return an empirical distribution as a curve of few points.

    Parameters
    ----------
    values : array (n,)
        What is not finite is left out of the curve, but not out of the count.
    count : int
        Trials, so that the curve ends at the share of those that have a value.
    points : int
        Most points of the curve; the least and the greatest value are among them.

    Returns
    -------
    x, share : array (q,)
        Values in order and the share of trials that are not above them.
    """
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return np.zeros(0), np.zeros(0)
    at = np.unique(np.linspace(0, len(ordered) - 1, min(points, len(ordered))).astype(int))
    return ordered[at], (at + 1.0) / count
