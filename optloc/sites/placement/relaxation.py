"""Lower bound of the criterion in a node of the search, by a relaxation in machine code.

A node of the branch and bound has sites that are taken, sites that are left out, and free sites. The
relaxation gives each free site a weight between 0 and 1. At any weights w and with any multipliers, the
tangent of L at w (`optloc.sites.placement.criteria`) is below the criterion of each choice. So the least
value of the tangent over the node is a valid bound, even without convergence. A primal-dual
interior-point method improves the multipliers of places, failures, rules and limits 0 <= w <= 1. Nodes
that can be pruned, and nodes that must be branched, need only a few steps.

Letters: n free sites, R rules, Q items f_q(w) under the maximum (places, scenarios of failure, or both;
see `criteria`). The level t is an upper limit of all items: the method minimises t with f_q <= t. mu is
the barrier parameter: the target of each product of a slack and its multiplier.

S. Boyd and L. Vandenberghe, "Convex Optimization" (2004), sections 7.5 and 11.7.
"""

from __future__ import annotations

import numpy as np

from optloc.engine import cholesky, compiled, put, solve_factored
from optloc.problem import Array
from optloc.sites.placement.criteria import VOLUME, add_square, derive, evaluate

# Items with a multiplier below this share of the largest are omitted: they take the same time as the others but
# hardly change the bound.
_SHARE = 1e-3
# Largest share of the way to the boundary in one step, and factor on the barrier parameter at each step.
_REACH, _FALL = 0.9, 0.2
# Rounding error of a bound, relative to the terms of its difference.
_ROUNDING = 1e-9
# Barrier parameter of the first step, relative to the criterion and per site; relative gap of bound and
# criterion at which the iteration ends; steps after it is certain that the node must be branched.
_BEGIN, _CLOSE, _LATE = 0.15, 1e-4, 2
# Distance of the first level from the largest item, relative to the criterion.
_ABOVE = 0.1


@compiled
def barrier_weights(values: Array, mu: float, weights: Array) -> None:
    """Write the weights (Q,) mu / (t - values), with t such that their sum is 1: the multipliers of a smoothed maximum.

    `values` (Q,) are the items. The function computes t.
    """
    n = values.shape[0]
    top = values[0]
    for i in range(n):
        top = max(top, values[i])
    # The sum decreases with t and is convex, so Newton's method from the left never passes the root.
    t = top + mu
    for _ in range(50):
        total, slope = 0.0, 0.0
        for i in range(n):
            x = mu / (t - values[i])
            total += x
            slope += x * x / mu
        move = (total - 1.0) / slope
        t += move
        if move <= 1e-12 * mu:
            break
    total = 0.0
    for i in range(n):
        weights[i] = mu / (t - values[i])
        total += weights[i]
    for i in range(n):
        weights[i] /= total


@compiled
def share_out(
    values: Array, level: float, mu: float, share: Array, active: Array, slopes: Array, gradient: Array, hessian: Array
) -> tuple[float, Array]:
    """Eliminate the level t from the Newton step: write the gradient (n,), add to the Hessian (n, n).

    The maximum of the items is min t with t >= f_q. The slacks are s_q = t - f_q, the multipliers are
    `share`, and a_q = share_q / s_q. The step of the level is dt = (sum mu / s_q - 1 + sum a_q g_q'dw) / sum
    a_q, with the gradients g_q = slopes[q]. The function returns the constant part of dt and its derivative
    (n,) with respect to the step dw. `values` (Q,) are the items f_q, `level` is t, and items with `active`
    (Q,) 0 are omitted.
    """
    count, n = slopes.shape
    # `pull` is sum a_q g_q, `push` is sum mu / s_q - 1, and `total` is sum a_q
    pull, push, total = np.zeros(n), -1.0, 0.0
    gradient[:] = 0.0
    for q in range(count):
        if active[q] == 0.0:
            continue
        left = level - values[q]
        a = share[q] / left
        total += a
        push += mu / left
        for j in range(n):
            gradient[j] += mu / left * slopes[q, j]
            pull[j] += a * slopes[q, j]
        add_square(slopes[q], a, hessian)
    add_square(pull, -1.0 / total, hessian)
    for j in range(n):
        gradient[j] -= pull[j] * push / total
        pull[j] /= total
    return push / total, pull


