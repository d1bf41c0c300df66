"""Search for the best set of sites: local exchange, then branch and bound with a proven bound.

A set is an int array (n,): 1 for each of the n sites that is taken, otherwise 0. A node of the search is
a family of sets: its state (n,) marks each site as taken (IN), left out (OUT) or undecided (FREE). The
value of a set is the criterion, which the search minimises. The bound of a node is a lower bound of the
values of all its sets.

The search takes the open node with the lowest bound first. The bound is a relaxation
(`optloc.sites.placement.relaxation`) that starts with the weights of the parent node. Sites whose reduced
cost excludes one of their two values are fixed at once.

Arguments of many functions: `task` is the search task, `asked` are its arguments for the enumeration, and
`progress` is the state of the running search. `chosen` (n,) is a set, and `seed` is the seed of random
numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from math import comb
from operator import itemgetter
from time import monotonic

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from formulations.placement import Criterion, Design
from optloc.problem import Array
from optloc.sites.placement.branching import FREE, IN, OUT, expand, propagate, score, settle
from optloc.sites.placement.completions import CompletionRequest, exhaust

# Random sets that are improved by exchange in addition to the rounded relaxation; steps of the relaxation at
# the root and in a node.
_STARTS, _ROOT_STEPS, _STEPS = 15, 60, 40
# Two values with a smaller relative difference are equal: sums over places have rounding errors.
_SAME = 1e-12
# A site with a larger weight is almost certainly taken, so a branch on it decides little. When the branch was
# at the weight nearest 1/2, the hardest of 100 searches had 50 % more nodes.
_TAKEN = 0.9
# Rounding error of a rule whose largest entry is 1.
_ROOM = 1e-9
# Seconds between two recorded points of bound and value.
_EVERY = 0.05
# A node with at most this number of sets is enumerated: that takes as long as one relaxation and avoids a
# subtree. If one site may fail, the number counts the sets without their last site. Of the limits 200, 400, 800
# and 2000, the third was the fastest.
_FEW, _FEW_FAIL = 800, 8_000
# Factor on these limits if the sites are not compared all at once: sites with several rows, or the criteria D
# and E.
_SLOW = 0.1
_KINDS: dict[Criterion, int] = {"A": 0, "D": 1, "E": 2}


@dataclass(frozen=True, slots=True)
class SearchTask:
    """A search for the best set of sites: design, criterion and rules.

    Parameters
    ----------
    design : Design
        Rows, priors and weights of the places.
    criterion : "A", "D" or "E"
        Trace, log determinant or largest eigenvalue of the covariance of the position, m^2.
    worst : bool
        True: the maximum over the places; False: their weighted mean.
    fail : bool
        True: the criterion after the worst loss of one site.
    rules, limits : array (R, n), (R,)
        A set w (n,) is allowed if rules @ w <= limits; the first rule has no negative entry.
    state : int array (n,)
        -1 for free sites, 0 for sites that are left out, 1 for sites that are taken.
    """

    design: Design
    criterion: Criterion
    worst: bool
    fail: bool
    rules: Array
    limits: Array
    state: Array

    @property
    def kind(self) -> int:
        """Return the number of the criterion in machine code: 0 for A, 1 for D, 2 for E."""
        return _KINDS[self.criterion]

    def score(self, sets: Array) -> Array:
        """Return the criterion (B,) of B sets (B, n): m^2, or the log determinant for D.

        The criterion is infinite if a set gives no fix.
        """
        design, chosen = self.design, np.ascontiguousarray(sets, dtype=np.int64)
        return np.asarray(
            score(
                np.ascontiguousarray(design.rows),
                design.prior,
                design.weight,
                design.dimension,
                self.kind,
                int(self.worst),
                int(self.fail),
                chosen,
            )
        )

    def asked(self) -> CompletionRequest:
        """Return rows, rules and criterion as arguments of the compiled enumeration (`exhaust`)."""
        design = self.design
        sites = np.ascontiguousarray(np.moveaxis(design.rows, -1, 1))
        whole = np.trace(design.prior, axis1=1, axis2=2) + (sites**2).sum(axis=(1, 2, 3))
        kinds = self.kind, int(self.worst), int(self.fail)
        return CompletionRequest(
            sites, design.prior, whole, design.weight, design.dimension, *kinds, self.rules, self.limits
        )

    def fits(self, sets: Array) -> Array:
        """Return a mask (B,) of the sets (B, n) that meet all rules, up to rounding."""
        upper = self.limits + _ROOM * np.maximum(1.0, np.abs(self.limits))
        return np.asarray((sets @ self.rules.T <= upper).all(-1))

    def scale(self, value: float) -> float:
        """Return a value of the criterion as a variance, m^2.

        For D, it is the geometric mean of the variances along the axes of the ellipsoid.
        """
        return float(np.exp(value / self.design.dimension)) if self.criterion == "D" else value

    def enough(self, value: float, gap: float) -> float:
        """Return the lower bound that proves a relative gap of at most `gap` (0 to 1) for a set with this `value`.

        The search can stop, or drop a node, as soon as the bound reaches this number. For D, the gap applies to
        the variance, not to the log determinant.
        """
        if self.criterion == "D":
            return value + self.design.dimension * float(np.log1p(-gap))
        return value * (1.0 - gap)


@dataclass(frozen=True, slots=True)
class BestSetResult:
    """The result of a search.

    Parameters
    ----------
    best : tuple of (float, array (n,))
        Values and sets, best first; empty if the rules allow no set.
    bound : float
        Lower bound of the value of each set that meets the rules; infinite if there is no set.
    closed : bool
        Whether the gap of bound and value is at most the requested gap.
    root : float
        Bound of the root node, before any branch.
    nodes : int
        Number of solved relaxations.
    course : array (q, 3)
        Seconds since the start, bound and value at q moments of the search, in the units of the criterion.
    """

    best: tuple[tuple[float, Array], ...]
    bound: float
    closed: bool
    root: float
    nodes: int
    course: Array


@dataclass(slots=True)
class _SearchState:
    """The state of a running search.

    `task` is the search, and `asked` holds its arguments for the enumeration. `gap` is the requested relative
    gap. `keep` is the number of sets to return. `seen` maps the bytes of each good set to its value and the
    set. `heap` contains the open nodes: bound, counter, state (n,) and weights (n,). `nodes` counts the
    solved relaxations, and `count` counts the opened nodes.
    """

    task: SearchTask
    asked: CompletionRequest
    gap: float
    keep: int
    seen: dict[bytes, tuple[float, Array]]
    heap: list[tuple[float, int, Array, Array]]
    nodes: int = 0
    count: int = 0

    @property
    def value(self) -> float:
        """Return the best value so far; infinite before the first set."""
        return min((value for value, _ in self.seen.values()), default=np.inf)

    def add(self, value: float, chosen: Array) -> None:
        """Store a set (n,) and its value; if more than 4 `keep` sets are stored, keep only the best `keep` sets."""
        self.seen[chosen.astype(np.int8).tobytes()] = (value, chosen)
        if len(self.seen) > 4 * self.keep:  # limit the memory: keep the best sets
            best = sorted(self.seen.items(), key=lambda item: item[1][0])[: self.keep]
            self.seen = dict(best)

    def push(self, bound: float, state: Array, w: Array) -> None:
        """Add an open node: its bound, the states (n,) of all sites and the weights (n,) of its relaxation."""
        self.count += 1  # equal bounds: arrays cannot be compared, counters can
        heappush(self.heap, (bound, self.count, state, w))

    @property
    def enough(self) -> float:
        """Return the bound that ends the search for the best value so far; infinite without a set."""
        return self.task.enough(self.value, self.gap) if self.seen else np.inf

    @property
    def bound(self) -> float:
        """Return the proven lower bound of all sets: the lowest bound of an open node, at most `enough`.

        Nodes with a bound above `enough` were dropped, so a larger number is not proven.
        """
        return min(self.heap[0][0] if self.heap else np.inf, self.enough)


def search(
    task: SearchTask,
    *,
    gap: float = 0.01,
    seconds: float = 60.0,
    keep: int = 5,
    seed: int = 0,
    tell: Callable[[float, float, int], None] = lambda bound, value, nodes: None,
) -> BestSetResult:
    """Return the best sets of the search, and a proven bound for all sets.

    Parameters
    ----------
    task : SearchTask
        Design, criterion and rules.
    gap : float
        Relative gap, 0 to 1, at which the search stops.
    seconds : float
        Time limit, seconds; the loading of machine code does not count.
    keep : int
        Number of sets to return.
    seed : int
        Seed of the random starts.
    tell : callable of (bound, value, nodes)
        Progress callback, called about every 0.05 s, in the units of the criterion.
    """
    _load()
    begun = monotonic()
    rows = np.ascontiguousarray(task.design.rows)  # each array layout would be compiled separately
    task = replace(task, design=replace(task.design, rows=rows))
    progress, state = _SearchState(task, task.asked(), gap, max(1, keep), {}, []), np.array(task.state, dtype=np.int64)
    if not propagate(task.rules, task.limits, state):
        return BestSetResult((), bound=np.inf, closed=True, root=np.inf, nodes=0, course=np.zeros((0, 3)))
    root, w = -np.inf, np.where(state == IN, 1.0, 0.0)
    if (state == FREE).any():
        w[state == FREE] = 0.5
        root, w, _ = _relax(progress, state, w, np.nan, _ROOT_STEPS)
        progress.push(root, state, w)
    for value, chosen in _start_sets(task, state, w, seed):
        progress.add(value, chosen)
    if not progress.seen:
        return BestSetResult((), bound=np.inf, closed=True, root=np.inf, nodes=progress.nodes, course=np.zeros((0, 3)))
    course = [(monotonic() - begun, progress.bound, progress.value)]
    while progress.heap and progress.heap[0][0] < progress.enough and monotonic() - begun < seconds:
        _branch(progress, *progress.heap[0][:1], *heappop(progress.heap)[2:])
        if monotonic() - begun > course[-1][0] + _EVERY:
            course.append((monotonic() - begun, progress.bound, progress.value))
            tell(progress.bound, progress.value, progress.nodes)
    closed = not progress.heap or progress.heap[0][0] >= progress.enough
    course.append((monotonic() - begun, progress.bound, progress.value))
    first = min(progress.seen.values(), key=itemgetter(0))[1]
    for removed in np.flatnonzero((first == 1) & (task.state == FREE)).tolist():  # good alternatives
        value, chosen = _exchange(task, progress.asked, first, removed, np.inf)
        if chosen.any():
            progress.add(value, chosen)
    best = sorted(progress.seen.values(), key=itemgetter(0))[: progress.keep]
    return BestSetResult(tuple(best), progress.bound, closed, root, progress.nodes, np.array(course))


def _load() -> None:
    """Load or compile the machine code before the time limit starts: the first compilation takes a minute."""
    prior, none = np.ones((1, 1, 1)), np.zeros(0)
    one = SearchTask(
        Design(np.ones((1, 1, 1, 2)), prior, np.ones(1), 1), "A", False, False, np.ones((1, 2)), np.ones(1), none
    )
    state = np.full(2, FREE, dtype=np.int64)
    propagate(one.rules, one.limits, state)
    _relax(_SearchState(one, one.asked(), 0.5, 1, {}, []), state, np.full(2, 0.5), np.nan, 1)
    settle(0.0, np.zeros(2), 1.0, state)
    one.score(np.eye(2))
    _enumerate(one.asked(), state, np.zeros(2), 1.0)


def _relax(progress: _SearchState, state: Array, w: Array, enough: float, steps: int) -> tuple[float, Array, Array]:
    """Return bound, weights (n,) and reduced costs (n,) of the relaxation of a node.

    `state` and `w` (n,) are the states and the first weights of all sites. The relaxation stops at the bound
    `enough` (NaN: no limit) or after `steps` steps. The reduced cost of a site is the rise of the bound if
    the site is taken (positive) or left out (negative).
    """
    task, x, cost = progress.task, w.copy(), np.empty(len(w))
    design = task.design
    bound, _, _ = expand(
        design.rows,
        design.prior,
        design.weight,
        design.dimension,
        task.rules,
        task.limits,
        task.kind,
        int(task.worst),
        int(task.fail),
        state,
        x,
        enough,
        steps,
        cost,
    )
    progress.nodes += 1
    return float(bound), x, cost


def _branch(progress: _SearchState, bound: float, state: Array, w: Array) -> None:
    """Open both children of a node: the site with the largest weight up to `_TAKEN` is taken, then left out.

    `bound` is the bound of the node, `state` (n,) and `w` (n,) are its states and weights.
    """
    free = np.flatnonzero(state == FREE)
    j = free[np.where(w[free] > _TAKEN, -1.0, w[free]).argmax()]
    for one in (1, 0):
        child, x = state.copy(), w.copy()
        child[j] = x[j] = one
        _bound_node(progress, bound, child, x)


def _bound_node(progress: _SearchState, bound: float, state: Array, w: Array) -> None:
    """Bound a node, and add it to the open nodes if it can contain a better set.

    A node without free sites is one set: its value is stored. A small node is enumerated. `bound` is the
    bound of the parent. `state` (n,) and `w` (n,) are states and first weights; `state` is changed.
    """
    task = progress.task
    while propagate(task.rules, task.limits, state):
        if not (state == FREE).any():
            if task.fits(state[None])[0]:
                progress.add(float(task.score(state[None])[0]), state)
            return
        if _is_small(task, state):
            value, best = _enumerate(progress.asked, state, w, progress.enough)
            if best.any():
                progress.add(value, best)
            return
        low, w, cost = _relax(progress, state, w, progress.enough, _STEPS)
        bound = max(bound, low)
        if bound >= progress.enough:
            return
        fixed = settle(low, cost, progress.enough, state)
        # If at least a fifth of the free sites was fixed, relax again at once; otherwise the node stays open.
        if not fixed or (state == FREE).sum() > 0.8 * ((state == FREE).sum() + fixed):
            if fixed and not propagate(task.rules, task.limits, state):
                return
            if (state == FREE).any():
                progress.push(bound, state, w)
                return


def _enumerate(
    asked: CompletionRequest, state: Array, w: Array, enough: float, most: int = sys.maxsize
) -> tuple[float, Array]:
    """Return value and set (n,) of the best set of a node with a value below `enough`.

    If no set is below, the set is all zeros and the value is `enough`. The weights `w` (n,) order the sites:
    likely sites are added first. `most` is the largest number of sites to add.
    """
    best, free = np.zeros(len(state), dtype=np.int64), np.flatnonzero(state == FREE)
    order = free[np.argsort(w[free], kind="stable")]
    return float(exhaust(asked, state, order, most, enough, best)), best


def _is_small(task: SearchTask, state: Array) -> bool:
    """Return whether a node has so few sets that enumeration is faster than a relaxation; `state` (n,) is its state."""
    # `addable` sites fit at most. `counted`: the number of sites is the only rule, so only full sets count. `at_once`:
    # the enumeration compares all candidates of the last site at once.
    sizes = task.rules[0][state == FREE]
    left = task.limits[0] - task.rules[0][state == IN].sum()
    addable = int((np.cumsum(np.sort(sizes)) <= left + _ROOM * max(1.0, abs(task.limits[0]))).sum())
    largest = max(1, addable - int(task.fail))
    counted = len(task.rules) == 1 and np.ptp(sizes) == 0.0
    number = sum(comb(len(sizes), size) for size in range(largest if counted else 1, largest + 1))
    at_once = task.criterion == "A" and task.design.rows.shape[1] == 1
    return number <= (_FEW_FAIL if task.fail else _FEW) * (1.0 if at_once else _SLOW)


def _start_sets(task: SearchTask, state: Array, w: Array, seed: int) -> Iterator[tuple[float, Array]]:
    """Yield values and sets (n,) from the rounded relaxation and from `_STARTS` random orders, improved by exchange.

    `w` (n,) are the weights of the relaxation at the root. No single exchange or addition improves a yielded
    set. The sets give the search a good first value, so that it can drop nodes early.
    """
    rng = np.random.default_rng(seed)
    for priority in (w, *rng.random((_STARTS, len(w)))):
        chosen = _round_to_set(task, state, priority)
        if chosen is None:
            return
        yield exchanged(task, chosen)


def _round_to_set(task: SearchTask, state: Array, priority: Array) -> Array | None:
    """Return a set (n,) of sites with high priority that meets the rules; None if the rules allow no set.

    Sites are added in order of their `priority` (n,), as long as the rules without negative entries allow it.
    """
    chosen = (state == IN).astype(np.int64)
    for j in np.argsort(-priority, kind="stable"):
        if state[j] == FREE:
            chosen[j] = 1
            chosen[j] = int((task.rules @ chosen <= task.limits + _ROOM)[(task.rules >= 0.0).all(1)].all())
    if task.fits(chosen[None])[0]:
        return np.asarray(chosen)
    # The greedy set may violate a rule with a least number of sites. Then an integer programme finds a set that
    # meets all rules. `_ROOM` is a small reward for sites with priority 0.
    lower, upper = (state == IN).astype(float), (state != 0).astype(float)
    rules = LinearConstraint(task.rules, -np.inf, task.limits)
    found = milp(
        -priority - _ROOM,
        integrality=np.ones(len(state), dtype=np.int64),
        bounds=Bounds(lower, upper),
        constraints=rules,
    )
    return None if found.x is None else np.asarray(np.round(found.x).astype(np.int64))


def random_sets(task: SearchTask, count: int, seed: int) -> Iterator[Array]:
    """Yield at most `count` random sets (n,) that meet the rules.

    Sites are added in random order until no other site fits.
    """
    rng = np.random.default_rng(seed)
    for priority in rng.random((count, len(task.state))):
        chosen = _round_to_set(task, task.state, priority)
        if chosen is not None:
            yield chosen


def exchanged(task: SearchTask, chosen: Array) -> tuple[float, Array]:
    """Return value and set (n,) after repeated exchange or addition of one site, until no change improves the value.

    The set that is passed in meets the rules. Kept sites are never exchanged.
    """
    asked, value = task.asked(), float(task.score(chosen[None])[0])
    while True:
        better, other = value - _SAME * max(1.0, abs(value)), None
        for removed in (None, *np.flatnonzero((chosen == 1) & (task.state == FREE)).tolist()):
            found, tried = _exchange(task, asked, chosen, removed, better)
            if tried.any():
                better, other = found, tried
        if other is None:
            return value, chosen
        value, chosen = float(task.score(other[None])[0]), other


def _exchange(
    task: SearchTask, asked: CompletionRequest, chosen: Array, removed: int | None, enough: float
) -> tuple[float, Array]:
    """Return value and set (n,) with the best new site, instead of site `removed` (None: in addition to all sites).

    If no set of this kind has a value below `enough`, the set is all zeros.
    """
    state = np.where(chosen == 1, IN, np.where(task.state == FREE, FREE, OUT))
    if removed is not None:
        state[removed] = OUT
    return _enumerate(asked, state, np.zeros(len(chosen)), enough, 1)
