"""The gauge freedom of a network: its frame, and mirror images if stations or pulses are in one plane.

Rows between stations and pulses do not change if the whole network moves, turns or is mirrored. This
module finds these motions, and other open motions, at an estimate. It also sets the frame of the result.

Letters: M stations, N pulses, d coordinates, S estimates. P is the number of station unknowns: M d
coordinates, then M clocks if the stations do not share a clock. All of them are in metres. A motion is a
direction (P,) of change. The frame has g motions, and f is the number of other open motions.

Arguments of many functions: `net` is the network, `lik` is its likelihood, and `at` is one estimate of
all unknowns (S = 1).
"""

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

# Singular values below this share of the largest count as zero; exact zeros have a rounding error of 1e-15.
_ZERO = 1e-9
# Probability level of the test for points in one plane: three standard deviations of a single number.
_LEVEL = 0.9973
# Tolerance of exact knowledge, as a share of the network size: the rounding error of a refinement.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class GaugeRank:
    """Motions of stations and clocks that the rows determine at an estimate, after elimination of the pulses.

    Parameters
    ----------
    jacobian : array (q, P)
        Whitened derivatives by station coordinates and clocks, without the part that pulses explain, 1 / m.
    free : array (P, g)
        Orthonormal basis of the frame: motions of the whole network and of all clocks that change no row.
    open : array (P, f)
        Orthonormal basis of the other motions that change no row; f > 0 means that the geometry is singular.
    """

    jacobian: Array
    free: Array
    open: Array

    def covariance(self, fixed: Array) -> Array:
        """Return the covariance (P, P), m^2, of stations and clocks in a frame.

        The frame is defined by `fixed` (g, P): `fixed` times each change of the unknowns is zero.
        """
        p = self.jacobian.shape[1]
        # Unknowns that change no row (exact coordinates) get the covariance zero. `basis` spans the changes that the
        # frame allows: the null space of `fixed`.
        moving = np.flatnonzero(np.abs(self.jacobian).max(axis=0) > 0.0)
        basis = np.eye(p)[:, moving]
        if len(fixed):
            within = np.linalg.svd(fixed[:, moving])[2][np.linalg.matrix_rank(fixed[:, moving]) :]
            basis = basis @ within.T
        # With the triangle R of the QR factors, the covariance is (R'R)^-1 in this basis.
        triangle = np.linalg.qr(self.jacobian @ basis)[1]
        half = basis @ np.linalg.inv(triangle)
        return np.asarray(half @ half.T)


def determined(lik: Likelihood, at: NetworkEstimate) -> GaugeRank:
    """Return the determined, free and open motions at an estimate (S = 1): how far the rows fix stations and clocks."""
    p, jacobian = lik.free.size, without_pulses(lik, at)
    # Exact coordinates do not move. A motion of the frame is free only if it changes no row.
    motions = frame_moves(lik.network, at)
    motions[~lik.free] = 0.0
    size = float(np.linalg.norm(jacobian, 2))
    free = _null_space(jacobian, _span(motions), size)
    # `rest` are the other motions: the complement of the free ones, without motions of exact coordinates.
    rest = np.linalg.svd(free.T)[2][free.shape[1] :].T if free.shape[1] else np.eye(p)
    rest = rest[:, np.abs(rest[lik.free]).max(axis=0) > _ZERO]
    exact = np.flatnonzero(~lik.free)
    rest = _span(rest - np.isin(np.arange(p), exact)[:, None] * rest)
    return GaugeRank(jacobian, free, _null_space(jacobian, rest, size))


