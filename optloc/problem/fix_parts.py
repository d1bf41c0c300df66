"""Parts of a fix: the steps of its computation, active constraints, and other positions that fit the data.

Letters: size of the parameter vector, q number of the other minima. Leading axes `...` count the fixes of a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from optloc.base.records import Axes
from optloc.base.types import Array


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the computation of a fix.

    Parameters
    ----------
    name : str
        Method, for instance "gtrs" or "lsr".
    detail : str
        Summary of the step in a few words.
    seconds : float
        Wall-clock time for the whole batch.
    """

    name: str
    detail: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Active:
    """A constraint that is active: the fix meets it with equality.

    Parameters
    ----------
    name : str
        Name of the constraint and its side, for instance "height upper".
    multiplier : float
        Lagrange multiplier, in cost per SI unit of the constrained quantity: positive at an upper bound, negative at a
        lower bound. The gradient of the cost plus the sum of all multipliers times their gradients is zero.
    """

    name: str
    multiplier: float


@dataclass(frozen=True, slots=True)
class Alternatives:
    """Other minima of the cost, sorted by cost.

    Parameters
    ----------
    x : array (..., q, size)
        Parameter vectors; NaN in unused entries.
    gap : array (..., q)
        Cost of each minimum minus the cost of the fix; infinite in unused entries.
    """

    x: Annotated[Array, Axes(2, slots=True)]
    gap: Annotated[Array, Axes(1, slots=True, empty=np.inf)]

    @property
    def doubt(self) -> Array:
        """Return the probability (..., q) that the alternative is correct, given that either it or the fix is correct.

        Both have the same prior probability, and the likelihood of each is proportional to exp(-cost / 2).
        """
        from scipy.special import expit

        return np.asarray(expit(-0.5 * self.gap))
