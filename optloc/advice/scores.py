"""One score for all explanations of a misfit: -2 log likelihood of the recorded data, plus stated prices.

The score of a change is the sum of four parts. Its cost is the least chi-square with the change. Its spread is
``2 log`` of the factors by which the change enlarges the noise: values that are multiplied by c have noise that is
multiplied by c, and the density of the values as recorded then stays comparable. Its parameters and its choices have
prices. Smaller scores are better, and a difference of 9 is three sigma of one number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.advice.change import Change, MisfitCase
from optloc.advice.fits import Fits
from optloc.base.types import Array
from optloc.problem.chart import tail_probability

GAP = 9.0
"""Difference of scores at which one explanation excludes another: three sigma of one number."""

# Prior of the size of an error: uniform in its logarithm, over four decades and both signs. The density at the size t,
# in sigmas, is 1 / (2 ln(1e4) t), and the likelihood integrates to sqrt(2 pi).
_DENSITY = 2.0 * np.log(1e4) / np.sqrt(2.0 * np.pi)
# Smallest size that has a separate price: smaller errors are not distinguished from none.
_LEAST = 3.0
# Prior spread of the logarithm of a wrong noise level: a factor of four and a half is one sigma.
_LEVEL = 1.5


@dataclass(frozen=True, slots=True)
class Scored:
    """An explanation with its score.

    Parameters
    ----------
    change : Change
        The change.
    theta, sigma : array (q,)
        Estimates of its parameters, and standard deviations.
    cost : float
        Chi-square after the change.
    dof : int
        Degrees of freedom after the change.
    score : float
        Cost plus prices.
    x : array (K, size)
        Unknowns after the change.
    case : MisfitCase
        The epochs that are explained.
    """

    change: Change
    theta: Array
    sigma: Array
    cost: float
    dof: int
    score: float
    x: Array
    case: MisfitCase

    @property
    def p(self) -> float:
        """Return the probability of a larger chi-square after the change."""
        return float(tail_probability(np.array([self.cost]), np.array([self.dof]))[0]) if self.dof > 0 else np.nan


def price_of_parameters(theta: Array, sigma: Array) -> float:
    """Return the price of the estimated parameters (q,): 2 log of the prior range over the posterior width."""
    size = np.maximum(np.abs(theta) / np.maximum(sigma, 1e-300), _LEAST)
    return float((2.0 * np.log(_DENSITY * size)).sum())


def price_of_level(factor: float, dof: float) -> float:
    """Return the price of a noise level that is `factor` times the stated one, estimated from `dof` numbers."""
    return float((np.log(factor) / _LEVEL) ** 2 + np.log1p(2.0 * max(dof, 0.0) * _LEVEL**2))


def score_of_level(cost: float, dof: int) -> float:
    """Return the score of the explanation that all noise is understated by one factor."""
    if dof < 1 or cost <= dof:
        return cost
    return dof * (1.0 + float(np.log(cost / dof))) + price_of_level(float(np.sqrt(cost / dof)), dof)


def least_score(case: MisfitCase, change: Change, odds: float, cost: float = 0.0) -> float:
    """Return a score that a change has at least; `cost` is a cost that it has at least, as far as it is known."""
    parameters = price_of_parameters(np.zeros(change.size(case.base.dimension)), np.ones(1))
    return max(cost, change.least) + _price_of_change(case, change, odds) + parameters


def _price_of_change(case: MisfitCase, change: Change, odds: float) -> float:
    """Return the part of a score that is known before a fit: of the cause, the choice and the noise."""
    spread = np.broadcast_to(change.spread, case.present.shape)
    enlarged = 2.0 * float(np.log(spread)[case.present].sum())
    if change.levels:
        # part of the rows is used up by the unknowns
        inside = int((np.broadcast_to(change.spread != 1.0, case.present.shape) & case.present).sum())
        share = max(float(case.dof.sum()), 1.0) / max(int(case.present.sum()), 1)
        enlarged = enlarged * share + price_of_level(float(spread.max()), inside * share)
    more = change.extra * price_of_parameters(np.array([30.0]), np.ones(1))
    return odds + 2.0 * float(np.log(change.alternatives)) + more + enlarged


def scored(case: MisfitCase, changes: Sequence[Change], fits: Fits, odds: Sequence[float]) -> list[Scored]:
    """Return the scores of fitted changes, without those that fit no determined position or have impossible estimates.

    `odds` (E,) are the prices of the causes.
    """
    out = []
    for e, change in enumerate(changes):
        cost, q = float(fits.cost[e].sum()), change.size(case.base.dimension)
        dof = int(case.dof.sum()) - q - change.extra
        if not np.isfinite(cost) or dof < 0:
            continue
        theta, sigma = fits.theta[e, :q], fits.sigma[e, :q]
        if change.admits is not None and not change.admits(theta):
            continue
        score = cost + _price_of_change(case, change, odds[e]) + price_of_parameters(theta, sigma)
        out.append(Scored(change, theta, sigma, cost, dof, score, fits.x[e], case))
    return out
