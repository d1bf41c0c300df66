"""Enumeration of all sets of a small node, in machine code: faster than a bound for each child.

Sites are added depth first; each addition updates the inverse information. All candidates for the last
site are compared at once. If one site may fail, the last two sites are compared: the set must be good
enough without either of them, and few sites pass this test. A comparison by updates has a tolerance of a
millionth for rounding errors. Values within the tolerance are recomputed from the sums.

Letters: P places, n sites with r rows each, m unknowns, d of them coordinates of the position, R rules, q
sites that can be added. g (m,) is a whitened row, M (m, m) the information (prior and rows of a set), C the
selection of the position. The set under construction is the first `size` entries of an array `members` of
site numbers.

Arguments of all functions: `asked` contains rows, rules and criterion, `work` is scratch memory, and
`others` are the sites that can be added. `enough` is the value to beat.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.engine import compiled, put_rows
from optloc.problem import Array
from optloc.sites.placement.branching import IN, OUT, number_left
from optloc.sites.placement.criteria import TRACE, VOLUME, invert, measure

# Relative rounding error of sums of costs: with it, a set that uses the budget exactly is allowed.
_EXACT = 1e-9
# Largest relative error of a criterion by update. The rounding error 1e-16 grows by the condition number, and
# by the factor by which another site lowers the variance. This factor is at most the condition number.
_WRONG = 1e-6
# Largest product of condition number and variance drop at which an update may be compared, and updated again.
_COMPARE, _AGAIN = 1e9, 1e8


class CompletionRequest(NamedTuple):
    """Arguments of the enumeration: rows, criterion and rules.

    Parameters
    ----------
    sites : array (P, n, r, m)
        Whitened rows of each site at each place.
    prior : array (P, m, m)
        Information without any site.
    whole : array (P,)
        Trace of the information of the prior and all sites; it bounds the condition number.
    weight : array (P,)
        Weights of the places, sum 1.
    d, kind, worst, fail : int
        See `optloc.sites.placement.branching.score`.
    rules, limits : array (R, n), (R,)
        rules @ w <= limits; the first rule has no negative entry.
    """

    sites: Array
    prior: Array
    whole: Array
    weight: Array
    d: int
    kind: int
    worst: int
    fail: int
    rules: Array
    limits: Array


class OtherSites(NamedTuple):
    """Sites that can be added to a set, in the order of the search.

    Parameters
    ----------
    site : int array (q,)
        Numbers of the q sites.
    rows : array (P, r, m, q)
        Whitened rows of the sites.
    products : array (P, m (m + 1) / 2, q)
        Products g_a g_b, b <= a, of the first row g of each site; `trace_with` needs them.
    """

    site: Array
    rows: Array
    products: Array


class CompletionWorkspace(NamedTuple):
    """Scratch arrays of the enumeration.

    `matrix` and `inverse` are (m, m). `cov`, `turn` and `basis` are (d, d), and `shares` is (d,); see
    `measure`. `first` (1,) is the index in `members` of the loss that failed the last test: it is tested
    first in the next set.
    """

    matrix: Array
    inverse: Array
    cov: Array
    turn: Array
    basis: Array
    shares: Array
    first: Array


@compiled
def trace_of(matrix: Array, d: int) -> float:
    """Return the trace of the leading (d, d) block of a matrix."""
    total = 0.0
    for i in range(d):
        total += matrix[i, i]
    return total


@compiled
def inverse_of(
    asked: CompletionRequest, p: int, members: Array, size: int, lost: int, matrix: Array, out: Array
) -> bool:
    """Write the inverse (m, m) of the information of a set at place `p` to `out`; return False if it is singular.

    The set is the first `size` entries of `members`, without entry `lost` (-1: no loss). `matrix` (m, m) is
    scratch.
    """
    _, _, r, m = asked.sites.shape
    for i in range(m):
        for k in range(i + 1):
            matrix[i, k] = asked.prior[p, i, k]
    for one in range(size):
        if one == lost:
            continue
        for q in range(r):
            row = asked.sites[p, members[one], q]
            for i in range(m):
                x = row[i]
                for k in range(i + 1):
                    matrix[i, k] += x * row[k]
    return bool(np.isfinite(invert(matrix, out, matrix)))  # in place: each entry is read before it is overwritten


@compiled
def update(inverse: Array, row: Array, s: Array) -> None:
    """Replace the inverse of M (m, m) by the inverse of M + g g' (Sherman-Morrison), g = `row` (m,); `s` is scratch."""
    m, along = inverse.shape[0], 1.0
    for i in range(m):
        x = 0.0
        for k in range(m):
            x += inverse[i, k] * row[k]
        s[i] = x
        along += row[i] * x
    for i in range(m):
        x = s[i] / along
        for k in range(m):
            inverse[i, k] -= x * s[k]


