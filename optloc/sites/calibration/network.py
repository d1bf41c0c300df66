"""A network of stations, clocks and emitters that are unknown together: measurements and prior knowledge.

A pulse is one emission at an unknown position and, except for two-way ranges, at an unknown time. A slot is the
kind and the stations of one measurement; each pulse has at most one value for each slot.

Letters: M stations, N pulses, R slots, d coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.engine import numbers
from optloc.files import Units, positive_speed, stated_speed
from optloc.models import MODELS, kind_named
from optloc.problem import SPEED_OF_LIGHT, Amount, Array, HasShortForm, InvalidProblem, check_once, nearest

CLOCKED = ("toa", "tdoa")
"""Kinds that depend on the station clock; a two-way range does not."""

KINDS = (*CLOCKED, "range")
"""Kinds of rows between stations and pulses."""


@dataclass(frozen=True, slots=True)
class NetworkSlot:
    """The stations of one measurement: a column of the table of measurements.

    Parameters
    ----------
    kind : str
        "toa", "tdoa" or "range".
    a, b : int
        Stations; `b` is -1 for kinds with one station.
    """

    kind: str
    a: int
    b: int = -1


@dataclass(frozen=True, slots=True, repr=False)
class Network(HasShortForm):
    """Measurements between stations and pulses at unknown positions.

    Parameters
    ----------
    names : tuple of M str
        Names of the stations.
    slots : tuple of R NetworkSlot
        Columns of `z`.
    z : array (N, R)
        Measured values of N pulses, metres (times are multiplied by the propagation speed).
    sigma : array (N, R)
        Standard deviations, metres; infinite if there is no measurement.
    place : array (M, d)
        Prior coordinates of the stations, metres.
    place_sigma : array (M, d)
        Standard deviations of the prior coordinates, metres: infinite for a free coordinate, zero for an exact
        one.
    synchronised : bool
        Whether the stations share a clock; otherwise each station has an unknown offset.
    between : int array (q, 2)
        Pairs of stations with a measured distance.
    distance, distance_sigma : array (q,)
        The measured distances and their standard deviations, metres.
    labels : tuple of N str
        Names of the pulses.
    """

    names: tuple[str, ...]
    slots: tuple[NetworkSlot, ...]
    z: Array
    sigma: Array
    place: Array
    place_sigma: Array
    synchronised: bool
    between: Array
    distance: Array
    distance_sigma: Array
    labels: tuple[str, ...]

    @property
    def dimension(self) -> int:
        """Return the number of dimensions, 2 or 3."""
        return int(self.place.shape[1])

    @property
    def stations(self) -> int:
        """Return the number M of stations."""
        return len(self.names)

    @property
    def pulses(self) -> int:
        """Return the number N of pulses."""
        return int(self.z.shape[0])

    @property
    def given(self) -> Array:
        """Return a mask (N, R) of the measured entries of `z`."""
        return np.isfinite(self.sigma)

    @property
    def emission(self) -> Array:
        """Return a mask (N,) of the pulses with an unknown emission time."""
        emitting = np.array([MODELS[slot.kind].emission for slot in self.slots])
        return np.asarray((self.given & emitting).any(axis=1))

    @property
    def rows(self) -> int:
        """Return the number of measurements, distances between stations, and prior coordinates that are not exact."""
        soft = np.isfinite(self.place_sigma) & (self.place_sigma > 0.0)
        return int(self.given.sum() + len(self.distance) + soft.sum())

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns, frame included."""
        free = int((self.place_sigma > 0.0).sum())
        clocks = 0 if self.synchronised else self.stations
        return free + clocks + self.pulses * self.dimension + int(self.emission.sum())

    def take(self, pulses: Array) -> Network:
        """Return the network with a selection of the pulses (mask or indices)."""
        labels = tuple(np.array(self.labels, dtype=object)[pulses])
        return Network(
            self.names,
            self.slots,
            self.z[pulses],
            self.sigma[pulses],
            self.place,
            self.place_sigma,
            self.synchronised,
            self.between,
            self.distance,
            self.distance_sigma,
            labels,
        )


