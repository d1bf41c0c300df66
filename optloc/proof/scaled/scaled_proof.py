"""The proof of a fix of a cost with unknown factors: no position costs less, and no other minimum is within a gap.

A factor multiplies the ranges of a group of rows (an unknown speed of waves, for instance), or is a component of an
unknown velocity. Letters: N problems, B is N or 1 if all share, q whitened rows, J nodes, G factors, d coordinates.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from optloc.base.threads import map_on_threads
from optloc.base.types import Array
from optloc.kernels.jit import compiled, enabled, may_use_code, plain, put, worth_loading, zero
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.proof.atlas import Atlas, atlas_of, first_minima, with_minima
from optloc.proof.batch import FIRST_BOXES, ProofRequest, ProofResult, empty_answer, plainly
from optloc.proof.box import DEPTH, bound_nodes, push_around, relative_rounding, station_cube
from optloc.proof.convex_boxes import accuracy_floor_far, widen_core
from optloc.proof.global_search import verdict_of
from optloc.proof.local_search import BUDGET, COARSE, INFINITE, OPEN, STATIONARY
from optloc.proof.pieces import CAPACITY, push_pieces
from optloc.proof.position_costs import costs_of_groups, costs_of_velocity, factors_of_rows, roots
from optloc.proof.scaled.enclosures import first_enclosed, stays_finite
from optloc.proof.scaled.reduction import HERE, Scaled, reduce_rows, rounding_of_residual
from optloc.proof.scaled.scaled_search import (
    ScaledSearchWorkspace,
    ScaledTables,
    cost_near,
    look_at,
    rest_of,
    search_scaled,
    set_near_minimum,
    set_scaled_minimum,
    tables_of,
)
from optloc.proof.search_space import (
    COARSEST,
    LINES,
    LocalAxes,
    accuracy_floor,
    chart_at,
    cost_of,
    equal_within,
)
from optloc.proof.space import Space, floor_of, in_atlas

# Greatest number of nodes of a moving target that count for the budget of boxes. Of 30 scenes in space with 200 m of
# noise, 9 were open after the 3 500 boxes of all 35 nodes. After the 10 800 boxes of 20 nodes (0.6 s) 4 were open, and
# after 30 000 boxes 3.
_MOST_COUNTED = 20


class ScaledCosts(NamedTuple):
    """The costs of a flat batch of N problems over the position, with unknown factors of rows.

    Parameters
    ----------
    kinds, data, K, w, level
        As in `optloc.proof.position_costs.PositionCosts`; priors on the factors are the last rows.
    lift : array (B, q, G)
        Coefficients of the factors alone in each row, without a node. They are zero except in rows of priors.
    group : int array (J,)
        The factor of each node, -1 for a node without a factor.
    free : bool
        Whether factors may be negative: True for the components of a velocity.
    """

    kinds: Array
    data: Array
    K: Array
    w: Array
    level: Array
    lift: Array
    group: Array
    free: bool = False

    @property
    def dense(self) -> float:
        """Return the weight of a box in the budget of boxes: the number of nodes.

        The time of a box grows with its square. With an unknown velocity (`free`) it is at most `_MOST_COUNTED`.
        """
        return float(min(len(self.kinds), _MOST_COUNTED if self.free else len(self.kinds)))

    def take(self, items: Array | slice) -> ScaledCosts:
        """Return the costs of the problems with the indices `items`."""

        def chosen(array: Array) -> Array:
            return array if len(array) == 1 else array[items]

        return self._replace(
            data=chosen(self.data), K=chosen(self.K), w=self.w[items], level=self.level[items], lift=chosen(self.lift)
        )

    def one(self, i: int) -> Scaled:
        """Return the cost of problem i."""
        data, K, lift = (plainly(each[i if len(each) > 1 else 0]) for each in (self.data, self.K, self.lift))
        return Scaled(cost_of(self.kinds, data, K, plainly(self.w[i])), lift, self.group, self.free)


def scaled_costs(problem: Problem) -> ScaledCosts:
    """Return the costs of a flat batch of problems whose rows have unknown factors, see `optloc.proof.scope`.

    The priors on the factors are the last G rows.
    """
    costs, group = costs_of_groups(problem, factors_of_rows(problem))
    inverse_sigma, means = _factor_priors(problem, len(costs.w))
    G, (rows, J) = len(inverse_sigma), costs.K.shape[1:]
    K = np.concatenate([costs.K, np.zeros((len(costs.K), G, J))], axis=1)
    lift = np.zeros((rows + G, G))
    lift[rows + np.arange(G), np.arange(G)] = inverse_sigma
    w = np.concatenate([costs.w, inverse_sigma * means], axis=1)
    return ScaledCosts(plainly(costs.kinds), costs.data, K, w, costs.level, lift[None], plainly(group))


def _factor_priors(problem: Problem, count: int) -> tuple[Array, Array]:
    """Return the inverse standard deviations (G,) of the factors, zero without a prior, and their means (N, G).

    `count` is the number N of problems. A mean is 1 plus the mean of the scale error.
    """
    inverse_sigma, means = [], []
    priors = {name: (mean, precision) for name, mean, precision in prior_parts(problem)}
    for bias in problem.biases:
        if form_of(bias).enters == "scales":
            n = len(bias.members)
            mean, precision = priors.get(bias.name, (np.zeros(n), np.zeros((n, n))))
            inverse_sigma.append(np.sqrt(np.diagonal(precision, axis1=-2, axis2=-1).reshape(-1, n)[0]))
            means.append(np.broadcast_to(1.0 + mean, (count, n)))
    return np.concatenate(inverse_sigma), np.concatenate(means, axis=1)


# Share of the longest column below which a number counts as rounding: whitening loses some digits. It applies to
# singular values, and to entries of rows without a velocity.
_NOTHING = 1e-12


def largest_rate(problem: Problem) -> float:
    """Return the largest size of a measured rate or of a station's velocity, metres per second; 1 without any."""
    moving = problem.stations.velocity
    sizes = [] if moving is None else [np.abs(moving).max(initial=0.0)]
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        if MODELS[rows.kind].velocity:
            rates = problem.observed[..., start : start + rows.count]
            sizes.append(np.abs(rates, where=np.isfinite(rates), out=np.zeros(rates.shape)).max(initial=0.0))
    return float(max(sizes, default=0.0)) or 1.0


