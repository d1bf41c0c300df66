"""A network from the arguments of a call, with one kind of measurements.

Letters: M stations, N pulses, R slots, d coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.engine import numbers
from optloc.files import Units
from optloc.models import kind_named
from optloc.problem import Amount, InvalidProblem, nearest
from optloc.sites.calibration.network import KINDS, Network, NetworkSlot, checked, network_speed
from optloc.sites.calibration.network_checks import plausible


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
        If an argument is invalid, or a range is negative; the message names it.

    Warns
    -----
    UserWarning
        For values that contradict the known distances between stations, such as centimetres read as metres.
    """
    kind = kind_named(kind)
    metres = 1.0 if wave_speed is None else network_speed(wave_speed, "wave_speed").speed
    if two_way or turn_around is not None:
        metres, z = 0.5 * metres, np.asarray(z, dtype=float) - _pause(kind, wave_speed, turn_around)
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
    return plausible(checked(made))


def _pause(kind: str, wave_speed: Amount | None, turn_around: Amount | None) -> float:
    """Return the turn-around time of two-way ranges, s; raise InvalidProblem for other kinds or without a speed."""
    place = "two_way" if turn_around is None else "turn_around"
    if kind != "range":
        raise InvalidProblem(f"{kind} has no way back", place, 'remove this argument; it is for kind="range"')
    if wave_speed is None:
        what = "two-way ranges are times, which need a wave speed"
        raise InvalidProblem(what, place, 'add wave_speed="air:20C"')
    pause = 0.0 if turn_around is None else Units("time").plain(turn_around, "s", "turn_around")
    if not pause >= 0.0:
        raise InvalidProblem("the turn-around time is negative", "turn_around", 'write it as "2 ms"')
    return pause
