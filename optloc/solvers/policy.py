"""The thresholds of a verdict: each is a promise to the reader of a status, so they stand in one place."""

from __future__ import annotations

from typing import Any

AMBIGUOUS_GAP = 9.0
"""Cost by which another minimum must exceed the best: at three sigma of one number the data tell them apart."""

LISTED_GAP = 25.0
"""Cost up to which other minima are listed: with five stations a gap of less still misleads one fix in a thousand."""

P_SUSPECT = 1e-3
"""Probability of the chi-square test below which more is looked into: a better minimum, a constraint that is wrong."""

P_MISFIT = 1e-4
"""Probability of the chi-square test below which the noise does not allow the residuals: so rarely good data fail."""

P_OUTLIER = 0.01
"""Probability at which a search for suspects takes notice: of all groups of a long list together, and with redundancy
one, where an error shows but nobody can be named."""

REGION_LEVEL = 0.95
"""Level of the likelihood region that must not reach to infinity, with d degrees of freedom: what users ask for."""

FAR, FLAT = 1e4, 1e6
"""Spreads of the stations: from here on a fix must be a good one, and from there on every wave front is flat."""

SAME_PLACE = 1e-2
"""Squared distance in standard deviations below which two minima are one: a tenth of a sigma tells nobody anything."""

WEAK = 1e-12
"""Squared pivot of the scaled information below which a direction is open: rounding leaves 1e-13 of a zero."""

REJECTED = 0.25
"""Share of its weight below which a row that a loss doubts is called rejected: four sigma of the Cauchy loss."""

# Relative difference of costs that rounding, the refinement's tolerance and two ways to compute them leave: nothing
# beside the gap of 9 at which a second minimum matters.
_EQUAL = 1e-6


def equal_cost(cost: Any) -> Any:
    """Return how far from a cost, or from each of many, another counts as equal."""
    return _EQUAL * (1.0 + cost)