def velocity_costs(problem: Problem) -> ScaledCosts:
    """Return the costs of a flat batch of problems of a target of unknown velocity at one epoch.

    Rates are linear in the velocity: its components are the factors, and they multiply components of unit vectors from
    the stations. An orthogonal transform of the rows removes the factors from the last rows, which bound the position
    at every velocity. Rows of a prior on the velocity, if there is one, follow them. The factors are in units of the
    largest rate, so that bounds of rounding do not depend on the unit of length.
    """
    costs, group = costs_of_velocity(problem)
    w, d, speed = costs.w, problem.dimension, largest_rate(problem)
    K = np.where(group >= 0, speed, 1.0) * costs.K
    # The left singular vectors of the columns with factors: only the first `rank` transformed rows contain factors.
    basis, size, _ = np.linalg.svd(K[:, :, group >= 0])
    transform = np.swapaxes(basis, -1, -2)
    K, w = transform @ K, (transform @ w[..., None])[..., 0]
    rank = int((size > _NOTHING * size.max(initial=0.0)).sum(-1).max(initial=0))
    # Exact zeros in place of rounding: `rest_of` finds the rows without factors by their zeros.
    K[:, rank:, group >= 0] = 0.0
    length = np.linalg.norm(K, axis=1, keepdims=True)
    K[:, rank:] = np.where(np.abs(K[:, rank:]) > _NOTHING * length, K[:, rank:], 0.0)
    # Nodes that the rows without factors use come first, because `rest_of` returns these rows over the first nodes.
    order = np.argsort(~K[:, rank:].any((0, 1)), kind="stable")
    priors = [(roots(precision), mean) for name, mean, precision in prior_parts(problem) if name == "velocity"]
    lift = np.zeros((1, K.shape[1], d))
    for root, mean in priors:  # at most one: rows without nodes, in which only `lift` is not zero
        whole = speed * (root if root.ndim == 3 else root[None])
        lift = np.concatenate([np.zeros((len(whole), K.shape[1], d)), whole], axis=1)
        K = np.concatenate([K, np.zeros((len(K), d, K.shape[2]))], axis=1)
        w = np.concatenate([w, np.broadcast_to((root @ mean[..., None])[..., 0], (len(w), d))], axis=1)
    kinds, data = plainly(costs.kinds[order]), costs.data[:, order]
    return ScaledCosts(kinds, data, K[:, :, order], w, costs.level, lift, plainly(group[order]), free=True)


