"""Stations or pulses in one plane: what stands beside the plane has a mirror image that fits as well."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse.csgraph import connected_components

from optloc.base.types import Array
from optloc.calibration.likelihood import Estimate, Likelihood
from optloc.calibration.network import Network
from optloc.problem.chart import quantile
from optloc.solvers.policy import AMBIGUOUS_GAP

# Level at which points refute that they are in one plane: that of three sigma of a single number.
_LEVEL = 0.9973
# Share of the size by which what is known exactly may be missed: rounding of a refinement.
_ROUNDING = 1e-6


def flat(lik: Likelihood, at: Estimate, covariance: Array) -> list[str]:
    """Return what follows from stations, or pulses, in one plane, in sentences.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        Its minimum, S = 1.
    covariance : array (P, P)
        Of station coordinates and clocks, in any frame.

    Returns
    -------
    list of str
        Empty where nothing is in a plane, or what is known of the stations says on which side all are.
    """
    net, out = lik.network, list[str]()
    if np.isfinite(net.place_sigma).all():
        return out
    m, d = net.stations, net.dimension
    places = covariance[: m * d, : m * d].reshape(m, d, m, d)
    if _in_one_plane(at.stations[0], lambda normal: np.einsum("c,icje,e->ij", normal, places, normal)):
        out.append("The stations are in one plane as far as the data tell: which side of it pulses are on is open.")
    placed = np.flatnonzero(net.given.sum(axis=1) > d)
    pulses = at.pulses[0, placed]
    if _in_one_plane(pulses, lambda normal: _of_pulses(lik, at, covariance, placed, normal)) and _may_be_mirrored(
        net, at.stations[0], pulses
    ):
        out.append("The pulses are in one plane as far as the data tell: which side of it stations are on is open.")
    return out


def _in_one_plane(points: Array, covariance: Callable[[Array], Array]) -> bool:
    """Return whether points (m, d) are in one plane, by the covariance (m, m) of their heights along a normal."""
    m, d = points.shape
    if m <= d:
        return True
    centred = points - points.mean(axis=0)
    turn = np.linalg.svd(centred)[2]
    # of heights above the best plane what no other plane explains: its covariance is the same in every frame
    left = np.linalg.svd(np.column_stack([np.ones(m), centred @ turn[:-1].T]).T)[2][d:]
    height = left @ (centred @ turn[-1])
    spread = left @ covariance(turn[-1]) @ left.T
    return bool(height @ np.linalg.pinv(spread, hermitian=True) @ height < quantile(_LEVEL, len(left)))


def _of_pulses(lik: Likelihood, at: Estimate, covariance: Array, which: Array, normal: Array) -> Array:
    """Return the covariance (n, n) of the heights of some pulses: from their own rows, and from the stations."""
    by_station, by_pulse = (one[0, which] for one in lik.jacobian(at))
    own = np.einsum("c,jcr->jr", normal, np.linalg.pinv(by_pulse)[:, : len(normal)])
    along = np.einsum("jr,jrp->jp", own, by_station)
    # a pulse's own errors and those of the stations have nothing in common: these come from what pulses leave over
    return np.asarray(np.diag((own**2).sum(axis=1)) + along @ covariance @ along.T)


def _may_be_mirrored(net: Network, stations: Array, pulses: Array) -> bool:
    """Return whether what is known of places and distances lets stations (m, d) change sides of the pulses' plane.

    Stations whose distances were measured change together; all at once is the mirror image of the whole network.
    """
    middle = pulses.mean(axis=0)
    normal = np.linalg.svd(pulses - middle)[2][-1]
    there = stations - 2.0 * ((stations - middle) @ normal)[:, None] * normal
    linked = np.zeros((net.stations, net.stations))
    linked[tuple(net.between.T)] = 1.0
    count, group = connected_components(linked, directed=False)
    known = np.isfinite(net.place_sigma)
    sigma = np.maximum(net.place_sigma, _ROUNDING * float(np.ptp(stations)))
    off, now = ((np.where(known, x - net.place, 0.0) / sigma) ** 2 for x in (there, stations))
    dearer = np.bincount(group, (off - now).sum(axis=1), count)
    return count > 1 and bool((dearer < AMBIGUOUS_GAP).any())
