"""Steps of the branch and bound in machine code: propagation of rules, score of whole sets, bound of a node.

A node is a family of sets: its state (n,) marks each site as taken (IN), left out (OUT) or undecided
(FREE). A set is 1 for each site that is taken, otherwise 0. Rules are linear: rules @ set <= limits.

Letters: P places, n sites, m unknowns of the target, d of them coordinates of the position. A site has r
rows (measurements), B is the number of sets, and R is the number of rules.
"""

from __future__ import annotations

import numpy as np

from optloc.engine import compiled, put_rows
from optloc.problem import Array
from optloc.sites.placement.criteria import gather, invert, measure
from optloc.sites.placement.relaxation import relax

FREE, OUT, IN = -1, 0, 1
"""States of a site: undecided, left out, taken."""

# Relative rounding error of sums of costs: with it, a set that uses the budget exactly is allowed.
_EXACT = 1e-9
# Distance of the first weights of a node from the limits of 0 <= w <= 1.
_INSIDE = 0.02


@compiled
def propagate(rules: Array, limits: Array, state: Array) -> bool:
    """Fix in `state` (n,) all sites that the rules decide; return False if the rules then allow no set.

    If all free sites fit together, the function takes them all: another site never makes a criterion worse.
    """
    count, n = rules.shape
    changed = True
    while changed:
        changed, all_fit = False, True
        for i in range(count):
            least, most = 0.0, 0.0
            for j in range(n):
                if state[j] == IN:
                    least += rules[i, j]
                    most += rules[i, j]
                elif state[j] == FREE:
                    least += min(0.0, rules[i, j])
                    most += rules[i, j]
            limit = limits[i] + _EXACT * max(1.0, abs(limits[i]))
            if least > limit:
                return False
            all_fit = all_fit and most <= limit
            for j in range(n):
                if state[j] == FREE and least + abs(rules[i, j]) > limit:
                    state[j] = OUT if rules[i, j] > 0.0 else IN
                    changed = True
        if all_fit and not changed:
            for j in range(n):
                if state[j] == FREE:
                    state[j] = IN
    return True


@compiled
def score(rows: Array, prior: Array, weight: Array, d: int, kind: int, worst: int, fail: int, chosen: Array) -> Array:
    """Return the criterion (B,) of sets of sites (B, n): m^2, or log det for VOLUME; infinite for singular information.

    Parameters
    ----------
    rows : array (P, r, m, n)
        Whitened rows of each site at each place.
    prior : array (P, m, m)
        Information without any site.
    weight : array (P,)
        Weights of the places, sum 1.
    d, kind, worst
        See `optloc.sites.placement.criteria.evaluate`.
    fail : int
        1 for the value after the worst loss of one site, otherwise 0.
    chosen : int array (B, n)
        1 for sites that are taken.
    """
    places, r, m, n = rows.shape
    out = np.empty(chosen.shape[0])
    matrix, lower = np.empty((m, m)), np.empty((m, m))
    inverse, turn, basis, shares = np.empty((m, m)), np.empty((d, d)), np.empty((d, d)), np.empty(d)
    members = np.empty(n, dtype=np.int64)
    for b in range(chosen.shape[0]):
        size = 0
        for j in range(n):
            if chosen[b, j] == IN:
                members[size] = j
                size += 1
        out[b] = -np.inf
        for lost in range(size if fail and size else 1):
            total = -np.inf if worst else 0.0
            for p in range(places):
                for i in range(m):
                    for k in range(m):
                        matrix[i, k] = prior[p, i, k]
                for one in range(size):
                    if fail and one == lost:
                        continue
                    for q in range(r):
                        for i in range(m):
                            x = rows[p, q, i, members[one]]
                            for k in range(m):
                                matrix[i, k] += x * rows[p, q, k, members[one]]
                ok = invert(matrix, inverse, lower)
                if not np.isfinite(ok):
                    total = np.inf
                    break
                top, _, _ = measure(kind, inverse[:d, :d].copy(), turn, basis, shares)
                total = max(total, top) if worst else total + weight[p] * top
            out[b] = max(out[b], total)
    return out


@compiled
def number_left(rule: Array, limit: float, state: Array) -> int:
    """Return the largest number of free sites that a rule still allows: the cheapest sites are counted first.

    `rule` (n,) has no negative entry. `limit` is its limit, and `state` (n,) contains FREE, OUT or IN.
    """
    left, sizes, count = limit, np.empty(rule.shape[0]), 0
    for j in range(rule.shape[0]):
        if state[j] == IN:
            left -= rule[j]
        elif state[j] == FREE:
            sizes[count] = rule[j]
            count += 1
    number = 0
    for size in np.sort(sizes[:count]):
        left -= size
        if left < -_EXACT * max(1.0, abs(limit)):
            break
        number += 1
    return number


