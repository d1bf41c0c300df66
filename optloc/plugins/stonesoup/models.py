"""Measurement models of Stone Soup with functions, derivatives and inverses of optloc, and a feeder for pairs.

One measurement of a model is one scan with several rows. The feeder joins detections of single pairs to
such scans. Rows that share a station have correlated errors; the feeder computes their covariance.

Letters: s stations, d coordinates, m rows of a measurement, n numbers of a state, N states.
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

# A detection with one of these statuses has no usable position.
_NOT_ONE_PLACE = (Status.CONTRADICTORY, Status.MISFIT, Status.UNBOUNDED, Status.AMBIGUOUS)
_TYPES = {"azimuth": Bearing, "elevation": Elevation}

Row = tuple[str, int, int]
"""Kind, first and second station of a row; -1 for a kind with one station."""


def arrival_covariance(pairs: Any, sigma: Any, stations: int) -> Array:
    """Return the covariance (m, m) of differences between stations: rows that share a station are correlated.

    Parameters
    ----------
    pairs : int array (m, 2)
        Stations a and b of each row.
    sigma : float or array (s,)
        Standard deviation of the arrival of each station, metres, or of its range rate, m/s.
    stations : int
        Number s of stations.
    """
    index = np.atleast_2d(np.asarray(pairs, dtype=int))
    variance = np.broadcast_to(np.asarray(sigma, dtype=float) ** 2, (stations,))
    return np.asarray(arrivals([(index[None, :, 0], 1), (index[None, :, 1], -1)], variance)[0])


class StationMeasurement(NonLinearGaussianMeasurement, ReversibleModel, ABC):  # type: ignore[misc]  # untyped bases
    """Base class of the models below: measurements of a target by stations at given positions.

    If stations move, give each detection a separate model. Azimuths are measured from +x towards +y, elevations
    upwards from the plane. Ranges and range differences are in metres, range rates and their differences in
    metres per second.

    Raises
    ------
    InvalidProblem
        If stations, mapping or rows do not fit together. A rotation offset is an error too: turn the frame
        instead.
    """

    stations: np.ndarray = Property(doc="Positions (s, d) of the stations, metres.")
    translation_offset: StateVector | None = Property(
        default=None, doc="Origin (d, 1) of the station positions, such as the position of a platform; by default zero."
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Check the shapes of stations, offset and covariance."""
        super().__init__(*args, **kwargs)
        self.stations = np.asarray(self.stations, dtype=float)
        if np.any(np.asarray(self.rotation_offset, dtype=float)):
            raise InvalidProblem(
                "a rotation offset is not supported", "rotation_offset", "turn the station positions instead"
            )
        if self.stations.ndim != 2 or self.stations.shape[1] != len(self.mapping):
            what = f"stations have shape {self.stations.shape}, but {len(self.mapping)} coordinates are mapped"
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
        """Return kind and stations of each of the m rows of the measurement."""

    @property
    def ndim_meas(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    @property
    def sites(self) -> Array:
        """Return the station positions (s, d), metres: `stations` plus the translation offset."""
        offset = self.translation_offset
        return self.stations if offset is None else self.stations + np.asarray(offset, dtype=float).ravel()

    @property
    def places(self) -> list[int]:
        """Return the state indices that the measurement depends on: the position."""
        return list(self.mapping)

    @property
    def rates(self) -> Array | None:
        """Return the station velocities (s, d), m/s, or None if the measurement does not depend on velocities."""
        return None

    @clearable_cached_property("stations", "translation_offset", "noise_covar")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement, with an unknown position and all values zero."""
        return self._build_problem(Motion())

    def _build_problem(self, motion: Motion) -> Problem:
        """Return the optloc problem of one measurement, with all values zero; `motion` is its unknown."""
        rates = None if self.rates is None else self.rates[None]
        covariance = np.asarray(self.noise_covar, dtype=float)
        return problem_of(self.sites[None], [self.rows], [covariance], velocity=rates, motions=(motion,))

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        """Return the measurement (m, 1) of a state, or (m, N) of N states, with noise if requested."""
        vector = np.asarray(state.state_vector, dtype=float)[self.places].T  # (N, d or 2 d)
        values = self._in_scan_order(predict(self.problem, vector).T)
        if isinstance(noise, bool) or noise is None:
            noise = self.rvs(num_samples=values.shape[1], **kwargs) if noise else 0
        return self._with_angle_types(values) + noise

    def jacobian(self, state: Any, **kwargs: Any) -> Array:
        """Return the derivative (m, n) of the measurement with respect to the state."""
        vector = np.asarray(state.state_vector, dtype=float)[self.places, 0]
        out = np.zeros((self.ndim_meas, self.ndim_state))
        out[:, self.places] = self._in_scan_order(linearise(self.problem, vector).shared)
        return out

    def inverse_function(self, detection: Any, **kwargs: Any) -> Any:
        """Return the state (n, 1) that fits a detection best, without a first guess; zero outside `places`.

        For a detection with N measurements (m, N), the result is N independent states (n, N).

        Raises
        ------
        NotImplementedError
            If a measurement has no clean and unique fix; initiators of Stone Soup can skip such measurements.
        """
        # `order` sorts the values by kind, as the problem needs them.
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
        return self._with_angle_types(drawn.reshape(self.ndim_meas, num_samples))

    def logpdf(self, state1: Any, state2: Any, **kwargs: Any) -> Any:
        """Return the logarithm of the density of a measurement `state1`, given a state `state2`; angles are wrapped."""
        from scipy.stats import multivariate_normal

        off = np.asarray(state1.state_vector - self.function(state2), dtype=float)
        return multivariate_normal.logpdf(off.T, cov=np.asarray(self.covar(**kwargs), dtype=float))

    @property
    def order(self) -> Array:
        """Return the index (m,) in the measurement of each row of `problem`, which sorts the rows by kind."""
        return rows_by_kind([self.rows])[1]

    def _in_scan_order(self, values: Array) -> Array:
        """Return values (m, N) of the rows of `problem` in the row order of the measurement."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def _with_angle_types(self, values: Array) -> Any:
        """Return values (m, N) with angle rows as Stone Soup angles."""
        kind: Any = StateVector if values.shape[1] == 1 else StateVectors
        if not any(row[0] in _TYPES for row in self.rows):
            return kind(values)
        typed = values.astype(object)  # Stone Soup wraps only its angle types
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
    """Azimuths of some stations (with three coordinates, then elevations); then range differences of pairs, metres."""

    angles: np.ndarray = Property(doc="Stations (q,) that measure angles.")
    pairs: np.ndarray = Property(doc="Stations a and b (m, 2) of each range difference.")

    @property
    def rows(self) -> Sequence[Row]:
        """Return kind and stations of each row."""
        kinds = ("azimuth", "elevation")[: len(self.mapping) - 1]
        seen = [(kind, int(a), -1) for kind in kinds for a in np.atleast_1d(self.angles)]
        return [*seen, *(("tdoa", int(a), int(b)) for a, b in np.atleast_2d(self.pairs))]


class RateMeasurement(StationMeasurement, ABC):
    """Base class of the models below, whose measurements also depend on the velocity of the target.

    Raises
    ------
    InvalidProblem
        If the velocities do not fit the stations, or if the state has no velocity of the target.
    """

    velocities: np.ndarray | None = Property(
        default=None, doc="Velocities (s, d) of the stations, m/s; by default they are at rest."
    )
    velocity_mapping: Sequence[int] | None = Property(
        default=None,
        doc="State indices of the velocity; by default, each follows the index of its position coordinate.",
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Check the velocities of the stations and the state indices of the velocity."""
        super().__init__(*args, **kwargs)
        self.velocities = None if self.velocities is None else np.asarray(self.velocities, dtype=float)
        if self.velocities is not None and self.velocities.shape != self.stations.shape:
            what = f"velocities have shape {self.velocities.shape}, stations {self.stations.shape}"
            raise InvalidProblem(what, "velocities", "give one velocity for each station")
        if self.moving and (len(self.places) != 2 * len(self.mapping) or max(self.places) >= self.ndim_state):
            what = f"velocity indices {self.places[len(self.mapping) :]} do not fit a state of size {self.ndim_state}"
            raise InvalidProblem(what, "velocity_mapping", "give the state indices of the velocity")

    @property
    def moving(self) -> bool:
        """Return whether any row depends on velocities."""
        return True

    @property
    def places(self) -> list[int]:
        """Return the state indices of the position, then of the velocity."""
        own = self.velocity_mapping
        return [*self.mapping, *([i + 1 for i in self.mapping] if own is None else own)]

    @property
    def rates(self) -> Array | None:
        """Return the station velocities (s, d), metres per second."""
        return np.zeros_like(self.stations) if self.velocities is None else self.velocities

    @clearable_cached_property("stations", "translation_offset", "noise_covar", "velocities")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement, with an unknown position and velocity and all values zero."""
        return self._build_problem(Motion(1))


class RangeRate(RateMeasurement):
    """Range rates of single stations, m/s. A Doppler shift f corresponds to the range rate -c f / carrier."""

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
    """Any mixture of kinds in one measurement, with one inverse from all rows together.

    The combined model of Stone Soup adds the inverses of its models, so the sum is no valid state. Use this class
    with a table of rows instead. For the units of the elements, see `optloc.models.MODELS`: metres, radians, ratios,
    metres per second.
    """

    table: Sequence[Row] = Property(doc="Kind, first and second station of each row; -1 for a kind with one station.")

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
        """Return the state indices of the position and, if a row depends on the velocity, of the velocity."""
        return super().places if self.moving else list(self.mapping)

    @property
    def rates(self) -> Array | None:
        """Return the station velocities (s, d), metres per second, or None if no row depends on velocities."""
        return super().rates if self.moving else None

    @clearable_cached_property("stations", "translation_offset", "noise_covar", "velocities", "table")  # type: ignore[untyped-decorator]
    def problem(self) -> Problem:
        """Return the optloc problem of one measurement, with an unknown position, or position and velocity."""
        return self._build_problem(Motion(int(self.moving)))


def values_of(detection: Any) -> Array:
    """Return the values (m,) of a detection: metres, radians, ratios or m/s."""
    return np.asarray(detection.state_vector, dtype=float)[:, 0]


def rows_by_kind(scans: Sequence[Sequence[Row]]) -> tuple[dict[str, list[tuple[int, int, int]]], Array]:
    """Return (a, b, scan) of the rows of each kind, and the index (m,) of each row in the concatenated scans.

    The kinds are in the order of their first row. An optloc problem needs its rows in this order.
    """
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
    """Return the problem of several scans, with all values zero.

    Parameters
    ----------
    stations : array (..., k, s, d)
        Station positions at each scan, metres.
    scans : sequence of k sequences of (kind, a, b)
        Rows of each scan.
    covariances : sequence of k arrays (..., m, m)
        Covariance of the rows of each scan.
    velocity : array (..., k, s, d), optional
        Station velocities at each scan, m/s.
    **more
        Further arguments of `optloc.assemble`.
    """
    kinds, order = rows_by_kind(scans)
    parts = []
    for kind, rows in kinds.items():
        a, b, k = np.array(rows).T
        parts.append(measured(kind, np.zeros(len(rows)), a=a, b=b, epoch=k, sigma=1.0))
    place = np.argsort(order)  # index of each scan row in the order by kind
    ends = np.cumsum([0, *(len(rows) for rows in scans)])
    blocks = [
        Block(place[None, first:last], np.asarray(covariance, dtype=float)[..., None, :, :])
        for first, last, covariance in zip(ends[:-1], ends[1:], covariances, strict=True)
    ]
    first = stations[..., :1, :, :]
    still = first if np.array_equal(stations, np.broadcast_to(first, stations.shape)) else stations
    return replace(assemble(station_array(still, velocity=velocity), *parts, **more), noise=group(blocks))


class PairFeeder(DetectionFeeder):  # type: ignore[misc]  # untyped base
    """Joins the TDOA detections of one time to one vector detection for each target.

    Rows that share a station share the error of its arrival. Their covariance is D diag(arrival_sigma^2) D' plus
    the independent noise of each row. Without independent noise, a pair that closes a loop adds no information
    and is left out.
    """

    arrival_sigma: float = Property(doc="Standard deviation of each station's arrival, metres.")
    row_sigma: float = Property(default=0.0, doc="Standard deviation of the independent noise of each row, metres.")
    label: str | None = Property(
        default=None, doc="Metadata key that identifies targets; None: all pairs of one time belong to one target."
    )

    @BufferedGenerator.generator_method  # type: ignore[untyped-decorator]
    def data_gen(self) -> Iterator[tuple[dt.datetime, set[Detection]]]:
        """Yield each time with its vector detections.

        Raises
        ------
        InvalidProblem
            If a detection is not a TDOA, or if stations differ between detections of one time.
        """
        for time, detections in self.reader:
            groups: dict[Any, list[Detection]] = {}
            for detection in detections:
                if not isinstance(detection.measurement_model, TDOA):
                    what = f"a detection has the measurement model {type(detection.measurement_model).__name__}"
                    raise InvalidProblem(what, "PairFeeder", "feed detections of the model TDOA")
                name = detection.metadata.get(self.label) if self.label else None
                groups.setdefault(name, []).append(detection)
            yield time, {self._join(group) for group in groups.values()}

    def _join(self, group: list[Detection]) -> Detection:
        """Return one vector detection from `group`, the pair detections of one target at one time."""
        group = sorted(group, key=lambda detection: np.atleast_2d(detection.measurement_model.pairs).tolist())
        models = [detection.measurement_model for detection in group]
        first = models[0]
        if any(not np.array_equal(model.stations, first.stations) for model in models):
            raise InvalidProblem(
                "stations differ between detections of one time", "PairFeeder", "give all pairs the same stations"
            )
        pairs = np.concatenate([np.atleast_2d(model.pairs) for model in models])
        z = np.concatenate([values_of(detection) for detection in group])
        # The covariance of arrival noise is singular on closed loops: such rows are sums of others.
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
    """Return a mask (m,) of the pairs (m, 2) that form no closed loop with earlier pairs.

    Each kept pair connects two groups of stations that earlier pairs do not connect. `stations` is the number
    of stations.
    """
    # Label of the connected group of each station.
    group, kept = np.arange(stations), np.zeros(len(pairs), dtype=bool)
    for i, (a, b) in enumerate(pairs):
        if group[a] != group[b]:
            kept[i] = True
            group[group == group[b]] = group[a]
    return kept
