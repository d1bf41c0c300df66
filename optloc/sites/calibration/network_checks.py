"""Physical checks of a network before the search: negative ranges, wrong units, and times of sound read as light.

The unit of a network can be checked if a size is known: from stations with known positions, from distances between
stations, or from the size of the Earth. The checks of problems, `optloc.model_checks.suspicious_values`, test pairs of
stations with a known distance. Each pair is an epoch of a problem in the plane.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from optloc.files import fits_sound
from optloc.model_checks import suspicious_values
from optloc.models import MODELS
from optloc.problem import Array, InvalidProblem, Motion, Problem, assemble, measured
from optloc.sites.calibration.network import Network

# Number of standard deviations beyond which noise does not explain a value, as in the checks of problems.
_SIGMAS = 6.0
# Largest numbers of pairs and of pulses that are compared: an error of the unit affects all of them.
_PAIRS, _PULSES = 40, 64
# Largest distance of two points on the Earth, m: the equatorial diameter.
_EARTH = 12_756_274.0


def refuse_negative(
    z: Array, sigma: Array, who: Callable[[int], str], where: Callable[[int], str], way_out: str
) -> None:
    """Raise InvalidProblem for a range that is negative beyond its noise.

    Parameters
    ----------
    z, sigma : array (m,)
        Ranges and their standard deviations, metres.
    who, where : callable
        Name of a range, and its place for messages, from its number.
    way_out : str
        How a missing reading is stated.
    """
    bad = np.flatnonzero(z < -_SIGMAS * sigma)
    if len(bad):
        i = int(bad[0])
        what = f"the range {who(i)} is {z[i]:.4g} m, and no distance is negative"
        raise InvalidProblem(what, where(i), f"correct it; if it means no reading, {way_out}")


def suspicious_network(
    network: Network, units: Mapping[str, float] | None = None, speed: float | None = None, surface: str = "file"
) -> tuple[str, ...]:
    """Return sentences about values that are suspicious for the known distances between stations.

    Parameters
    ----------
    network : Network
        Any network; without a known distance there is no sentence.
    units : mapping of kind to float, optional
        Metres in one unit of the written values.
    speed : float, optional
        Wave speed, m/s.
    surface : "file" or "python"
        Source of the network, for the names of settings.
    """
    pairs = _pairs_problem(network)
    if pairs is None:
        return ()
    return tuple(f"{one.seen}; {one.advice}" for one in suspicious_values(pairs, surface, units=units, speed=speed))


def plausible(network: Network) -> Network:
    """Return the network of the arguments of a call; raise InvalidProblem for a negative range, and warn of others."""
    pulse, slot = np.nonzero(network.given & [one.kind == "range" for one in network.slots])
    who = [
        f"of pulse {network.labels[j]} at {network.names[network.slots[r].a]}" for j, r in zip(pulse, slot, strict=True)
    ]
    refuse_negative(network.z[pulse, slot], network.sigma[pulse, slot], who.__getitem__, lambda _: "z", "use NaN")
    for sentence in suspicious_network(network, surface="python"):
        # two levels up is the caller of `network_of`
        warnings.warn(sentence, UserWarning, stacklevel=3)
    return network


def require_speed(network: Network, where: str, example: str) -> None:
    """Raise InvalidProblem if times at the speed of light contradict the size of the network or of the Earth.

    Call it if no wave speed is stated. `where` is the place for messages, and `example` a way to state the speed.
    """
    longest = max((float(size.max(initial=0.0)) for size in _differences(network)), default=0.0)
    apart = _known_pairs(network)[2]
    noise = float(network.sigma[network.given].min(initial=np.inf))
    if fits_sound(longest, noise, float(apart.max(initial=0.0))) or longest > _EARTH:
        what = f"light travels {longest / 1e3:.3g} km in these times, and no wave speed is stated"
        raise InvalidProblem(what, where, f"state it, such as {example}, or correct the unit")


def _differences(network: Network) -> Iterator[Array]:
    """Yield the differences of path length that each pulse determines, absolute values in metres."""
    for kind in dict.fromkeys(slot.kind for slot in network.slots):
        if kind != "range" and not network.synchronised:
            continue  # clocks have any offset
        z = np.where(network.given, network.z, np.nan)[:, [slot.kind == kind for slot in network.slots]]
        z = z[np.isfinite(z).any(axis=1)]
        if len(z):
            yield np.nanmax(np.abs(z), axis=1) if kind == "tdoa" else np.nanmax(z, axis=1) - np.nanmin(z, axis=1)


def _known_pairs(network: Network) -> tuple[Array, Array, Array, Array]:
    """Return stations a and b (q,), their known distances (q,) and standard deviations (q,), metres."""
    spread = np.sqrt((network.place_sigma**2).sum(-1))
    a, b = np.triu_indices(network.stations, 1)
    known = np.isfinite(spread[a]) & np.isfinite(spread[b])
    a, b = a[known], b[known]
    apart = np.linalg.norm(network.place[a] - network.place[b], axis=-1)
    stated = network.between
    return (
        np.concatenate([a, stated[:, 0]]),
        np.concatenate([b, stated[:, 1]]),
        np.concatenate([apart, network.distance]),
        np.concatenate([np.hypot(spread[a], spread[b]), network.distance_sigma]),
    )


def _pairs_problem(network: Network) -> Problem | None:
    """Return a problem with an epoch for each pulse and each pair of stations with a known distance; None without.

    The two stations of an epoch are on a line, at their known distance.
    """
    a, b, apart, spread = _known_pairs(network)
    pairs, pulses = _spread(len(a), _PAIRS), _spread(network.pulses, _PULSES)
    distances: list[float] = []
    rows: dict[str, list[tuple[int, int, float, float]]] = {}
    for i in pairs:
        for kind, values in _values_between(network, int(a[i]), int(b[i])).items():
            for j in pulses:
                if not np.isfinite(values[0][:, j]).all():
                    continue
                # half of the variance of the distance is added to each row
                sigma = np.sqrt(values[1][:, j] ** 2 + 0.5 * spread[i] ** 2)
                epoch = len(distances)
                rows.setdefault(kind, []).extend(
                    (epoch, end, float(values[0][end, j]), float(sigma[end])) for end in range(len(sigma))
                )
                distances.append(float(apart[i]))
    if not distances:
        return None
    position = np.zeros((len(distances), 2, 2))
    position[:, 1, 0] = distances
    parts = []
    for kind, found in rows.items():
        epochs, ends, z, sigma = (np.array(column) for column in zip(*found, strict=True))
        second = {"b": 1} if MODELS[kind].stations == 2 else {}
        parts.append(measured(kind, z, a=ends, epoch=epochs, sigma=sigma, **second))
    times = np.arange(float(len(distances)))
    return assemble(position, *parts, times=times, motions=(Motion(0, span="epoch"),))


def _values_between(network: Network, a: int, b: int) -> dict[str, tuple[Array, Array]]:
    """Return the values and standard deviations of two stations by kind, metres; NaN for missing values.

    Both arrays are (2, N) for kinds with one station, and (1, N) for differences. Only the first slot of a station
    counts.
    """
    z = np.where(network.given, network.z, np.nan)
    found = {}
    for kind in dict.fromkeys(slot.kind for slot in network.slots):
        if kind != "range" and not network.synchronised:
            continue  # clocks have any offset
        ends = ((a, b),) if MODELS[kind].stations == 2 else ((a, -1), (b, -1))
        slots = [
            next((r for r, slot in enumerate(network.slots) if slot.kind == kind and (slot.a, slot.b) == one), None)
            for one in ends
        ]
        if kind == "tdoa" and slots == [None]:  # the other order has the same size
            slots = [next((r for r, s in enumerate(network.slots) if s.kind == kind and (s.a, s.b) == (b, a)), None)]
        chosen = [r for r in slots if r is not None]
        if len(chosen) == len(ends):
            found[kind] = (z[:, chosen].T, network.sigma[:, chosen].T)
    return found


def _spread(count: int, most: int) -> Array:
    """Return at most `most` numbers below `count`, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)) if count else np.zeros(0, dtype=int)
