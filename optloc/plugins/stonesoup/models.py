"""Measurement models of Stone Soup whose functions, derivatives and inverses are those of optloc, and their feeder.

A model is one scan of several rows. The feeder makes such scans of detections of single pairs, with the covariance that
rows share where they share a station.
"""

from __future__ import annotations

import datetime as dt
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from stonesoup.base import Property, clearable_cached_property
from stonesoup.buffered_generator import BufferedGenerator
from stonesoup.feeder.base import DetectionFeeder
from stonesoup.models.base import ReversibleModel
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection

from optloc.engine import linearise, predict
from optloc.models import MODELS, kind_named
from optloc.problem import (
    Array,
    Block,
    InvalidProblem,
    Motion,
    Problem,
    Status,
    arrivals,
    assemble,
    group,
    measured,
    station_array,
)
from optloc.solvers import solve

# A detection with one of these has no position of its own.
_NOT_ONE_PLACE = (Status.CONTRADICTORY, Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS)
_TYPES = {"azimuth": Bearing, "elevation": Elevation}

Row = tuple[str, int, int]
"""Kind, first and second station; -1 where the kind takes none."""


def arrival_covariance(pairs: Any, sigma: Any, stations: int) -> Array:
    """Return the covariance (m, m) of differences of what stations measure: rows that share a station correlate.

    Parameters
    ----------
    pairs : int array (m, 2)
        Stations a and b of each row.
    sigma : float or array (s,)
        Standard deviation of each station's arrival, metres; of its range rate, m/s.
    stations : int
        Number of stations s.
    """
    index = np.atleast_2d(np.asarray(pairs, dtype=int))
    variance = np.broadcast_to(np.asarray(sigma, dtype=float) ** 2, (stations,))
    return np.asarray(arrivals([(index[None, :, 0], 1), (index[None, :, 1], -1)], variance)[0])


