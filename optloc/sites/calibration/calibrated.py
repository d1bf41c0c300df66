"""Networks from nothing: starts until three agree, moves of single blocks, and a verdict with its reasons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from optloc.engine import STRAIGHT
from optloc.problem import PRECEDENCE, Array, InvalidProblem, NoSolution, Status, no_station, tail_probability
from optloc.sites.calibration.blocks import StationBlock, blocks, moved_pulses, place_pulses
from optloc.sites.calibration.gauge import (
    GaugeRank,
    departure,
    determined,
    fixed_by,
    flat,
    in_frame,
    over,
    with_mean_clock,
)
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, likelihood, together
from optloc.sites.calibration.multi_start import AGREEING, NetworkSearchResult, frame_size, proven, search
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.outliers import PRICE, outliers
from optloc.sites.calibration.restarts import laid
from optloc.solvers import AMBIGUOUS_GAP, LISTED_GAP, P_MISFIT, Finding, objections

# Pulses that starts are made from: those with most rows. More find nothing that so many do not.
_CORE = 60
# Method that places the other pulses; their proof comes with that of all.
_QUICK = "gtrs+lsr"
# Share of pulses with two places that the others outvote: of more, the cheapest combination of their sides is chosen
# among so many that it feigns a shape of the stations (flat ones come out 0.1 to 0.3 m thick at 3 cm).
_TWOFOLD = 0.5
# Share of the size by which distances differ in networks that are not the same.
_ALIKE = 1e-3
# Probability beyond the ellipsoid in which two networks are one answer.
_WITHIN = 0.05
# Share of the largest variance below which a change of distances is none that stations can make.
_ZERO = 1e-9
# Share of the largest move of a pulse above which others are elsewhere, too, and do not just follow the stations.
_GIVES_WAY = 0.1
# Share of squared errors that another network with nearly the same stations may add: 10 % of a deviation.
_COVERS = 0.2


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another network that the data allow.

    Parameters
    ----------
    what : str
        How it differs, for instance "pulse 7 elsewhere".
    gap : float
        Its cost beyond that of the network found.
    stations : array (M, d)
        Where it has the stations, metres, in the same frame.
    pulses : array (N, d)
        Where it has the pulses that can be placed.
    """

    what: str
    gap: float
    stations: Array
    pulses: Array


@dataclass(frozen=True, slots=True)
class Calibration:
    """A network with its covariance and verdict.

    Parameters
    ----------
    network : Network
        What was measured.
    stations : array (M, d)
        Places, metres, in the frame `gauge`.
    clocks : array (M,)
        Offsets times the speed of propagation, metres; zeros where stations share a clock.
    pulses : array (N, d)
        Places, metres; NaN where a pulse has too few rows, or is not proven to fit at one place alone.
    emission : array (N,)
        Times of emission times the speed of propagation, metres.
    covariance : array (P, P)
        Of the M d station coordinates, then the clocks where these are sought, square metres, in that frame.
    gauge : str
        What defines the frame: "known places", "centre and main axes of the stations" or the names of stations.
    status : Status
        The verdict.
    findings : tuple of str
        All that speaks against the network, a sentence each; empty for `ok`.
    proof : "blockwise" or "unknown"
        "blockwise": with the others held, no other place of any one station or pulse costs less, and none of a station
        costs up to 9 more, proven. It does not exclude that several move together.
    cost : float
        Weighted sum of squared residuals.
    dof : int
        Degrees of freedom.
    p_value : float
        Chi-square probability of a cost at least this large.
    agreeing, starts : int
        How many starts arrived here, and how many were made.
    alternatives : tuple of Alternative
        Other networks within 25 of the cost, cheapest first.
    residuals : array (N, R)
        Whitened residuals; NaN where nothing was measured.
    left_out : int array (k, 2)
        Pulse and column of `network.z` of each row that was left out as gross, with `robust`.
    """

    network: Network
    stations: Array
    clocks: Array
    pulses: Array
    emission: Array
    covariance: Array
    gauge: str
    status: Status
    findings: tuple[str, ...]
    proof: str
    cost: float
    dof: int
    p_value: float
    agreeing: int
    starts: int
    alternatives: tuple[Alternative, ...]
    residuals: Array
    left_out: Array = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))

    @property
    def sigma(self) -> Array:
        """Return the standard deviations (M, d) of the stations' coordinates in the frame, metres."""
        m, d = self.stations.shape
        return np.asarray(np.sqrt(np.diag(self.covariance)[: m * d]).reshape(m, d))

    def distances(self) -> tuple[Array, Array, Array]:
        """Return distances between stations, which no frame changes, and their covariance.

        Returns
        -------
        pairs : int array (q, 2)
            All pairs of stations.
        distance : array (q,)
            Metres.
        covariance : array (q, q)
            Square metres.
        """
        pairs, length, flat = spans(self.stations)
        size = flat.shape[1]
        return pairs, length, flat @ self.covariance[:size, :size] @ flat.T

    def require(self, allow: tuple[str, ...] = ()) -> Calibration:
        """Return this where its status is `ok` or one that is allowed.

        Raises
        ------
        NoSolution
            With the findings.
        """
        if self.status is not Status.OK and self.status.label not in allow:
            raise NoSolution(self.network, self)
        return self


