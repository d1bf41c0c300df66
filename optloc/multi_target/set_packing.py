"""Which sets of rows to take, no row twice: a set packing, its prices and its bound."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from optloc.base.types import Array
from optloc.multi_target.sets import Tuples

# Weight of even prices against the value of the bound: small enough to choose among duals of one value
# without moving the bound.
_EVEN = 1e-4


@dataclass(frozen=True, slots=True)
class Prices:
    """Multipliers of the rows, and of the number of emitters where it is given.

    For any prices u >= 0 and v, sum over sets of an assignment of (c + u(T) - v) is at least its number of sets times
    the least such value, so that its cost is at least n v - sum u + n min(0, least).

    Parameters
    ----------
    row : array (m, c)
        Price of each row.
    emitter : float
        What an emitter is paid for; 0 where their number is free.
    """

    row: Array
    emitter: float

    def reduced(self, tuples: Tuples) -> Array:
        """Return the costs (q,) of sets less what their rows and they themselves are priced at."""
        return np.asarray(tuples.cost + tuples.prices(self.row) - self.emitter)

    def bound(self, count: int | None, most: int, floor: float) -> float:
        """Return a lower bound of the cost of assignments, from one of the reduced costs of all sets.

        Parameters
        ----------
        count : int or None
            Number of emitters, if it is given.
        most : int
            Emitters that an assignment can have at most.
        floor : float
            No set has a lower reduced cost.
        """
        # Each set taken lowers the sum by the floor at the most, so a number of sets by that number of floors.
        number = most if count is None else count
        return number * (min(0.0, floor) + self.emitter) - float(self.row.sum())


def incidence(tuples: Tuples, width: int) -> sparse.csc_array:
    """Return which rows, of m channels with `width` values each, are in which sets, (m * width, q)."""
    which, channel = np.nonzero(tuples.picks >= 0)
    row = channel * width + tuples.picks[which, channel]
    shape = (tuples.picks.shape[1] * width, len(tuples.cost))
    return sparse.csc_array((np.ones(len(row)), (row, which)), shape=shape)


def cheapest_sets(tuples: Tuples, width: int, count: int | None, forced: int | None = None) -> tuple[Array, float]:
    """Return the sets of least total cost that share no row, and the total, infinite where there are none.

    Parameters
    ----------
    tuples : Tuples
        Sets to choose from.
    width : int
        Values of a channel.
    count : int or None
        How many sets, or None for as many as pay.
    forced : int, optional
        A set that must be taken.

    References
    ----------
    C. L. Morefield, "Application of 0-1 integer programming to multitarget tracking problems", IEEE Trans. Autom.
    Control 22 (1977).
    """
    size = len(tuples.cost)
    # milp refuses an empty programme.
    if not size or count == 0:
        empty = count in (None, 0) and forced is None
        return np.zeros(0, dtype=np.int64), 0.0 if empty else np.inf
    rules = [LinearConstraint(incidence(tuples, width), -np.inf, 1.0)]
    if count is not None:
        rules.append(LinearConstraint(np.ones((1, size)), count, count))
    # A set that must be taken has its bounds at one.
    lower = np.zeros(size)
    if forced is not None:
        lower[forced] = 1.0
    solved = milp(tuples.cost, integrality=np.ones(size, dtype=np.int64), bounds=Bounds(lower, 1.0), constraints=rules)
    if solved.x is None:
        return np.zeros(0, dtype=np.int64), np.inf
    # HiGHS answers ones that are ones to within its tolerance.
    taken = np.flatnonzero(solved.x > 0.5)
    return taken, float(tuples.cost[taken].sum())


def price_rows(tuples: Tuples, taken: Array, worth: Array, count: int | None) -> Prices:
    """Return the prices of the rows: the dual of the linear relaxation.

    Of the many duals, one is taken in which the rows of a taken set share its price as their worth has it.

    Parameters
    ----------
    tuples : Tuples
        Sets to choose from.
    taken : int array (n,)
        Those that are taken.
    worth : array (m, c)
        By how much each row lowers the cost of its set, above 0.
    count : int or None
        How many sets must be taken.
    """
    m, width = shape = worth.shape
    if not len(tuples.cost):
        return Prices(np.zeros(shape), 0.0)
    inside, k = incidence(tuples, width), len(taken)
    # Unknowns: a price for each row, one for each emitter, and the highest price over worth within each taken set.
    one, none = sparse.csr_array(np.ones((len(tuples.cost), 1))), sparse.csr_array((len(tuples.cost), k))
    sets: Any = sparse.hstack([-inside.T, one, none])
    row, number = inside[:, taken].nonzero()
    even = sparse.csr_array(
        (
            np.concatenate([1.0 / worth.ravel()[row], -np.ones(len(row))]),
            (np.tile(np.arange(len(row)), 2), np.concatenate([row, m * width + 1 + number])),
        ),
        shape=(len(row), m * width + 1 + k),
    )
    total = np.concatenate([np.ones(m * width), [-float(count or 0)], np.full(k, _EVEN)])
    # Without a given number there is no rule on it, and so no price of an emitter.
    free = (0.0, 0.0) if count is None else (None, None)
    bounds = [(0.0, None)] * (m * width) + [free] + [(0.0, None)] * k
    limits = np.concatenate([tuples.cost, np.zeros(len(row))])
    solved = linprog(total, A_ub=sparse.vstack([sets, even]), b_ub=limits, bounds=bounds)
    if solved.x is None:
        return Prices(np.zeros(shape), 0.0)
    # A price below zero by rounding would make the bound a wrong one.
    return Prices(np.maximum(solved.x[: m * width], 0.0).reshape(shape), float(solved.x[m * width]))
