"""Studies of networks: simulation of stations, clocks and pulses, solution by a method, and comparison with the truth.

Networks are known up to a rigid motion and a reflection, so errors are measured after the best alignment.
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
from optloc.sites.calibration.network import Network, network_of

CALIBRATE = "calibrate"
"""Name of the method of optloc for networks."""

# Rows that each pulse keeps beyond its number of unknowns: with fewer it does not constrain the network.
_SPARE = 2
# Eigenvalues of a covariance below this share of the largest belong to the frame.
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
        The noise level, metres.
    seed : int
        Seed of the study.
    trials : int
        Number of trials.
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
        """Return the columns of the table that all trials share."""
        table = self.table
        rows = table.stations * table.pulses
        sizes = {"dimension": table.dimension, "stations": table.stations, "rows": rows, "epochs": table.pulses}
        return {"kinds": "toa", **sizes}

    @property
    def numbers(self) -> int:
        """Return the number of measurements of a trial."""
        return self.table.stations * self.table.pulses

    def draw(self, first: int, count: int) -> Networks:
        """Return trials `first` to ``first + count``; they do not depend on other draws."""
        drawn = [_trial(self, number) for number in range(first, first + count)]
        seed = tuple(f"{self.seed}:{self.key}:{number}" for number in range(first, first + count))
        digest = tuple(_digest(self, network) for network, _, _ in drawn)
        bad = np.array([bad for _, _, bad in drawn])
        return Networks(tuple(one[0] for one in drawn), together(*(one[1] for one in drawn)), seed, digest, bad)


@dataclass(frozen=True, slots=True)
class Networks:
    """Simulated trials of a case of networks.

    Parameters
    ----------
    networks : tuple of n Network
        The networks that methods solve.
    truth : NetworkEstimate
        The n true networks.
    seed, digest : tuple of n str
        Names of the trials' seeds, and digests of the drawn numbers.
    bad : int array (n,)
        Number of arrivals with a gross error.
    """

    networks: tuple[Network, ...]
    truth: NetworkEstimate
    seed: tuple[str, ...]
    digest: tuple[str, ...]
    bad: Array

    def part(self, first: int, count: int) -> Networks:
        """Return `count` trials from the trial `first` on."""
        kept = slice(first, first + count)
        truth = self.truth.take(kept)
        return Networks(self.networks[kept], truth, self.seed[kept], self.digest[kept], self.bad[kept])


def check_network(table: NetworkTable, where: str) -> None:
    """Raise InvalidProblem for amounts that are invalid or do not fit each other."""
    for key in ("box", "around"):
        if (given := getattr(table, key)) is not None and len(given) < table.dimension:
            what = f"{len(given)} widths do not fit {table.dimension} dimensions"
            raise InvalidProblem(what, join(where, key), "give one for each")
    for key in ("box", "around", "emission", "clocks"):
        _lengths(table, key, where)
    if table.outliers is not None:
        _size(table, where)


def noise_of(level: Amount, where: str) -> float:
    """Return a noise level in metres."""
    sigma = Units("length").plain(level, "m", where)
    if not sigma > 0.0:
        raise InvalidProblem(f"{level!r} is not positive", where, "give a positive standard deviation")
    return sigma


def _lengths(table: NetworkTable, key: str, where: str) -> Array:
    """Return the lengths of a key of the table as an array in metres; raise InvalidProblem if negative."""
    given = getattr(table, key)
    values = given if isinstance(given, list) else [] if given is None else [given]
    lengths = np.array([Units("length").plain(value, "m", join(where, key)) for value in values])
    if not (lengths >= 0.0).all():
        raise InvalidProblem(f"{key} is negative", join(where, key), "give widths")
    return lengths


def _size(table: NetworkTable, where: str) -> float:
    """Return the size of gross errors in metres."""
    assert table.outliers is not None
    size, place = table.outliers.size, join(where, "outliers.size")
    if isinstance(size, dict):
        raise InvalidProblem("networks have arrivals only", place, 'write one length, such as "4 m"')
    return Units("length").plain(size, "m", place)


def _trial(case: NetworkCase, number: int) -> tuple[Network, NetworkEstimate, int]:
    """Return one network, its true values and the number of its arrivals with a gross error."""
    # A seed sequence mixes words of 32 bits. Positions, noise and gross errors have separate streams: a change of one
    # does not shift the others.
    key = [int(case.key[:8], 16), int(case.key[8:], 16)]
    words = np.random.SeedSequence([case.seed, *key], spawn_key=(number,)).spawn(3)
    place, noise, flaws = (np.random.default_rng(word) for word in words)
    table, m, n, d = case.table, case.table.stations, case.table.pulses, case.table.dimension
    box = _lengths(table, "box", case.where)[:d]
    around = box if table.around is None else _lengths(table, "around", case.where)[:d]
    stations, pulses = place.uniform(-0.5, 0.5, (m, d)) * box, place.uniform(-0.5, 0.5, (n, d)) * around
    sent = place.uniform(-0.5, 0.5, n) * _lengths(table, "emission", case.where)[0]
    clocks = place.uniform(-0.5, 0.5, m) * (0.0 if table.synchronised else _lengths(table, "clocks", case.where)[0])
    line = pulses[:, None] - stations
    z = np.sqrt((line * line).sum(axis=-1)) + sent[:, None] + clocks + case.level * noise.standard_normal((n, m))
    bad = np.zeros((n, m), dtype=bool)
    if table.outliers is not None:
        bad = flaws.random((n, m)) < table.outliers.share
        sign = np.where(flaws.random((n, m)) < 0.5 - 0.5 * table.outliers.late, -1.0, 1.0)
        z = z + bad * sign * _size(table, case.where)
    chance = flaws.random((n, m))
    least = min(m, d + 1 + _SPARE)
    kept = (chance >= table.missing) | (np.argsort(np.argsort(-chance, axis=1), axis=1) < least)
    made = network_of(np.where(kept, z, np.nan), case.level, dimension=d, synchronised=table.synchronised)
    truth = NetworkEstimate(stations[None], clocks[None], pulses[None], sent[None])
    return made, truth, int((bad & kept).sum())


def _digest(case: NetworkCase, network: Network) -> str:
    """Return 16 hexadecimal digits that identify the drawn arrivals."""
    made = hashlib.blake2b(case.key.encode(), digest_size=8)
    for array in (network.z, network.sigma):
        made.update(np.ascontiguousarray(array).tobytes())
    return made.hexdigest()


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
    stations, clocks : array (M, d), (M,)
        Positions and clock offsets, metres; NaN without a result.
    covariance : array (P, P)
        Covariance of both, in the frame of all stations; NaN without one.
    cost : float
        Cost of the likelihood.
    dof : int
        Degrees of freedom.
    proof : str
        Proof as in a `Calibration`.
    others : tuple of arrays (M, d)
        Stations of the other networks that it lists, metres.
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
    """Return the results of `optloc.calibrate` for each network."""
    return tuple(_of_calibration(calibrate(network)) for network in networks.networks)


def _of_calibration(found: Calibration) -> NetworkResult:
    """Return a calibration as the result of a method."""
    reason = found.findings[0] if found.findings else ""
    others = tuple(one.stations for one in found.alternatives)
    values = (found.stations, found.clocks, found.covariance, found.cost, found.dof)
    return NetworkResult(found.status, reason, *values, found.proof, others)


def refined(network: Network, starts: NetworkEstimate) -> NetworkResult:
    """Return the cheapest minimum that is reached from several starts, claimed as an answer.

    `starts` are S estimates; without any, the result has no network.
    """
    m, d = network.stations, network.dimension
    p = m * d + (0 if network.synchronised else m)
    nothing = np.full((m, d), np.nan), np.full(m, np.nan), np.full((p, p), np.nan)
    if not starts.count:
        return NetworkResult(Status.NUMERICAL, "There is no start.", *nothing, np.nan, 0)
    lik = likelihood(network)
    ends, cost = lik.refine(starts)
    if not np.isfinite(cost).any():
        return NetworkResult(Status.NUMERICAL, "No start led to a network.", *nothing, np.nan, 0)
    at = ends.take(np.array([int(np.nanargmin(cost))]))
    covariance, free = _covariance(network, at)
    dof = network.rows - network.unknowns + free
    if not np.isfinite(covariance).all():
        words = "The arrivals do not determine the network, apart from its frame."
        return NetworkResult(
            Status.SINGULAR_GEOMETRY, words, at.stations[0], at.clocks[0], covariance, np.nanmin(cost), dof
        )
    return NetworkResult(Status.OK, "", at.stations[0], at.clocks[0], covariance, float(np.nanmin(cost)), dof)


def _covariance(network: Network, at: NetworkEstimate) -> tuple[Array, int]:
    """Return the covariance of an estimate in the frame of all stations, NaN if singular, and the frame's freedoms."""
    frame = determined(likelihood(network), at)
    p, free = frame.jacobian.shape[1], frame.free.shape[1]
    if not frame.open.shape[1]:
        try:
            return frame.covariance(frame.free.T), free
        except np.linalg.LinAlgError:
            pass
    return np.full((p, p), np.nan), free


