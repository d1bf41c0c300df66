"""The thresholds of the verdict. They define the meaning of each status, so all of them are in this module."""

from __future__ import annotations

from typing import Any

AMBIGUOUS_GAP = 9.0
"""Cost by which another minimum must exceed the best: the data distinguish the two at three sigma of one number."""

LISTED_GAP = 25.0
"""Cost up to which other minima are listed: with five stations a smaller gap still misleads one fix in a thousand."""

P_SUSPECT = 1e-3
"""Probability of the chi-square test below which a search looks for a better minimum or a wrong constraint."""

P_MISFIT = 1e-4
"""Probability of the chi-square test below which the model is refuted: good data fail this rarely."""

P_OUTLIER = 0.01
"""Probability at which a search for suspects notices an error.

It applies to all groups of a long list together. It also applies at redundancy one, where an error can be noticed
but its row cannot be named.
"""

REGION_LEVEL = 0.95
"""Level of the likelihood region, with d degrees of freedom, that must not reach to infinity: users expect 95 %."""

FAR, FLAT = 1e4, 1e6
"""Distances in spreads of the stations: beyond FAR a fix must be good otherwise; beyond FLAT wave fronts are flat.
"""

SAME_PLACE = 1e-2
"""Squared distance in standard deviations below which two minima are one: a tenth of a sigma has no effect."""

WEAK = 1e-12
"""Squared pivot of the scaled information below which a direction is undetermined: rounding turns a zero into 1e-13."""

REJECTED = 0.25
"""Share of its weight below which a row under a robust loss counts as rejected: four sigma of the Cauchy loss."""

# Relative difference of costs that comes from rounding, from the tolerance of the refinement and from the order of
# operations. It is negligible against the gap of 9 at which a second minimum matters.
_EQUAL = 1e-6


def equal_cost(cost: Any) -> Any:
    """Return the largest difference at which another cost counts as equal to a cost, or to each of many costs.

    Smaller differences come from rounding.
    """
    return _EQUAL * (1.0 + cost)
