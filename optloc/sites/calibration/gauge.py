"""What no measurement of a network tells: its frame, and the side of a plane in which stations or pulses are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from optloc.problem import Array, quantile
from optloc.sites.calibration.blocks import settled
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, together
from optloc.sites.calibration.network import Network
from optloc.solvers import AMBIGUOUS_GAP

# Singular values of scaled derivatives below this share of the largest are zeros: exact ones come out at 1e-15.
_ZERO = 1e-9
# Level at which points refute that they are in one plane: that of three sigma of a single number.
_LEVEL = 0.9973
# Share of the size by which what is known exactly may be missed: rounding of a refinement.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class GaugeRank:
    """What rows determine of stations and clocks at an estimate, pulses eliminated.

    Parameters
    ----------
    jacobian : array (q, P)
        Whitened derivatives by station coordinates and clocks, what pulses explain taken away.
    free : array (P, g)
        Orthonormal: moves of the whole network and of its clocks that no row sees, the frame.
    open : array (P, f)
        Orthonormal: other changes that no row sees.
    """

    jacobian: Array
    free: Array
    open: Array

    def covariance(self, fixed: Array) -> Array:
        """Return the covariance (P, P) in the frame in which `fixed` (g, P) times any change is zero."""
        p = self.jacobian.shape[1]
        moving = np.flatnonzero(np.abs(self.jacobian).max(axis=0) > 0.0)
        basis = np.eye(p)[:, moving]
        if len(fixed):
            within = np.linalg.svd(fixed[:, moving])[2][np.linalg.matrix_rank(fixed[:, moving]) :]
            basis = basis @ within.T
        triangle = np.linalg.qr(self.jacobian @ basis)[1]
        half = basis @ np.linalg.inv(triangle)
        return np.asarray(half @ half.T)


def determined(lik: Likelihood, at: NetworkEstimate) -> GaugeRank:
    """Return what the rows determine at an estimate (S = 1)."""
    p, jacobian = lik.free.size, without_pulses(lik, at)
    motions = frame_moves(lik.network, at)
    motions[~lik.free] = 0.0
    size = float(np.linalg.norm(jacobian, 2))
    free = _unseen(jacobian, _span(motions), size)
    rest = np.linalg.svd(free.T)[2][free.shape[1] :].T if free.shape[1] else np.eye(p)
    rest = rest[:, np.abs(rest[lik.free]).max(axis=0) > _ZERO]
    held = np.flatnonzero(~lik.free)
    rest = _span(rest - np.isin(np.arange(p), held)[:, None] * rest)
    return GaugeRank(jacobian, free, _unseen(jacobian, rest, size))


def without_pulses(lik: Likelihood, at: NetworkEstimate) -> Array:
    """Return a triangle (q, P) with the derivatives of an estimate (S = 1), what pulses explain taken away."""
    by_station, by_pulse, known = lik.jacobian(at)
    n, r, p = by_station.shape
    # a pulse far away has columns of very different lengths
    length = np.sqrt((by_pulse**2).sum(axis=1, keepdims=True))
    q, triangle = np.linalg.qr(by_pulse / np.where(length > 0.0, length, 1.0))
    pivot = np.abs(np.einsum("nii->ni", triangle))
    q = q * (pivot > _ZERO)[:, None]
    reduced = (by_station - q @ (np.swapaxes(q, 1, 2) @ by_station)).reshape(n * r, p)
    return np.asarray(np.linalg.qr(np.concatenate([reduced, known]), mode="r"))


# Deviations at which the cost is compared with that of a Gaussian: as of a fix.
_FAR = 3.0
# Share of that cost below which a rise counts as none.
_NONE = 1e-9


def departure(lik: Likelihood, at: NetworkEstimate, told: GaugeRank) -> float:
    """Return how far the cost departs from that of a Gaussian with the covariance found.

    Three deviations to either side along each principal axis of stations and clocks, the pulses wherever they then fit
    best: the largest ``|ln((f(x +- 3 t) - f(x)) / 9)|``, as of a fix (`optloc.model_checks.shape`).

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
        The one found, S = 1.
    told : GaugeRank
        What is determined there, nothing left open.
    """
    width, axes = np.linalg.eigh(told.covariance(told.free.T))
    far = (axes * (_FAR * np.sqrt(np.maximum(width, 0.0))))[:, width > _ZERO * width[-1]].T
    costs = lik.cost(together(at, settled(lik.network, shifted(at, np.concatenate([far, -far])))))
    rise = (costs[1:] - costs[0]) / _FAR**2
    return float(np.abs(np.log(np.maximum(rise, _NONE))).max())


def shifted(at: NetworkEstimate, moves: Array) -> NetworkEstimate:
    """Return an estimate (S = 1) with its stations, and clocks where these are sought, moved in several ways (n, P)."""
    there, size = at.take(np.zeros(len(moves), dtype=int)), at.stations[0].size
    stations = there.stations + moves[:, :size].reshape(there.stations.shape)
    clocks = there.clocks + moves[:, size:] if moves.shape[1] > size else there.clocks
    return replace(there, stations=stations, clocks=clocks)


def over(one: NetworkEstimate, at: NetworkEstimate) -> NetworkEstimate:
    """Return a network turned, and mirrored if need be, onto another's stations (Procrustes)."""
    a, b = one.stations[0], at.stations[0]
    u, _, v = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    turn = u @ v
    return replace(
        one,
        stations=(one.stations - a.mean(axis=0)) @ turn + b.mean(axis=0),
        pulses=(one.pulses - a.mean(axis=0)) @ turn + b.mean(axis=0),
    )