def network_speed(given: Amount | None, where: str) -> float:
    """Return the wave speed of a network, m/s; light without a stated speed.

    `given` is a number, or text as for `optloc.locate`, such as "air:20C". `where` is the place for messages. Raise
    InvalidProblem for an uncertain speed, or the file of a profile, which networks cannot use.
    """
    if not isinstance(given, str):
        return SPEED_OF_LIGHT if given is None else positive_speed(given, "speed", where)
    stated = stated_speed(given, where)
    if stated.sigma is not None:
        advice = "leave the standard deviation out; a wrong speed scales the network"
        raise InvalidProblem("the speed of a network is exact", where, advice)
    return stated.speed


def network_of(
    z: Any,
    sigma: Any,
    *,
    kind: str = "toa",
    pairs: Sequence[tuple[int, int]] | None = None,
    names: Sequence[str] | None = None,
    dimension: int | None = None,
    place: Any = None,
    place_sigma: Any = None,
    synchronised: bool = True,
    distances: Sequence[tuple[int, int, float, float]] = (),
    labels: Sequence[str] | None = None,
    wave_speed: Amount | None = None,
    two_way: bool = False,
    turn_around: Amount | None = None,
) -> Network:
    """Return a network with one kind of measurements.

    Parameters
    ----------
    z : array (N, M), or (N, R) with `pairs`
        Arrival times multiplied by the propagation speed, or ranges, of N pulses at M stations, metres; NaN if
        there is no measurement.
    sigma : float or array like `z`
        Standard deviations, metres.
    kind : str
        "toa" (unknown emission time), "range" (two-way) or, with `pairs`, "tdoa".
    pairs : sequence of (a, b), optional
        Stations of each column of differences ``r_a - r_b``.
    names : sequence of M str, optional
        Names of the stations; "A1", "A2" and so on by default.
    dimension : 2 or 3, optional
        Number of dimensions; by default the number of columns of `place`, or 3.
    place, place_sigma : array (M, d), optional
        Prior coordinates of the stations and their standard deviations, metres. Zero sigma is exact; an infinite
        sigma (or a NaN coordinate) is free. By default all coordinates are free.
    synchronised : bool
        Whether the stations share a clock.
    distances : sequence of (a, b, distance, sigma)
        Measured distances between stations, metres.
    labels : sequence of N str, optional
        Names of the pulses.
    wave_speed : float or str, optional
        Wave speed, m/s or text such as "air:20C". If it is given, `z` and `sigma` are times in seconds.
    two_way : bool
        Whether ranges are times of the way there and back; needs `wave_speed`.
    turn_around : float or str, optional
        Time between arrival and reply at the other end, seconds or text such as "2 ms", for two-way times.

    Returns
    -------
    Network
        The input of `calibrate`.

    Raises
    ------
    InvalidProblem
        If an argument is invalid; the message names it.
    """
    kind = kind_named(kind)
    metres = 1.0 if wave_speed is None else network_speed(wave_speed, "wave_speed")
    if two_way or turn_around is not None:
        metres, z = _one_way(kind, z, metres, two_way, turn_around, stated=wave_speed is not None)
    z, sigma = metres * np.asarray(z, dtype=float), metres * np.asarray(sigma, dtype=float)
    if kind not in KINDS:
        raise InvalidProblem(f"networks have no rows of kind {kind!r}", "kind", nearest(kind, list(KINDS)))
    if (kind == "tdoa") != (pairs is not None):
        raise InvalidProblem(
            "the argument pairs and the kind tdoa need each other", "pairs", 'give pairs with kind="tdoa" only'
        )
    values = np.asarray(numbers(np.where(np.isnan(z), 0.0, z), "z"))
    if values.ndim != 2 or not values.size:
        raise InvalidProblem(f"the measurements have shape {values.shape}", "z", "give one row for each pulse")
    count = values.shape[1] if pairs is None else 1 + max(max(pair) for pair in pairs)
    names = tuple(names) if names is not None else tuple(f"A{i + 1}" for i in range(count))
    if pairs is None:
        slots = tuple(NetworkSlot(kind, i) for i in range(values.shape[1]))
    else:
        slots = tuple(NetworkSlot(kind, int(a), int(b)) for a, b in pairs)
    deviations = np.where(np.isnan(z), np.inf, np.broadcast_to(np.asarray(sigma, dtype=float), values.shape))
    known = np.full((len(names), dimension or 3), np.nan) if place is None else np.asarray(place, dtype=float)
    if known.ndim != 2 or dimension not in (None, known.shape[-1]):
        what = f"places of shape {known.shape} for {len(names)} stations in {dimension or 3} dimensions"
        raise InvalidProblem(what, "place", "give one row for each station, and a column for each axis")
    if place_sigma is None:
        place_sigma = np.where(np.isnan(known), np.inf, 0.0)
    spread = np.where(np.isnan(known), np.inf, np.broadcast_to(np.asarray(place_sigma, dtype=float), known.shape))
    made = Network(
        names,
        slots,
        values,
        deviations,
        np.where(np.isnan(known), 0.0, known),
        spread,
        synchronised,
        np.array([[a, b] for a, b, _, _ in distances], dtype=np.int64).reshape(-1, 2),
        np.array([d for _, _, d, _ in distances], dtype=float),
        np.array([s for _, _, _, s in distances], dtype=float),
        tuple(labels) if labels is not None else tuple(str(j) for j in range(len(values))),
    )
    return checked(made)


