"""The proof of a fix of a cost with an unknown factor: no position costs less, and no other minimum is within a gap."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from optloc.base.threads import mapped
from optloc.base.types import Array
from optloc.compute.jit import compiled, enabled, plain, put, usable, worth_loading, zero
from optloc.compute.systems import invert
from optloc.linear.normal import prior_parts
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.proof.atlas import Atlas, atlas_of, first_minima, with_minima
from optloc.proof.batch import FIRST_BOXES, Answered, Asked, empty_answer, plainly
from optloc.proof.box import DEPTH, bound_nodes, cube, digits, push_around, reaches_infinity
from optloc.proof.convex_boxes import accuracy_floor_far, widen_core
from optloc.proof.enclosure import SLACK, around_node
from optloc.proof.everywhere import ANOTHER, CHEAPER, CLEAR, INFINITE, UNBOUNDED, push_pieces
from optloc.proof.near import BETTER, BUDGET, COARSE, OPEN, OTHER, STATIONARY, UNIQUE, VALUE
from optloc.proof.nodes.node import RANGE
from optloc.proof.position_costs import position_costs
from optloc.proof.scaled.reduction import FACTOR, HERE, MOST, Scaled, blur_of, look_at, reduce_rows
from optloc.proof.scaled.scaled_search import (
    CAPACITY,
    Tables,
    cost_near,
    in_atlas,
    search_scaled,
    set_near_minimum,
    set_scaled_minimum,
    tables_of,
)
from optloc.proof.search_space import COARSEST, LINES, Chart, accuracy_floor, chart_at, cost_of, equal_within
from optloc.proof.space import Space


class ScaledCosts(NamedTuple):
    """The costs of a flat batch of N problems over the position, with one unknown factor of all rows.

    Parameters
    ----------
    kinds, data, K, w, level
        As of `optloc.proof.position_costs.PositionCosts`; a prior on the factor is the last row.
    lift : array (q,)
        Constant part of the column of the factor, see `optloc.proof.scaled.reduction.Scaled`.
    """

    kinds: Array
    data: Array
    K: Array
    w: Array
    level: Array
    lift: Array

    @property
    def dense(self) -> float:
        """Return with how many nodes the time of a box grows as their square."""
        return float(len(self.kinds))

    def take(self, items: Array | slice) -> ScaledCosts:
        """Return the costs of some of the problems."""

        def own(array: Array) -> Array:
            return array if len(array) == 1 else array[items]

        return self._replace(data=own(self.data), K=own(self.K), w=self.w[items], level=self.level[items])

    def one(self, i: int) -> Scaled:
        """Return the cost of one problem."""
        data, K = self.data[i if len(self.data) > 1 else 0], self.K[i if len(self.K) > 1 else 0]
        return Scaled(cost_of(self.kinds, plainly(data), plainly(K), plainly(self.w[i])), self.lift)


def scaled_costs(problem: Problem) -> ScaledCosts:
    """Return the costs of a flat batch of problems whose rows have one unknown factor, see `optloc.proof.scope`."""
    costs = position_costs(problem)
    name = next(bias.name for bias in problem.biases if form_of(bias).enters == "scales")
    prior = [(mean, precision) for own, mean, precision in prior_parts(problem) if own == name]
    root, mean = (float(np.sqrt(prior[0][1].item())), float(np.ravel(prior[0][0])[0])) if prior else (0.0, 0.0)
    K = np.concatenate([costs.K, np.zeros((len(costs.K), 1, costs.K.shape[2]))], axis=1)
    w = np.concatenate([costs.w, np.full((len(costs.w), 1), root * (1.0 + mean))], axis=1)
    lift = np.zeros(K.shape[1])
    lift[-1] = root
    return ScaledCosts(plainly(costs.kinds), costs.data, K, w, costs.level, lift)


@compiled
def prove_scaled(
    scaled: Scaled, x: Array, others: Array, gaps: Array, eps: float, budget: int, rivals: Array, found: Array
) -> tuple[int, int, float, float, int]:
    """Prove of a cost with an unknown factor what `optloc.proof.everywhere.prove_everywhere` proves of a cost.

    Parameters
    ----------
    scaled : Scaled
        The cost; without its factor it stays finite at infinity (`optloc.proof.box.reaches_infinity`).
    x, others, gaps, eps, budget, rivals, found
        As there; others (P, D) are the known minima.

    Returns
    -------
    verdict, boxes, bound, gap, met
        As there.
    """
    cost, tables, D = scaled.cost, tables_of(scaled), x.shape[0]
    far = reaches_infinity(cost.kinds, cost.K)
    chart, _ = chart_at(cost, x, tables.near)
    tables.near.at[:] = 0.0
    cost_near(scaled, chart, tables)
    look_at(scaled, tables.sheet, tables.near, tables.look)
    chart, good = chart_at(tables.look, x, tables.near)
    tables.near.at[:] = 0.0
    least, noise = cost_near(scaled, chart, tables), blur_of(scaled, tables.sheet)
    if not (good and tables.sheet.span[FACTOR] > 0.0):
        return STATIONARY, 0, -inf, gaps[0], 0
    middle, radius = cube(cost.kinds, cost.data, x)
    atlas = atlas_of(middle, radius, D, (1 + (others.shape[0] if gaps[0] > 0.0 else 0)) if far else 0)
    most, noise = max(COARSEST, eps), max(noise, digits(cost.K) * accuracy_floor_far(cost, atlas) if far else 0.0)
    eps = equal_within(eps, least, noise)
    if not eps <= most:
        return COARSE, 0, -inf, gaps[0], 0
    levels, stack = np.empty(gaps.shape[0]), np.empty((CAPACITY, DEPTH))
    for k in range(gaps.shape[0]):
        levels[k] = least + gaps[k] if gaps[k] > 0.0 else least - eps
    if far:
        space, size = _with_minima(scaled, tables, atlas, chart, x, others, levels, least, eps, stack)
    else:
        first = _first_enclosed(scaled, levels, least)
        if first == levels.shape[0]:
            return OPEN, 0, -inf, gaps[0], 0
        gaps, levels = gaps[first:], levels[first:]
        space, size = _within_balls(scaled, tables, atlas, chart, x, others, levels, least, eps, stack)
    if size == 0:
        return STATIONARY, 0, -inf, gaps[0], 0
    outcome, boxes, bound, shown, met = search_scaled(
        scaled, tables, space, stack, size, levels, eps, budget, rivals, found
    )
    if outcome == CLEAR:
        return UNIQUE if gaps[shown] > 0.0 else VALUE, boxes, bound, gaps[shown], met
    if outcome == CHEAPER:
        return BETTER, boxes, bound, gaps[0], 0
    if outcome == ANOTHER:
        return OTHER, boxes, bound, gaps[0], 0
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least - eps), gaps[-1], 0


@compiled
def _with_minima(
    scaled: Scaled,
    tables: Tables,
    atlas: Atlas,
    chart: Chart,
    x: Array,
    others: Array,
    levels: Array,
    least: float,
    eps: float,
    stack: Array,
) -> tuple[Space, int]:
    """Return the atlas with known minima, and the number of boxes pushed: 0 where the fix is no minimum."""
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


# Ranges without an emission time: a prior keeps the factor from zero, and balls around the stations enclose the cheap
# positions.

# Share of the diagonal that a pivot must exceed, as in `optloc.proof.enclosure`.
_PIVOT = 1e-9
# Least factor of use: the balls of a smaller one are ten times larger.
_SMALLEST = 0.1


@compiled
def _least_factor(scaled: Scaled, level: float) -> float:
    """Return the least factor that the prior allows at a cost, negative without a prior."""
    last = scaled.lift.shape[0] - 1
    lift = scaled.lift[last]
    return float((scaled.cost.w[last] - np.sqrt(level)) / lift * (1.0 - 1e-12)) if lift > 0.0 else -1.0


@compiled
def _first_enclosed(scaled: Scaled, levels: Array, least: float) -> int:
    """Return the first level whose positions are enclosed, or the number of levels."""
    for k in range(levels.shape[0]):
        if _least_factor(scaled, max(levels[k], least)) >= _SMALLEST:
            return k
    return int(levels.shape[0])


@compiled
def _within_balls(
    scaled: Scaled,
    tables: Tables,
    atlas: Atlas,
    chart: Chart,
    x: Array,
    others: Array,
    levels: Array,
    least: float,
    eps: float,
    stack: Array,
) -> tuple[Space, int]:
    """Return search coordinates with known minima, and the number of boxes pushed: 0 without balls or a minimum.

    A range times the factor is within ``rho sqrt(R_jj)`` of its least-squares value, with R the inverse of K'K.
    """
    cost, level = scaled.cost, max(levels[0], least)
    rho, low, high, J = np.sqrt(level), np.full(3, -inf), np.full(3, inf), cost.kinds.shape[0]
    R, none, hull = cost.A.copy(), np.empty((0, 3)), np.zeros(3)
    for k in range(x.shape[0], 3):
        low[k] = high[k] = 0.0
    space = Space(False, atlas, chart, none, none)
    if not invert(R, J, _PIVOT):
        return space, 0
    for j in range(J):
        most = rho * np.sqrt(R[j, j]) * (1.0 + SLACK)
        for m in range(J):
            for i in range(cost.w.shape[0]):
                most += R[j, m] * cost.K[i, m] * cost.w[i]
        most = most * (1.0 + SLACK) / _least_factor(scaled, level)
        around_node(RANGE, cost.data[j], 0.0, most, chart.origin, chart.back, low, high)
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


def prove_all_scaled(costs: ScaledCosts, asked: Asked) -> Answered:
    """Return the outcome of the proofs of n fixes of n problems, see `optloc.proof.batch.prove_all`.

    Claims are about all positions, whatever region is asked for. Few proofs begin in plain Python, because most of
    them end before machine code is loaded.
    """
    n, d = asked.x.shape
    out, asked = empty_answer(n, d), Asked(*map(plainly, asked))
    out.everywhere[:] = True

    def prove(i: int, most: int) -> None:
        if np.array_equal(asked.region[i], asked.fallback[i]):  # what is tried after all positions
            out.verdict[i], out.bound[i], out.gap[i] = BUDGET, -inf, asked.gaps[i, -1]
            return
        others, budget = asked.others[i, : asked.known[i]], min(int(asked.budget[i]), most)
        out.verdict[i], out.boxes[i], out.bound[i], out.gap[i], out.met[i] = prove_scaled(
            costs.one(i), asked.x[i], others, asked.gaps[i], float(asked.eps[i]), budget, out.rivals[i], out.found[i]
        )

    left = list(range(n))
    if not worth_loading(prove_scaled, n):
        few = max(1, FIRST_BOXES // n)
        with plain(), np.errstate(all="ignore"):
            for i in left:
                prove(i, few)
        # with more boxes a larger gap may be proven than with few, and minima may be met
        left = [i for i in left if out.boxes[i] >= few and asked.budget[i] > few]
    if left and enabled() and usable(prove_scaled, n):
        mapped(lambda i: prove(i, int(asked.budget[i])), left)
    return out


def scaled_lack_code(count: int) -> bool:
    """Return whether proofs ended early because there is no machine code of them yet."""
    return enabled() and not usable(prove_scaled, count)


@compiled
def _evaluate(scaled: Scaled, x: Array, out: Array) -> None:
    """Write the least cost over the factor at positions x (P, D), and the rounding of its residual, to out (2, P)."""
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
        tables.sheet.span[MOST] = inf  # the best factor alone counts
        out[0, p], out[1, p] = tables.sheet.span[HERE], blur_of(scaled, tables.sheet)


def costs_at_scaled(costs: ScaledCosts, x: Array) -> tuple[Array, Array]:
    """Return costs (n, P) at positions x (n, P, d) and the rounding of their residuals, see `costs_at`."""
    out = np.zeros((2, *x.shape[:2]))

    def evaluate() -> None:
        for i, places in enumerate(x):
            own = np.zeros((2, x.shape[1]))
            _evaluate(costs.one(i), plainly(places), own)
            out[:, i] = own

    if worth_loading(_evaluate, len(x)):
        evaluate()
    else:
        with plain(), np.errstate(all="ignore"):
            evaluate()
    return out[0], out[1]