@compiled
def cheapest(cost: Array, size: Array, most: float, at: Array) -> tuple[float, float]:
    """Return the minimum of cost'v over 0 <= v <= 1 with size'v <= most, and the rule's multiplier; write v to `at`.

    All arrays are (n,), and no entry of `size` is negative: this is a fractional knapsack problem.
    """
    # Sites with a negative cost are taken in the order of cost per size. The last of them may be taken in part: its
    # rate is the multiplier.
    n = cost.shape[0]
    rate = np.empty(n)
    total = 0.0
    for j in range(n):
        at[j] = 0.0
        rate[j] = 0.0
        if cost[j] < 0.0:
            if size[j] > 0.0:
                rate[j] = cost[j] / size[j]
            else:
                at[j] = 1.0
                total += cost[j]
    left, multiplier = most, 0.0
    for j in np.argsort(rate, kind="mergesort"):
        if rate[j] >= 0.0:
            break
        if left <= 0.0:
            multiplier = -rate[j]
            break
        at[j] = min(1.0, left / size[j])
        total += cost[j] * at[j]
        left -= size[j] * at[j]
        if at[j] < 1.0:
            multiplier = -rate[j]
            break
    return total, multiplier


@compiled
def step(
    w: Array,
    left: Array,
    duals: Array,
    rules: Array,
    limits: Array,
    mu: float,
    gradient: Array,
    hessian: Array,
    move: Array,
    change: Array,
    gain: Array,
) -> float:
    """Write the interior-point step of w, multipliers and slacks; return its feasible length (0 to 1), 0 if it failed.

    Parameters
    ----------
    w : array (n,)
        Weights, inside 0 < w < 1.
    left : array (R,)
        Slacks of the rules, positive.
    duals : array (2 n + R,)
        Multipliers of w >= 0, of w <= 1 and of the rules, positive.
    rules, limits : array (R, n), (R,)
        rules @ w <= limits.
    mu : float
        Target value of the products of slacks and multipliers.
    gradient, hessian : array (n,), (n, n)
        Derivatives of the criterion; the Hessian is overwritten.
    move, change, gain : array (n,), (2 n + R,), (R,)
        Output: the changes of w, multipliers and slacks.
    """
    # Newton equations of the barrier problem; multipliers and slacks are eliminated, so only `move` is unknown.
    n, count = w.shape[0], rules.shape[0]
    for j in range(n):
        move[j] = mu / w[j] - mu / (1.0 - w[j]) - gradient[j]
        hessian[j, j] += duals[j] / w[j] + duals[n + j] / (1.0 - w[j])
    for i in range(count):
        gain[i] = limits[i] - left[i]
        for j in range(n):
            gain[i] -= rules[i, j] * w[j]
        pull = duals[2 * n + i] / left[i]
        for j in range(n):
            move[j] -= rules[i, j] * (mu / left[i] - pull * gain[i])
        add_square(rules[i], pull, hessian)
    if not cholesky(hessian, len(move), 0.0):
        return 0.0
    solve_factored(hessian, move)
    # Multipliers and slacks follow from the move. `reach` keeps the weights and slacks positive.
    reach = 1.0
    for i in range(count):
        for j in range(n):
            gain[i] -= rules[i, j] * move[j]
        change[2 * n + i] = mu / left[i] - duals[2 * n + i] * (1.0 + gain[i] / left[i])
        if gain[i] < 0.0:
            reach = min(reach, -_REACH * left[i] / gain[i])
    for j in range(n):
        change[j] = mu / w[j] - duals[j] * (1.0 + move[j] / w[j])
        change[n + j] = mu / (1.0 - w[j]) - duals[n + j] * (1.0 - move[j] / (1.0 - w[j]))
        if move[j] < 0.0:
            reach = min(reach, -_REACH * w[j] / move[j])
        elif move[j] > 0.0:
            reach = min(reach, _REACH * (1.0 - w[j]) / move[j])
    return reach


@compiled
def advance(duals: Array, change: Array) -> None:
    """Add `change` to the multipliers `duals` (same shape), shortened so that all of them stay positive."""
    reach = 1.0
    for i in range(duals.shape[0]):
        if change[i] < 0.0:
            reach = min(reach, -_REACH * duals[i] / change[i])
    for i in range(duals.shape[0]):
        duals[i] += reach * change[i]


@compiled
def bound_at(
    x: Array, low: float, gradient: Array, duals: Array, rules: Array, limits: Array, reduced: Array, at: Array
) -> float:
    """Return the least value of the tangent at x over the node; write the reduced costs (n,) of the sites to `reduced`.

    The value is a valid lower bound of the node. `low` is the value of the tangent at the weights x (n,), and
    `gradient` (n,) is its slope. `duals`, `rules` and `limits` are as in `step`. `at` (n,) is the minimiser
    of `cheapest`.
    """
    # `held` is the part of the tangent that does not depend on the weights
    n, held = x.shape[0], low
    for j in range(n):
        reduced[j] = gradient[j]
        held -= gradient[j] * x[j]
    for i in range(1, rules.shape[0]):
        held -= duals[2 * n + i] * limits[i]
        for j in range(n):
            reduced[j] += duals[2 * n + i] * rules[i, j]
    least, price = cheapest(reduced, rules[0], limits[0], at)
    for j in range(n):
        reduced[j] += price * rules[0, j]
    return held + least - _ROUNDING * (abs(held) + abs(least) + abs(low))


