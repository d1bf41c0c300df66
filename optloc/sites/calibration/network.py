"""A network of stations, clocks and emitters that are unknown together: measurements and prior knowledge.

A pulse is one emission at an unknown position and, except for two-way ranges, at an unknown time. A slot is the
kind and the stations of one measurement; each pulse has at most one value for each slot.

Letters: M stations, N pulses, R slots, d coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.files import NOT_STATED, StatedSpeed, positive_speed, stated_speed
from optloc.models import MODELS
from optloc.problem import SPEED_OF_LIGHT, Amount, Array, HasShortForm, InvalidProblem, check_once

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


def network_speed(given: Amount | None, where: str) -> StatedSpeed:
    """Return the wave speed of a network; light without a stated speed.

    `given` is a number, or text as for `optloc.locate`, such as "air:20C". `where` is the place for messages. Raise
    InvalidProblem for an uncertain speed, or the file of a profile, which networks cannot use.
    """
    if given is None:
        return StatedSpeed(SPEED_OF_LIGHT, None, NOT_STATED)
    if not isinstance(given, str):
        speed = positive_speed(given, "speed", where)
        return StatedSpeed(speed, None, f"{speed:.6g} m/s")
    stated = stated_speed(given, where)
    if stated.sigma is not None:
        advice = "leave the standard deviation out; a wrong speed scales the network"
        raise InvalidProblem("the speed of a network is exact", where, advice)
    return stated


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
