"""What is said of the emitters of one epoch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.multi_target.sets import value_width
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.tracking.associate import Clutter


@dataclass(frozen=True, slots=True)
class Ghost:
    """A place that is no emitter in the best assignment, but in one that fits about as well.

    Parameters
    ----------
    position : array (d,)
        Metres.
    rows : int array (n,)
        Global rows that meet there.
    gap : float
        Cost of the best assignment with an emitter there less that of the best one.
    """

    position: Array
    rows: Array
    gap: float


@dataclass(frozen=True, slots=True)
class Emitters:
    """The emitters of one epoch, and whose rows are whose.

    Parameters
    ----------
    fixes : tuple of Fix
        Of each emitter, the one whose rows speak loudest for it first; each is the fix of its own rows.
    assignment : int array (m,)
        Emitter of each row of the problem; -1 for a false one, and for rows of other epochs.
    cost : float
        Sum of the costs of the emitters: twice the negative logarithm of the likelihood ratio against all rows being
        false, penalties included.
    bound : float
        No assignment of emitters in the region costs less.
    costs : array (n + 2,)
        Least cost found with 0, 1, ... n + 1 emitters; infinite where there is no such assignment among those found.
    margin : float
        Cost of the best assignment found with another number of emitters, or with one at another place, less `cost`.
    ghosts : tuple of Ghost
        Places that fit about as well, the best first.
    status : Status
        ok, or why not.
    reason : str
        The status in a sentence.
    boxes : int
        How many boxes of places the bound took.
    """

    fixes: tuple[Fix, ...]
    assignment: Array
    cost: float
    bound: float
    costs: Array
    margin: float
    ghosts: tuple[Ghost, ...]
    status: Status
    reason: str
    boxes: int

    @property
    def count(self) -> int:
        """Return the number of emitters."""
        return len(self.fixes)

    @property
    def gap(self) -> float:
        """Return the cost less its lower bound."""
        return self.cost - self.bound

    @property
    def position(self) -> Array:
        """Return the positions (n, d) of the emitters, metres."""
        return np.array([fix.position for fix in self.fixes])

    def rows(self, emitter: int) -> Array:
        """Return the global rows of an emitter."""
        return np.flatnonzero(self.assignment == emitter)


def evenly(problem: Problem, detection: float, false: float) -> Clutter:
    """Return the density of false rows that lie anywhere a true one can: as many in each channel, spread evenly.

    Parameters
    ----------
    problem : Problem
        Differences of ranges lie between plus and minus the stations' distance, azimuths in the full circle,
        elevations in half of it.
    detection : float
        Probability that an emitter is seen in a channel.
    false : float
        Mean number of false rows of a channel and epoch, above 0.

    Raises
    ------
    InvalidProblem
        For kinds without bounds, and numbers out of range.
    """
    if not 0.0 < false < np.inf:
        raise InvalidProblem(f"{false} false rows in a channel", "false", "give a mean number above 0")
    density = {}
    for block in problem.rows:
        width = value_width(problem, block)
        if width is None:
            what = f"there is no end to possible values of {block.kind}"
            raise InvalidProblem(what, "false", "give the density of false rows, optloc.multi_target.Clutter")
        if block.count:
            # One density for a kind: pairs of stations differ in width, and the mean keeps the mean number of false
            # rows.
            density[block.kind] = float(false / np.mean(width))
    return Clutter(detection, density)
