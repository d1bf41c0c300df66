"""Gates: which rows of a scan can be those of a predicted state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc import noise as noises
from optloc.errors import InvalidProblem
from optloc.linear import linearise
from optloc.problem import Problem
from optloc.track.track import filter_of
from optloc.track.updates import Update, Updated
from optloc.types import Array
from optloc.weigh import weighed


@dataclass(frozen=True, slots=True)
class Innovation:
    """What a scan measures less what a predicted state lets expect.

    Parameters
    ----------
    value : array (..., m)
        z - h(x) of each row in its SI unit, angles wrapped; zero for absent rows.
    covariance : array (..., m, m)
        S = H P H' + R.
    """

    value: Array
    covariance: Array

    @property
    def normalised(self) -> Array:
        """Return each row's innovation in units of its own standard deviation, (..., m)."""
        return np.asarray(self.value / np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))


def innovation(scan: Problem, mean: Array, cov: Array) -> Innovation:
    """Return the innovation of every row of a scan.

    Parameters
    ----------
    scan : Problem
        A problem of one epoch whose only unknown is the state.
    mean : array (..., n)
        Predicted states.
    cov : array (..., n, n)
        Their covariances.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), eq.
    5.2.3-9.
    """
    linear = linearise(scan, mean)
    H = linear.shared
    R = noises.dense(weighed(scan, mean).noise, np.arange(scan.count))
    return Innovation(linear.residual, H @ cov @ np.swapaxes(H, -1, -2) + R)


def gated(update: Update | str, width: float = 5.0) -> Update:
    """Return a filter that leaves out the rows whose innovation is too large to be true.

    Parameters
    ----------
    update : callable or str
        The filter, or its name in `UPDATES`.
    width : float
        Half width of the gate in standard deviations of each row's innovation, prediction included.

    Returns
    -------
    callable
        A filter; `Updated.count` tells how many rows passed.

    Raises
    ------
    InvalidProblem
        For an unknown filter or a width that is not positive.
    """
    rule = filter_of(update)
    check_width(width)

    def gate(scan: Problem, mean: Array, cov: Array) -> Updated:
        inside = np.abs(innovation(scan, mean, cov).normalised) <= width
        return rule(scan.with_rows(weight=scan.weight * inside), mean, cov)

    return gate


def check_width(width: float) -> None:
    """Refuse a gate that is not open; raise InvalidProblem."""
    if not width > 0.0:
        raise InvalidProblem(f"the gate is {width} wide", "width", "give a number of standard deviations above 0")
