"""Starts for a robust cost, without a guess: what fits when some stations or rows are left out."""

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

# Subsets of a problem at most: each is a closed form and a few steps. Stations up to which three are left out (92 sets
# of eight, of which 80 are taken), and rows up to which single ones are: of more, a station covers the likely errors.
_MOST, _THREE, _ROWS = 80, 8, 12
# Starts of a problem that are screened, cheaply, and annealed and kept.
_SCREENED, _KEPT = 30, 12
# Problems, and starts times rows, that are worked on at a time: some ten megabytes an array.
_EACH, _NUMBERS = 64, 2**20
# Epochs of a run that are fixed alone, spread over it, and places of each that are kept: two sides of flat stations.
_EPOCHS, _SIDES = 12, 2
# Starts whose residuals differ by less than this many sigma are one: they would doubt the same rows.
_SAME = 0.5
# Gauss-Newton steps before starts are compared: enough to leave the closed form's own weighting.
_FEW = 5
# Steps between two weighings on the way: the weights change before least squares would settle.
_BETWEEN = 2
# Rows that are tried on the other side of a cut: those nearest to it.
_FLIPPED = 10
# Standard deviation of normal deviates over the median of their sizes: a scale that half the rows may be wrong without
# moving much.
_MEDIAN = 1.4826
# Halvings of that scale, never below one sigma: what begins 64 sigma wide ends at the noise.
_HALVINGS = 6
# Growth of the control parameter and most steps of the graduation (Yang et al.: 1.4), which ends at the value where its
# weights are those of truncated least squares but in a sliver of a thousandth around the cut.
_GROWTH, _GRADES, _SHARP = 1.4, 40, 1e3


# Which rows to start from: all but those of some stations, or all but one, of the rows that each problem has.


def subsets(problem: Problem, clean: Array) -> tuple[Array, Array]:
    """Return the subsets of all problems of a flat batch: problem of each (S,), and its rows (S, m).

    One station is left out, or one row where a problem has few, or two stations, or three of few.

    Parameters
    ----------
    problem : Problem
        N problems; what is left out of each are its own stations, those that it has rows of.
    clean : bool array (N,)
        Problems of which no two stations are left out.
    """
    present = np.broadcast_to(problem.weight > 0.0, (problem.batch_shape[0], problem.count))
    touched, single = rows_of_stations(problem), np.eye(problem.count, dtype=bool)
    heard = np.asarray((present[:, None] & touched).any(-1))
    short = np.flatnonzero(present.sum(1) <= _ROWS)
    stations, rows = _unite(heard, touched, 3), _unite(present[short], single, 1)
    wanted = ~clean[stations[0]] | (stations[2] == 1)
    item = np.concatenate([stations[0][wanted], short[rows[0]]])
    kept = present[item] & ~np.concatenate([stations[1][wanted], rows[1]])
    # several stations, or one row, may leave the same rest: it is started from once
    _, first = np.unique(np.column_stack([item, kept]), axis=0, return_index=True)
    item, kept = item[first], kept[first]
    enough = degrees_of_freedom(problem.take(item).with_rows(weight=1.0 * kept)) >= 0
    return item[enough], kept[enough]


def _unite(own: Array, touched: Array, size: int) -> tuple[Array, Array, Array]:
    """Return problems (S,), unions (S, m) of the rows (g, m) of up to `size` of their members, and sizes (S,)."""
    count = own.sum(1)
    most = int(count.max(initial=0))
    # numbers of each problem's own members, first: sets are of places in this list, the same for all problems
    local = np.argsort(~own, axis=1, kind="stable")[:, :most]
    sizes = range(1, 1 + (size if most <= _THREE else min(size, 2)))
    items, unions = [np.zeros(0, dtype=int)], [np.zeros((0, touched.shape[1]), dtype=bool)]
    lengths = [np.zeros(0, dtype=int)]
    for members in [chosen for q in sizes for chosen in combinations(range(most), q)][:_MOST]:
        item = np.flatnonzero(count > max(members))
        items.append(item)
        unions.append(np.asarray(touched[local[item][:, members]].any(1)))
        lengths.append(np.full(len(item), len(members)))
    return np.concatenate(items), np.concatenate(unions), np.concatenate(lengths)


# Starts from those rows, the best of them, and two ways down to a loss that is not convex.


def robust_starts(problem: Problem, loss: Loss) -> Array:
    """Return starting vectors (N, q, size) of a flat batch; NaN in empty slots.

    Parameters
    ----------
    problem : Problem
        N problems.
    loss : Loss
        Whose cost decides which starts are kept.
    """
    plain = search_widely(problem)
    pool = surviving_candidates(plain, judge(problem, plain))[:, :_KEPT]
    parts = [pool, _graduate(problem, pool[:, :1])]
    if one_position(problem):
        # two rows that are left out are no rival of a cost below the price of one: a rival may cost that much more
        parts.append(_leave_out(problem, loss, plain.cost[:, 0] < AMBIGUOUS_GAP))
    else:
        parts.append(_annealed(problem, pool, loss))
        if is_registration_run(problem):
            # what gross errors have drawn to one side of the stations belongs to the other
            parts.append(_annealed(problem, mirror_courses(problem, parts[-1]), loss))
        if len(problem.motions) == 1 and problem.motions[0].known is None and problem.motions[0].span == "run":
            parts.append(_through_epochs(problem, loss))
    return pack(np.concatenate(parts, axis=1))