@compiled
def grow(
    asked: CompletionRequest,
    members: Array,
    size: int,
    last: Array,
    condition: float,
    out: Array,
    work: CompletionWorkspace,
) -> float:
    """Write the inverses (P, m, m) of a set with a new member to `out`; return their condition number.

    `last` (P, m, m) are the inverses of the set without its newest member, and `condition` is their condition
    number. The inverses are updated from `last`. If an update loses too much accuracy, the inverse is
    recomputed from the sums. The returned number is an upper bound; it is infinite if an inverse does not
    exist.
    """
    # An infinite `condition` means that `last` does not exist: the inverse is computed from the sums.
    places, _, r, m = asked.sites.shape
    most = 0.0
    for p in range(places):
        good = condition < _AGAIN
        if good:
            for i in range(m):
                for k in range(m):
                    out[p, i, k] = last[p, i, k]
            for q in range(r):
                update(out[p], asked.sites[p, members[size - 1], q], work.matrix[0])
            good = condition * trace_of(last[p], m) < _AGAIN * trace_of(out[p], m)
        if not good and not inverse_of(asked, p, members, size, -1, work.matrix, out[p]):
            return np.inf
        most = max(most, asked.whole[p] * trace_of(out[p], m))
    return most


@compiled
def worth(
    asked: CompletionRequest, members: Array, size: int, lost: int, enough: float, work: CompletionWorkspace
) -> float:
    """Return the criterion of a set without member `lost` (-1: the whole set), or any number not below `enough`.

    The function stops early when the criterion cannot be below `enough`. The set is the first `size` entries
    of `members`.
    """
    d, worst = asked.d, asked.worst
    total = -np.inf if worst else 0.0
    for p in range(asked.prior.shape[0]):
        if not inverse_of(asked, p, members, size, lost, work.matrix, work.inverse):
            return np.inf
        if asked.kind == TRACE:
            top = trace_of(work.inverse, d)
        else:
            put_rows(work.inverse[:d, :d], work.cov)
            top, _, _ = measure(asked.kind, work.cov, work.turn, work.basis, work.shares)
        total = max(total, top) if worst else total + asked.weight[p] * top
        if total >= enough and (worst or asked.kind != VOLUME):  # log det may be negative
            break
    return total


@compiled
def with_loss(asked: CompletionRequest, members: Array, size: int, enough: float, work: CompletionWorkspace) -> float:
    """Return the criterion of a set, after its worst loss if one site may fail, or any number not below `enough`.

    The set is the first `size` entries of `members`. The loss that failed the test in the previous set is
    tested first.
    """
    if not asked.fail or not size:
        return worth(asked, members, size, -1, enough, work)
    total, begin = -np.inf, work.first[0]
    for step in range(size):
        lost = (begin + step) % size
        total = max(total, worth(asked, members, size, lost, enough, work))
        if total >= enough:
            work.first[0] = lost
            break
    return total


@compiled
def trace_with(products: Array, inverse: Array, d: int, begin: int, along: Array, trace: Array) -> None:
    """Write the trace of the position covariance (q,) after the addition of each row g from index `begin`.

    tr C (M + g g')^-1 C' = tr C M^-1 C' - |C M^-1 g|^2 / (1 + g'M^-1 g)

    C selects the d coordinates of the position; `inverse` is M^-1 (m, m). Both quadratic forms are linear in
    the `products` of the rows, (m (m + 1) / 2, q). `along` (q,) is scratch: 1 + g'M^-1 g.
    """
    m, n, i = inverse.shape[0], products.shape[1], 0
    for j in range(begin, n):
        along[j] = 1.0
        trace[j] = 0.0
    for a in range(m):
        for b in range(a + 1):
            twice, x, y = 1.0 if a == b else 2.0, inverse[a, b], 0.0
            for k in range(d):
                y += inverse[k, a] * inverse[k, b]
            x *= twice
            y *= twice
            for j in range(begin, n):
                along[j] += x * products[i, j]
                trace[j] += y * products[i, j]
            i += 1
    whole = trace_of(inverse, d)
    for j in range(begin, n):
        trace[j] = whole - trace[j] / along[j]