def each(refine: Callable[[Network, int], NetworkResult]) -> Callable[[Networks], tuple[NetworkResult, ...]]:
    """Return a function that applies `refine` to each network, with a separate seed."""

    def run(networks: Networks) -> tuple[NetworkResult, ...]:
        seeds = [int(digest, 16) for digest in networks.digest]
        return tuple(refine(one, seed) for one, seed in zip(networks.networks, seeds, strict=True))

    return run


def from_truth(networks: Networks) -> tuple[NetworkResult, ...]:
    """Return the minima of the likelihood from the truth, which judge the other methods."""
    return tuple(refined(one, networks.truth.take(slice(i, i + 1))) for i, one in enumerate(networks.networks))


# Columns of the table.


@dataclass(frozen=True, slots=True)
class KnownNetworks:
    """Data of trials that do not depend on the method.

    Parameters
    ----------
    drawn : Networks
        The trials.
    bound : tuple of n arrays (P, P)
        Bounds at the truth in the frame of all stations; NaN where the geometry is singular.
    cost : array (n,)
        Cost at the truth.
    """

    drawn: Networks
    bound: tuple[Array, ...]
    cost: Array

    def part(self, first: int, count: int) -> KnownNetworks:
        """Return the data of `count` trials from the trial `first` on."""
        kept = slice(first, first + count)
        return KnownNetworks(self.drawn.part(first, count), self.bound[kept], self.cost[kept])


