"""Tell the rows of several emitters apart: columns, prices, and a proof that no column is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.problem import Problem
from optloc.several.answer import Emitters
from optloc.several.master import Prices, chosen, priced
from optloc.several.propose import proposed
from optloc.several.report import reported
from optloc.several.scene import Scene, scenes
from optloc.several.search import TOLERANCE, Region, Searched, search
from optloc.several.tuples import Tuples, fitted, nearby, nothing, thinned, together, worth
from optloc.solve.reasons import AMBIGUOUS_GAP
from optloc.track.sets import Clutter
from optloc.types import Array

# Turns of prices and searches; and those after which a number of emitters that nobody found is given up.
_ROUNDS, _HOPELESS = 80, 4


@dataclass(frozen=True, slots=True)
class Solved:
    """An assignment with its bound.

    Parameters
    ----------
    tuples : Tuples
        All sets of rows that were looked at.
    taken : int array (n,)
        Those of the assignment.
    prices : Prices
        Of the rows, with which no set that was looked at has a negative reduced cost.
    cost, bound : float
        Its cost, and a lower bound of that of any.
    boxes : int
        How many boxes the bound took.
    """

    tuples: Tuples
    taken: Array
    prices: Prices
    cost: float
    bound: float
    boxes: int


def separate(
    problem: Problem,
    clutter: Clutter,
    *,
    count: int | None = None,
    region: tuple[Any, Any] | None = None,
    penalty: float | None = None,
    boxes: int = 400_000,
) -> tuple[Emitters, ...]:
    """Return the emitters of each epoch of a problem whose rows do not say whose they are, without a guess.

    Each emitter gives at most one row to a channel (a kind at its stations), and a row is at most one emitter's. Of
    all assignments the one with the greatest likelihood is sought, every emitter at the best place for its own rows,
    and with as many emitters as pay their penalty: see `optloc.several.scene.Scene`. Sets of rows are columns of a set
    packing; they are proposed by closed-form fixes of as few rows as it takes, and branch and bound over all places of
    the region adds columns until no other can lower the cost.

    Parameters
    ----------
    problem : Problem
        Rows of kinds tdoa, azimuth, elevation, range or range_sum, with no batch axes and no unknowns but positions;
        their targets do not matter.
    clutter : Clutter
        Probability of detection and density of false rows.
    count : int, optional
        Number of emitters; None: the most likely.
    region : (lower, upper), optional
        Corners of the box, d coordinates each, in which emitters are sought; by default the box of the stations,
        wider by its greatest side on every side.
    penalty : float, optional
        What an emitter pays for being one, in twice a log-likelihood; None: what its d most telling rows are worth.
    boxes : int
        Boxes of places that each search looks at before it gives up; the bound is then lower.

    Returns
    -------
    tuple of Emitters
        One for each epoch that has rows.

    Raises
    ------
    InvalidProblem
        For kinds, unknowns, noise or arguments that sets of rows cannot be scored with.

    References
    ----------
    S. Deb, M. Yeddanapudi, K. Pattipati, Y. Bar-Shalom, "A generalized S-D assignment algorithm for
    multisensor-multitarget state estimation", IEEE Trans. Aerosp. Electron. Syst. 33 (1997).
    C. L. Morefield, "Application of 0-1 integer programming to multitarget tracking problems", IEEE Trans. Autom.
    Control 22 (1977).
    """
    if count is not None and count < 0:
        raise InvalidProblem(f"a count of {count}", "count", "give the number of emitters, or None")
    if penalty is not None and not np.isfinite(penalty):
        raise InvalidProblem(f"a penalty of {penalty}", "penalty", "give a finite number, or None")
    within = _region(problem, region)
    return tuple(_separated(problem, scene, within, count, boxes) for scene in scenes(problem, clutter, penalty))


def _region(problem: Problem, given: Sequence[Any] | None) -> Region:
    """Return the region given, or one around the stations."""
    if given is None:
        position = problem.stations.position.reshape(-1, problem.dimension)
        lower, upper = position.min(0), position.max(0)
        reach = float((upper - lower).max())
        return Region(lower - reach, upper + reach)
    lower, upper = (np.asarray(corner, dtype=float) for corner in given)
    good = lower.shape == upper.shape == (problem.dimension,) and np.isfinite(lower).all() and np.isfinite(upper).all()
    if not good or not (lower < upper).all():
        advice = f"give two corners of {problem.dimension} finite coordinates, the lower one first"
        raise InvalidProblem(f"a region from {lower} to {upper}", "region", advice)
    return Region(lower, upper)


def _separated(problem: Problem, scene: Scene, region: Region, count: int | None, boxes: int) -> Emitters:
    solved = _solved(scene, region, count, boxes)
    return reported(problem, scene, solved, count)


def _solved(scene: Scene, region: Region, count: int | None, boxes: int) -> Solved:
    """Return the best assignment: columns are added while the search finds one that is worth its price."""
    # Sets that do not pay by themselves are kept where they may have to be taken, or be listed as ghosts.
    limit = AMBIGUOUS_GAP + (scene.penalty if count is not None else 0.0)
    most = int(np.isfinite(scene.z).sum()) // scene.least
    tuples, total = _paying(proposed(scene), limit), 0
    fresh, bound = thinned(scene, _promising(tuples)), -np.inf
    for turn in range(_ROUNDS):
        tuples = _paying(together(tuples, fresh), limit)
        taken, cost = chosen(tuples, scene.z.shape[1], count)
        prices = priced(tuples, taken, worth(scene, tuples.take(taken)), count)
        found = search(scene, prices, region, boxes)
        total += found.boxes
        bound = max(bound, prices.bound(count, most, found.floor))
        fresh = _worth(scene, prices, found)
        if not len(fresh.cost) or (turn >= _HOPELESS and not np.isfinite(cost)):
            break
    return Solved(tuples, taken, prices, cost, min(bound, cost), total)


def _worth(scene: Scene, prices: Prices, found: Searched) -> Tuples:
    """Return the sets found, and others near their places, that are worth more than their price."""
    if not len(found.places):
        return nothing(scene)
    d = scene.scan.dimension
    more = nearby(scene, found.places, np.zeros((len(found.places), d, d)), prices.row)
    enough = (found.picks >= 0).sum(-1) >= d
    own = fitted(scene, found.picks[enough], found.places[enough])[0]
    sets = together(own, more)
    fresh = sets.take(prices.reduced(sets) < -0.5 * TOLERANCE)
    # Prices that are too high for one set are too high for its neighbours as well.
    return together(fresh, thinned(scene, fresh))


def _promising(tuples: Tuples, most: int = 40) -> Tuples:
    return tuples.take(np.arange(min(most, len(tuples.cost))))


def _paying(tuples: Tuples, limit: float) -> Tuples:
    return tuples.take(np.flatnonzero(tuples.cost < limit))