def _through_epochs(problem: Problem, loss: Loss) -> Array:
    """Return the best starts (N, q, size) of runs that pass through the places where two epochs were fixed alone.

    What is wrong in a few epochs does not touch the places of the others (as by samples that are as small as can be: M.
    A. Fischler, R. C. Bolles, "Random sample consensus", Commun. ACM 24 (1981)); here all pairs of a few are tried.
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
        place = np.concatenate([place[:, i] - velocity * time[i], velocity, rest], axis=-1)
    x = vectors(problem, place.reshape(size, -1, place.shape[-1]))
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    return _annealed(problem, _cheapest(problem, x[item, slot], item, loss, _SCREENED, anneal=False), loss)


def _annealed(problem: Problem, pool: Array, loss: Loss) -> Array:
    """Return where starts (N, q, size) lead that doubt what does not fit them, the cheapest first."""
    item, slot = np.nonzero(np.isfinite(pool).all(-1))
    return _cheapest(problem, pool[item, slot], item, loss, _KEPT, anneal=True)


def _leave_out(problem: Problem, loss: Loss, clean: Array) -> Array:
    """Return the best starts (N, q, size) from closed forms of all subsets."""
    # Correlation matters for the answer, hardly for where to look for it, and it costs time.
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
    """Return the cheapest of starts (M, size) of given problems (M,), each once, as (N, most, size)."""
    size, count = problem.batch_shape[0], len(x)
    cost, u, x = np.full(count, np.inf), np.zeros((count, problem.count)), np.array(x)
    usable = np.flatnonzero(np.isfinite(x).all(-1))
    step = max(1, _NUMBERS // problem.count)
    for first in range(0, len(usable), step):
        some = usable[first : first + step]
        x[some], cost[some], u[some] = _anneal(problem.take(item[some]), x[some], loss, _HALVINGS if anneal else 0)
    chosen = np.full((size, most, x.shape[1]), np.nan)
    # by problem, the cheapest of each first
    order = np.lexsort((cost, item))
    order = order[np.isfinite(cost[order])]
    # residuals row by row: their largest is then found many starts at a time
    x, u, item = x[order], np.ascontiguousarray(u[order].T), item[order]
    for slot in range(most):
        if not len(item):
            return chosen[:, :slot]
        begins = np.append(True, item[1:] != item[:-1])
        best = np.flatnonzero(begins)
        chosen[item[best], slot] = x[best]
        left = np.abs(u - u[:, best[np.cumsum(begins) - 1]]).max(0) >= _SAME
        x, u, item = x[left], u[:, left], item[left]
    return chosen


def _anneal(problem: Problem, x: Array, loss: Loss, halvings: int) -> tuple[Array, Array, Array]:
    """Return vectors after a few weighings by the Cauchy loss whose scale is halved, their costs and residuals."""
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
    """Return starts (N, q, size) beside the cheapest minimum: those with one more row in or out, of rows at the brink.

    A loss that cuts rows off has minima of its own for almost every set of rows; the best ones differ in few rows.
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
    brink = np.argsort(np.abs(u - loss.constant), axis=1)[:, :q]
    each = np.repeat(np.arange(len(item)), q)
    changed, row = weight[each], (np.arange(len(each)), brink.ravel())
    changed[row] = 1.0 - changed[row]
    beside = part.take(each).with_rows(weight=doubt.take(each).row_weight(changed))
    out = np.full((len(x), q, x.shape[-1]), np.nan)
    out[item] = refine(beside, x[item][each], limit=_FEW, face=exact(problem)).x.reshape(len(item), q, -1)
    return out


def _graduate(problem: Problem, start: Array) -> Array:
    """Return where truncated least squares leads (N, q, size) when it begins convex and is bent step by step.

    H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception", IEEE Robot.
    Autom. Lett. 5 (2020), eq. 14 for the weights and section III-C for the schedule.
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
            # so small a mu that no residual is beyond the convex part (eq. 14); the floor keeps it finite if all rows
            # agree
            convex = c**2 / np.maximum(2.0 * worst**2 - c**2, 1e-300)
            mu = np.minimum(convex, _SHARP) if grade == 0 else mu * _GROWTH
            if (mu > _SHARP).all():
                break
            # between the cuts where it is 1 and 0: clipped there
            bent = c / u * np.sqrt(mu * (mu + 1.0)) - mu
            weight = np.where(np.isfinite(u), np.clip(bent, 0.0, 1.0), 0.0)
            x = refine(problem.with_rows(weight=doubt.row_weight(weight)), x, limit=_BETWEEN, face=face).x
    out[item, slot] = x
    return out
