"""Set packing: the cheapest selection of sets of rows without a shared row, its prices (dual) and its bound.

Letters: q sets, m channels with up to c values each. A row is a value of a channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from optloc.base.types import Array
from optloc.multi_target.sets import Tuples

# Weight of evenly shared prices relative to the value of the bound: small enough to select among dual solutions of
# equal value without a change of the bound.
_EVEN = 1e-4


@dataclass(frozen=True, slots=True)
class Prices:
    """Dual prices u of the rows, and v of the number of emitters if it is given.

    The reduced cost of a set T is c + u(T) - v. For any u >= 0 and v, the sum of the reduced costs of n sets is at
    least n times the least of all. Each row is in at most one set, so the cost of an assignment is at least n v - sum u
    + n min(0, least).

    Parameters
    ----------
    row : array (m, c)
        Price of each row.
    emitter : float
        Price v, the payment for each emitter; 0 if their number is free.
    """

    row: Array
    emitter: float

    def reduced(self, tuples: Tuples) -> Array:
        """Return the reduced costs (q,) of sets: cost plus the prices of their rows minus the price of an emitter."""
        return np.asarray(tuples.cost + tuples.prices(self.row) - self.emitter)

    def bound(self, count: int | None, most: int, floor: float) -> float:
        """Return a lower bound of the cost of all assignments, from a lower bound of the reduced costs of all sets.

        Parameters
        ----------
        count : int or None
            Number of emitters if it is given.
        most : int
            Maximum number of emitters of an assignment.
        floor : float
            Lower bound of the reduced costs of all sets.
        """
        # Each taken set changes the sum by at least the floor, so n sets change it by at least n times the floor.
        number = most if count is None else count
        return number * (min(0.0, floor) + self.emitter) - float(self.row.sum())


def incidence(tuples: Tuples, width: int) -> sparse.csc_array:
    """Return the sparse incidence matrix (m * width, q): 1 if a row (channel * width + value) is in a set.

    `width` is the number of values of a channel.
    """
    which, channel = np.nonzero(tuples.picks >= 0)
    row = channel * width + tuples.picks[which, channel]
    shape = (tuples.picks.shape[1] * width, len(tuples.cost))
    return sparse.csc_array((np.ones(len(row)), (row, which)), shape=shape)


def cheapest_sets(tuples: Tuples, width: int, count: int | None, forced: int | None = None) -> tuple[Array, float]:
    """Return the numbers (n,) of the sets of least total cost that share no row, and their total cost.

    The cost is infinite if no sets meet the conditions.

    Parameters
    ----------
    tuples : Tuples
        Candidate sets.
    width : int
        Number of values of a channel.
    count : int or None
        Number of sets, or None for the number with the least cost.
    forced : int, optional
        A set that must be taken.

    References
    ----------
    C. L. Morefield, "Application of 0-1 integer programming to multitarget tracking problems", IEEE Trans. Autom.
    Control 22 (1977).
    """
    size = len(tuples.cost)
    # milp does not accept an empty problem.
    if not size or count == 0:
        empty = count in (None, 0) and forced is None
        return np.zeros(0, dtype=np.int64), 0.0 if empty else np.inf
    rules = [LinearConstraint(incidence(tuples, width), -np.inf, 1.0)]
    if count is not None:
        rules.append(LinearConstraint(np.ones((1, size)), count, count))
    # A forced set has lower and upper bound one.
    lower = np.zeros(size)
    if forced is not None:
        lower[forced] = 1.0
    solved = milp(tuples.cost, integrality=np.ones(size, dtype=np.int64), bounds=Bounds(lower, 1.0), constraints=rules)
    if solved.x is None:
        return np.zeros(0, dtype=np.int64), np.inf
    # HiGHS returns ones only up to its tolerance.
    taken = np.flatnonzero(solved.x > 0.5)
    return taken, float(tuples.cost[taken].sum())


def price_rows(tuples: Tuples, taken: Array, worth: Array, count: int | None) -> Prices:
    """Return the prices of the rows: a dual solution of the linear relaxation.

    There are many dual solutions. In the selected one, the rows of a taken set share its price in proportion to their
    worth.

    Parameters
    ----------
    tuples : Tuples
        Candidate sets.
    taken : int array (n,)
        Numbers of the taken sets.
    worth : array (m, c)
        Decrease of the cost of its set due to each row, above 0.
    count : int or None
        Required number of sets; None if it is free.

    Returns
    -------
    Prices
        All zero if there are no sets, or if the linear program has no solution. Zero prices give a valid bound.
    """
    m, width = shape = worth.shape
    if not len(tuples.cost):
        return Prices(np.zeros(shape), 0.0)
    incidence_matrix, k = incidence(tuples, width), len(taken)
    # Unknowns: a price for each row, one for an emitter, and the highest quotient of price and worth in each taken set.
    ones, zeros = sparse.csr_array(np.ones((len(tuples.cost), 1))), sparse.csr_array((len(tuples.cost), k))
    # Constraint of each set: emitter price minus the prices of its rows <= cost, so that no reduced cost is negative.
    sets: Any = sparse.hstack([-incidence_matrix.T, ones, zeros])
    # Constraint of each row of a taken set: its price divided by its worth <= the highest quotient of this set.
    row, number = incidence_matrix[:, taken].nonzero()
    sharing = sparse.csr_array(
        (
            np.concatenate([1.0 / worth.ravel()[row], -np.ones(len(row))]),
            (np.tile(np.arange(len(row)), 2), np.concatenate([row, m * width + 1 + number])),
        ),
        shape=(len(row), m * width + 1 + k),
    )
    # Objective: the negative bound, sum of row prices minus count times emitter price. The highest quotients enter with
    # a small weight, so that prices are shared evenly.
    total = np.concatenate([np.ones(m * width), [-float(count or 0)], np.full(k, _EVEN)])
    # If the number is free, its constraint and the price of an emitter do not exist.
    free = (0.0, 0.0) if count is None else (None, None)
    bounds = [(0.0, None)] * (m * width) + [free] + [(0.0, None)] * k
    limits = np.concatenate([tuples.cost, np.zeros(len(row))])
    solved = linprog(total, A_ub=sparse.vstack([sets, sharing]), b_ub=limits, bounds=bounds)
    if solved.x is None:
        return Prices(np.zeros(shape), 0.0)
    # A price that is negative by rounding would make the bound invalid.
    return Prices(np.maximum(solved.x[: m * width], 0.0).reshape(shape), float(solved.x[m * width]))