class StationMeasurement(NonLinearGaussianMeasurement, ReversibleModel, ABC):  # type: ignore[misc]  # untyped bases
    """What stations at given positions measure of a target; base of the models below.

    Moving stations: give each detection a model of its own. Azimuths go from +x towards +y, elevations up from the
    plane, ranges and their differences are in metres, range rates and theirs in metres per second.

    Raises
    ------
    InvalidProblem
        Where stations, mapping or rows do not fit together, or for a rotation offset: turn the frame instead.
    """

    stations: np.ndarray = Property(doc="Positions (s, d) of the stations, metres.")
    translation_offset: StateVector | None = Property(
        default=None, doc="Where the origin of these positions is (d, 1), such as a platform's place; by default zero."
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.stations = np.asarray(self.stations, dtype=float)
        if np.any(np.asarray(self.rotation_offset, dtype=float)):
            raise InvalidProblem("there is a rotation offset", "rotation_offset", "give positions in a turned frame")
        if self.stations.ndim != 2 or self.stations.shape[1] != len(self.mapping):
            what = f"stations have shape {self.stations.shape} and {len(self.mapping)} coordinates are mapped"
            raise InvalidProblem(what, "stations", "give an array (stations, 2 or 3)")
        if self.translation_offset is not None and np.size(self.translation_offset) != len(self.mapping):
            what = f"the offset has shape {np.shape(self.translation_offset)} for {len(self.mapping)} coordinates"
            raise InvalidProblem(what, "translation_offset", "give one number for each coordinate")
        if np.shape(self.noise_covar) != (self.ndim_meas, self.ndim_meas):
            what = f"the covariance has shape {np.shape(self.noise_covar)} for {self.ndim_meas} rows"
            raise InvalidProblem(what, "noise_covar", "give one row and column for each row of the measurement")

    @property
    @abstractmethod
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row of the measurement."""

    @property
    def ndim_meas(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    @property
    def sites(self) -> Array:
        """Return where the stations are (s, d): their positions from the translation offset on."""
        offset = self.translation_offset
        return self.stations if offset is None else self.stations + np.asarray(offset, dtype=float).ravel()

    @property
    def places(self) -> list[int]:
        """Return the places in the state of what the measurement depends on: the position."""
        return list(self.mapping)

    @property
    def rates(self) -> Array | None:
        """Return the velocities (s, d) of the stations, metres per second, where they matter."""
        return None

    @clearable_cached_property("stations", "translation_offset", "noise_covar")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement: an unknown position, values of zero."""
        return self._posed(Motion())

    def _posed(self, motion: Motion) -> Problem:
        rates = None if self.rates is None else self.rates[None]
        covariance = np.asarray(self.noise_covar, dtype=float)
        return problem_of(self.sites[None], [self.rows], [covariance], velocity=rates, motions=(motion,))

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        """Return the measurement (m, 1) of a state, or (m, N) of N of them, with noise if wanted."""
        vector = np.asarray(state.state_vector, dtype=float)[self.places].T  # (N, d or 2 d)
        values = self._ordered(predict(self.problem, vector).T)
        if isinstance(noise, bool) or noise is None:
            noise = self.rvs(num_samples=values.shape[1], **kwargs) if noise else 0
        return self._typed(values) + noise

    def jacobian(self, state: Any, **kwargs: Any) -> Array:
        """Return the derivative (m, n) of the measurement with respect to the state."""
        vector = np.asarray(state.state_vector, dtype=float)[self.places, 0]
        out = np.zeros((self.ndim_meas, self.ndim_state))
        out[:, self.places] = self._ordered(linearise(self.problem, vector).shared)
        return out

    def inverse_function(self, detection: Any, **kwargs: Any) -> Any:
        """Return the state (n, 1) whose `places` fit a detection best, found without a guess; zeros elsewhere.

        Of a detection with several measurements (m, N) it returns their states (n, N), each found by itself.

        Raises
        ------
        NotImplementedError
            Where one has no clean fix of its own; initiators of Stone Soup can skip such ones.
        """
        z = np.asarray(detection.state_vector, dtype=float)[self.order].T
        fix = solve(self.problem.with_rows(z=z if len(z) > 1 else z[0])).flat()
        bad = np.flatnonzero(~fix.answered | fix.has(*_NOT_ONE_PLACE))
        if len(bad):
            raise NotImplementedError(Status(int(fix.code[bad[0]])).sentence)
        out = np.zeros((self.ndim_state, len(z)))
        out[self.places] = fix.x.T
        return out.view(StateVector if len(z) == 1 else StateVectors)

    def rvs(self, num_samples: int = 1, **kwargs: Any) -> Any:
        """Return samples (m, N) of the noise."""
        drawn = np.asarray(super().rvs(num_samples, **kwargs), dtype=float)
        return self._typed(drawn.reshape(self.ndim_meas, num_samples))

    def logpdf(self, state1: Any, state2: Any, **kwargs: Any) -> Any:
        """Return the logarithm of the density of a measurement given a state, angles wrapped."""
        from scipy.stats import multivariate_normal

        off = np.asarray(state1.state_vector - self.function(state2), dtype=float)
        return multivariate_normal.logpdf(off.T, cov=np.asarray(self.covar(**kwargs), dtype=float))

    @property
    def order(self) -> Array:
        """Return the place in the measurement of each row of `problem`, which keeps kinds together."""
        return rows_by_kind([self.rows])[1]

    def _ordered(self, values: Array) -> Array:
        """Return values (m, N) of the rows of `problem` in the order of the measurement."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def _typed(self, values: Array) -> Any:
        """Return values (m, N) with the angles among them as angles."""
        kind: Any = StateVector if values.shape[1] == 1 else StateVectors
        if not any(row[0] in _TYPES for row in self.rows):
            return kind(values)
        typed = values.astype(object)  # Stone Soup wraps differences of its own angle types only
        for i, (name, _, _) in enumerate(self.rows):
            if name in _TYPES:
                typed[i] = [_TYPES[name](value) for value in values[i]]
        return kind(typed)


class TDOA(StationMeasurement):
    """Range differences r_a - r_b of pairs of stations, metres."""

    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each row.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        return [("tdoa", int(a), int(b)) for a, b in np.atleast_2d(self.pairs)]


class GROA(StationMeasurement):
    """Gain ratios r_a / r_b of pairs of stations."""

    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each row.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        return [("groa", int(a), int(b)) for a, b in np.atleast_2d(self.pairs)]


class AOATDOA(StationMeasurement):
    """Azimuths, in space then elevations, of some stations; then range differences r_a - r_b of pairs, metres."""

    angles: np.ndarray = Property(doc="Stations (q,) that measure angles.")
    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each range difference.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        kinds = ("azimuth", "elevation")[: len(self.mapping) - 1]
        seen = [(kind, int(a), -1) for kind in kinds for a in np.atleast_1d(self.angles)]
        return [*seen, *(("tdoa", int(a), int(b)) for a, b in np.atleast_2d(self.pairs))]


class RateMeasurement(StationMeasurement, ABC):
    """What depends on the velocity of the target as well; base of the models below.

    Raises
    ------
    InvalidProblem
        Where velocities do not fit the stations, or the state has no place for the target's.
    """

    velocities: np.ndarray | None = Property(
        default=None, doc="Velocities (s, d) of the stations, m/s; by default they are at rest."
    )
    velocity_mapping: Sequence[int] | None = Property(
        default=None, doc="Places of the velocity in the state; by default those after the position's."
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.velocities = None if self.velocities is None else np.asarray(self.velocities, dtype=float)
        if self.velocities is not None and self.velocities.shape != self.stations.shape:
            what = f"velocities have shape {self.velocities.shape}, stations {self.stations.shape}"
            raise InvalidProblem(what, "velocities", "give one for each station")
        if self.moving and (len(self.places) != 2 * len(self.mapping) or max(self.places) >= self.ndim_state):
            what = f"the velocity is at {self.places[len(self.mapping) :]} of a state of {self.ndim_state}"
            raise InvalidProblem(what, "velocity_mapping", "name the places of the velocity")

    @property
    def moving(self) -> bool:
        """Return whether any row depends on velocities."""
        return True

    @property
    def places(self) -> list[int]:
        """Return the places in the state of the position, then of the velocity."""
        own = self.velocity_mapping
        return [*self.mapping, *([i + 1 for i in self.mapping] if own is None else own)]

    @property
    def rates(self) -> Array | None:
        """Return the velocities (s, d) of the stations."""
        return np.zeros_like(self.stations) if self.velocities is None else self.velocities

    @clearable_cached_property("stations", "translation_offset", "noise_covar", "velocities")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement: an unknown position and velocity, values of zero."""
        return self._posed(Motion(1))


class RangeRate(RateMeasurement):
    """Range rates of single stations, m/s: a Doppler shift f is the rate -c f / carrier."""

    receivers: np.ndarray = Property(doc="Station (m,) of each row.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and station of each row."""
        return [("range_rate", int(a), -1) for a in np.atleast_1d(self.receivers)]


class FDOA(RateMeasurement):
    """Range-rate differences of pairs of stations, m/s."""

    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each row.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        return [("fdoa", int(a), int(b)) for a, b in np.atleast_2d(self.pairs)]


class TDOAFDOA(RateMeasurement):
    """Range differences of pairs of stations, metres, then range-rate differences of the same pairs, m/s."""

    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each range difference and each rate difference.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        return [(kind, int(a), int(b)) for kind in ("tdoa", "fdoa") for a, b in np.atleast_2d(self.pairs)]


class AnyRows(RateMeasurement):
    """Any mixture of kinds in one measurement, with one inverse of all of them together.

    Stone Soup's combined model of several sums their inverses, which is a state of none: name the rows here instead.
    Elements follow `optloc.models.MODELS`: metres, radians, ratios, metres per second.
    """

    table: Sequence[Row] = Property(doc="Kind, first and second station of each row; -1 where a kind takes none.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        return [(kind_named(str(kind), "table"), int(a), int(b)) for kind, a, b in self.table]

    @property
    def moving(self) -> bool:
        """Return whether any row depends on velocities."""
        return any(MODELS[kind].velocity for kind, _, _ in self.rows)

    @property
    def places(self) -> list[int]:
        """Return the places in the state of the position and, where a row depends on it, of the velocity."""
        return super().places if self.moving else list(self.mapping)

    @property
    def rates(self) -> Array | None:
        """Return the velocities (s, d) of the stations, where they matter."""
        return super().rates if self.moving else None

    @clearable_cached_property("stations", "translation_offset", "noise_covar", "velocities", "table")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement: an unknown position, or position and velocity."""
        return self._posed(Motion(int(self.moving)))


def values_of(detection: Any) -> Array:
    """Return the values (m,) of a detection."""
    return np.asarray(detection.state_vector, dtype=float)[:, 0]


def rows_by_kind(scans: Sequence[Sequence[Row]]) -> tuple[dict[str, list[tuple[int, int, int]]], Array]:
    """Return (a, b, scan) of the rows of each kind, and the place of each in the scans one after the other."""
    found: dict[str, list[tuple[int, int, int]]] = {}
    places: dict[str, list[int]] = {}
    every = [(k, row) for k, rows in enumerate(scans) for row in rows]
    for i, (k, (kind, a, b)) in enumerate(every):
        found.setdefault(kind, []).append((a, b, k))
        places.setdefault(kind, []).append(i)
    return found, np.concatenate([np.array(part) for part in places.values()])


def problem_of(
    stations: Array,
    scans: Sequence[Sequence[Row]],
    covariances: Sequence[Array],
    *,
    velocity: Array | None = None,
    **more: Any,
) -> Problem:
    """Return the problem of some scans, with values of zero.

    Parameters
    ----------
    stations : array (..., k, s, d)
        Positions at each scan.
    scans : sequence of k sequences of (kind, a, b)
        Rows.
    covariances : sequence of k arrays (..., m, m)
        Of the rows of each scan.
    velocity : array (..., k, s, d), optional
        Of the stations at each scan.
    **more
        Further arguments of `optloc.assemble`.
    """
    kinds, order = rows_by_kind(scans)
    parts = []
    for kind, rows in kinds.items():
        a, b, k = np.array(rows).T
        parts.append(measured(kind, np.zeros(len(rows)), a=a, b=b, epoch=k, sigma=1.0))
    place = np.argsort(order)  # where each row of the scans stands among those sorted by kind
    ends = np.cumsum([0, *(len(rows) for rows in scans)])
    blocks = [
        Block(place[None, first:last], np.asarray(covariance, dtype=float)[..., None, :, :])
        for first, last, covariance in zip(ends[:-1], ends[1:], covariances, strict=True)
    ]
    first = stations[..., :1, :, :]
    still = first if np.array_equal(stations, np.broadcast_to(first, stations.shape)) else stations
    return replace(assemble(station_array(still, velocity=velocity), *parts, **more), noise=group(blocks))


class PairFeeder(DetectionFeeder):  # type: ignore[misc]  # untyped base
    """Groups the TDOA detections of an instant to one vector detection of each target.

    Rows that share a station share the error of its arrival: their covariance is D diag(arrival_sigma^2) D' plus that
    of each row's own noise. Without such own noise, pairs that close a loop say nothing new and are left out.
    """

    arrival_sigma: float = Property(doc="Standard deviation of each station's arrival, metres.")
    row_sigma: float = Property(default=0.0, doc="Standard deviation of the own noise of each row, metres.")
    label: str | None = Property(
        default=None, doc="Key of the metadata that tells targets apart; None: all pairs of an instant are of one."
    )

    @BufferedGenerator.generator_method  # type: ignore[untyped-decorator]
    def data_gen(self) -> Iterator[tuple[dt.datetime, set[Detection]]]:
        """Yield the times and the vector detections.

        Raises
        ------
        InvalidProblem
            For a detection that is no TDOA, or stations that differ within an instant.
        """
        for time, detections in self.reader:
            groups: dict[Any, list[Detection]] = {}
            for detection in detections:
                if not isinstance(detection.measurement_model, TDOA):
                    what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
                    raise InvalidProblem(what, "PairFeeder", "feed detections of the model TDOA")
                name = detection.metadata.get(self.label) if self.label else None
                groups.setdefault(name, []).append(detection)
            yield time, {self._joined(group) for group in groups.values()}

    def _joined(self, group: list[Detection]) -> Detection:
        group = sorted(group, key=lambda detection: np.atleast_2d(detection.measurement_model.pairs).tolist())
        models = [detection.measurement_model for detection in group]
        first = models[0]
        if any(not np.array_equal(model.stations, first.stations) for model in models):
            raise InvalidProblem("stations differ within an instant", "PairFeeder", "give all pairs the same stations")
        pairs = np.concatenate([np.atleast_2d(model.pairs) for model in models])
        z = np.concatenate([values_of(detection) for detection in group])
        # Noise of arrivals alone is singular on closed loops: their rows are sums of the others.
        kept = np.ones(len(z), dtype=bool) if self.row_sigma > 0.0 else _forest(pairs, len(first.stations))
        covariance = arrival_covariance(pairs[kept], self.arrival_sigma, len(first.stations))
        model = TDOA(
            ndim_state=first.ndim_state,
            mapping=first.mapping,
            noise_covar=covariance + self.row_sigma**2 * np.eye(len(covariance)),
            stations=first.stations,
            pairs=pairs[kept],
        )
        metadata = {key: value for detection in group for key, value in detection.metadata.items()}
        return Detection(z[kept][:, None], timestamp=group[0].timestamp, measurement_model=model, metadata=metadata)


def _forest(pairs: Array, stations: int) -> Array:
    """Return which pairs (m,) link stations that those before leave apart."""
    # Groups of linked stations, each named by one of its members.
    group, kept = np.arange(stations), np.zeros(len(pairs), dtype=bool)
    for i, (a, b) in enumerate(pairs):
        if group[a] != group[b]:
            kept[i] = True
            group[group == group[b]] = group[a]
    return kept
