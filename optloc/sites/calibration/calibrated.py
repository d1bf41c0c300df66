"""Self-calibration of a network: search, block moves with proofs, and a result with status and findings.

`calibrate` searches with up to 60 pulses, adds the other pulses as fixes, and refines everything together. Then it
tests the result: open motions, mirror images, misfit, alternatives and proofs of single stations and pulses.

Letters: M stations, N pulses, R columns of measurements, d coordinates. P is the number of station coordinates M d,
plus M clocks if the stations do not share a clock. `lik` is the likelihood of a network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.problem import (
    PRECEDENCE,
    Array,
    HasShortForm,
    InvalidProblem,
    NoSolution,
    Status,
    no_station,
    plot_of,
    tail_probability,
)
from optloc.sites.calibration.blocks import StationBlock, blocks, moved_pulses, place_pulses
from optloc.sites.calibration.gauge import (
    departure,
    determined,
    fixed_by,
    flat,
    in_frame,
    is_mirror_image,
    over,
    spans,
    with_mean_clock,
)
from optloc.sites.calibration.likelihood import Likelihood, NetworkEstimate, likelihood, together
from optloc.sites.calibration.multi_start import NetworkSearchResult, frame_size, proven, search
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.network_findings import NETWORK_FINDINGS, NetworkFacts, mirror_words, shorten
from optloc.sites.calibration.outliers import PRICE, outliers
from optloc.sites.calibration.restarts import laid
from optloc.solvers import AMBIGUOUS_GAP, LISTED_GAP, objections

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Pulses in the search, those with the most rows: more pulses did not find other networks.
_CORE = 60
# Method for the other pulses; their proof follows with the proofs of all pulses.
_QUICK = "gtrs+lsr"
MIRROR_IMAGE = "The mirror image"
"""Name of the alternative that is the mirror image of the network."""

# Difference of distances, as a share of the size, from which two networks are different.
_ALIKE = 1e-3
# Two networks are one result if their difference has at least this probability under the covariance.
_WITHIN = 0.05
# Variances below this share of the largest belong to changes of distances that no motion of stations can make.
_ZERO = 1e-9
# Share of the largest pulse displacement above which another pulse is elsewhere too, and not only follows the stations.
_GIVES_WAY = 0.1
# Largest share that another network with nearly the same stations may add to the squared errors: 10 % of a
# standard deviation.
_COVERS = 0.2


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another network that the data allow.

    Parameters
    ----------
    what : str
        The difference, for instance "pulse 7 elsewhere".
    gap : float
        Its cost minus the cost of the network found.
    stations : array (M, d)
        Station positions in the same frame, metres.
    pulses : array (N, d)
        Positions of the pulses that have enough rows, metres.
    """

    what: str
    gap: float
    stations: Array
    pulses: Array


