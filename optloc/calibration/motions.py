"""Joint moves of a network: all stations bend along the directions of largest variance, and pulses follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.types import Array
from optloc.calibration.gauge import determined
from optloc.calibration.likelihood import Estimate, Likelihood

# Directions of largest variance, and standard deviations to either side: other minima were 5 to 20 deviations away, in
# a valley that is curved.
_WEAK, _STEPS = 3, (6.0, 14.0)
# Share of the largest variance below which a direction is exact.
_EXACT = 1e-9


def bent(lik: Likelihood, at: Estimate) -> tuple[Estimate, Array] | None:
    """Return the minima that bent networks lead to, and their costs.

    Each network is moved along one direction and refined while it is held there, so that all else follows. Then it is
    released and refined.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
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
    ahead = np.repeat(axes[:, weak].T, 2 * len(_STEPS), axis=0)
    far = np.tile([*_STEPS, *(-step for step in _STEPS)], len(weak))
    moves = ahead * (far * np.repeat(np.sqrt(width[weak]), 2 * len(_STEPS)))[:, None]
    m, d = lik.network.stations, lik.network.dimension
    there = at.take(np.zeros(len(moves), dtype=int))
    there = replace(there, stations=there.stations + moves[:, : m * d].reshape(-1, m, d))
    if not lik.network.synchronised:
        there = replace(there, clocks=there.clocks + moves[:, m * d :])
    held = replace(lik, hold=np.ascontiguousarray(ahead[:, None]))
    return lik.refine(held.refine(there)[0])
