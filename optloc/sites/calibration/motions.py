"""Joint moves of a network: all stations bend along the directions of largest variance, and pulses follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.problem import Array
from optloc.sites.calibration.gauge import determined, shifted
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate

# Directions of largest variance, and standard deviations to either side: other minima were 5 to 20 deviations away, in
# a valley that is curved.
_WEAK, _STEPS = 3, (6.0, 14.0)
# Deviation of the tether, as a share of that of the direction: it holds the direction to a tenth, and gives way to
# those that are better determined.
_TETHER = 0.3
# Steps with a tether: the rest follows roughly.
_SETTLING = 30
# Share of the largest variance below which a direction is exact.
_EXACT = 1e-9


def bent(lik: Likelihood, at: NetworkEstimate) -> tuple[NetworkEstimate, Array] | None:
    """Return the minima that bent networks lead to, and their costs.

    Each network is moved along one direction and refined while its stations are tethered there, so that the directions
    that rows determine better follow. Then it is released and refined.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
        A minimum, S = 1.

    Returns
    -------
    tuple of Estimate and array (S,), or None
        None where some motion of the network changes no row.
    """
    told = determined(lik, at)
    if told.open.shape[1]:
        return None
    width, axes = np.linalg.eigh(told.covariance(told.free.T))
    weak = np.flatnonzero(width > _EXACT * width[-1])[-_WEAK:]
    deviation = np.repeat(np.sqrt(width[weak]), 2 * len(_STEPS))
    far = np.tile([*_STEPS, *(-step for step in _STEPS)], len(weak)) * deviation
    there = shifted(at, np.repeat(axes[:, weak].T, 2 * len(_STEPS), axis=0) * far[:, None])
    return lik.refine(replace(lik, tether=_TETHER * deviation).refine(there, _SETTLING)[0])