def without_pulses(lik: Likelihood, at: NetworkEstimate) -> Array:
    """Return a triangle (q, P): the whitened derivatives at an estimate (S = 1) after elimination of the pulses.

    Its normal matrix is the information about stations and clocks if the pulses are unknown.
    """
    by_station, by_pulse, known = lik.jacobian(at)
    n, r, p = by_station.shape
    # the columns of a distant pulse have different lengths, so scale them first
    length = np.sqrt((by_pulse**2).sum(axis=1, keepdims=True))
    # Project out the part of the rows that each pulse explains; columns with a zero pivot explain nothing.
    q, triangle = np.linalg.qr(by_pulse / np.where(length > 0.0, length, 1.0))
    pivot = np.abs(np.einsum("nii->ni", triangle))
    q = q * (pivot > _ZERO)[:, None]
    reduced = (by_station - q @ (np.swapaxes(q, 1, 2) @ by_station)).reshape(n * r, p)
    return np.asarray(np.linalg.qr(np.concatenate([reduced, known]), mode="r"))


# Distance in standard deviations at which the cost is compared with the Gaussian cost, as for a fix.
_FAR = 3.0
# Smallest rise of the cost, as a share of the Gaussian rise: smaller rises count as this one, so that the
# logarithm exists.
_NONE = 1e-9


def departure(lik: Likelihood, at: NetworkEstimate, rank: GaugeRank) -> float:
    """Return the largest deviation of the cost from the Gaussian cost, as the logarithm of their ratio.

    A large number means that the covariance is not valid. The test points are three standard deviations away,
    on both sides of each principal axis of stations and clocks. The pulses are refitted at each test point.
    The result is the largest ``|ln((f(x +- 3 t) - f(x)) / 9)|``, as for a fix (`optloc.model_checks.shape`);
    f is the cost and t is one standard deviation along the axis. `at` (S = 1) is the estimate. `rank`
    contains its determined motions; there must be no open motion.
    """
    # `far` are moves of three standard deviations along the principal axes that have a variance.
    width, axes = np.linalg.eigh(rank.covariance(rank.free.T))
    far = (axes * (_FAR * np.sqrt(np.maximum(width, 0.0))))[:, width > _ZERO * width[-1]].T
    costs = lik.cost(together(at, settled(lik.network, shifted(at, np.concatenate([far, -far])))))
    rise = (costs[1:] - costs[0]) / _FAR**2
    return float(np.abs(np.log(np.maximum(rise, _NONE))).max())


def shifted(at: NetworkEstimate, moves: Array) -> NetworkEstimate:
    """Return n copies of an estimate (S = 1), with stations and unknown clocks moved by `moves` (n, P), metres."""
    there, size = at.take(np.zeros(len(moves), dtype=int)), at.stations[0].size
    stations = there.stations + moves[:, :size].reshape(there.stations.shape)
    clocks = there.clocks + moves[:, size:] if moves.shape[1] > size else there.clocks
    return replace(there, stations=stations, clocks=clocks)


def over(one: NetworkEstimate, at: NetworkEstimate) -> NetworkEstimate:
    """Return network `one` (S = 1) rotated, and mirrored if needed, onto the stations of network `at` (Procrustes).

    Then the positions of two free networks can be compared.
    """
    a, b = one.stations[0], at.stations[0]
    # The orthogonal matrix nearest to the correlation of the centred stations; it may mirror.
    u, _, v = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    turn = u @ v
    return replace(
        one,
        stations=(one.stations - a.mean(axis=0)) @ turn + b.mean(axis=0),
        pulses=(one.pulses - a.mean(axis=0)) @ turn + b.mean(axis=0),
    )


def is_mirror_image(one: NetworkEstimate, at: NetworkEstimate, tolerance: float) -> bool:
    """Return whether network `one` is the mirror image of network `at` (S = 1 each), up to a motion in space.

    All distances of stations and pulses to stations agree within `tolerance`, m, and no rotation maps one to the other.
    """
    a, b = (np.concatenate([each.stations[0], each.pulses[0]]) for each in (one, at))
    m = at.stations.shape[1]
    apart = [np.linalg.norm(points[:, None] - points[None, :m], axis=-1) for points in (a, b)]
    if np.abs(apart[0] - apart[1]).max() > tolerance:
        return False
    u, _, v = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    return bool(np.linalg.det(u @ v) < 0.0)


