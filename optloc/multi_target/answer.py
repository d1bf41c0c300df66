"""The result for the emitters of one epoch, and a model of evenly distributed false rows.

Letters: n emitters, m rows of the problem, d coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.short_form import HasShortForm
from optloc.base.types import Array, Status
from optloc.multi_target.sets import value_width
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.tracking.associate import Clutter


@dataclass(frozen=True, slots=True)
class Ghost:
    """A position that is not an emitter in the best assignment, but in another assignment with about the same cost.

    Parameters
    ----------
    position : array (d,)
        Metres, in the frame of the problem.
    rows : int array (n,)
        Global numbers of the rows that this emitter would have.
    gap : float
        Cost of the best assignment with this emitter minus the cost of the best assignment, in units of chi-square.
    """

    position: Array
    rows: Array
    gap: float


@dataclass(frozen=True, slots=True, repr=False)
class Emitters(HasShortForm):
    """The emitters of one epoch, and the assignment of its rows to them.

    Parameters
    ----------
    fixes : tuple of Fix
        Fix of each emitter from its rows, in the order of decreasing evidence.
    assignment : int array (m,)
        Emitter number of each row of the problem; -1 for false rows, and for rows of other epochs.
    cost : float
        Sum of the costs of the emitters: twice the negative logarithm of the likelihood ratio of this assignment to one
        in which all rows are false, with penalties.
    bound : float
        Lower bound of the cost of all assignments with emitters in the region.
    costs : array (n + 2,)
        Least cost found with 0, 1, ... n + 1 emitters; infinite if no assignment with this number was found.
    margin : float
        Difference between `cost` and the cost of the best assignment with another number of emitters or another
        position.
    ghosts : tuple of Ghost
        Other positions with about the same cost, the best first.
    status : Status
        The status: `ok`, or the most serious finding.
    reason : str
        The reason for the status, as a sentence.
    boxes : int
        Number of boxes of positions that branch and bound examined.
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
        """Return the cost minus its lower bound: no assignment can cost less by more than this gap."""
        return self.cost - self.bound

    @property
    def position(self) -> Array:
        """Return the positions (n, d) of the emitters, metres."""
        return np.array([fix.position for fix in self.fixes])

    def rows(self, emitter: int) -> Array:
        """Return the global numbers of the rows of an emitter."""
        return np.flatnonzero(self.assignment == emitter)


def evenly(problem: Problem, detection: float, false: float) -> Clutter:
    """Return a clutter model with the same mean number of false rows in each channel, evenly distributed.

    Parameters
    ----------
    problem : Problem
        The problem, which determines the ranges of values. Range differences are between plus and minus the distance of
        the stations. Azimuths cover the full circle, elevations half a circle.
    detection : float
        Probability that an emitter gives a row in a channel.
    false : float
        Mean number of false rows per channel and epoch, above 0.

    Raises
    ------
    InvalidProblem
        For kinds with unlimited values, and for numbers out of range.
    """
    if not 0.0 < false < np.inf:
        raise InvalidProblem(f"{false} false rows in a channel", "false", "give a mean number above 0")
    density = {}
    for block in problem.rows:
        width = value_width(problem, block)
        if width is None:
            what = f"values of {block.kind} have no limit"
            raise InvalidProblem(what, "false", "give the density of false rows, optloc.multi_target.Clutter")
        if block.count:
            # A kind has one density. Intervals differ between pairs of stations, and their mean keeps the mean number
            # of false rows.
            density[block.kind] = float(false / np.mean(width))
    return Clutter(detection, density)
