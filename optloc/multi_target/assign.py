"""Assignment of rows to several emitters by column generation: columns are sets of rows.

The cheapest selection of the known sets gives prices of rows. A search over all positions then finds new sets that are
worthwhile at these prices. Both steps alternate until there is no new set.

Letters: m channels of a scene, q sets, n emitters, d coordinates. The picks (q, m) of sets are the numbers of the
values that they take from each channel; -1 for none.

Arguments of functions: `scene` has the rows of one epoch. `region` is the box that contains the emitters. `solved` is
the best assignment, `fixes` are the fixes of its emitters, and `ghosts` other positions with about the same cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.normal import covariance
from optloc.models import MODELS
from optloc.multi_target.answer import Emitters, Ghost
from optloc.multi_target.assignment_findings import Assigned, count_in_words, verdict
from optloc.multi_target.pricing_search import TOLERANCE, PricedRegion, PricingResult, search
from optloc.multi_target.set_packing import Prices, cheapest_sets, price_rows
from optloc.multi_target.sets import (
    Scene,
    Tuples,
    merge,
    no_sets,
    of_picks,
    refine_sets,
    row_worth,
    scenes,
    sets_near,
    without_one_row,
)
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.policy import AMBIGUOUS_GAP, LISTED_GAP
from optloc.solvers.solution import solve
from optloc.tracking.associate import Clutter

# Maximum number of closed-form fixes of few rows, and of fixes that are refined, which are one batch. The
# branch-and-bound search finds sets that these fixes miss.
_TRIED, _FOLLOWED = 800, 800
# Chi-square above which a point of a closed form is not a common position of its rows. d rows fit their fix exactly;
# the rest is rounding near a station, or a branch with a negative range.
_FITS = 100.0
# Maximum number of listed ghosts, and squared distance above which a position counts as different: four sigmas.
_LISTED, _APART = 12, 16.0
# Maximum number of iterations of prices and searches, and the number after which a count of emitters without an
# assignment is given up: four times the best columns of the whole region did not make it possible.
_ROUNDS, _HOPELESS = 80, 4
# Number of cheapest sets from which the first iteration also tries subsets with one row less.
_PROMISING = 40


def separate(
    problem: Problem,
    clutter: Clutter,
    *,
    count: int | None = None,
    region: tuple[ArrayLike, ArrayLike] | None = None,
    penalty: float | None = None,
    boxes: int = 400_000,
) -> tuple[Emitters, ...]:
    """Return the emitters of each epoch of a problem with unlabelled rows, without a first guess.

    Each emitter gives at most one row in a channel (a kind at its stations), and a row belongs to at most one emitter.
    The result is the assignment with the greatest likelihood. Each emitter is at the best position for its rows, and
    the number of emitters is limited by a penalty for each, see `optloc.multi_target.sets.Scene`. The problem is a set
    packing whose columns are sets of rows. Closed-form fixes of as few rows as possible propose sets. Branch and bound
    over all positions of the region then adds columns until no other column can lower the cost.

    Parameters
    ----------
    problem : Problem
        Rows of kinds tdoa, azimuth, elevation, range or range_sum, without batch axes and with positions as the only
        unknowns. The targets of its rows are ignored.
    clutter : Clutter
        Probability of detection, and density of false rows.
    count : int, optional
        Number of emitters; None: the most likely.
    region : (lower, upper), optional
        Corners of the box, d coordinates each, that contains the emitters. Default: the box of the stations, extended
        on every side by its longest side.
    penalty : float, optional
        Cost of each emitter, in units of twice a log-likelihood. None: the value of its d most informative rows.
    boxes : int
        Maximum number of boxes of positions in each search. If it is reached, the bound is lower.

    Returns
    -------
    tuple of Emitters
        One for each epoch that has rows.

    Raises
    ------
    InvalidProblem
        For kinds, unknowns, noise or arguments for which sets of rows have no score.

    References
    ----------
    S. Deb, M. Yeddanapudi, K. Pattipati, Y. Bar-Shalom, "A generalized S-D assignment algorithm for
    multisensor-multitarget state estimation", IEEE Trans. Aerosp. Electron. Syst. 33 (1997).
    C. L. Morefield, "Application of 0-1 integer programming to multitarget tracking problems", IEEE Trans. Autom.
    Control 22 (1977).
    """
    if count is not None and count < 0:
        raise InvalidProblem(f"the count is {count}", "count", "give the number of emitters, or None")
    if penalty is not None and not np.isfinite(penalty):
        raise InvalidProblem(f"the penalty is {penalty}", "penalty", "give a finite number, or None")
    search_region = _region(problem, region)
    return tuple(
        emitters_of(problem, scene, _solve_epoch(scene, search_region, count, boxes), count)
        for scene in scenes(problem, clutter, penalty)
    )


def _region(problem: Problem, corners: Sequence[Any] | None) -> PricedRegion:
    """Return the given region, or the box of the stations extended on every side by its longest side."""
    if corners is None:
        position = problem.stations.position.reshape(-1, problem.dimension)
        lower, upper = position.min(0), position.max(0)
        longest_side = float((upper - lower).max())
        return PricedRegion(lower - longest_side, upper + longest_side)
    lower, upper = (np.asarray(corner, dtype=float) for corner in corners)
    good = lower.shape == upper.shape == (problem.dimension,) and np.isfinite(lower).all() and np.isfinite(upper).all()
    if not good or not (lower < upper).all():
        advice = f"give two corners of {problem.dimension} finite coordinates, the lower one first"
        raise InvalidProblem(f"the region from {lower} to {upper} is not a box", "region", advice)
    return PricedRegion(lower, upper)


@dataclass(frozen=True, slots=True)
class Solved:
    """An assignment with its bound.

    Parameters
    ----------
    tuples : Tuples
        All sets of rows that were examined.
    taken : int array (n,)
        Numbers of the sets of the assignment.
    prices : Prices
        Prices of the rows. With them no examined set has a negative reduced cost.
    cost, bound : float
        Cost of the assignment, and a lower bound of the cost of all assignments.
    boxes : int
        Number of boxes that the searches examined.
    """

    tuples: Tuples
    taken: Array
    prices: Prices
    cost: float
    bound: float
    boxes: int


def _solve_epoch(scene: Scene, region: PricedRegion, count: int | None, boxes: int) -> Solved:
    """Return the best assignment. Columns are added while the search finds one with a negative reduced cost.

    `count` is the required number of emitters, or None. `boxes` is the maximum number of boxes in each search.
    """
    # Sets with a positive cost are kept if the assignment may need them, or if they may be listed as ghosts.
    limit = AMBIGUOUS_GAP + (scene.penalty if count is not None else 0.0)
    # Upper limit of the number of emitters, from the number of rows.
    most_emitters = int(np.isfinite(scene.z).sum()) // scene.least
    tuples, examined_boxes = _drop_expensive(propose_sets(scene), limit), 0
    new_sets, bound = without_one_row(scene, tuples.take(np.arange(min(_PROMISING, len(tuples.cost))))), -np.inf
    for iteration in range(_ROUNDS):
        tuples = _drop_expensive(merge(tuples, new_sets), limit)
        taken, cost = cheapest_sets(tuples, scene.z.shape[1], count)
        # At these prices no examined column has a negative reduced cost. The search checks all other columns.
        prices = price_rows(tuples, taken, row_worth(scene, tuples.take(taken)), count)
        result = search(scene, prices, region, boxes)
        examined_boxes += result.boxes
        # Every iteration gives a valid bound, so keep the best.
        bound = max(bound, prices.bound(count, most_emitters, result.floor))
        new_sets = _new_sets(scene, prices, result)
        if not len(new_sets.cost) or (iteration >= _HOPELESS and not np.isfinite(cost)):
            break
    return Solved(tuples, taken, prices, cost, min(bound, cost), examined_boxes)


def _new_sets(scene: Scene, prices: Prices, result: PricingResult) -> Tuples:
    """Return the sets that the search found, and others near their positions, that have a negative reduced cost.

    `prices` are the current prices of the rows, and `result` is the result of the search with them.
    """
    if not len(result.places):
        return no_sets(scene)
    d = scene.scan.dimension
    nearby = sets_near(scene, result.places, np.zeros((len(result.places), d, d)), prices.row)
    # The rows were chosen one by one for a position. With fewer than d rows they do not determine a position.
    enough = (result.picks >= 0).sum(-1) >= d
    refined = refine_sets(scene, result.picks[enough], result.places[enough])[0]
    sets = merge(refined, nearby)
    cheaper = sets.take(prices.reduced(sets) < -0.5 * TOLERANCE)
    # If the price of a set is too high, the prices of its neighbours probably are too.
    return merge(cheaper, without_one_row(scene, cheaper))


def _drop_expensive(tuples: Tuples, limit: float) -> Tuples:
    """Return the sets that cost less than `limit`."""
    return tuples.take(np.flatnonzero(tuples.cost < limit))


# Candidate positions of emitters: closed-form fixes of as few rows as possible.


def propose_sets(scene: Scene, seed: int = 0) -> Tuples:
    """Return sets of rows near the closed-form fixes of d rows each: all, or a seeded sample if there are many.

    `seed` determines the sample. The sets have costs and refined positions.
    """
    picks = _combinations(scene, np.random.default_rng(seed))
    if not len(picks):
        return no_sets(scene)
    problem = scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float))
    fix = solve(problem, "roots", refine=False)
    # All roots of the closed form, because d rows can have several common positions.
    x = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    # The set (`item`) and the number of the root (`slot`) of each finite position.
    item, slot = np.nonzero(np.isfinite(x).all(-1))
    with np.errstate(all="ignore"):  # some points of the closed form coincide with stations
        equations = equations_at(problem.take(item), x[item, slot])
        cov = covariance(equations)[0]
    good = np.flatnonzero(np.isfinite(cov).all((-1, -2)) & (equations.cost < _FITS))[:_FOLLOWED]
    return sets_near(scene, x[item, slot][good], cov[good], np.zeros_like(scene.z))


def _combinations(scene: Scene, rng: np.random.Generator) -> Array:
    """Return the picks (q, m) of sets of d rows that determine a position.

    The sets are in random order from `rng`. The list ends with the subset of channels that brings it to `_TRIED` sets.
    """
    d, count = scene.scan.dimension, scene.scan.count
    ends = _ends(scene)
    values = [np.flatnonzero(np.isfinite(channel)) for channel in scene.z]
    present = [i for i in range(count) if len(values[i])]
    subsets = [subset for subset in combinations(present, d) if _form_tree([ends[i] for i in subset])]
    picks = []
    # A seeded sample, so that results do not depend on the machine.
    for number in rng.permutation(len(subsets)):
        subset = subsets[number]
        # All combinations of one value from each channel of the subset, because rows are unlabelled.
        for chosen in product(*(values[i] for i in subset)):
            picks_of_set = np.full(count, -1)
            picks_of_set[list(subset)] = chosen
            picks.append(picks_of_set)
        if len(picks) >= _TRIED:
            break
    return np.array(picks).reshape(-1, count)


def _ends(scene: Scene) -> list[tuple[int, int] | None]:
    """Return the two stations of each channel (m,); None for channels with one station."""
    ends: list[tuple[int, int] | None] = []
    for block in scene.scan.rows:
        has_two = MODELS[block.kind].stations > 1
        ends += [(int(a), int(b)) if has_two else None for a, b in zip(block.a, block.b, strict=True)]
    return ends


def _form_tree(pairs: list[tuple[int, int] | None]) -> bool:
    """Return whether pairs of stations form one tree, which is necessary for a closed-form position.

    The entry None is a channel with one station, which does not matter.
    """
    trees = [set(pair) for pair in pairs if pair is not None]
    while len(trees) > 1:
        joined = next((other for other in trees[1:] if trees[0] & other), None)
        if joined is None or len(trees[0] & joined) > 1:
            return False
        trees = [trees[0] | joined, *(other for other in trees[1:] if other is not joined)]
    return True


# From the best assignment to the result: fixes, ghosts, and the margin of the number of emitters.


def emitters_of(problem: Problem, scene: Scene, solved: Solved, count: int | None) -> Emitters:
    """Return the emitters of an assignment of one epoch; `count` is the required number of emitters, or None."""
    # Sort the emitters by evidence: the lowest cost first. The fixes and the assignment use this order.
    taken = solved.taken[np.argsort(solved.tuples.cost[solved.taken], kind="stable")]
    best, width = solved.tuples.take(taken), scene.z.shape[1]
    fixes = fix_sets(scene, best.picks)
    # Number of the emitter of each row of the problem; -1 for false rows.
    assignment = np.full(problem.count, -1)
    for number, picks in enumerate(best.picks):
        channels = np.flatnonzero(picks >= 0)
        assignment[scene.row[channels, picks[channels]]] = number
    # Least cost for 0, 1, ... emitters, up to one more than in the assignment.
    costs = np.array([cheapest_sets(solved.tuples, width, k)[1] for k in range(len(taken) + 2)])
    ghosts = _ghosts(scene, solved, fixes, width, count)
    numbers = [] if count is not None else [costs[k] - solved.cost for k in (len(taken) - 1, len(taken) + 1) if k >= 0]
    margin = float(min([*numbers, *(ghost.gap for ghost in ghosts)], default=np.inf))
    status, reason = _verdict(scene, solved, fixes, ghosts, costs, count)
    return Emitters(fixes, assignment, solved.cost, solved.bound, costs, margin, ghosts, status, reason, solved.boxes)


def fix_sets(scene: Scene, picks: Array) -> tuple[Fix, ...]:
    """Return the fix of each of n sets of rows with picks (n, m)."""
    if not len(picks):
        return ()
    fix = solve(scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float)))
    return tuple(fix[i] for i in range(len(picks)))


def _ghosts(scene: Scene, solved: Solved, fixes: tuple[Fix, ...], width: int, count: int | None) -> tuple[Ghost, ...]:
    """Return the positions of other sets that belong to an assignment with nearly the least cost, the best first.

    `fixes` are the fixes of the best assignment. `width` is the number of values of a channel. `count` is the required
    number of emitters, or None.
    """
    tuples, ghosts = solved.tuples, list[Ghost]()
    known = [(fix.position, _information(fix.covariance())) for fix in fixes]
    # The reduced cost is a lower bound of the additional cost of an assignment with this set. In increasing order, the
    # first set above the limit ends the search.
    lowest = solved.prices.reduced(tuples)
    for i in np.argsort(lowest, kind="stable"):
        if len(ghosts) == _LISTED or lowest[i] >= LISTED_GAP:
            break
        # Leave out a position within four sigmas of an emitter or of a listed ghost.
        if any(
            (tuples.x[i] - known_position) @ weight @ (tuples.x[i] - known_position) < _APART
            for known_position, weight in known
        ):
            continue
        # Additional cost of the best assignment that contains this set; infinite if no assignment contains it.
        gap = cheapest_sets(tuples, width, count, forced=int(i))[1] - solved.cost
        if not gap < LISTED_GAP:
            continue
        channels = np.flatnonzero(tuples.picks[i] >= 0)
        ghosts.append(Ghost(tuples.x[i], scene.row[channels, tuples.picks[i][channels]], float(gap)))
        ghost_fix = fix_sets(scene, tuples.picks[i : i + 1])[0]
        known.append((tuples.x[i], _information(ghost_fix.covariance())))
    return tuple(sorted(ghosts, key=lambda ghost: ghost.gap))


def _information(cov: Array) -> Array:
    """Return the inverse (d, d) of a covariance; zero if it is not finite, so that all positions count as near."""
    return np.linalg.pinv(cov) if np.isfinite(cov).all() else np.zeros_like(cov)


def _verdict(
    scene: Scene, solved: Solved, fixes: tuple[Fix, ...], ghosts: tuple[Ghost, ...], costs: Array, count: int | None
) -> tuple[Status, str]:
    """Return the status and the reason of an assignment.

    `costs` (n + 2,) is the least cost for each number of emitters. `count` is the required number, or None.
    """
    measured = np.isfinite(scene.z)
    gaps = tuple(ghost.gap for ghost in ghosts)
    size = int(measured.any(1).sum()), len(scene.z), scene.least
    false = int(measured.sum()) - int((solved.tuples.picks[solved.taken] >= 0).sum())
    assigned = Assigned(fixes, gaps, costs, solved.cost, solved.bound, count, *size)
    return verdict(assigned, f"{count_in_words(len(fixes))}; false rows: {false}")