def known_networks(drawn: Networks) -> KnownNetworks:
    """Return bound and cost at the truth of trials."""
    one = [(network, drawn.truth.take(slice(i, i + 1))) for i, network in enumerate(drawn.networks)]
    bound = tuple(_covariance(network, at)[0] for network, at in one)
    return KnownNetworks(drawn, bound, np.array([float(likelihood(network).cost(at)[0]) for network, at in one]))


def true_columns(known: KnownNetworks) -> dict[str, Any]:
    """Return the columns that do not depend on the method; the columns of a single target are NaN."""
    nowhere = dict.fromkeys((f"truth_{axis}" for axis in "xyz"), np.nan)
    spread = [_spread(bound, network) for bound, network in zip(known.bound, known.drawn.networks, strict=True)]
    own = {"outliers": known.drawn.bad, "cost_truth": known.cost, "crlb_velocity": np.nan}
    return nowhere | own | {"crlb": np.array([s[0] for s in spread]), "crlb_bias": np.array([s[1] for s in spread])}


def _spread(covariance: Array, network: Network) -> tuple[float, float]:
    """Return the root mean square deviation of a station's position and of a clock, metres."""
    m, d = network.stations, network.dimension
    variance = np.diag(covariance)
    clocks = float(np.sqrt(variance[m * d :].mean())) if not network.synchronised else np.nan
    return float(np.sqrt(variance[: m * d].sum() / m)), clocks


def found_columns(known: KnownNetworks, found: tuple[NetworkResult, ...]) -> dict[str, Any]:
    """Return the columns of the results of a method for n networks."""
    truth = [known.drawn.truth.take(slice(i, i + 1)) for i in range(len(found))]
    rows = [_row(*one) for one in zip(found, known.drawn.networks, truth, known.bound, strict=True)]
    values: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    values |= {name: values[name].astype(object) for name in ("status", "reason", "proof")}
    nothing = dict.fromkeys(("error_x", "error_y", "error_z", "error_velocity", "bound"), np.nan)
    return values | nothing | {"rejected": 0, "certificate": ""}


def _row(one: NetworkResult, network: Network, truth: NetworkEstimate, bound: Array) -> dict[str, Any]:
    """Return the columns of the result for one network."""
    error = distances_apart(one.stations, truth.stations[0])
    size, located = error.size, bool(np.isfinite(one.stations).all())
    # in the frame of the result, like its covariance
    own = distances_apart(truth.stations[0], one.stations)
    return {
        "status": one.status.label,
        "reason": one.reason,
        "answered": located and one.status in ANSWERED,
        "located": located,
        "error": rms(error),
        "error_nearest": min([rms(error), *(rms(distances_apart(other, truth.stations[0])) for other in one.others)]),
        "error_bias": np.nan if network.synchronised else float(np.std(one.clocks - truth.clocks[0])),
        "deviation": float(np.sqrt(_squared(error, bound[:size, :size]))),
        "sigma": _spread(one.covariance, network)[0],
        "nees": _squared(own, one.covariance[:size, :size]),
        "cost": one.cost,
        "dof": one.dof,
        "alternatives": len(one.others),
        "proof": one.proof,
    }


def distances_apart(places: Array, truth: Array) -> Array:
    """Return the differences (m, d) between positions and the truth after the best rigid motion and reflection, metres.

    P. H. Schoenemann, "A generalized solution of the orthogonal Procrustes problem", Psychometrika 31 (1966).
    """
    if not (np.isfinite(places).all() and np.isfinite(truth).all()):
        return np.full(truth.shape, np.nan)
    a, b = places - places.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    return np.asarray(a @ (u @ v) - b)


def rms(error: Array) -> float:
    """Return the root mean square length of vectors (m, d)."""
    return float(np.sqrt((error * error).sum(axis=-1).mean()))


def _squared(error: Array, covariance: Array) -> float:
    """Return e' C^+ e over the degrees of freedom of the shape, times the dimension."""
    d = error.shape[1]
    if not (np.isfinite(covariance).all() and np.isfinite(error).all()):
        return np.nan
    width, axes = np.linalg.eigh(covariance)
    seen = width > _FRAME * width[-1]
    return float(d * (((axes[:, seen].T @ error.ravel()) ** 2) / width[seen]).sum() / max(int(seen.sum()), 1))
