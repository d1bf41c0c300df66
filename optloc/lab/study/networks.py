"""Studies of networks: simulation of stations, clocks and pulses, solution by a method, and comparison with the truth.

A network consists of stations with unknown positions and clocks. Each pulse arrives at the stations, and an arrival is
one measurement. Networks are known up to a rigid motion and a reflection, so errors are measured after the best
alignment.

Letters in shapes: k trials, m stations, n pulses, d coordinates. A covariance has p unknowns. These are first the m d
coordinates of all stations, station by station. If the stations do not share one clock, their m clock offsets follow.
Clock offsets and emission times are multiplied by the propagation speed, and are in metres.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from optloc.files import Units, join
from optloc.lab.study.document import NetworkTable
from optloc.problem import ANSWERED, Amount, Array, InvalidProblem, Status
from optloc.sites.calibration.calibrated import Calibration, calibrate
from optloc.sites.calibration.gauge import determined
from optloc.sites.calibration.likelihood import NetworkEstimate, likelihood, together
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.network_arguments import network_of

CALIBRATE = "calibrate"
"""Name of the method of optloc for networks."""

# Arrivals that each pulse keeps beyond its d + 1 unknowns: with fewer it does not constrain the network.
_SPARE = 2
# The covariance of all stations is singular: a rigid motion of the network has no variance. Eigenvalues below this
# share of the largest belong to rigid motions.
_FRAME = 1e-9


@dataclass(frozen=True)
class NetworkCase:
    """Common data of all trials of a case of networks, without functions, so that it can be sent to workers.

    Parameters
    ----------
    table : NetworkTable
        The table with its swept values inserted.
    sweep : str
        The swept values as JSON.
    label : str
        The noise level as written in the file.
    level : float
        The noise level: standard deviation of an arrival, metres.
    seed : int
        Seed of the study.
    trials : int
        Number of trials.
    unit : str
        Unit of `level`, for the table of the study.
    """

    table: NetworkTable
    sweep: str
    label: str
    level: float
    seed: int
    trials: int
    unit: str = "m"

    @cached_property
    def key(self) -> str:
        """Return 16 hexadecimal digits that identify the data of all trials."""
        text = self.table.model_dump_json(exclude={"noise", "sweep", "trials"})
        return hashlib.blake2b(f"{self.seed} {self.label} {self.sweep} {text}".encode(), digest_size=8).hexdigest()

    @property
    def where(self) -> str:
        """Return the location that error messages name."""
        return f"network {self.table.name!r}"

    @property
    def facts(self) -> dict[str, Any]:
        """Return the columns of the table that all trials share, by name."""
        table = self.table
        rows = table.stations * table.pulses
        sizes = {"dimension": table.dimension, "stations": table.stations, "rows": rows, "epochs": table.pulses}
        return {"kinds": "toa", **sizes}

    @property
    def numbers(self) -> int:
        """Return the number of measurements of a trial."""
        return self.table.stations * self.table.pulses

    def draw(self, first: int, count: int) -> Networks:
        """Return `count` trials, from the trial `first` on; they do not depend on other draws."""
        drawn = [_trial(self, number) for number in range(first, first + count)]
        seed = tuple(f"{self.seed}:{self.key}:{number}" for number in range(first, first + count))
        digest = tuple(_digest(self, network) for network, _, _ in drawn)
        bad = np.array([bad for _, _, bad in drawn])
        return Networks(tuple(trial[0] for trial in drawn), together(*(trial[1] for trial in drawn)), seed, digest, bad)


@dataclass(frozen=True, slots=True)
class Networks:
    """Simulated trials of a case of networks.

    Parameters
    ----------
    networks : tuple of k Network
        The networks that methods solve.
    truth : NetworkEstimate
        The k true networks.
    seed, digest : tuple of k str
        Names of the trials' seeds, and digests of the drawn numbers.
    bad : int array (k,)
        Number of arrivals with a gross error.
    """

    networks: tuple[Network, ...]
    truth: NetworkEstimate
    seed: tuple[str, ...]
    digest: tuple[str, ...]
    bad: Array

    def part(self, first: int, count: int) -> Networks:
        """Return `count` trials, from the trial `first` on."""
        kept = slice(first, first + count)
        truth = self.truth.take(kept)
        return Networks(self.networks[kept], truth, self.seed[kept], self.digest[kept], self.bad[kept])


def check_network(table: NetworkTable, where: str) -> None:
    """Raise InvalidProblem if a length of the table is invalid or negative, or if a box has too few widths.

    `where` is the location of the table for error messages.
    """
    for key in ("box", "around"):
        if (given := getattr(table, key)) is not None and len(given) < table.dimension:
            what = f"{len(given)} widths do not fit {table.dimension} dimensions"
            raise InvalidProblem(what, join(where, key), "give one for each")
    for key in ("box", "around", "emission", "clocks"):
        _lengths(table, key, where)
    if table.outliers is not None:
        _gross_size(table, where)


def noise_of(level: Amount, where: str) -> float:
    """Return a noise level as a standard deviation in metres; raise InvalidProblem unless it is positive."""
    sigma = Units("length").plain(level, "m", where)
    if not sigma > 0.0:
        raise InvalidProblem(f"{level!r} is not positive", where, "give a positive standard deviation")
    return sigma


def _lengths(table: NetworkTable, key: str, where: str) -> Array:
    """Return the lengths of the table's key `key`, an array in metres; empty without the key.

    Raise InvalidProblem if a length is negative.
    """
    given = getattr(table, key)
    values = given if isinstance(given, list) else [] if given is None else [given]
    lengths = np.array([Units("length").plain(value, "m", join(where, key)) for value in values])
    if not (lengths >= 0.0).all():
        raise InvalidProblem(f"{key} is negative", join(where, key), "give widths")
    return lengths


def _gross_size(table: NetworkTable, where: str) -> float:
    """Return the size of gross errors in metres; raise InvalidProblem if the table gives a size for each kind."""
    assert table.outliers is not None
    size, place = table.outliers.size, join(where, "outliers.size")
    if isinstance(size, dict):
        raise InvalidProblem("networks have arrivals only", place, 'write one length, such as "4 m"')
    return Units("length").plain(size, "m", place)


def _trial(case: NetworkCase, number: int) -> tuple[Network, NetworkEstimate, int]:
    """Return the network of the trial `number`, its true values, and the number of its arrivals with a gross error.

    Emission times, clocks and arrivals are multiplied by the propagation speed, so all are in metres.
    """
    # A seed sequence mixes words of 32 bits. Positions, noise and gross errors have separate streams: a change of one
    # does not shift the others.
    key = [int(case.key[:8], 16), int(case.key[8:], 16)]
    streams = np.random.SeedSequence([case.seed, *key], spawn_key=(number,)).spawn(3)
    position_rng, noise_rng, error_rng = (np.random.default_rng(stream) for stream in streams)
    table, m, n, d = case.table, case.table.stations, case.table.pulses, case.table.dimension
    box = _lengths(table, "box", case.where)[:d]
    around = box if table.around is None else _lengths(table, "around", case.where)[:d]
    stations, pulses = position_rng.uniform(-0.5, 0.5, (m, d)) * box, position_rng.uniform(-0.5, 0.5, (n, d)) * around
    sent = position_rng.uniform(-0.5, 0.5, n) * _lengths(table, "emission", case.where)[0]
    clocks = position_rng.uniform(-0.5, 0.5, m) * (
        0.0 if table.synchronised else _lengths(table, "clocks", case.where)[0]
    )
    separation = pulses[:, None] - stations
    z = (
        np.sqrt((separation * separation).sum(axis=-1))
        + sent[:, None]
        + clocks
        + case.level * noise_rng.standard_normal((n, m))
    )
    gross = np.zeros((n, m), dtype=bool)
    if table.outliers is not None:
        gross = error_rng.random((n, m)) < table.outliers.share
        # With `late`, no sign is negative.
        sign = np.where(error_rng.random((n, m)) < 0.5 - 0.5 * table.outliers.late, -1.0, 1.0)
        z = z + gross * sign * _gross_size(table, case.where)
    # An arrival is missing with the probability `table.missing`. But each pulse keeps the `least` arrivals with its
    # largest draws. The double argsort is the rank of a draw: 0 for the largest draw of the pulse.
    missing_draw = error_rng.random((n, m))
    least = min(m, d + 1 + _SPARE)
    kept = (missing_draw >= table.missing) | (np.argsort(np.argsort(-missing_draw, axis=1), axis=1) < least)
    network = network_of(np.where(kept, z, np.nan), case.level, dimension=d, synchronised=table.synchronised)
    truth = NetworkEstimate(stations[None], clocks[None], pulses[None], sent[None])
    return network, truth, int((gross & kept).sum())


def _digest(case: NetworkCase, network: Network) -> str:
    """Return 16 hexadecimal digits that identify the drawn arrivals."""
    digest = hashlib.blake2b(case.key.encode(), digest_size=8)
    for array in (network.z, network.sigma):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


# Results of methods.


@dataclass(frozen=True, slots=True)
class NetworkResult:
    """Result of a method for one network.

    Parameters
    ----------
    status : Status
        Status of the result; a baseline claims `OK` for every result.
    reason : str
        Reason of another status.
    stations, clocks : array (m, d), (m,)
        Positions and clock offsets, metres; NaN without a result.
    covariance : array (p, p)
        Covariance of the positions and clocks, m^2, in the frame of all stations; NaN without a covariance.
    cost : float
        Cost of the likelihood (chi-square).
    dof : int
        Degrees of freedom.
    proof : str
        Proof as in a `Calibration`.
    others : tuple of arrays (m, d)
        Stations of the other networks that the method lists, metres.
    """

    status: Status
    reason: str
    stations: Array
    clocks: Array
    covariance: Array
    cost: float
    dof: int
    proof: str = "unknown"
    others: tuple[Array, ...] = ()


def calibrated(networks: Networks) -> tuple[NetworkResult, ...]:
    """Return the result of `optloc.calibrate` for each network."""
    return tuple(_result_of(calibrate(network)) for network in networks.networks)


def _result_of(calibration: Calibration) -> NetworkResult:
    """Return a calibration as the result of a method."""
    reason = calibration.findings[0] if calibration.findings else ""
    others = tuple(other.stations for other in calibration.alternatives)
    values = (calibration.stations, calibration.clocks, calibration.covariance, calibration.cost, calibration.dof)
    return NetworkResult(calibration.status, reason, *values, calibration.proof, others)


def refined(network: Network, starts: NetworkEstimate) -> NetworkResult:
    """Return the cheapest minimum of the likelihood that least squares reaches from several starts, with the status OK.

    `starts` are any number of estimates. Without a start or a finite minimum, the status is NUMERICAL. If the arrivals
    do not determine the minimum, the status is SINGULAR_GEOMETRY.
    """
    m, d = network.stations, network.dimension
    p = m * d + (0 if network.synchronised else m)
    missing = np.full((m, d), np.nan), np.full(m, np.nan), np.full((p, p), np.nan)
    if not starts.count:
        return NetworkResult(Status.NUMERICAL, "There is no start.", *missing, np.nan, 0)
    lik = likelihood(network)
    minima, cost = lik.refine(starts)
    if not np.isfinite(cost).any():
        return NetworkResult(Status.NUMERICAL, "No start led to a network.", *missing, np.nan, 0)
    best = minima.take(np.array([int(np.nanargmin(cost))]))
    # `free` is the number of motions of the frame: they change no predicted arrival, so they use no row.
    covariance, free = _covariance(network, best)
    dof = network.rows - network.unknowns + free
    if not np.isfinite(covariance).all():
        reason = "The arrivals do not determine the network, apart from its frame."
        return NetworkResult(
            Status.SINGULAR_GEOMETRY, reason, best.stations[0], best.clocks[0], covariance, np.nanmin(cost), dof
        )
    return NetworkResult(Status.OK, "", best.stations[0], best.clocks[0], covariance, float(np.nanmin(cost)), dof)


def _covariance(network: Network, estimate: NetworkEstimate) -> tuple[Array, int]:
    """Return the covariance (p, p) of an estimate, m^2, and the number of motions of the frame.

    The covariance is given in the frame of all stations, and is NaN if the arrivals do not determine the network. The
    motions are the rigid motions and clock shifts that no arrival measures; they add to the degrees of freedom.
    """
    # `free` are the motions of the frame. `open` are other motions that change no arrival: then no covariance exists.
    frame = determined(likelihood(network), estimate)
    p, free = frame.jacobian.shape[1], frame.free.shape[1]
    if not frame.open.shape[1]:
        try:
            return frame.covariance(frame.free.T), free
        except np.linalg.LinAlgError:
            pass
    return np.full((p, p), np.nan), free


def each(refine: Callable[[Network, int], NetworkResult]) -> Callable[[Networks], tuple[NetworkResult, ...]]:
    """Return a function that applies `refine` to each network, with a separate seed.

    The seed is the digest of the trial, so a result does not depend on the other trials of the call.
    """

    def run(networks: Networks) -> tuple[NetworkResult, ...]:
        seeds = [int(digest, 16) for digest in networks.digest]
        return tuple(refine(one, seed) for one, seed in zip(networks.networks, seeds, strict=True))

    return run


def from_truth(networks: Networks) -> tuple[NetworkResult, ...]:
    """Return, for each network, the minimum of the likelihood that least squares reaches from the truth.

    The study compares the costs of other methods with the costs of these minima.
    """
    return tuple(refined(one, networks.truth.take(slice(i, i + 1))) for i, one in enumerate(networks.networks))


# Columns of the table.


@dataclass(frozen=True, slots=True)
class KnownNetworks:
    """Data of trials that do not depend on the method.

    Parameters
    ----------
    drawn : Networks
        The k trials.
    bound : tuple of k arrays (p, p)
        Cramer-Rao bounds at the truth in the frame of all stations, m^2; NaN where the geometry is singular.
    cost : array (k,)
        Cost at the truth.
    """

    drawn: Networks
    bound: tuple[Array, ...]
    cost: Array

    def part(self, first: int, count: int) -> KnownNetworks:
        """Return the data of `count` trials, from the trial `first` on."""
        kept = slice(first, first + count)
        return KnownNetworks(self.drawn.part(first, count), self.bound[kept], self.cost[kept])


def known_networks(drawn: Networks) -> KnownNetworks:
    """Return the trials with their bounds and their costs at the truth."""
    pairs = [(network, drawn.truth.take(slice(i, i + 1))) for i, network in enumerate(drawn.networks)]
    bound = tuple(_covariance(network, truth)[0] for network, truth in pairs)
    return KnownNetworks(
        drawn, bound, np.array([float(likelihood(network).cost(truth)[0]) for network, truth in pairs])
    )


def true_columns(known: KnownNetworks) -> dict[str, Any]:
    """Return the columns that do not depend on the method, by name; the columns of a single target are NaN."""
    target_columns = dict.fromkeys((f"truth_{axis}" for axis in "xyz"), np.nan)
    deviations = [_deviations(bound, network) for bound, network in zip(known.bound, known.drawn.networks, strict=True)]
    trial_columns = {"outliers": known.drawn.bad, "cost_truth": known.cost, "crlb_velocity": np.nan}
    return (
        target_columns
        | trial_columns
        | {"crlb": np.array([pair[0] for pair in deviations]), "crlb_bias": np.array([pair[1] for pair in deviations])}
    )


def _deviations(covariance: Array, network: Network) -> tuple[float, float]:
    """Return the root mean square standard deviation of the stations' positions and of their clocks, metres.

    `covariance` (p, p) is in m^2. The second number is NaN if the stations share one clock.
    """
    m, d = network.stations, network.dimension
    variance = np.diag(covariance)
    clocks = float(np.sqrt(variance[m * d :].mean())) if not network.synchronised else np.nan
    return float(np.sqrt(variance[: m * d].sum() / m)), clocks


def found_columns(known: KnownNetworks, results: tuple[NetworkResult, ...]) -> dict[str, Any]:
    """Return the columns of the results of a method for k networks, by name: arrays (k,), or one value for all."""
    truth = [known.drawn.truth.take(slice(i, i + 1)) for i in range(len(results))]
    rows = [_result_columns(*item) for item in zip(results, known.drawn.networks, truth, known.bound, strict=True)]
    values: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    values |= {name: values[name].astype(object) for name in ("status", "reason", "proof")}
    unused = dict.fromkeys(("error_x", "error_y", "error_z", "error_velocity", "bound"), np.nan)
    return values | unused | {"rejected": 0, "certificate": ""}


def _result_columns(result: NetworkResult, network: Network, truth: NetworkEstimate, bound: Array) -> dict[str, Any]:
    """Return the columns of the result for one network, by name; `bound` (p, p) is the bound of its true network.

    The p unknowns begin with the coordinates of all stations.
    """
    error = distances_apart(result.stations, truth.stations[0])
    unknowns, located = error.size, bool(np.isfinite(result.stations).all())
    # A covariance belongs to the frame of its network. So the error for `nees` is computed in the frame of the result,
    # and the error for `deviation` in the frame of the truth.
    error_in_result_frame = distances_apart(truth.stations[0], result.stations)
    # The arrivals do not determine a common offset of all clocks. The standard deviation in `error_bias` removes it.
    return {
        "status": result.status.label,
        "reason": result.reason,
        "answered": located and result.status in ANSWERED,
        "located": located,
        "error": rms(error),
        "error_nearest": min(
            [rms(error), *(rms(distances_apart(other, truth.stations[0])) for other in result.others)]
        ),
        "error_bias": np.nan if network.synchronised else float(np.std(result.clocks - truth.clocks[0])),
        "deviation": float(np.sqrt(_normalised_square(error, bound[:unknowns, :unknowns]))),
        "sigma": _deviations(result.covariance, network)[0],
        "nees": _normalised_square(error_in_result_frame, result.covariance[:unknowns, :unknowns]),
        "cost": result.cost,
        "dof": result.dof,
        "alternatives": len(result.others),
        "proof": result.proof,
    }


def distances_apart(places: Array, truth: Array) -> Array:
    """Return the differences (m, d) between positions and the truth after the best rigid motion and reflection, metres.

    `places` and `truth` are the estimated and the true positions (m, d), metres. The result is NaN if one of them is
    not finite. Source: P. H. Schoenemann, "A generalized solution of the orthogonal Procrustes problem", Psychometrika
    31 (1966).
    """
    if not (np.isfinite(places).all() and np.isfinite(truth).all()):
        return np.full(truth.shape, np.nan)
    a, b = places - places.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    return np.asarray(a @ (u @ v) - b)


def rms(error: Array) -> float:
    """Return the root mean square length of vectors (m, d), in their unit."""
    return float(np.sqrt((error * error).sum(axis=-1).mean()))


def _normalised_square(error: Array, covariance: Array) -> float:
    """Return the squared error of all stations in units of a covariance, scaled so that its expectation is d.

    The result is d e' C^+ e / r: e is the error (m, d) as one vector, C^+ the pseudo-inverse of the covariance (m d, m
    d), and r its rank. It is NaN if an argument is not finite.
    """
    d = error.shape[1]
    if not (np.isfinite(covariance).all() and np.isfinite(error).all()):
        return np.nan
    variances, axes = np.linalg.eigh(covariance)
    kept = variances > _FRAME * variances[-1]
    return float(d * (((axes[:, kept].T @ error.ravel()) ** 2) / variances[kept]).sum() / max(int(kept.sum()), 1))