def _span(columns: Array) -> Array:
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > _ZERO * max(float(np.max(s, initial=0.0)), 1e-300)])


def _unseen(jacobian: Array, basis: Array, size: float) -> Array:
    """Return those directions of a subspace that a matrix takes to nothing."""
    if not basis.shape[1]:
        return basis
    _, s, turn = np.linalg.svd(jacobian @ basis, full_matrices=True)
    small = np.ones(basis.shape[1], dtype=bool)
    small[: len(s)] = s <= _ZERO * size
    return np.asarray(basis @ turn[small].T)


def frame_moves(net: Network, at: NetworkEstimate) -> Array:
    """Return columns (P, g): translations, rotations and, with clocks, the common offset of all."""
    m, d = net.stations, net.dimension
    p = m * d + (0 if net.synchronised else m)
    columns = []
    for c in range(d):
        column = np.zeros(p)
        column[c : m * d : d] = 1.0
        columns.append(column)
    for i in range(d):
        for k in range(i):
            turned = np.zeros((m, d))
            turned[:, i], turned[:, k] = at.stations[0, :, k], -at.stations[0, :, i]
            columns.append(np.concatenate([turned.ravel(), np.zeros(p - m * d)]))
    if not net.synchronised:
        columns.append(np.concatenate([np.zeros(m * d), np.ones(m)]))
    return np.array([c / max(float(np.linalg.norm(c)), 1e-300) for c in columns]).T


def in_frame(net: Network, at: NetworkEstimate, named: tuple[int, ...]) -> NetworkEstimate:
    """Return a free network in the frame of some stations, or of all.

    Parameters
    ----------
    net : Network
        What was measured.
    at : NetworkEstimate
        S = 1.
    named : tuple of int
        The first is the origin, the second lies on the first axis, the third in the plane of the first two (in space).
        Empty: the centroid is the origin, and the axes are the principal ones of the stations.

    Returns
    -------
    NetworkEstimate
        Of the two mirror images in space the one in which the station farthest from the plane of the first two axes is
        above it; in the plane likewise.
    """
    d = net.dimension
    stations = at.stations[0]
    if named:
        origin = stations[named[0]]
        basis = np.linalg.qr(np.array([stations[i] - origin for i in named[1:d]]).T, mode="complete")[0]
        for c, i in enumerate(named[1:d]):
            basis[:, c] *= 1.0 if basis[:, c] @ (stations[i] - origin) >= 0.0 else -1.0
        signed = [d - 1]
    else:
        origin = stations.mean(axis=0)
        basis = np.linalg.svd(stations - origin)[2].T
        signed = list(range(d))
    for c in signed:
        along = (stations - origin) @ basis[:, c]
        basis[:, c] *= 1.0 if along[np.abs(along).argmax()] >= 0.0 else -1.0
    moved = replace(at, stations=(at.stations - origin) @ basis, pulses=(at.pulses - origin) @ basis)
    return with_mean_clock(net, moved, named[:1])


def with_mean_clock(net: Network, at: NetworkEstimate, named: tuple[int, ...] = ()) -> NetworkEstimate:
    """Return a network whose clocks are told against that of a named station, or against their mean.

    Parameters
    ----------
    net : Network
        What was measured.
    at : NetworkEstimate
        S = 1.
    named : tuple of int
        The station, or empty.
    """
    if net.synchronised:
        return at
    offset = at.clocks[0, named[0]] if named else at.clocks[0].mean()
    return replace(at, clocks=at.clocks - offset, emission=at.emission + np.where(net.emission, offset, 0.0))


def fixed_by(net: Network, named: tuple[int, ...]) -> Array:
    """Return rows (g, P) that name the coordinates, and the clock, which named stations hold at zero."""
    m, d = net.stations, net.dimension
    p = m * d + (0 if net.synchronised else m)
    held = [named[c] * d + k for c in range(d) for k in range(d) if k >= c]
    if not net.synchronised:
        held.append(m * d + named[0])
    return np.eye(p)[held]


def flat(lik: Likelihood, at: NetworkEstimate, covariance: Array) -> list[str]:
    """Return what follows from stations, or pulses, in one plane, in sentences.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
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


def _of_pulses(lik: Likelihood, at: NetworkEstimate, covariance: Array, which: Array, normal: Array) -> Array:
    """Return the covariance (n, n) of the heights of some pulses: from their own rows, and from the stations."""
    by_station, by_pulse = (one[which] for one in lik.jacobian(at)[:2])
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
