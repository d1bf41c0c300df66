"""What no measurement of a network tells: its frame, and the side of a plane in which stations or pulses are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from optloc.base.types import Array
from optloc.calibration.likelihood import Estimate, Likelihood
from optloc.calibration.network import Network
from optloc.problem.chart import quantile
from optloc.solvers.policy import AMBIGUOUS_GAP

# Singular values of scaled derivatives below this share of the largest are zeros: exact ones come out at 1e-15.
_ZERO = 1e-9
# Level at which points refute that they are in one plane: that of three sigma of a single number.
_LEVEL = 0.9973
# Share of the size by which what is known exactly may be missed: rounding of a refinement.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class Determined:
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


def determined(lik: Likelihood, at: Estimate) -> Determined:
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
    return Determined(jacobian, free, _unseen(jacobian, rest, size))


def without_pulses(lik: Likelihood, at: Estimate) -> Array:
    """Return a triangle (q, P) with the derivatives of an estimate (S = 1), what pulses explain taken away."""
    by_station, by_pulse = (one[0] for one in lik.jacobian(at))
    n, r, p = by_station.shape
    # a pulse far away has columns of very different lengths
    length = np.sqrt((by_pulse**2).sum(axis=1, keepdims=True))
    q, triangle = np.linalg.qr(by_pulse / np.where(length > 0.0, length, 1.0))
    pivot = np.abs(np.einsum("nii->ni", triangle))
    q = q * (pivot > _ZERO)[:, None]
    reduced = (by_station - q @ (np.swapaxes(q, 1, 2) @ by_station)).reshape(n * r, p)
    return np.asarray(np.linalg.qr(np.concatenate([reduced, lik.known(at)[1][0]]), mode="r"))


# Repetitions of the measurement that a covariance is checked by: so few where there is hardly an excess, as of most
# networks of many stations; else so many at least, and at most, until they tell on which side of what is allowed it is.
_FEW, _NONE = 4, 0.05
_REPEATED, _MOST = 10, 60
# Deviations at which the cost is compared with that of a Gaussian, and steps in which pulses settle there.
_FAR, _SETTLING = 3.0, 6


def excess(lik: Likelihood, at: Estimate, told: Determined, allowed: float) -> float:
    """Return by what share squared errors, in the covariance that comes with them, exceed what it promises.

    The measurement is repeated, as if the network were the one found. Each repetition has an estimate and a covariance
    of its own; the squared error of the estimate in it (NEES) is compared with the cost of the network found, which is
    chi-square however curved the coordinates are. So the noise of few repetitions cancels, and what is left is what
    curvature does: places that the ellipsoid leaves out, and information that errors of the places feign.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        The one found, S = 1.
    told : Determined
        What is determined there, nothing left open.
    allowed : float
        The share that matters: repetitions end where they tell on which side of it the excess is.

    Returns
    -------
    float
        Mean of (NEES - chi-square), and two deviations of that mean, over the number of station unknowns: zero where
        all is linear.
    """
    net, rng = lik.network, np.random.default_rng(0)
    size = int(lik.free.sum()) - told.free.shape[1]
    sigma = np.where(net.given, net.sigma, 0.0)
    exact = np.where(net.given, net.z - lik.residual(at)[0] * sigma, 0.0)
    soft = np.where(np.isfinite(net.place_sigma) & (net.place_sigma > 0.0), net.place_sigma, 0.0)
    place = np.where(soft > 0.0, at.stations[0], net.place)
    apart = net.distance - lik.spans(at)[0][0] * net.distance_sigma
    over_by: list[float] = []
    while not _is_told(over_by, allowed):
        again = replace(
            net,
            z=exact + sigma * rng.standard_normal(sigma.shape),
            place=place + soft * rng.standard_normal(soft.shape),
            distance=apart + net.distance_sigma * rng.standard_normal(apart.shape),
        )
        own = replace(lik, network=again)
        found, cost = own.refine(at)
        truth = at if np.isfinite(net.place_sigma).any() else over(at, found)
        off = (truth.stations[0] - found.stations[0]).ravel()
        if not net.synchronised:
            off = np.concatenate([off, truth.clocks[0] - found.clocks[0]])
        held = replace(own, free=np.zeros_like(lik.free))
        squared = float(((without_pulses(own, found) @ off) ** 2).sum())
        over_by.append((squared - float((held.refine(at)[1] - cost)[0])) / max(size, 1))
    return sum(_mean(over_by))


def rise(lik: Likelihood, at: Estimate, told: Determined) -> float:
    """Return the least share that the cost rises by of what the covariance says, in any of its principal directions.

    Looked at three deviations to either side, as of a fix, the pulses wherever they then fit best. Where the network
    found happens to have more information than its neighbours, repetitions of it show nothing, and the cost does.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        The one found, S = 1.
    told : Determined
        What is determined there, nothing left open.
    """
    m, d = lik.network.stations, lik.network.dimension
    width, axes = np.linalg.eigh(told.covariance(told.free.T))
    far = (axes * (_FAR * np.sqrt(np.maximum(width, 0.0))))[:, width > _ZERO * width[-1]].T
    moves = np.concatenate([far, -far])
    s = len(moves)
    clocks = at.clocks if lik.network.synchronised else at.clocks + moves[:, m * d :]
    there = at.take(np.zeros(s, dtype=int))
    stations = at.stations + moves[:, : m * d].reshape(s, m, d)
    there = replace(there, stations=stations, clocks=np.broadcast_to(clocks, (s, m)))
    held = replace(lik, free=np.zeros_like(lik.free))
    return float((held.refine(there, _SETTLING)[1].min() - lik.cost(at)[0]) / _FAR**2)


def thinness(lik: Likelihood, at: Estimate, told: Determined) -> tuple[float, float]:
    """Return how unsure the shape of a free network is, and how thick the network is.

    Errors of a share of the thickness turn lines between stations by as many radians, and what is turned is not linear.
    Neither the cost at the network found nor repetitions of it show that where the thickness itself is an error.

    Parameters
    ----------
    lik : Likelihood
        The network.
    at : Estimate
        The one found, S = 1.
    told : Determined
        What is determined there, nothing left open.

    Returns
    -------
    deviation : float
        Standard deviation of all stations together along the weakest direction, metres; zero where places are known.
    thickness : float
        Root mean square of the stations' distances from their best plane (line in two dimensions), metres.
    """
    m, d = lik.network.stations, lik.network.dimension
    if m <= d or np.isfinite(lik.network.place_sigma).any():
        return 0.0, 0.0
    width = np.linalg.eigvalsh(told.covariance(told.free.T)[: m * d, : m * d])
    centred = at.stations[0] - at.stations[0].mean(axis=0)
    return float(np.sqrt(width[-1])), float(np.linalg.svd(centred, compute_uv=False)[-1] / np.sqrt(m))


def _is_told(over_by: list[float], allowed: float) -> bool:
    """Return whether repetitions tell on which side of a bound their mean is, or are many enough."""
    if len(over_by) < _FEW:
        return False
    mean, error = _mean(over_by)
    enough = len(over_by) >= _REPEATED and not mean - error <= allowed < mean + error
    return len(over_by) >= _MOST or enough or mean + error <= min(_NONE, allowed)


def _mean(values: list[float]) -> tuple[float, float]:
    """Return a mean and two of its deviations."""
    return float(np.mean(values)), float(2.0 * np.std(values, ddof=1) / np.sqrt(len(values)))


def over(one: Estimate, at: Estimate) -> Estimate:
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


def frame_moves(net: Network, at: Estimate) -> Array:
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


def in_frame(net: Network, at: Estimate, named: tuple[int, ...]) -> Estimate:
    """Return a free network in the frame of some stations, or of all.

    Parameters
    ----------
    net : Network
        What was measured.
    at : Estimate
        S = 1.
    named : tuple of int
        The first is the origin, the second lies on the first axis, the third in the plane of the first two (in space).
        Empty: the centroid is the origin, and the axes are the principal ones of the stations.

    Returns
    -------
    Estimate
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


def with_mean_clock(net: Network, at: Estimate, named: tuple[int, ...] = ()) -> Estimate:
    """Return a network whose clocks are told against that of a named station, or against their mean.

    Parameters
    ----------
    net : Network
        What was measured.
    at : Estimate
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