@compiled
def expand(
    rows: Array,
    prior: Array,
    weight: Array,
    d: int,
    rules: Array,
    limits: Array,
    kind: int,
    worst: int,
    fail: int,
    state: Array,
    w: Array,
    enough: float,
    most: int,
    cost: Array,
) -> tuple[float, float, int]:
    """Return bound, criterion and number of steps of the relaxation of a node with at least one free site.

    The function moves the information of the taken sites into the prior, and calls `relax` with the free sites.

    With `fail`, the failed site is unknown in advance. The rules still allow at most c free sites. By
    Jensen's inequality, the mean of the criterion over their failures is at least the criterion at the
    weights (1 - 1 / c) v, where v are the weights of the free sites. Sites that are already taken fail one by
    one: each failure is one scenario.

    Parameters
    ----------
    rows, prior, weight, d, kind, worst, fail
        See `score`.
    rules, limits : array (R, n), (R,)
        rules @ w <= limits; the first rule has no negative entry.
    state : int array (n,)
        FREE, OUT or IN.
    w, cost : array (n,)
        Start and output as in `relax`, but for all sites: w is 1 for taken sites; the cost of fixed sites is 0.
    enough, most
        See `relax`.

    Notes
    -----
    `inner` are the rows of the free sites; `lines` and `left` are their rules and the limits that remain. Scenario 0
    has all taken sites. In each other scenario, the weight -1 subtracts one taken site again.
    """
    places, r, m, n = rows.shape
    free, taken = np.flatnonzero(state == FREE), np.flatnonzero(state == IN)
    count, sure = len(free), len(taken)
    inner = np.empty((places, r, m, count))
    for p in range(places):
        for q in range(r):
            for a in range(m):
                for j in range(count):
                    inner[p, q, a, j] = rows[p, q, a, free[j]]
    scenarios = sure + 1 if fail else 1
    bases, off, scale = np.empty((scenarios, places, m, m)), np.full(scenarios, -1), np.ones(scenarios)
    ones, scaled = np.ones(1), np.empty((r, m, 1))
    for p in range(places):
        total = prior[p].copy()
        for own in taken:
            gather(rows[p, :, :, own : own + 1].copy(), total, ones, -1, 1.0, scaled, bases[0, p])
            put_rows(bases[0, p], total)
        bases[0, p] = total
        for s in range(1, scenarios):
            gather(rows[p, :, :, taken[s - 1] : taken[s - 1] + 1].copy(), total, -ones, -1, 1.0, scaled, bases[s, p])
    if fail:
        scale[0] = 1.0 - 1.0 / max(1, number_left(rules[0], limits[0], state))
    lines, left = np.empty((rules.shape[0], count)), limits.copy()
    x, rise, room = np.empty(count), np.empty(count), 0.0
    for i in range(rules.shape[0]):
        for own in taken:
            left[i] -= rules[i, own]
        for j in range(count):
            lines[i, j] = rules[i, free[j]]
    for j in range(count):
        x[j] = min(1.0 - _INSIDE, max(_INSIDE, w[free[j]]))
        room += x[j] * lines[0, j]
    if room > left[0]:  # shrink the weights so that they meet the first rule; 1e-3 keeps them inside 0 < w
        for j in range(count):
            x[j] *= max(left[0], 0.0) / room
            x[j] = max(1e-3, x[j])
    bound, value, steps = relax(inner, bases, weight, d, off, scale, lines, left, kind, worst, x, enough, most, rise)
    cost[:] = 0.0
    for j in range(n):
        w[j] = 1.0 if state[j] == IN else 0.0
    for j in range(count):
        w[free[j]] = x[j]
        cost[free[j]] = rise[j]
    return bound, value, steps


@compiled
def settle(bound: float, cost: Array, enough: float, state: Array) -> int:
    """Fix in `state` the free sites whose other value raises the bound to `enough`; return their number.

    `bound` is the bound of the node. `cost` (n,) is its rise if a site is taken (positive) or left out
    (negative).
    """
    fixed = 0
    for j in range(state.shape[0]):
        if state[j] == FREE and bound + abs(cost[j]) >= enough:
            state[j] = OUT if cost[j] > 0.0 else IN
            fixed += 1
    return fixed