@compiled
def one_more(
    asked: CompletionRequest, others: OtherSites, inverses: Array, begin: int, values: Array, work: CompletionWorkspace
) -> None:
    """Write the criterion (q,) of a set after the addition of each other site from index `begin` to `values`.

    The criterion is computed by updates of the `inverses` (P, m, m) of the set.
    """
    d, n = asked.d, len(others.site)
    single, brought = np.empty(n), np.empty(n)
    values[begin:] = -np.inf if asked.worst else 0.0
    for p in range(len(asked.weight)):
        if others.rows.shape[1] == 1 and asked.kind == TRACE:  # most of the time is spent here
            trace_with(others.products[p], inverses[p], d, begin, single, brought)
        else:
            for j in range(begin, n):
                put_rows(inverses[p], work.inverse)
                for q in range(others.rows.shape[1]):
                    update(work.inverse, others.rows[p, q, :, j], work.matrix[0])
                put_rows(work.inverse[:d, :d], work.cov)
                brought[j], _, _ = measure(asked.kind, work.cov, work.turn, work.basis, work.shares)
        for j in range(begin, n):
            values[j] = max(values[j], brought[j]) if asked.worst else values[j] + asked.weight[p] * brought[j]


@compiled
def comparable(asked: CompletionRequest, inverses: Array, condition: float, enough: float) -> bool:
    """Return whether updates of `inverses` (P, m, m) are accurate enough to compare criteria with `enough`.

    `condition` is an upper bound of the condition number of the inverses.
    """
    if asked.kind == VOLUME:
        return condition * condition < _COMPARE
    total = 0.0
    for p in range(len(asked.weight)):
        part = trace_of(inverses[p], asked.d)
        total = max(total, part) if asked.worst else total + asked.weight[p] * part
    return condition * max(1.0, total / enough) < _COMPARE


@compiled
def allowed(asked: CompletionRequest, members: Array, size: int, partly: bool) -> bool:
    """Return whether the first `size` members meet the rules, up to rounding.

    With `partly`, more sites follow, so only rules without negative entries are tested.
    """
    for i in range(asked.rules.shape[0]):
        used, low = 0.0, 0.0
        for one in range(size):
            used += asked.rules[i, members[one]]
        if partly:
            for j in range(asked.rules.shape[1]):
                low = min(low, asked.rules[i, j])
        if low == 0.0 and used > asked.limits[i] + _EXACT * max(1.0, abs(asked.limits[i])):
            return False
    return True


@compiled
def finish(
    asked: CompletionRequest,
    members: Array,
    size: int,
    others: OtherSites,
    begin: int,
    one: bool,
    two: bool,
    inverses: Array,
    condition: float,
    enough: float,
    best: Array,
    work: CompletionWorkspace,
) -> float:
    """Return the least criterion below `enough` of a set with one or two more sites; write the set to `best` (n,).

    The added sites come from `others`, from index `begin`. `one` and `two` select sets with one and with two
    more sites. Two sites are added only if one may fail: then the set must be good enough without either of
    them. If no set is better, the function returns `enough` and does not change `best`. `inverses` (P, m, m)
    and `condition` describe the set of the first `size` members.
    """
    # If updates are too inaccurate for a comparison, the values stay at minus infinity and all sites are kept. The
    # kept sets are computed again from the sums.
    count, keep, values = 0, np.empty(len(others.site), dtype=np.int64), np.full(len(others.site), -np.inf)
    limit = enough + _WRONG * abs(enough)
    if comparable(asked, inverses, condition, enough):
        one_more(asked, others, inverses, begin, values, work)
    for q in range(begin, len(others.site)):
        if values[q] < limit:
            keep[count] = others.site[q]
            count += 1
    for q in range(count):
        for t in range(q if one else q + 1, count if two else q + 1):
            members[size], members[size + 1] = keep[q], keep[t]
            taken = size + 1 if t == q else size + 2
            value = with_loss(asked, members, taken, enough, work)
            if value < enough and allowed(asked, members, taken, False):
                enough = value
                best[:] = OUT
                for i in range(taken):
                    best[members[i]] = IN
    return enough