@compiled
def relax(
    rows: Array,
    bases: Array,
    weight: Array,
    d: int,
    off: Array,
    scale: Array,
    rules: Array,
    limits: Array,
    kind: int,
    worst: int,
    w: Array,
    enough: float,
    most: int,
    cost: Array,
) -> tuple[float, float, int]:
    """Return bound, criterion and number of steps of a node; write the weights and reduced costs at the bound.

    The bound is L - gradient'w - limits'nu + min over 0 <= v <= 1 with rules[0]'v <= limits[0] of (gradient +
    rules'nu)'v. It is valid for any w and any multipliers nu >= 0 of the other rules. The returned criterion
    is the least one of the weights that meet the rules; infinite if none did.

    Parameters
    ----------
    rows, bases, weight, d, off, scale, kind, worst
        See `evaluate`.
    rules, limits : array (R, n), (R,)
        rules @ w <= limits; the first rule has no negative entry.
    w : array (n,)
        Start, inside 0 < w < 1; overwritten with the weights at the best bound.
    enough : float
        Value to beat. When the bound reaches it, the iteration ends. When the criterion is below it, the node
        must be branched, and only a few steps follow.
    most : int
        Largest number of steps.
    cost : array (n,)
        Output: rise of the bound if a site is taken (positive), or left out (negative).

    Notes
    -----
    `turns` are the weights of the items, and `best` is the least criterion of weights that meet the rules. `late`
    counts the steps after `best` fell below `enough`, and `taken` counts all steps.
    """
    places, m, n = rows.shape[0], rows.shape[2], w.shape[0]
    scenarios, count = bases.shape[0], rules.shape[0]
    items = scenarios * places if worst else scenarios
    state = (
        np.empty((scenarios, places, m, m)),
        np.empty((scenarios, places, d, d)),
        np.empty((scenarios, places, d, d)),
        np.empty((scenarios, places, d)),
    )
    values, share, slopes = np.empty((2, items)), np.ones(items), np.empty((items, n))
    gradient, hessian, reduced, at = np.empty(n), np.empty((n, n)), np.empty(n), np.empty(n)
    left, duals, x, turns = np.empty(count), np.empty(2 * n + count), w.copy(), np.zeros(items)
    bound, best, mu, level, late, taken = -np.inf, np.inf, -1.0, 0.0, 0, 0
    while taken < most:
        taken += 1
        value = evaluate(rows, bases, weight, d, x, off, scale, kind, worst, state, values)
        # `size` is the scale of the criterion. A log determinant can be 0, so its scale is d.
        if not np.isfinite(value):
            break
        size = float(d) if kind == VOLUME else abs(value)
        if mu < 0.0:
            mu = _BEGIN * size / n
            begin(x, left, duals, rules, limits, mu)
            barrier_weights(values[0], _ABOVE * size, share)
            level = values[0].max() + _ABOVE * size
        # The level must stay above all items: their slacks are positive.
        level = max(level, values[0].max() + 0.5 * mu)
        low = weigh(values, level, mu, share, turns)
        derive(rows, bases, weight, d, x, off, scale, kind, worst, state, turns, slopes, hessian)
        mix(turns, slopes, gradient)
        found = bound_at(x, low, gradient, duals, rules, limits, reduced, at)
        if found > bound:
            bound = found
            put(x, w)
            put(reduced, cost)
        best = min(best, value) if meets(x, rules, limits) else best
        late += 1 if best < enough else 0
        if bound >= enough or best - bound <= _CLOSE * size or late > _LATE:
            break
        mu = _FALL * product(x, left, duals, level, values[0], share)
        reach, level = go(x, left, duals, rules, limits, mu, level, values[0], share, turns, slopes, gradient, hessian)
        if reach <= 0.0:
            break
    return bound, best, taken


@compiled
def mix(turns: Array, slopes: Array, gradient: Array) -> None:
    """Write the gradient (n,) of the weighted sum of the items with gradients (Q, n) and weights `turns` (Q,)."""
    for j in range(gradient.shape[0]):
        gradient[j] = 0.0
        for q in range(turns.shape[0]):
            gradient[j] += turns[q] * slopes[q, j]


@compiled
def product(x: Array, left: Array, duals: Array, level: float, values: Array, share: Array) -> float:
    """Return the mean product of slacks and multipliers of sites, rules and (if there are several) items.

    The next barrier parameter is a share of this mean. The arguments are as in `go`: weights `x`, slacks `left`,
    multipliers `duals`, `level`, items `values` and multipliers `share` of the items.
    """
    n, count, items = x.shape[0], left.shape[0], share.shape[0]
    total, terms = 0.0, 2 * n + count
    for j in range(n):
        total += duals[j] * x[j] + duals[n + j] * (1.0 - x[j])
    for i in range(count):
        total += duals[2 * n + i] * left[i]
    if items > 1:
        terms += items
        for q in range(items):
            total += share[q] * (level - values[q])
    return float(total / terms)


