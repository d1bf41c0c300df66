"""Starts for a robust cost, without a first guess: fixes without some stations or rows.

Letters: N problems, m rows, S subsets of rows, q starts of a problem, M starts of all problems, `size` numbers of a
parameter vector. u are residuals in sigma. The *cut* of a loss is its constant c, in sigma: truncated least squares
rejects rows with larger residuals.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from optloc.base.types import Array, Status
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import exact
from optloc.linear.courses import elapsed
from optloc.linear.mirror import one_position, rows_of_stations
from optloc.linear.normal import depends_on_place, with_station_noise
from optloc.linear.redundancy import degrees_of_freedom
from optloc.linear.vectors import vectors
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.noise import independent, variances
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.solvers.pool import Pool, pack
from optloc.solvers.robust.reweighting import Doubt, fold_signs, weigh_by
from optloc.solvers.stages import roots, search_widely
from optloc.solvers.starts.position import is_registration_run
from optloc.solvers.starts.registration import mirror_courses, split_epochs
from optloc.solvers.verdict.judge import judge, surviving_candidates

# Limits of the subsets. Most subsets of a problem: each takes a closed form and a few steps. Most stations for which
# three are left out (92 sets of eight, of which 80 are taken). Most rows for which single rows are left out: with more
# rows, leaving out a station covers the likely errors.
_MOST, _THREE, _ROWS = 80, 8, 12
# Most starts of a problem that pass the cheap comparison, and most that are annealed and kept.
_SCREENED, _KEPT = 30, 12
# Problems, and starts times rows, per part: an array takes about ten megabytes.
_EACH, _NUMBERS = 64, 2**20
# Epochs of a run that are fixed separately, spread over the run, and positions kept for each: both sides of flat
# stations.
_EPOCHS, _SIDES = 12, 2
# Starts whose residuals differ by less than this many sigma are equal: the loss would reject the same rows.
_SAME = 0.5
# Gauss-Newton steps before starts are compared: enough to remove the effect of the weights of the closed form.
_FEW = 5
# Steps between two updates of the weights during annealing: the weights change before least squares would converge.
_BETWEEN = 2
# Rows that are tried on the other side of the cut of a loss: those nearest to it.
_FLIPPED = 10
# Ratio of the standard deviation to the median of absolute values, for normal errors. This scale changes little even if
# half of the rows are wrong.
_MEDIAN = 1.4826
# Halvings of that scale, down to one sigma: a scale of 64 sigma ends at the noise.
_HALVINGS = 6
# Growth factor of the control parameter (Yang et al.: 1.4), most steps of the graduation, and final value. At the final
# value the weights equal the weights of truncated least squares, except within a thousandth around the cut.
_GROWTH, _GRADES, _SHARP = 1.4, 40, 1e3


# Subsets of rows for the starts: all rows except the rows of some stations, or all except one row.


def subsets(problem: Problem, clean: Array) -> tuple[Array, Array]:
    """Return the subsets of all problems of a flat batch: problem of each subset (S,), and flags (S, m) of its rows.

    A subset leaves out one station or two. If a problem has few stations, three are left out too; if it has few rows,
    single rows are left out too.

    Parameters
    ----------
    problem : Problem
        N problems; only stations with rows of a problem are left out of it.
    clean : bool array (N,)
        Problems for which subsets leave out one station only.
    """
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    # `touched` flags the rows of each station, and `single` the one row of each row
    touched, single = rows_of_stations(problem), np.eye(problem.count, dtype=bool)
    measured = np.asarray((present[:, None] & touched).any(-1))
    short = np.flatnonzero(present.sum(1) <= _ROWS)
    stations, rows = _unite(measured, touched, 3), _unite(present[short], single, 1)
    wanted = ~clean[stations[0]] | (stations[2] == 1)
    item = np.concatenate([stations[0][wanted], short[rows[0]]])
    kept = present[item] & ~np.concatenate([stations[1][wanted], rows[1]])
    # different sets may leave the same rows, which then give one start
    _, first = np.unique(np.column_stack([item, kept]), axis=0, return_index=True)
    item, kept = item[first], kept[first]
    enough = degrees_of_freedom(problem.take(item).with_rows(weight=1.0 * kept)) >= 0
    return item[enough], kept[enough]


def _unite(members_of: Array, touched: Array, size: int) -> tuple[Array, Array, Array]:
    """Return the unions of the rows of up to `size` members: problems (S,), rows (S, m), sizes (S,).

    A member is a station or a row, g in total. `members_of` (N, g) flags the members of each problem, and `touched` (g,
    m) the rows of each member.
    """
    count = members_of.sum(1)
    most = int(count.max(initial=0))
    # the members of each problem come first, so that one list of index sets serves all problems
    local = np.argsort(~members_of, axis=1, kind="stable")[:, :most]
    sizes = range(1, 1 + (size if most <= _THREE else min(size, 2)))
    items, unions = [np.zeros(0, dtype=int)], [np.zeros((0, touched.shape[1]), dtype=bool)]
    lengths = [np.zeros(0, dtype=int)]
    for members in [chosen for q in sizes for chosen in combinations(range(most), q)][:_MOST]:
        item = np.flatnonzero(count > max(members))
        items.append(item)
        unions.append(np.asarray(touched[local[item][:, members]].any(1)))
        lengths.append(np.full(len(item), len(members)))
    return np.concatenate(items), np.concatenate(unions), np.concatenate(lengths)


# Starts from these subsets, selection of the best, and two ways to reach the minimum of a non-convex loss.


def robust_starts(problem: Problem, loss: Loss) -> Array:
    """Return starting vectors (N, q, size) of a flat batch; NaN in empty slots.

    Parameters
    ----------
    problem : Problem
        N problems.
    loss : Loss
        Its cost selects the starts.
    """
    plain = search_widely(problem)
    pool = surviving_candidates(plain, judge(problem, plain))[:, :_KEPT]
    parts = [pool, _graduate(problem, pool[:, :1])]
    if one_position(problem):
        # If the cost is below the price of one row, a solution without two rows is no rival: it costs more than the
        # gap.
        parts.append(_leave_out(problem, loss, plain.cost[:, 0] < AMBIGUOUS_GAP))
    else:
        parts.append(_annealed(problem, pool, loss))
        if is_registration_run(problem):
            # gross errors may draw a course to the wrong side of the stations
            parts.append(_annealed(problem, mirror_courses(problem, parts[-1]), loss))
        if len(problem.motions) == 1 and problem.motions[0].known is None and problem.motions[0].span == "run":
            parts.append(_through_epochs(problem, loss))
    return pack(np.concatenate(parts, axis=1))


def _through_epochs(problem: Problem, loss: Loss) -> Array:
    """Return the best starts (N, q, size) of runs, each through the positions of two epochs that are fixed separately.

    Errors in a few epochs do not affect the positions of the other epochs. The method is a random sample consensus with
    minimal samples (M. A. Fischler, R. C. Bolles, Commun. ACM 24 (1981)), here over all pairs of a few epochs.
    """
    size, d, order = problem.batch_shape[0], problem.dimension, problem.motions[0].order
    epoch = np.unique(np.linspace(0, problem.epochs - 1, _EPOCHS).round().astype(int))
    still = replace(problem.motions[0], order=0, reference=None)
    alone = replace(split_epochs(problem), motions=(still,)).flat()
    alone = alone.take((np.arange(size)[:, None] * problem.epochs + epoch).ravel())
    found = _leave_out(alone, LOSSES["cauchy"], np.zeros(size * len(epoch), dtype=bool))
    place = found[:, :_SIDES, :d].reshape(size, len(epoch), -1, d)
    if order:
        i, j = np.triu_indices(len(epoch), 1)
        time = elapsed(problem, 0)[epoch][:, None, None]
        velocity = (place[:, j] - place[:, i]) / (time[j] - time[i])
        rest = np.zeros((*velocity.shape[:-1], d * (order - 1)))
        # position at the reference time of the state, velocity, and zeros for higher derivatives
        place = np.concatenate([place[:, i] - velocity * time[i], velocity, rest], axis=-1)
    x = vectors(problem, place.reshape(size, -1, place.shape[-1]))
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    return _annealed(problem, _cheapest(problem, x[item, slot], item, loss, _SCREENED, anneal=False), loss)


def _annealed(problem: Problem, pool: Array, loss: Loss) -> Array:
    """Return the end points (N, q, size) of annealing from starts `pool` (N, q, size), the cheapest first.

    Annealing means steps under the Cauchy loss with a falling scale of the residuals.
    """
    item, slot = np.nonzero(np.isfinite(pool).all(-1))
    return _cheapest(problem, pool[item, slot], item, loss, _KEPT, anneal=True)


def _leave_out(problem: Problem, loss: Loss, clean: Array) -> Array:
    """Return the best starts (N, q, size) from closed forms of all subsets.

    For problems flagged in `clean` (N,) the subsets leave out one station only.
    """
    # Correlation matters for the answer, but little for its start, and it costs time.
    noise = with_station_noise(problem).noise if not depends_on_place(problem) else problem.noise
    problem = replace(problem, noise=independent(variances(noise, problem.count)))
    size = problem.batch_shape[0]
    each = [np.arange(i, min(i + _EACH, size)) for i in range(0, size, _EACH)]
    parts = [_start_subsets(problem.take(own), loss, clean[own]) for own in each]
    out = np.full((size, max(part.shape[1] for part in parts), problem.layout.size), np.nan)
    for i, part in enumerate(parts):
        out[i * _EACH : i * _EACH + len(part), : part.shape[1]] = part
    return out


def _start_subsets(problem: Problem, loss: Loss, clean: Array) -> Array:
    """Return the best starts (N, q, size) from closed forms of all subsets, for a part of the batch of `_leave_out`."""
    item, kept = subsets(problem, clean)
    if not len(item):
        return np.full((problem.batch_shape[0], 0, problem.layout.size), np.nan)
    part = problem.take(item)
    part = part.with_rows(weight=np.where(kept, part.weight, 0.0))
    found = roots(part, None)
    pair, slot = found.occupied
    x = refine(part, found.x[pair, slot], item=pair, limit=_FEW, face=exact(problem)).x
    pool = _cheapest(problem, x, item[pair], loss, _SCREENED, anneal=False)
    return _annealed(problem, pool, loss)


def _cheapest(problem: Problem, x: Array, item: Array, loss: Loss, most: int, *, anneal: bool) -> Array:
    """Return the cheapest starts (N, q, size) of starts x (M, size), q at most `most`, without repetitions.

    `item` (M,) is the problem of each start. `anneal` moves the starts by annealing before the comparison. Two starts
    are equal if their residuals differ by less than `_SAME` sigma. NaN in empty slots.
    """
    size, count = problem.batch_shape[0], len(x)
    cost, u, x = np.full(count, np.inf), np.zeros((count, problem.count)), np.array(x)
    usable = np.flatnonzero(np.isfinite(x).all(-1))
    step = max(1, _NUMBERS // problem.count)
    for first in range(0, len(usable), step):
        some = usable[first : first + step]
        x[some], cost[some], u[some] = _anneal(problem.take(item[some]), x[some], loss, _HALVINGS if anneal else 0)
    chosen = np.full((size, most, x.shape[1]), np.nan)
    # sorted by problem, then by cost
    order = np.lexsort((cost, item))
    order = order[np.isfinite(cost[order])]
    # one row of `u` per measurement: the maximum over measurements is then fast for many starts
    x, u, item = x[order], np.ascontiguousarray(u[order].T), item[order]
    for slot in range(most):
        if not len(item):
            return chosen[:, :slot]
        begins = np.append(True, item[1:] != item[:-1])
        best = np.flatnonzero(begins)
        # `best[np.cumsum(begins) - 1]` is the index of the cheapest start of the problem of each start
        chosen[item[best], slot] = x[best]
        different = np.abs(u - u[:, best[np.cumsum(begins) - 1]]).max(0) >= _SAME
        x, u, item = x[different], u[:, different], item[different]
    return chosen


def _anneal(problem: Problem, x: Array, loss: Loss, halvings: int) -> tuple[Array, Array, Array]:
    """Return vectors (M, size) after annealing, their costs (M,) and residuals (M, m).

    Annealing means steps under the Cauchy loss with a falling scale. The scale is halved `halvings` times. With 0
    halvings the vectors do not move. Residuals are in sigma. Costs are the costs under `loss`, infinite for invalid
    vectors.
    """
    doubt, cauchy, face = Doubt.of(problem, x), LOSSES["cauchy"], exact(problem)
    weight = np.ones(doubt.base.shape)
    with np.errstate(all="ignore"):
        u = doubt.residual(problem, x, weight)
        size = np.where(doubt.base > 0.0, np.abs(u), np.nan)
        scale = np.maximum(1.0, _MEDIAN * np.nanmedian(size, axis=1, keepdims=True)) if halvings else 1.0
        for halving in range(halvings):
            weight = weigh_by(cauchy, problem, doubt, x, weight, np.maximum(1.0, scale * 0.5**halving))
            x = refine(problem.with_rows(weight=doubt.row_weight(weight)), x, limit=_BETWEEN, face=face).x
        u = doubt.residual(problem, x, weight) if halvings else u
        cost = np.where(doubt.base > 0.0, loss.rho(fold_signs(loss, u, doubt.sided)), 0.0).sum(-1)
    return x, np.where(np.isfinite(cost) & np.isfinite(u).all(-1), cost, np.inf), np.nan_to_num(u)


def flip_rows(problem: Problem, loss: Loss, pool: Pool) -> Array:
    """Return starts (N, q, size) near the cheapest minimum: each adds or removes one row near the cut of the loss.

    A loss that cuts rows off has a minimum for almost every set of rows, and the best minima differ in few rows.
    """
    best = np.where(pool.code == Status.OK, pool.cost, np.inf).argmin(1)
    x = pool.x[np.arange(len(best)), best]
    item = np.flatnonzero(np.isfinite(x).all(-1))
    if not len(item):
        return np.asarray(x[:, None])
    part = problem.take(item)
    doubt, q = Doubt.of(part, x[item]), min(_FLIPPED, problem.count)
    weight = weigh_by(loss, part, doubt, x[item], np.ones(doubt.base.shape))
    u = np.where(doubt.base > 0.0, np.abs(doubt.residual(part, x[item], weight)), np.inf)
    near_cut = np.argsort(np.abs(u - loss.constant), axis=1)[:, :q]
    each = np.repeat(np.arange(len(item)), q)
    changed, row = weight[each], (np.arange(len(each)), near_cut.ravel())
    changed[row] = 1.0 - changed[row]
    changed_problems = part.take(each).with_rows(weight=doubt.take(each).row_weight(changed))
    out = np.full((len(x), q, x.shape[-1]), np.nan)
    out[item] = refine(changed_problems, x[item][each], limit=_FEW, face=exact(problem)).x.reshape(len(item), q, -1)
    return out


def _graduate(problem: Problem, start: Array) -> Array:
    """Return the minima (N, q, size) of truncated least squares by graduation from a convex cost, next to starts.

    H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception", IEEE Robot.
    Autom. Lett. 5 (2020), eq. 14 for the weights and section III-C for the schedule. c is the cut of the loss in sigma,
    and mu the control parameter: small for a convex cost, large for the truncated cost.
    """
    item, slot = np.nonzero(np.isfinite(start).all(-1))
    out = np.full(start.shape, np.nan)
    if not len(item):
        return out
    problem, x = problem.take(item), start[item, slot]
    doubt, face, c = Doubt.of(problem, x), exact(problem), LOSSES["truncated"].constant
    weight, mu = np.ones(doubt.base.shape), np.full((len(x), 1), np.inf)
    with np.errstate(all="ignore"):
        for grade in range(_GRADES):
            u = np.abs(doubt.residual(problem, x, weight))
            worst = np.where(doubt.base > 0.0, u, 0.0).max(1, keepdims=True)
            # the largest mu for which every residual is in the convex part (eq. 14); the floor keeps it finite if all
            # rows agree
            convex = c**2 / np.maximum(2.0 * worst**2 - c**2, 1e-300)
            mu = np.minimum(convex, _SHARP) if grade == 0 else mu * _GROWTH
            if (mu > _SHARP).all():
                break
            # the weight between the two cuts; clipped to 1 and 0 at the cuts
            bent = c / u * np.sqrt(mu * (mu + 1.0)) - mu
            weight = np.where(np.isfinite(u), np.clip(bent, 0.0, 1.0), 0.0)
            x = refine(problem.with_rows(weight=doubt.row_weight(weight)), x, limit=_BETWEEN, face=face).x
    out[item, slot] = x
    return out