def spans(stations: Array) -> tuple[Array, Array, Array]:
    """Return all pairs of stations (q, 2), their distances (q,) and the derivatives of these (q, M d)."""
    m, d = stations.shape
    pairs = np.array([(i, k) for i in range(m) for k in range(i)], dtype=int).reshape(-1, 2)
    line = stations[pairs[:, 0]] - stations[pairs[:, 1]]
    length = np.linalg.norm(line, axis=1)
    unit = line / np.maximum(length, 1e-300)[:, None]
    jacobian = np.zeros((len(pairs), m, d))
    every = np.arange(len(pairs))
    jacobian[every, pairs[:, 0]], jacobian[every, pairs[:, 1]] = unit, -unit
    return pairs, length, jacobian.reshape(len(pairs), m * d)


def calibrate(
    network: Network,
    *,
    gauge: tuple[str, ...] = (),
    seed: int = 0,
    starts: int | None = None,
    robust: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Calibration:
    """Find stations, clocks and pulses together, without a guess.

    Parameters
    ----------
    network : Network
        What was measured and what is known.
    gauge : tuple of str
        Names of d stations that define the frame of a free network; by default all do.
    seed : int
        Decides the starts.
    starts : int, optional
        Starts after which the search ends, agreed or not.
    robust : bool
        Whether rows that most others contradict are left out first: they are named, and the network is `unproven` at
        best, as no proof says that these are the wrong ones.
    tell : callable, optional
        Called with a sentence on each round.

    Returns
    -------
    Calibration
        Network, covariance, verdict.

    Raises
    ------
    InvalidProblem
        For stations of `gauge` that are not there, or where known places define the frame.
    """
    named = _named(network, gauge)
    if robust:
        return _without_gross(network, gauge, seed, starts, tell)
    enough = _placeable(network)
    if network.rows - network.unknowns + frame_size(network) < 0 or enough.sum() < 1:
        return _refused(network, Status.TOO_FEW_ROWS, "There are fewer measurements than unknowns.")
    core = np.sort(np.argsort(-network.given.sum(axis=1), kind="stable")[:_CORE])
    core = core[enough[core]]
    found = search(network.take(core), seed, starts, tell)
    if found is None:
        return _refused(network, Status.NUMERICAL, "No start led to a network.")
    at = found.best
    rest = enough.copy()
    rest[core] = False
    if rest.any():
        at = _with_rest(network, at, core, np.flatnonzero(rest))
    lik = likelihood(network.take(enough))
    made = _judged(lik, lik.refine(at)[0], found, named)
    return _whole(made, network, enough)


def _without_gross(
    network: Network, gauge: tuple[str, ...], seed: int, starts: int | None, tell: Callable[[str], None] | None
) -> Calibration:
    """Return the network of the rows that agree, and name those that do not."""
    core = np.sort(np.argsort(-network.given.sum(axis=1), kind="stable")[:_CORE])
    gross = np.zeros(network.z.shape, dtype=bool)
    gross[core] = outliers(network.take(core), seed)
    found = calibrate(
        replace(network, sigma=np.where(gross, np.inf, network.sigma)), gauge=gauge, seed=seed, starts=starts, tell=tell
    )
    # all rows are asked again, those of pulses that the search did not have too
    residual = _all_residuals(network, found)
    again = network.given & (residual**2 > PRICE)
    if (again != gross).any() and np.isfinite(found.stations).all():
        gross = again
        found = calibrate(
            replace(network, sigma=np.where(gross, np.inf, network.sigma)),
            gauge=gauge,
            seed=seed,
            starts=starts,
            tell=tell,
        )
    left = np.argwhere(gross)
    if not len(left):
        return found
    names = [f"{network.names[network.slots[r].a]} of pulse {network.labels[j]}" for j, r in left]
    words = f"Left out as gross, which no proof confirms: {_few(names)}."
    status = min(found.status, Status.UNPROVEN, key=PRECEDENCE.index) if found.status in PRECEDENCE else found.status
    return replace(found, network=network, status=status, findings=(*found.findings, words), left_out=left)


def _all_residuals(network: Network, found: Calibration) -> Array:
    """Return whitened residuals (N, R) of all rows; zeros of pulses without a place."""
    at = NetworkEstimate(found.stations[None], found.clocks[None], found.pulses[None], found.emission[None])
    return np.asarray(np.nan_to_num(likelihood(network).residual(at)[0]))


def _with_rest(network: Network, at: NetworkEstimate, core: Array, rest: Array) -> NetworkEstimate:
    """Return an estimate of all pulses that can be placed: the core's, and fixes of the others."""
    n, d = network.pulses, network.dimension
    pulses, emission = np.zeros((1, n, d)), np.zeros((1, n))
    pulses[0, core], emission[0, core] = at.pulses[0], at.emission[0]
    pulses[0, rest] = at.stations[0].mean(axis=0)
    there = NetworkEstimate(at.stations, at.clocks, pulses, emission)
    whole = moved_pulses(likelihood(network), there, rest, place_pulses(network, at, rest, _QUICK).position)
    every = np.sort(np.concatenate([core, rest]))
    return NetworkEstimate(at.stations, at.clocks, whole.pulses[:, every], whole.emission[:, every])


# The verdict.


def _judged(lik: Likelihood, at: NetworkEstimate, found: NetworkSearchResult, named: tuple[int, ...]) -> Calibration:
    net = lik.network
    soft = bool(np.isfinite(net.place_sigma).any())
    at, checked, others = proven(lik, at)
    at = with_mean_clock(net, at) if soft else in_frame(net, at, named)
    told = determined(lik, at)
    cost = float(lik.cost(at)[0])
    dof = net.rows - net.unknowns + told.free.shape[1]
    p = float(tail_probability(np.array(cost), np.array(dof)))
    covariance, sides, bent = np.full((lik.free.size, lik.free.size), np.nan), list[str](), np.nan
    if not told.open.shape[1]:
        covariance = told.covariance(fixed_by(net, named) if named else told.free.T)
        sides, bent = flat(lik, at, covariance), departure(lik, at, told)
    alternatives = _alternatives(lik, at, cost, found, others)
    pulses = at.pulses[0].copy()
    pulses[[block.index for block in checked if not block.station and not block.proven]] = np.nan
    rivals = [other for other in alternatives if other.gap < AMBIGUOUS_GAP]
    same = [_same_stations(at, other, covariance) for other in rivals]
    for other in (one for one, alike in zip(rivals, same, strict=True) if alike):
        pulses[_moved_pulses(at, other)] = np.nan
    elsewhere = tuple(one for one, alike in zip(rivals, same, strict=True) if not alike)
    facts = _Facts(net, found, told, p, tuple(sides), bent, checked, elsewhere, np.isnan(pulses).any(axis=1))
    findings = objections(_FINDINGS, facts)
    gauge = "known places" if soft else ", ".join(net.names[i] for i in named)
    return Calibration(
        net,
        at.stations[0],
        at.clocks[0],
        pulses,
        at.emission[0],
        covariance,
        gauge or "centre and main axes of the stations",
        findings[0][0] if findings else Status.OK,
        tuple(words for _, words in findings),
        "unknown" if facts.refuted or facts.unproven else "blockwise",
        cost,
        dof,
        p,
        found.agreeing,
        found.made,
        alternatives,
        np.where(net.given, lik.residual(at)[0], np.nan),
    )


def _open_words(net: Network, told: GaugeRank) -> str:
    m, d = net.stations, net.dimension
    share = np.sqrt((told.open[: m * d] ** 2).sum(axis=1).reshape(m, d).sum(axis=1))
    if not net.synchronised:
        share = np.hypot(share, np.sqrt((told.open[m * d :] ** 2).sum(axis=1)))
    largest = [net.names[i] for i in np.argsort(-share, kind="stable")[:3]]
    count = told.open.shape[1]
    return (
        f"{count} motion{'s' if count > 1 else ''} of the network beyond the frame change no measurement, mostly of "
        f"{', '.join(largest)}; add pulses off their plane, distances between stations, or known places."
    )


def _curved_words(far: float) -> str:
    words = f"three deviations away the cost is up to {np.exp(far):.2g} times more or less than it says"
    return f"The covariance does not cover: {words}."


@dataclass(frozen=True, slots=True)
class _Facts:
    """The facts that decide about a network.

    Parameters
    ----------
    net, found, motions : Network, NetworkSearchResult, GaugeRank
        The network, its starts, and the motions that the data determine.
    p : float
        Probability of residuals as large.
    sides : tuple of str
        Sentences on stations, or pulses, in one plane.
    departure : float
        See `optloc.sites.calibration.gauge.departure`; NaN where a motion is open.
    blocks : tuple of StationBlock
        Stations and pulses with their proofs.
    elsewhere : tuple of Alternative
        Networks with other stations that fit about as well.
    twofold : bool array (N,)
        Pulses without a single place.
    """

    net: Network
    found: NetworkSearchResult
    motions: GaugeRank
    p: float
    sides: tuple[str, ...]
    departure: float
    blocks: tuple[StationBlock, ...]
    elsewhere: tuple[Alternative, ...]
    twofold: Array

    @property
    def refuted(self) -> list[str]:
        """Return the names of blocks that cost less elsewhere."""
        return [block.name for block in self.blocks if block.refuted]

    @property
    def unproven(self) -> list[str]:
        """Return the names of blocks without a proof; a pulse may be elsewhere at the same cost."""
        return [block.name for block in self.blocks if not (block.proven if block.station else block.cheapest)]


_FINDINGS = (
    Finding(Status.SINGULAR_GEOMETRY, lambda e: e.motions.open.shape[1], lambda e: [_open_words(e.net, e.motions)]),
    Finding(Status.AMBIGUOUS, lambda e: e.sides, lambda e: e.sides),
    Finding(Status.CURVED, lambda e: e.departure > STRAIGHT, lambda e: [_curved_words(e.departure)]),
    Finding(
        Status.MISFIT,
        lambda e: e.p < P_MISFIT,
        lambda e: [f"The residuals are larger than the stated noise allows: p = {e.p:.2g}."],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda e: e.elsewhere,
        lambda e: [f"{other.what} costs {other.gap:.2g} more: both fit the data." for other in e.elsewhere],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda e: e.twofold.mean() > _TWOFOLD,
        lambda e: [
            f"{e.twofold.sum()} of {len(e.twofold)} pulses have no single place, as near a plane of all stations."
        ],
    ),
    Finding(
        Status.UNPROVEN,
        lambda e: e.refuted,
        lambda e: [f"Another place costs less for {_few(e.refuted)}, the others held."],
    ),
    Finding(
        Status.UNPROVEN,
        lambda e: e.unproven and not e.refuted,
        lambda e: [f"That no other place fits as well is not proven of {_few(e.unproven)}."],
    ),
    Finding(
        Status.SEARCHED,
        lambda e: e.found.agreeing < AGREEING,
        lambda e: [f"{e.found.agreeing} of {e.found.made} starts arrived at this network; {AGREEING} must agree."],
    ),
)
"""All findings against networks."""


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def refuted_blocks(network: Network, at: NetworkEstimate) -> tuple[StationBlock, ...]:
    """Return the stations and pulses that cost less elsewhere with the others held, proven.

    Parameters
    ----------
    network : Network
        What was measured.
    at : NetworkEstimate
        One network, S = 1, for instance one with a station on the wrong side.

    Returns
    -------
    tuple of StationBlock
        Empty where none is.
    """
    return tuple(block for block in blocks(likelihood(network), at) if block.refuted)


def _alternatives(
    lik: Likelihood,
    at: NetworkEstimate,
    cost: float,
    found: NetworkSearchResult,
    others: list[tuple[str, NetworkEstimate]],
) -> tuple[Alternative, ...]:
    """Return other minima within `LISTED_GAP`: blocks elsewhere, ends of other starts, and the mirror image."""
    net = lik.network
    soft = bool(np.isfinite(net.place_sigma).any())
    if at.pulses.shape[1] == found.best.pulses.shape[1]:  # else starts are of the core alone
        near = found.ends.cost < found.cost + LISTED_GAP
        _, first = np.unique(np.round(found.ends.cost[near], 3), return_index=True)
        others = others + [("another network", found.ends.at.take(np.flatnonzero(near)[[i]])) for i in first]
    if soft:
        both = laid(at, net, np.random.default_rng(0))
        others = [*others, ("the mirror image", both.take(np.array([1])))]
    if not others:
        return ()
    ends, costs = lik.refine(together(*(one for _, one in others)))
    out: list[Alternative] = []
    shapes = [_shape(at, soft)]
    scale = max(float(np.abs(shapes[0]).max()), 1e-300)
    # of the same network, refined twice, the first name says more
    for i in np.argsort(np.round(costs, 3), kind="stable"):
        one, gap = ends.take(np.array([i])), float(costs[i] - cost)
        shape = _shape(one, soft)
        # a thousandth of the size, or where costs agree to what is left of the digits, is the same network
        if gap < LISTED_GAP and all(np.abs(shape - other).max() > _ALIKE * scale for other in shapes):
            shapes.append(shape)
            words = others[i][0]
            placed = one if soft else over(one, at)
            what = words[0].upper() + words[1:]
            out.append(Alternative(what, max(gap, 0.0), placed.stations[0], placed.pulses[0]))
    return tuple(out)


def _same_stations(at: NetworkEstimate, other: Alternative, covariance: Array) -> bool:
    """Return whether another network has the stations where this one has them, as far as its covariance tells.

    They are within its 95 % ellipsoid, and what the other's share of the likelihood adds to squared errors is covered.
    """
    if not np.isfinite(covariance).all():
        return False
    _, _, gradient = spans(at.stations[0])
    apart = spans(other.stations)[1] - spans(at.stations[0])[1]
    size = gradient.shape[1]
    width, axes = np.linalg.eigh(gradient @ covariance[:size, :size] @ gradient.T)
    told = width > _ZERO * width[-1]
    shift, dof = float((((axes.T @ apart)[told]) ** 2 / width[told]).sum()), int(told.sum())
    share = 1.0 / (1.0 + np.exp(0.5 * other.gap))
    within = float(tail_probability(np.array(shift), np.array(dof))) > _WITHIN
    return within and share * shift <= _COVERS * dof


def _moved_pulses(at: NetworkEstimate, other: Alternative) -> Array:
    """Return which pulses another network has elsewhere (N,): the rest gives way a little."""
    apart = np.linalg.norm(other.pulses - at.pulses[0], axis=1)
    return np.asarray(apart > _GIVES_WAY * apart.max())


def _shape(at: NetworkEstimate, soft: bool) -> Array:
    """Return distances between stations and to the pulses, which no frame changes; places too where these are known."""
    points = np.concatenate([at.stations[0], at.pulses[0]])
    apart = np.linalg.norm(points[:, None] - at.stations[0][None], axis=-1).ravel()
    return np.concatenate([apart, at.stations.ravel()]) if soft else apart


# What surrounds a search.


def _named(network: Network, gauge: tuple[str, ...]) -> tuple[int, ...]:
    if not gauge:
        return ()
    if np.isfinite(network.place_sigma).any():
        raise InvalidProblem("known places define the frame already", "gauge", "leave it out")
    if len(gauge) != network.dimension or len(set(gauge)) != len(gauge):
        raise InvalidProblem(f"a frame needs {network.dimension} stations", "gauge", "name so many, each once")
    for name in gauge:
        if name not in network.names:
            raise no_station(name, "gauge", network.names)
    return tuple(network.names.index(name) for name in gauge)


def _placeable(network: Network) -> Array:
    """Return which pulses have as many rows as unknowns (N,)."""
    needed = network.dimension + network.emission
    return np.asarray(network.given.sum(axis=1) >= needed)


def _refused(network: Network, status: Status, words: str) -> Calibration:
    m, n, d = network.stations, network.pulses, network.dimension
    p = m * d + (0 if network.synchronised else m)
    nan = np.full
    return Calibration(
        network,
        nan((m, d), np.nan),
        nan(m, np.nan),
        nan((n, d), np.nan),
        nan(n, np.nan),
        nan((p, p), np.nan),
        "none",
        status,
        (words,),
        "unknown",
        float("nan"),
        network.rows - network.unknowns + frame_size(network),
        float("nan"),
        0,
        0,
        (),
        np.where(network.given, np.nan, np.nan),
    )


def _whole(made: Calibration, network: Network, enough: Array) -> Calibration:
    """Return a calibration of all pulses, NaN for those that have too few rows."""
    pulses = np.full((network.pulses, network.dimension), np.nan)
    emission, residuals = np.full(network.pulses, np.nan), np.full(network.z.shape, np.nan)
    pulses[enough], emission[enough], residuals[enough] = made.pulses, made.emission, made.residuals
    return replace(made, network=network, pulses=pulses, emission=emission, residuals=residuals)