@compiled
def picked(asked: CompletionRequest, order: Array) -> OtherSites:
    """Return the sites `order` (q,), in this order, with the arrays for their comparison."""
    places, _, r, m = asked.sites.shape
    count = len(order)
    rows, products = np.empty((places, r, m, count)), np.empty((places, m * (m + 1) // 2, count))
    for p in range(places):
        for j in range(count):
            i = 0
            for a in range(m):
                for q in range(r):
                    rows[p, q, a, j] = asked.sites[p, order[j], q, a]
                for b in range(a + 1):
                    products[p, i, j] = asked.sites[p, order[j], 0, a] * asked.sites[p, order[j], 0, b]
                    i += 1
    return OtherSites(order, rows, products)


@compiled
def scratch(m: int, d: int) -> CompletionWorkspace:
    """Return the scratch arrays of the enumeration for `m` unknowns with `d` position coordinates."""
    square, small = np.empty((2, m, m)), np.empty((3, d, d))
    return CompletionWorkspace(
        square[0], square[1], small[0], small[1], small[2], np.empty(d), np.zeros(1, dtype=np.int64)
    )


@compiled
def is_counted(asked: CompletionRequest, order: Array) -> bool:
    """Return whether the number of these sites is the only rule: then no allowed full set contains another allowed set.

    `order` (q,) are the free sites.
    """
    for j in order:
        if asked.rules[0, j] != asked.rules[0, order[0]]:
            return False
    return bool(asked.rules.shape[0] == 1)


@compiled
def exhaust(asked: CompletionRequest, state: Array, order: Array, most: int, enough: float, best: Array) -> float:
    """Return the least criterion below `enough` of all sets of a node, or `enough`; write the set to `best` (n,).

    Parameters
    ----------
    asked : CompletionRequest
        Rows, criterion and rules.
    state : int array (n,)
        FREE, OUT or IN.
    order : int array (q,)
        The free sites, most promising last: then sets of the first sites soon fail the test.
    most : int
        Largest number of free sites to add.
    enough : float
        Value to beat, in the units of the criterion.
    best : int array (n,)
        Output: 1 for taken sites; unchanged if no set is below `enough`.
    """
    places, n, _, m = asked.sites.shape
    room = min(most, number_left(asked.rules[0], asked.limits[0], state))
    if room < 1:
        return enough
    # `room` is the number of sites that can be added, `sure` the number of taken sites, `deep` the largest depth. The
    # last one or two sites are added by `finish`.
    members, sure, deep = np.empty(n + 2, dtype=np.int64), 0, max(0, room - (2 if asked.fail else 1))
    for j in range(n):
        if state[j] == IN:
            members[sure] = j
            sure += 1
    counted, others, work = is_counted(asked, order), picked(asked, order), scratch(m, asked.d)
    # `at` is the next entry of `order` at each depth; `fresh` is True when a set is reached for the first time
    at, inverses = np.zeros(deep + 1, dtype=np.int64), np.empty((deep + 1, places, m, m))
    condition = np.empty(deep + 1)
    condition[0] = grow(asked, members, sure, inverses[0], np.inf, inverses[0], work)
    depth, fresh = 0, True
    while depth >= 0:
        size, begin, own = sure + depth, at[depth], inverses[depth]
        if fresh and (depth == deep or not counted):
            # If the number of sites is the only rule, a full set is never worse: only full sets are tested.
            two = depth == deep and room - depth > 1
            one = not (two and counted)
            enough = finish(asked, members, size, others, begin, one, two, own, condition[depth], enough, best, work)
        fresh = depth < deep and begin < len(order)
        if not fresh:
            depth -= 1
            continue
        members[size] = order[begin]
        at[depth] = begin + 1
        fresh = allowed(asked, members, size + 1, True)
        if fresh:
            depth += 1
            at[depth] = begin + 1
            condition[depth] = grow(asked, members, size + 1, own, condition[depth - 1], inverses[depth], work)
    return enough