@compiled
def prove_scaled(
    scaled: Scaled, x: Array, others: Array, gaps: Array, eps: float, budget: int, rivals: Array, found: Array
) -> tuple[int, int, float, float, int]:
    """Prove the claim of `optloc.proof.global_search.prove_globally` for a cost with unknown factors.

    Parameters
    ----------
    scaled : Scaled
        The cost.
    x, others, gaps, eps, budget, rivals, found
        As in `prove_globally`; others (P, D) are the known minima.

    Returns
    -------
    verdict, boxes, bound, gap, met
        As in `prove_globally`.
    """
    cost, tables, D, rest = scaled.cost, tables_of(scaled), x.shape[0], rest_of(scaled)
    # `far`: the search is over the atlas. `endless`: nothing limits the velocity, because it has no prior.
    far, endless = stays_finite(scaled), scaled.free and not scaled.lift.any()
    # First axes from the rows with all factors equal to one, then from the rows with the best factors at the fix.
    chart, _ = chart_at(cost, x, tables.near)
    tables.near.at[:] = 0.0
    cost_near(scaled, chart, tables)
    look_at(scaled, tables.sheet, tables.near, tables.look)
    chart, good = chart_at(tables.look, x, tables.near)
    tables.near.at[:] = 0.0
    least, noise = cost_near(scaled, chart, tables), rounding_of_residual(scaled, tables.sheet)
    for g in range(scaled.lift.shape[1]):
        # False for NaN, too: the rows at the fix then do not determine the factor.
        good = good and tables.sheet.best[g] > (-inf if scaled.free else 0.0)
    if not good:
        return STATIONARY, 0, -inf, gaps[0], 0
    middle, radius = station_cube(cost.kinds, cost.data, x)
    atlas = atlas_of(middle, radius, D, (1 + (others.shape[0] if gaps[0] > 0.0 else 0)) if far else 0)
    most, noise = (
        max(COARSEST, eps),
        max(noise, relative_rounding(cost.K) * accuracy_floor_far(cost, atlas) if far else 0.0),
    )
    eps = equal_within(eps, least, noise)
    if not eps <= most:
        return COARSE, 0, -inf, gaps[0], 0
    levels, stack = np.empty(gaps.shape[0]), np.empty((CAPACITY, DEPTH))
    for k in range(gaps.shape[0]):
        levels[k] = least + gaps[k] if gaps[k] > 0.0 else least - eps
    if far:
        space, size = _with_minima(scaled, tables, atlas, chart, x, others, levels, least, eps, stack)
    else:
        low, high = np.zeros(3), np.zeros(3)
        first = first_enclosed(scaled, chart, x, levels, least, low, high)
        if first == levels.shape[0]:
            return OPEN, 0, -inf, gaps[0], 0
        gaps, levels = gaps[first:], levels[first:]
        space, size = _in_box(scaled, tables, atlas, chart, x, others, levels, least, eps, low, high, stack)
    if size == 0:
        return STATIONARY, 0, -inf, gaps[0], 0
    work = ScaledSearchWorkspace(scaled, tables, floor_of(space, cost), tables.box, tables.near, rest)
    outcome, boxes, bound, shown, met = search_scaled(
        work, space, stack, size, levels, eps, True, budget, rivals, found
    )
    if outcome == INFINITE and endless:
        return OPEN, boxes, -inf, gaps[0], 0  # factors without a limit reduce the cost at infinity
    return verdict_of(outcome, boxes, bound, shown, met, gaps, least - eps)


@compiled
def _with_minima(
    scaled: Scaled,
    tables: ScaledTables,
    atlas: Atlas,
    chart: LocalAxes,
    x: Array,
    others: Array,
    levels: Array,
    least: float,
    eps: float,
    stack: Array,
) -> tuple[Space, int]:
    """Return the atlas with known minima, and the number of boxes on the stack: 0 if the fix is no minimum.

    The fix x and `others` (P, D), metres, are the minima. `levels` (in descending order) are the costs to exceed,
    `least` is the cost of the fix, and `eps` the tolerance of equal costs. The pieces to search are pushed on `stack`.
    The list leaves out a known minimum for which `set_scaled_minimum` returns False. The search may then find it again.
    """
    known, at, rho = zero(), np.empty(x.shape[0]), np.sqrt(max(levels[0], least))
    for p in range(atlas.minima.home.shape[0]):
        put(x if p == 0 else others[p - 1], at)
        if set_scaled_minimum(scaled, tables, atlas, chart, known, at, least - 0.5 * eps, 0.5 * eps, rho):
            widen_core(atlas, known, inf)
            known += 1
        elif p == 0:
            return in_atlas(atlas, chart), 0
    own = with_minima(atlas.middle, atlas.radius, x.shape[0], first_minima(atlas.minima, known))
    return in_atlas(own, chart), push_pieces(stack, own)