def _one_way(
    kind: str, z: Any, metres: float, two_way: bool, turn_around: Amount | None, *, stated: bool
) -> tuple[float, Array]:
    """Return the metres of a second of two-way times, and the times `z` without the turn-around time, seconds.

    `metres` is the wave speed, and `stated` is whether it is stated. Raise InvalidProblem for other kinds than ranges.
    """
    where = "two_way" if two_way else "turn_around"
    if kind != "range":
        raise InvalidProblem(f"{kind} has no way back", where, 'remove this argument; it is for kind="range"')
    if not stated:
        what = "two-way ranges are times, which need a wave speed"
        raise InvalidProblem(what, where, 'add wave_speed="air:20C"')
    pause = 0.0 if turn_around is None else Units("time").plain(turn_around, "s", "turn_around")
    if not pause >= 0.0:
        raise InvalidProblem("the turn-around time is negative", "turn_around", 'write it as "2 ms"')
    return 0.5 * metres, np.asarray(z, dtype=float) - pause


def checked(made: Network) -> Network:
    """Return the network unchanged after checks that its parts fit together.

    Raises
    ------
    InvalidProblem
        If a part does not fit; the message names it.
    """
    m, (n, r) = made.stations, made.z.shape
    if made.dimension not in (2, 3):
        raise InvalidProblem(f"a network has {made.dimension} dimensions", "dimension", "give 2 or 3")
    check_once(made.names, "station name {!r} is used twice", "names")
    if len(made.slots) != r or len(made.labels) != n or made.sigma.shape != (n, r):
        raise InvalidProblem(
            "slots, labels and standard deviations do not fit the measurements", "z", "give one for each measurement"
        )
    ends = np.array([[slot.a, slot.b] for slot in made.slots]).reshape(-1, 2)
    two = np.array([MODELS[slot.kind].stations == 2 for slot in made.slots])
    if (ends[:, 0] < 0).any() or (ends >= m).any() or (ends[two, 1] < 0).any() or (ends[:, 0] == ends[:, 1]).any():
        raise InvalidProblem(
            "a row has an unknown station, or the same station twice", "pairs", f"give two numbers from 0 to {m - 1}"
        )
    if np.isnan(made.sigma).any() or (made.sigma <= 0.0).any():
        raise InvalidProblem("a standard deviation is not positive", "sigma", "give metres above zero")
    if made.place.shape != (m, made.dimension) or made.place_sigma.shape != made.place.shape:
        raise InvalidProblem(f"places have shape {made.place.shape}", "place", f"give ({m}, {made.dimension})")
    if np.isnan(made.place_sigma).any() or (made.place_sigma < 0.0).any() or not np.isfinite(made.place).all():
        raise InvalidProblem(
            "a place or its standard deviation is not a number", "place_sigma", "give zero, metres or infinity"
        )
    b = made.between
    if len(b) and ((b < 0).any() or (b >= m).any() or (b[:, 0] == b[:, 1]).any()):
        raise InvalidProblem(
            "a distance has an unknown station or one twice", "distances", f"give two numbers from 0 to {m - 1}"
        )
    if (made.distance < 0.0).any() or not np.isfinite(made.distance).all():
        raise InvalidProblem("a distance between stations is negative or infinite", "distances", "give metres")
    if not np.isfinite(made.distance_sigma).all() or (made.distance_sigma <= 0.0).any():
        raise InvalidProblem("a distance has no positive standard deviation", "distances", "give metres above zero")
    return made