@compiled
def go(
    x: Array,
    left: Array,
    duals: Array,
    rules: Array,
    limits: Array,
    mu: float,
    level: float,
    values: Array,
    share: Array,
    active: Array,
    slopes: Array,
    gradient: Array,
    hessian: Array,
) -> tuple[float, float]:
    """Take one interior-point step in all unknowns; return its length (0 to 1), 0 if it failed, and the new item level.

    Parameters
    ----------
    x, left, duals : array (n,), (R,), (2 n + R,)
        Weights, slacks of the rules, and multipliers of 0 <= x <= 1 and of the rules. All are updated.
    rules, limits : array (R, n), (R,)
        rules @ x <= limits.
    mu, level : float
        Barrier parameter and level t of the items.
    values : array (Q,)
        Items at x.
    share : array (Q,)
        Multipliers of the items; updated.
    active : array (Q,)
        Items with 0 are omitted from the elimination of the level.
    slopes : array (Q, n)
        Gradients of the items.
    gradient, hessian : array (n,), (n, n)
        Derivatives of the weighted sum of the items; overwritten.
    """
    n, count, items = x.shape[0], left.shape[0], share.shape[0]
    move, change, gain = np.empty(n), np.empty(2 * n + count), np.empty(count)
    # `turn` are the changes of the multipliers of the items. `rise` is the change of the level: a constant part, plus
    # `pull` times the move of the weights. `grow` is the change of the slack of an item.
    turn, pull, rise = np.empty(items), np.zeros(n), 0.0
    if items > 1:
        rise, pull = share_out(values, level, mu, share, active, slopes, gradient, hessian)
    reach = step(x, left, duals, rules, limits, mu, gradient, hessian, move, change, gain)
    if reach <= 0.0:
        return 0.0, level
    if items > 1:
        for j in range(n):
            rise += pull[j] * move[j]
        for q in range(items):
            away, grow = level - values[q], rise
            for j in range(n):
                grow -= slopes[q, j] * move[j]
            turn[q] = mu / away - share[q] * (1.0 + grow / away)
            if grow < 0.0:
                reach = min(reach, -_REACH * away / grow)
        level += reach * rise
        advance(share, turn)
    for j in range(n):
        x[j] += reach * move[j]
    for i in range(count):
        left[i] += reach * gain[i]
    advance(duals, change)
    return reach, level


@compiled
def weigh(values: Array, level: float, mu: float, share: Array, turns: Array) -> float:
    """Write the shares (Q,) of the items to `turns`, sum 1; return the value of their tangent.

    Items with small multipliers get the share 0, which saves time: their derivatives are then not computed.
    `values` (2, Q) are the smoothed items and their tangents (see `evaluate`). `level` and `mu` are as in
    `go`. `share` (Q,) are the multipliers of the items. A single item has the share 1.
    """
    items = share.shape[0]
    if items == 1:
        share[0] = turns[0] = 1.0
        return float(values[1, 0])
    most, total, low = 0.0, 0.0, 0.0
    for q in range(items):
        most = max(most, share[q])
    for q in range(items):
        counts = share[q] > _SHARE * most or mu / (level - values[0, q]) > _SHARE * most
        turns[q] = share[q] if counts else 0.0
        total += turns[q]
    for q in range(items):
        turns[q] /= total
        low += turns[q] * values[1, q]
    return low


@compiled
def meets(w: Array, rules: Array, limits: Array) -> bool:
    """Return whether the weights (n,) meet all rules, rules @ w <= limits, up to rounding."""
    for i in range(rules.shape[0]):
        used = 0.0
        for j in range(w.shape[0]):
            used += rules[i, j] * w[j]
        if used > limits[i] + 1e-6 * max(1.0, abs(limits[i])):
            return False
    return True


@compiled
def begin(w: Array, left: Array, duals: Array, rules: Array, limits: Array, mu: float) -> None:
    """Write the first slacks `left` (R,) and multipliers `duals` (2 n + R,) at w: each of their products is mu.

    A slack is at least 0.1, also if the weights violate the rule: the steps then remove the violation.
    """
    n, count = w.shape[0], rules.shape[0]
    for j in range(n):
        duals[j] = mu / w[j]
        duals[n + j] = mu / (1.0 - w[j])
    for i in range(count):
        left[i] = limits[i]
        for j in range(n):
            left[i] -= rules[i, j] * w[j]
        left[i] = max(left[i], 0.1)
        duals[2 * n + i] = mu / left[i]