@dataclass(frozen=True, slots=True, repr=False)
class Calibration(HasShortForm):
    """A network with its covariance and status.

    Parameters
    ----------
    network : Network
        Measurements and prior knowledge.
    stations : array (M, d)
        Station positions in the frame `gauge`, metres.
    clocks : array (M,)
        Clock offsets times the propagation speed, metres; zeros if the stations share a clock.
    pulses : array (N, d)
        Pulse positions, metres; NaN if a pulse has too few rows, or if its position is not proven to be unique.
    emission : array (N,)
        Emission times multiplied by the propagation speed, metres.
    covariance : array (P, P)
        Covariance of the M d station coordinates, then of unknown clocks, in that frame, square metres. NaN if the
        measurements do not determine a motion.
    gauge : str
        Definition of the frame: "known places", "centre and main axes of the stations" or names of stations.
    status : Status
        `ok`, or the most serious problem.
    findings : tuple of str
        One sentence for each problem; empty for `ok`.
    proof : "blockwise" or "unknown"
        "blockwise" is a proof for each single station or pulse while all others are fixed: no other position has a
        lower cost. For a station, no other position costs up to 9 more. The proof does not cover joint moves of
        several stations or pulses.
    cost : float
        Weighted sum of squared residuals.
    dof : int
        Degrees of freedom.
    p_value : float
        Probability of a cost at least as large, from the chi-square distribution.
    agreeing, starts : int
        Number of starts that reached this network, and of all starts.
    alternatives : tuple of Alternative
        Other networks with a cost at most 25 higher, cheapest first.
    residuals : array (N, R)
        Whitened residuals; NaN if there is no measurement.
    left_out : int array (k, 2)
        Pulse and column of `network.z` of each row that `robust` left out as gross.
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

    def plot(self, **options: Any) -> Axes:
        """Return a plan in matplotlib axes; see `optloc.sites.calibration_axes` for the options."""
        return plot_of(self, **options)

    @property
    def sigma(self) -> Array:
        """Return the standard deviations (M, d) of the station coordinates in the frame, metres."""
        m, d = self.stations.shape
        return np.asarray(np.sqrt(np.diag(self.covariance)[: m * d]).reshape(m, d))

    def distances(self) -> tuple[Array, Array, Array]:
        """Return the distances between stations, which do not depend on the frame, and their covariance.

        Returns
        -------
        pairs : int array (q, 2)
            All pairs of stations.
        distance : array (q,)
            Distances, metres.
        covariance : array (q, q)
            Covariance of the distances, square metres.
        """
        pairs, length, flat = spans(self.stations)
        size = flat.shape[1]
        return pairs, length, flat @ self.covariance[:size, :size] @ flat.T

    def require(self, allow: tuple[str, ...] = ()) -> Calibration:
        """Return this calibration if its status is `ok` or in `allow`.

        Raises
        ------
        NoSolution
            For any other status; the exception has the findings.
        """
        if self.status is not Status.OK and self.status.label not in allow:
            raise NoSolution(self.network, self)
        return self


def calibrate(
    network: Network,
    *,
    gauge: tuple[str, ...] = (),
    seed: int = 0,
    starts: int | None = None,
    robust: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Calibration:
    """Estimate stations, clocks and pulses together, without a first guess.

    Parameters
    ----------
    network : Network
        Measurements and prior knowledge.
    gauge : tuple of str
        Names of d stations that define the frame of a free network; by default all stations define it.
    seed : int
        Seed of the random starts.
    starts : int, optional
        Largest number of starts, even if they do not agree.
    robust : bool
        Whether to leave out and list rows that most other rows contradict. The best possible status is then
        `unproven`: no proof shows that these rows are wrong.
    tell : callable, optional
        Called with a progress message after each round.

    Returns
    -------
    Calibration
        Network, covariance, status and findings.

    Raises
    ------
    InvalidProblem
        If `gauge` names an unknown station, or if known positions already define the frame.
    """
    named = _station_indices(network, gauge)
    if robust:
        return _calibrate_robust(network, gauge, seed, starts, tell)
    enough = _placeable(network)  # mask (N,) of pulses
    if network.rows - network.unknowns + frame_size(network) < 0 or enough.sum() < 1:
        return _failure(
            network,
            Status.TOO_FEW_ROWS,
            "There are fewer measurements than unknowns; add pulses, distances or known positions.",
        )
    core = np.sort(np.argsort(-network.given.sum(axis=1), kind="stable")[:_CORE])  # pulses with the most rows
    core = core[enough[core]]
    found = search(network.take(core), seed, starts, tell)
    if found is None:
        return _failure(
            network, Status.NUMERICAL, "No start converged to a network; check the unit and the sigma of the values."
        )
    at = found.best
    rest = enough.copy()
    rest[core] = False
    if rest.any():
        at = _add_other_pulses(network, at, core, np.flatnonzero(rest))
    lik = likelihood(network.take(enough))
    made = _judge(lik, lik.refine(at)[0], found, named)
    return _with_all_pulses(made, network, enough)


def _calibrate_robust(
    network: Network, gauge: tuple[str, ...], seed: int, starts: int | None, tell: Callable[[str], None] | None
) -> Calibration:
    """Return the network of the rows that agree, with a list of the rows that were left out; see `calibrate`."""
    core = np.sort(np.argsort(-network.given.sum(axis=1), kind="stable")[:_CORE])
    gross = np.zeros(network.z.shape, dtype=bool)
    gross[core] = outliers(network.take(core), seed)  # an infinite sigma leaves these rows out
    run = partial(calibrate, gauge=gauge, seed=seed, starts=starts, tell=tell)
    found = run(replace(network, sigma=np.where(gross, np.inf, network.sigma)))
    # test all rows again, also of pulses that were not in the search
    residual = _all_residuals(network, found)
    again = network.given & (residual**2 > PRICE)
    if (again != gross).any() and np.isfinite(found.stations).all():
        gross = again
        found = run(replace(network, sigma=np.where(gross, np.inf, network.sigma)))
    left = np.argwhere(gross)
    if not len(left):
        return found
    names = [f"{network.names[network.slots[r].a]} of pulse {network.labels[j]}" for j, r in left]
    words = f"These rows were left out as gross errors, without a proof: {shorten(names)}; check them by hand."
    status = min(found.status, Status.UNPROVEN, key=PRECEDENCE.index) if found.status in PRECEDENCE else found.status
    return replace(found, network=network, status=status, findings=(*found.findings, words), left_out=left)


def _all_residuals(network: Network, found: Calibration) -> Array:
    """Return whitened residuals (N, R) of all rows of a calibration; zeros for pulses without a position."""
    at = NetworkEstimate(found.stations[None], found.clocks[None], found.pulses[None], found.emission[None])
    return np.asarray(np.nan_to_num(likelihood(network).residual(at)[0]))


def _add_other_pulses(network: Network, at: NetworkEstimate, core: Array, rest: Array) -> NetworkEstimate:
    """Return an estimate of the pulses `core` of the search (`at`, S = 1), and of `rest`, the others, from fixes."""
    n, d = network.pulses, network.dimension
    pulses, emission = np.zeros((1, n, d)), np.zeros((1, n))
    pulses[0, core], emission[0, core] = at.pulses[0], at.emission[0]
    pulses[0, rest] = at.stations[0].mean(axis=0)  # pulses without a fix stay there
    there = NetworkEstimate(at.stations, at.clocks, pulses, emission)
    whole = moved_pulses(likelihood(network), there, rest, place_pulses(network, at, rest, _QUICK).position)
    every = np.sort(np.concatenate([core, rest]))
    return NetworkEstimate(at.stations, at.clocks, whole.pulses[:, every], whole.emission[:, every])


def _judge(lik: Likelihood, at: NetworkEstimate, found: NetworkSearchResult, named: tuple[int, ...]) -> Calibration:
    """Return the calibration of the refined estimate `at` (S = 1): proofs, frame, covariance, findings and status.

    `found` is the search, and `named` are the stations of the frame.
    """
    net = lik.network
    # `soft`: prior coordinates define the frame; otherwise `named` or all stations define it.
    soft = bool(np.isfinite(net.place_sigma).any())
    at, checked, others = proven(lik, at)
    at = with_mean_clock(net, at) if soft else in_frame(net, at, named)
    rank = determined(lik, at)
    cost = float(lik.cost(at)[0])
    # Motions of the frame are among the unknowns, but no row determines them: they cost no degree of freedom.
    dof = net.rows - net.unknowns + rank.free.shape[1]
    p = float(tail_probability(np.array(cost), np.array(dof)))
    covariance, sides, departs = np.full((lik.free.size, lik.free.size), np.nan), list[str](), np.nan
    if not rank.open.shape[1]:
        covariance = rank.covariance(fixed_by(net, named) if named else rank.free.T)
        sides, departs = flat(lik, at, covariance), departure(lik, at, rank)
    alternatives = _alternatives(lik, at, cost, found, others)
    pulses = at.pulses[0].copy()
    pulses[[block.index for block in checked if not block.station and not block.proven]] = np.nan
    images = [other for other in alternatives if other.gap < AMBIGUOUS_GAP and other.what == MIRROR_IMAGE]
    mirror = mirror_words(net, at.stations[0], images[0].stations, images[0].gap) if images else ""
    rivals = [other for other in alternatives if other.gap < AMBIGUOUS_GAP and other.what != MIRROR_IMAGE]
    # A rival with the same stations makes only its moved pulses ambiguous; other rivals make the network ambiguous.
    same = [_same_stations(at, other, covariance) for other in rivals]
    for other in (one for one, alike in zip(rivals, same, strict=True) if alike):
        pulses[_moved_pulses(at, other)] = np.nan
    elsewhere = tuple(one for one, alike in zip(rivals, same, strict=True) if not alike)
    others_named = tuple((other.what, other.gap) for other in elsewhere)
    facts = NetworkFacts(
        net, found, rank, p, tuple(sides), departs, checked, others_named, np.isnan(pulses).any(axis=1), mirror
    )
    findings = objections(NETWORK_FINDINGS, facts)
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


def refuted_blocks(network: Network, at: NetworkEstimate) -> tuple[StationBlock, ...]:
    """Return the stations and pulses with a lower cost at another position while all others are fixed.

    Parameters
    ----------
    network : Network
        Measurements and prior knowledge.
    at : NetworkEstimate
        One network, S = 1, for instance with a station on the wrong side.

    Returns
    -------
    tuple of StationBlock
        Empty if no block has a lower cost elsewhere.
    """
    return tuple(block for block in blocks(likelihood(network), at) if block.refuted)


def _alternatives(
    lik: Likelihood,
    at: NetworkEstimate,
    cost: float,
    found: NetworkSearchResult,
    others: list[tuple[str, NetworkEstimate]],
) -> tuple[Alternative, ...]:
    """Return other minima than `at` (S = 1): moved blocks, minima of other starts, and the mirror image.

    They cost at most `LISTED_GAP` more than `at`, which has the cost `cost`. `others` are estimates (S = 1) with a
    description; they are refined. `found` is the search.
    """
    net = lik.network
    soft = bool(np.isfinite(net.place_sigma).any())
    if at.pulses.shape[1] == found.best.pulses.shape[1]:  # otherwise the starts contain only a part of the pulses
        near = found.ends.cost < found.cost + LISTED_GAP
        _, first = np.unique(np.round(found.ends.cost[near], 3), return_index=True)
        others = others + [("another network", found.ends.at.take(np.flatnonzero(near)[[i]])) for i in first]
    if soft:
        both = laid(at, net, np.random.default_rng(0))  # the network, then its mirror image
        others = [*others, (MIRROR_IMAGE, both.take(np.array([1])))]
    if not others:
        return ()
    ends, costs = lik.refine(together(*(one for _, one in others)))
    out: list[Alternative] = []
    shapes = [_shape(at, soft)]
    scale = max(float(np.abs(shapes[0]).max()), 1e-300)
    # The same network can occur twice. A stable sort keeps the first name, which is the most specific.
    for i in np.argsort(np.round(costs, 3), kind="stable"):
        one, gap = ends.take(np.array([i])), float(costs[i] - cost)
        shape = _shape(one, soft)
        # Networks that differ by less than `_ALIKE` of the size are the same: the difference is rounding.
        if gap < LISTED_GAP and all(np.abs(shape - other).max() > _ALIKE * scale for other in shapes):
            shapes.append(shape)
            words = others[i][0]
            placed = one if soft else over(one, at)
            # Starts also end at the mirror image, so its shape decides the name.
            what = MIRROR_IMAGE if is_mirror_image(one, at, _ALIKE * scale) else words[0].upper() + words[1:]
            out.append(Alternative(what, max(gap, 0.0), placed.stations[0], placed.pulses[0]))
    return tuple(out)


def _same_stations(at: NetworkEstimate, other: Alternative, covariance: Array) -> bool:
    """Return whether another network has the same stations as `at` (S = 1), within the covariance (P, P), m^2.

    The stations are within the 95 % ellipsoid, and the covariance covers the squared error that the other network
    adds in proportion to its likelihood.
    """
    if not np.isfinite(covariance).all():
        return False
    _, _, gradient = spans(at.stations[0])
    apart = spans(other.stations)[1] - spans(at.stations[0])[1]
    size = gradient.shape[1]
    width, axes = np.linalg.eigh(gradient @ covariance[:size, :size] @ gradient.T)
    # `shift` is the squared distance in units of the covariance; `share` is the probability of the other network.
    known = width > _ZERO * width[-1]
    shift, dof = float((((axes.T @ apart)[known]) ** 2 / width[known]).sum()), int(known.sum())
    share = 1.0 / (1.0 + np.exp(0.5 * other.gap))
    within = float(tail_probability(np.array(shift), np.array(dof))) > _WITHIN
    return within and share * shift <= _COVERS * dof


def _moved_pulses(at: NetworkEstimate, other: Alternative) -> Array:
    """Return a mask (N,) of the pulses that another network has at different positions; others move a little."""
    apart = np.linalg.norm(other.pulses - at.pulses[0], axis=1)
    return np.asarray(apart > _GIVES_WAY * apart.max())


def _shape(at: NetworkEstimate, soft: bool) -> Array:
    """Return distances of stations to stations and pulses, metres; with a known frame (`soft`), also positions."""
    points = np.concatenate([at.stations[0], at.pulses[0]])
    apart = np.linalg.norm(points[:, None] - at.stations[0][None], axis=-1).ravel()
    return np.concatenate([apart, at.stations.ravel()]) if soft else apart


def _station_indices(network: Network, gauge: tuple[str, ...]) -> tuple[int, ...]:
    """Return the numbers of the `gauge` stations, or raise if these cannot define the frame."""
    if not gauge:
        return ()
    if np.isfinite(network.place_sigma).any():
        raise InvalidProblem("known places define the frame already", "gauge", "remove this argument")
    if len(gauge) != network.dimension or len(set(gauge)) != len(gauge):
        raise InvalidProblem(
            f"a frame needs {network.dimension} stations", "gauge", f"name {network.dimension} different stations"
        )
    for name in gauge:
        if name not in network.names:
            raise no_station(name, "gauge", network.names)
    return tuple(network.names.index(name) for name in gauge)


def _placeable(network: Network) -> Array:
    """Return a mask (N,) of the pulses that rows can place: at least one row for each of their unknowns."""
    needed = network.dimension + network.emission
    return np.asarray(network.given.sum(axis=1) >= needed)


def _failure(network: Network, status: Status, words: str) -> Calibration:
    """Return a calibration without estimates (all NaN), with a status and its sentence `words`."""
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


def _with_all_pulses(made: Calibration, network: Network, enough: Array) -> Calibration:
    """Return a calibration of all pulses, with NaN for pulses that have too few rows (outside `enough` (N,))."""
    pulses = np.full((network.pulses, network.dimension), np.nan)
    emission, residuals = np.full(network.pulses, np.nan), np.full(network.z.shape, np.nan)
    pulses[enough], emission[enough], residuals[enough] = made.pulses, made.emission, made.residuals
    return replace(made, network=network, pulses=pulses, emission=emission, residuals=residuals)