def _span(columns: Array) -> Array:
    """Return an orthonormal basis (P, g) of the space of the columns (P, k)."""
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > _ZERO * max(float(np.max(s, initial=0.0)), 1e-300)])


def _null_space(jacobian: Array, basis: Array, size: float) -> Array:
    """Return a basis (P, f) of the directions in a subspace that a matrix maps to zero.

    The matrix is `jacobian` (q, P), and `basis` (P, k) spans the subspace. A singular value of at most `_ZERO`
    times `size`, the norm of the matrix, is zero.
    """
    if not basis.shape[1]:
        return basis
    _, s, turn = np.linalg.svd(jacobian @ basis, full_matrices=True)
    small = np.ones(basis.shape[1], dtype=bool)
    small[: len(s)] = s <= _ZERO * size
    return np.asarray(basis @ turn[small].T)


def frame_moves(net: Network, at: NetworkEstimate) -> Array:
    """Return the motions of the frame as columns (P, g): translations, rotations and a common clock offset.

    Each column has length 1. `at` is one estimate, S = 1.
    """
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
    """Return a free network in the frame of the named stations, or of all stations.

    Parameters
    ----------
    net : Network
        Measurements and prior knowledge.
    at : NetworkEstimate
        The estimate, S = 1.
    named : tuple of int
        Stations of the frame: the first is the origin, the second is on the first axis, the third (in space) is
        in the plane of the first two axes. Empty: the origin is the centroid of all stations, and the axes are
        their principal axes.

    Returns
    -------
    NetworkEstimate
        One of the two mirror images: the station that is farthest from the plane of the first two axes is above
        this plane. In two dimensions, the same applies to the first axis. Without named stations, the station that
        is farthest from the origin along an axis has a positive coordinate there.
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
    """Return a network with clocks relative to the clock of the named station, or relative to their mean.

    `at` is an estimate (S = 1); `named` is one station or empty.
    """
    if net.synchronised:
        return at
    offset = at.clocks[0, named[0]] if named else at.clocks[0].mean()
    return replace(at, clocks=at.clocks - offset, emission=at.emission + np.where(net.emission, offset, 0.0))


def fixed_by(net: Network, named: tuple[int, ...]) -> Array:
    """Return a selection matrix (g, P) of the coordinates and the clock that the named stations fix at zero.

    It is the argument of `GaugeRank.covariance`. `named` are the numbers of d stations.
    """
    m, d = net.stations, net.dimension
    p = m * d + (0 if net.synchronised else m)
    indices = [named[c] * d + k for c in range(d) for k in range(d) if k >= c]
    if not net.synchronised:
        indices.append(m * d + named[0])
    return np.eye(p)[indices]


def flat(lik: Likelihood, at: NetworkEstimate, covariance: Array) -> list[str]:
    """Return a sentence for each mirror ambiguity that follows from stations, or pulses, in one plane.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : NetworkEstimate
        Its minimum, S = 1.
    covariance : array (P, P)
        Covariance of station coordinates and clocks, metres squared, in any frame.

    Returns
    -------
    list of str
        Empty without a common plane, or if prior knowledge of the stations decides the side.
    """
    net, out = lik.network, list[str]()
    if np.isfinite(net.place_sigma).all():
        return out
    m, d = net.stations, net.dimension
    places = covariance[: m * d, : m * d].reshape(m, d, m, d)
    if _in_one_plane(at.stations[0], lambda normal: np.einsum("c,icje,e->ij", normal, places, normal)):
        out.append(
            "The stations are in one plane within their errors: the data do not show on which side the pulses are; "
            "add a station off it."
        )
    placed = np.flatnonzero(net.given.sum(axis=1) > d)
    pulses = at.pulses[0, placed]
    if _in_one_plane(
        pulses, lambda normal: _height_covariance(lik, at, covariance, placed, normal)
    ) and _may_be_mirrored(net, at.stations[0], pulses):
        out.append(
            "The pulses are in one plane within their errors: the data do not show on which side the stations are; "
            "add a pulse off it."
        )
    return out


def _in_one_plane(points: Array, covariance: Callable[[Array], Array]) -> bool:
    """Return whether points (m, d) are in one plane within their errors, at the probability level `_LEVEL`.

    `covariance` returns the covariance (m, m), m^2, of the heights of the points along a normal (d,).
    """
    m, d = points.shape
    if m <= d:
        return True
    centred = points - points.mean(axis=0)
    turn = np.linalg.svd(centred)[2]
    # Remove the part of the heights that another plane explains: the covariance of the rest is the same in every
    # frame.
    left = np.linalg.svd(np.column_stack([np.ones(m), centred @ turn[:-1].T]).T)[2][d:]
    height = left @ (centred @ turn[-1])
    spread = left @ covariance(turn[-1]) @ left.T
    return bool(height @ np.linalg.pinv(spread, hermitian=True) @ height < quantile(_LEVEL, len(left)))


def _height_covariance(lik: Likelihood, at: NetworkEstimate, covariance: Array, which: Array, normal: Array) -> Array:
    """Return the covariance (n, n) of the heights of pulses, m^2: from the noise of their rows, and from the stations.

    The heights are coordinates along `normal` (d,). `which` (n,) are the numbers of the pulses, and `at` is
    one estimate (S = 1). `covariance` (P, P), m^2, belongs to stations and clocks.
    """
    by_station, by_pulse = (one[which] for one in lik.jacobian(at)[:2])
    height_slopes = np.einsum("c,jcr->jr", normal, np.linalg.pinv(by_pulse)[:, : len(normal)])
    along = np.einsum("jr,jrp->jp", height_slopes, by_station)
    # The two parts are independent: the station covariance comes from the part of the rows that pulses do not
    # explain.
    return np.asarray(np.diag((height_slopes**2).sum(axis=1)) + along @ covariance @ along.T)


def _may_be_mirrored(net: Network, stations: Array, pulses: Array) -> bool:
    """Return whether prior places and distances allow stations (m, d) to be mirrored in the plane of the pulses.

    `pulses` (n, d) are positions in one plane. Stations with measured distances between them are mirrored
    together. If all stations are mirrored, the result is the mirror image of the whole network, which is the
    same network.
    """
    middle = pulses.mean(axis=0)
    normal = np.linalg.svd(pulses - middle)[2][-1]
    there = stations - 2.0 * ((stations - middle) @ normal)[:, None] * normal
    linked = np.zeros((net.stations, net.stations))
    linked[tuple(net.between.T)] = 1.0
    count, group = connected_components(linked, directed=False)
    known = np.isfinite(net.place_sigma)
    sigma = np.maximum(net.place_sigma, _ROUNDING * float(np.ptp(stations)))
    cost_mirrored, cost_present = ((np.where(known, x - net.place, 0.0) / sigma) ** 2 for x in (there, stations))
    extra_cost = np.bincount(group, (cost_mirrored - cost_present).sum(axis=1), count)
    return count > 1 and bool((extra_cost < AMBIGUOUS_GAP).any())


def spans(stations: Array) -> tuple[Array, Array, Array]:
    """Return all pairs of stations (q, 2), their distances (q,), metres, and the derivatives of these (q, M d)."""
    m, d = stations.shape
    pairs = np.array([(i, k) for i in range(m) for k in range(i)], dtype=int).reshape(-1, 2)
    line = stations[pairs[:, 0]] - stations[pairs[:, 1]]
    length = np.linalg.norm(line, axis=1)
    unit = line / np.maximum(length, 1e-300)[:, None]
    jacobian = np.zeros((len(pairs), m, d))
    every = np.arange(len(pairs))
    jacobian[every, pairs[:, 0]], jacobian[every, pairs[:, 1]] = unit, -unit
    return pairs, length, jacobian.reshape(len(pairs), m * d)
