"""The proof of a fix of a cost with an unknown factor: no position costs less, and no other minimum is within a gap."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from optloc.base.threads import mapped
from optloc.base.types import Array
from optloc.compute.jit import compiled, enabled, plain, put, usable, worth_loading, zero
from optloc.linear.normal import prior_parts
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.proof.atlas import atlas_of, first_minima, with_minima
from optloc.proof.batch import FIRST_BOXES, Answered, Asked, empty_answer, plainly
from optloc.proof.box import bound_nodes, cube, digits
from optloc.proof.convex_boxes import accuracy_floor_far, widen_core
from optloc.proof.everywhere import ANOTHER, CHEAPER, CLEAR, INFINITE, UNBOUNDED
from optloc.proof.near import BETTER, BUDGET, COARSE, OTHER, STATIONARY, UNIQUE, VALUE
from optloc.proof.position_costs import position_costs
from optloc.proof.scaled.reduction import FACTOR, HERE, MOST, Scaled, blur_of, look_at, reduce_rows
from optloc.proof.scaled.scaled_search import cost_near, search_scaled, set_scaled_minimum, tables_of
from optloc.proof.search_space import COARSEST, LINES, accuracy_floor, chart_at, cost_of, equal_within


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
    atlas = atlas_of(middle, radius, D, 1 + (others.shape[0] if gaps[0] > 0.0 else 0))
    most, noise = max(COARSEST, eps), max(noise, digits(cost.K) * accuracy_floor_far(cost, atlas))
    eps = equal_within(eps, least, noise)
    if not eps <= most:
        return COARSE, 0, -inf, gaps[0], 0
    levels = np.empty(gaps.shape[0])
    for k in range(gaps.shape[0]):
        levels[k] = least + gaps[k] if gaps[k] > 0.0 else least - eps
    known, at, rho = zero(), np.empty(D), np.sqrt(max(levels[0], least))
    for p in range(atlas.minima.home.shape[0]):
        put(x if p == 0 else others[p - 1], at)
        if set_scaled_minimum(scaled, tables, atlas, known, at, least - 0.5 * eps, 0.5 * eps, rho):
            widen_core(atlas, known, inf)
            known += 1
        elif p == 0:
            return STATIONARY, 0, -inf, gaps[0], 0
    atlas = with_minima(middle, radius, D, first_minima(atlas.minima, known))
    outcome, boxes, bound, shown, met = search_scaled(scaled, tables, atlas, chart, levels, eps, budget, rivals, found)
    if outcome == CLEAR:
        return UNIQUE if gaps[shown] > 0.0 else VALUE, boxes, bound, gaps[shown], met
    if outcome == CHEAPER:
        return BETTER, boxes, bound, gaps[0], 0
    if outcome == ANOTHER:
        return OTHER, boxes, bound, gaps[0], 0
    return UNBOUNDED if outcome == INFINITE else BUDGET, boxes, min(bound, least - eps), gaps[-1], 0


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
