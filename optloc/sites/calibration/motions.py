"""Joint motions of a network: all stations move along the directions with the largest variance.

Letters: S estimates of all unknowns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.problem import Array
from optloc.sites.calibration.gauge import determined, shifted
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate

# Number of directions, and distances in standard deviations on both sides: other minima were 5 to 20 standard
# deviations away, in a curved valley.
_WEAK, _STEPS = 3, (6.0, 14.0)
# Standard deviation of the tether, as a share of the standard deviation of the direction. It fixes the
# direction to a tenth, but better determined directions can still move.
_TETHER = 0.3
# Refinement steps with the tether: the other unknowns follow approximately.
_SETTLING = 30
# Directions with a variance below this share of the largest count as exact.
_EXACT = 1e-9


def bent(lik: Likelihood, at: NetworkEstimate) -> tuple[NetworkEstimate, Array] | None:
    """Return the minima that moved networks reach, and their costs (S,); None if an open motion changes no row.

    `lik` is the likelihood of the network. Each copy of the network (`at`, S = 1) is moved along one direction of
    large variance. A tether is a prior with a small standard deviation. In a first refinement, it keeps the
    stations at their new positions, so that better determined directions adapt. A second refinement has no tether.
    """
    rank = determined(lik, at)
    if rank.open.shape[1]:
        return None
    width, axes = np.linalg.eigh(rank.covariance(rank.free.T))
    # Eigenvalues ascend, so the last directions have the largest variance. Each direction has a copy for each distance
    # and sign.
    weak = np.flatnonzero(width > _EXACT * width[-1])[-_WEAK:]
    deviation = np.repeat(np.sqrt(width[weak]), 2 * len(_STEPS))
    far = np.tile([*_STEPS, *(-step for step in _STEPS)], len(weak)) * deviation
    there = shifted(at, np.repeat(axes[:, weak].T, 2 * len(_STEPS), axis=0) * far[:, None])
    return lik.refine(replace(lik, tether=_TETHER * deviation).refine(there, _SETTLING)[0])
