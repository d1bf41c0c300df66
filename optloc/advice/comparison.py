"""One comparison of all explanations, in an order in which cheap fits exclude expensive ones.

An explanation whose least possible score exceeds the best score by the gap needs no fit: it can neither be given nor
listed. Its least score has the costs of rows that it does not affect, and the prices that are known before a fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from optloc.advice.change import Change, MisfitCase
from optloc.advice.explanation_table import EXPLANATIONS
from optloc.advice.fits import Fits, fit, in_base
from optloc.advice.scores import GAP, Scored, least_score, scored
from optloc.advice.suspects import Suspects
from optloc.base.types import Array

# Number of epochs in which changes without parameters are compared first. Their cost there bounds their cost in all.
_FIRST_EPOCHS = 2
# Largest number of readings of all values that are compared in all epochs.
_KEPT = 8

# A change with the price of its cause.
Offer = tuple[Change, float]


class Comparison:
    """The scores that are known, and the score from which an explanation is of no interest.

    Parameters
    ----------
    case : MisfitCase
        The problem.
    limit : float
        Score of the problem without a change.
    """

    def __init__(self, case: MisfitCase, limit: float) -> None:
        self.case, self.limit = case, limit
        self.found: list[Scored] = []

    def add(self, more: Iterable[Scored]) -> None:
        """Add explanations with their scores."""
        self.found += more
        self.limit = min([self.limit, *(one.score + GAP for one in self.found)])

    def open(self, offers: Sequence[Offer]) -> list[Offer]:
        """Return the changes whose least possible score is of interest."""
        return [(change, odds) for change, odds in offers if least_score(self.case, change, odds) < self.limit]

    def compare(self, offers: Sequence[Offer]) -> None:
        """Fit the changes that are of interest, and add their scores."""
        offers = self.open(offers)
        if offers:
            changes, odds = zip(*offers, strict=True)
            self.add(scored(self.case, changes, fit(self.case, changes), odds))


def compare_all(comparison: Comparison) -> None:
    """Compare all changes of all explanations."""
    case = comparison.case
    suspects = Suspects(case, comparison.limit)
    if suspects.fits is not None:
        price = EXPLANATIONS["offset"].price
        comparison.add(scored(case, suspects.offsets, suspects.fits, [price] * len(suspects.offsets)))
    fitted = {id(change) for change in suspects.offsets}
    offers = [(change, entry.price) for entry in EXPLANATIONS.values() for change in entry.changes(case, suspects)]
    left = [(change, odds) for change, odds in offers if id(change) not in fitted]
    own = [one for one in left if one[0].base is None]
    for change, odds in left:
        if change.base is not None and least_score(case, change, odds) < comparison.limit:
            other = in_base(case, change)
            comparison.add(scored(other, [change], fit(other, [change]), [odds]))
    comparison.compare([one for one in own if one[0].x is not None])
    rows = [one for one in own if one[0].x is None and one[0].members]
    for count in (1, 2):
        _compare_rows(comparison, [one for one in rows if len(one[0].members) == count])
    _compare_searched(comparison, [one for one in own if one[0].x is None and not one[0].members])


def _compare_rows(comparison: Comparison, offers: Sequence[Offer]) -> None:
    """Compare wrong rows by fits of the epochs of these rows: the others stay as they are."""
    case, offers = comparison.case, comparison.open(offers)
    if case.cost is None or len(case.times) == 1:
        comparison.compare(offers)
        return
    if not offers:
        return
    changes, odds = zip(*offers, strict=True)
    affected = np.any([column.coefficient != 0.0 for change in changes for column in change.columns], axis=(0, 2))
    some = np.flatnonzero(affected)
    part = fit(case.in_epochs(some), [change.in_epochs(some) for change in changes])
    x = np.repeat(case.x[None], len(changes), axis=0)
    cost = np.repeat(case.cost[None], len(changes), axis=0)
    x[:, some], cost[:, some] = part.x, part.cost
    comparison.add(scored(case, changes, Fits(x, part.theta, part.sigma, cost), odds))


def _compare_searched(comparison: Comparison, offers: Sequence[Offer]) -> None:
    """Compare changes that need a search, first in a few epochs."""
    case, offers = comparison.case, comparison.open(offers)
    if len(case.times) <= _FIRST_EPOCHS or not offers:
        comparison.compare(offers)
        return
    chosen = _telling_epochs(case)
    cost = fit(case.in_epochs(chosen), [change.in_epochs(chosen) for change, _ in offers]).cost.sum(-1)
    # a parameter that few epochs do not determine says nothing
    cost = np.where(np.isfinite(cost) | [not change.columns for change, _ in offers], cost, 0.0)
    least = [least_score(case, change, odds, cost[i]) for i, (change, odds) in enumerate(offers)]
    readings = [i for i in np.argsort(least, kind="stable") if not (offers[i][0].station or offers[i][0].columns)]
    dropped = set(readings[_KEPT:])
    comparison.compare([offers[i] for i in range(len(offers)) if least[i] < comparison.limit and i not in dropped])


def _telling_epochs(case: MisfitCase) -> Array:
    """Return the numbers of a few epochs in which a wrong change has a large cost."""
    cost = case.dof if case.cost is None else np.where(np.isfinite(case.cost), case.cost, np.inf)
    return np.lexsort((-case.dof, -cost))[:_FIRST_EPOCHS]