@compiled
def _in_box(
    scaled: Scaled,
    tables: ScaledTables,
    atlas: Atlas,
    chart: LocalAxes,
    x: Array,
    others: Array,
    levels: Array,
    least: float,
    eps: float,
    low: Array,
    high: Array,
    stack: Array,
) -> tuple[Space, int]:
    """Return search coordinates with known minima, and the number of boxes on the stack: 0 if the fix is no minimum.

    The boxes fill the region between `low` and `high` (3,), search coordinates; other arguments as in `_with_minima`.
    """
    rho, hull = np.sqrt(max(levels[0], least)), np.zeros(3)
    room, known = np.zeros((2, 1 + others.shape[0], 3)), zero()
    space = Space(False, atlas, chart, room[0], room[1])
    for p in range(1 + (others.shape[0] if levels.shape[0] > 1 else 0)):
        for k in range(3):
            room[0, known, k] = 0.0
            for m in range(x.shape[0]):
                room[0, known, k] += chart.back[k, m] * (others[p - 1, m] - x[m]) if p > 0 else 0.0
            hull[k] = max(high[k] - room[0, known, k], room[0, known, k] - low[k], 0.0)
        if set_near_minimum(scaled, tables, space, known, hull, least - 0.5 * eps, 0.5 * eps, rho):
            known += 1
        elif p == 0:
            return space, 0
    space = Space(False, atlas, chart, room[0, :known], room[1, :known])
    return space, push_around(stack, 0, low, high, room[1, 0], 0)


def prove_all_scaled(costs: ScaledCosts, asked: ProofRequest) -> ProofResult:
    """Return the results of the proofs of n fixes of n problems, see `optloc.proof.batch.prove_all`.

    Claims are for all positions; requested regions are ignored. A few proofs begin in plain Python, because most of
    them end before compiled code is loaded.
    """
    n, d = asked.x.shape
    out, asked = empty_answer(n, d), ProofRequest(*map(plainly, asked))
    out.everywhere[:] = True

    def prove(i: int, most: int) -> None:
        """Write the result of proof i, with at most `most` boxes."""
        if np.array_equal(asked.region[i], asked.fallback[i]):  # a second trial after a proof for all positions
            out.verdict[i], out.bound[i], out.gap[i] = BUDGET, -inf, asked.gaps[i, -1]
            return
        others, budget = asked.others[i, : asked.known[i]], min(int(asked.budget[i]), most)
        out.verdict[i], out.boxes[i], out.bound[i], out.gap[i], out.met[i] = prove_scaled(
            costs.one(i), asked.x[i], others, asked.gaps[i], float(asked.eps[i]), budget, out.rivals[i], out.found[i]
        )

    pending = list(range(n))
    if not worth_loading(prove_scaled, n):
        few = max(1, FIRST_BOXES // n)
        with plain(), np.errstate(all="ignore"):
            for i in pending:
                prove(i, few)
        # more boxes may prove a larger gap and find minima
        pending = [i for i in pending if out.boxes[i] >= few and asked.budget[i] > few]
    if pending and enabled() and may_use_code(prove_scaled, n):
        map_on_threads(lambda i: prove(i, int(asked.budget[i])), pending)
    return out


def scaled_lack_code(count: int) -> bool:
    """Return whether proofs ended early because their compiled code is not yet available."""
    return enabled() and not may_use_code(prove_scaled, count)


@compiled
def _evaluate(scaled: Scaled, x: Array, out: Array) -> None:
    """Write the least cost over the factors at positions x (P, D), and the rounding of its residual, to out (2, P)."""
    tables, axes, cost = tables_of(scaled), np.eye(3), scaled.cost
    near = tables.near
    for k in range(x.shape[1], 3):
        axes[k, k] = 0.0
    for p in range(x.shape[0]):
        near.centre[:] = 0.0
        for k in range(x.shape[1]):
            near.centre[k] = x[p, k]
        near.half[:] = 0.0
        bound_nodes(cost.kinds, cost.data, near.centre, axes, axes, near.half, near.line, near.nodes)
        floor = accuracy_floor(cost.kinds, cost.data, cost.weight, cost.w, near.centre, LINES)
        reduce_rows(scaled, floor, near, tables.sheet)
        tables.sheet.most[:] = inf  # only the best factors count
        out[0, p], out[1, p] = tables.sheet.span[HERE], rounding_of_residual(scaled, tables.sheet)


def costs_at_scaled(costs: ScaledCosts, x: Array) -> tuple[Array, Array]:
    """Return costs (n, P) at positions x (n, P, d), m, and the rounding of their residuals, see `costs_at`.

    Each cost is the least cost over the factors.
    """
    out = np.zeros((2, *x.shape[:2]))

    def evaluate() -> None:
        """Write the costs of all problems and their rounding."""
        for i, places in enumerate(x):
            result = np.zeros((2, x.shape[1]))
            _evaluate(costs.one(i), plainly(places), result)
            out[:, i] = result

    if worth_loading(_evaluate, len(x)):
        evaluate()
    else:
        with plain(), np.errstate(all="ignore"):
            evaluate()
    return out[0], out[1]
