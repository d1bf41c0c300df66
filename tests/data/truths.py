"""Independent answers for each data set: least squares started at the truth, in plain numpy, and horizontal errors."""

from __future__ import annotations

import numpy as np
from data.reference import Reference, centred, descend, ecef, horizontal

from optloc.lab.datasets.adsb import ARRIVAL, HEIGHT, Heard
from optloc.lab.datasets.gnss import SIGMA, Receptions
from optloc.lab.datasets.mrclam import Sightings, sigmas
from optloc.lab.datasets.starloc import SIGMA as BEARING, MarkGroups

RADIUS = 6.4e6


def adsb(data: Heard, given: str) -> Reference:
    """Return the minima in latitude, longitude and, unless exact, scaled height."""
    altitude, everywhere = data.geodetic[:, 2], np.ones_like(data.arrival)

    def place(u: np.ndarray) -> np.ndarray:
        return ecef(u[:, :2], altitude if given == "exactly" else RADIUS * u[:, 2])

    def residual(u: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(place(u)[:, None] - data.stations, axis=-1)
        off = centred(data.arrival - data.excess - distance, everywhere) / ARRIVAL
        if given != "row":
            return off
        return np.concatenate([off, (RADIUS * u[:, 2:] - altitude[:, None]) / HEIGHT], axis=1)

    start = data.geodetic[:, :2] if given == "exactly" else data.geodetic / (1.0, 1.0, RADIUS)
    u, cost = descend(residual, start, 1e-7)
    return Reference(place(u), cost)


def adsb_horizontal(data: Heard, position: np.ndarray) -> np.ndarray:
    """Return horizontal errors (..., n), metres."""
    truth = ecef(data.geodetic[:, :2], data.geodetic[:, 2])
    return horizontal(position, truth, data.geodetic[:, 0], data.geodetic[:, 1])


def adsb_width(data: Heard) -> np.ndarray:
    """Return the least distance between two stations of each message, metres, (n,)."""
    apart = np.linalg.norm(data.stations[:, :, None] - data.stations[:, None], axis=-1)
    return (apart + np.where(np.eye(apart.shape[-1]), np.inf, 0.0)).min((1, 2))


def gnss_epochs(data: Receptions, offset: tuple[str, ...]) -> Reference:
    """Return the minima of arrivals with an offset of some systems."""
    shared = [np.ones(len(data.systems)), *(np.array([s == n for s in data.systems], dtype=float) for n in offset)]
    whiten = data.weight / data.sigma
    nuisance = np.stack([column * whiten for column in shared], axis=-1)
    inverse = np.linalg.pinv(nuisance)

    def residual(x: np.ndarray) -> np.ndarray:
        off = (_off(data, x) * whiten)[..., None]
        return (off - nuisance @ (inverse @ off))[..., 0]

    return Reference(*descend(residual, np.tile(data.truth, (len(data.z), 1)), 10.0))


def gnss_draws(data: Receptions) -> Reference:
    """Return the minima of differences and the exact height: arrivals with a common clock."""
    lat, lon, h = data.geodetic
    start = np.tile([lat, lon], (len(data.z), 1))
    coordinates, cost = descend(lambda u: centred(_off(data, ecef(u, h)), data.weight) / SIGMA, start, 1e-6)
    return Reference(ecef(coordinates, h), cost)


def gnss_horizontal(data: Receptions, position: np.ndarray) -> np.ndarray:
    """Return horizontal errors (...), metres."""
    return horizontal(position, data.truth, *(np.asarray(v) for v in data.geodetic[:2]))


def _off(data: Receptions, x: np.ndarray) -> np.ndarray:
    return data.z - np.linalg.norm(x[:, None] - data.satellites, axis=-1)


def mrclam(data: Sightings, kinds: tuple[str, ...]) -> Reference:
    """Return the minima of bearings, ranges or both."""
    sigma = sigmas(kinds)
    first = np.searchsorted(data.epoch, np.arange(len(data.truth)))
    place = np.arange(len(data.epoch)) - first[data.epoch]

    def residual(x: np.ndarray) -> np.ndarray:
        line = x[data.epoch] - data.landmarks[data.a]
        model = {"azimuth": np.arctan2(line[:, 1], line[:, 0]), "range": np.hypot(line[:, 0], line[:, 1])}
        out = np.zeros((len(kinds), len(data.truth), place.max() + 1))
        for i, kind in enumerate(kinds):
            r = data.z[kind] - model[kind]
            r = (r + np.pi) % (2.0 * np.pi) - np.pi if kind == "azimuth" else r
            out[i, data.epoch, place] = r / sigma[kind]
        return np.moveaxis(out, 0, 1).reshape(len(data.truth), -1)

    return Reference(*descend(residual, data.truth, 1e-5))


def starloc(data: MarkGroups) -> Reference:
    """Return the minima of groups of bearings in the camera's axes."""

    def residual(x: np.ndarray) -> np.ndarray:
        u, v, w = np.moveaxis(np.einsum("ksij,ksj->ksi", data.axes, x[:, None] - data.place), -1, 0)
        model = np.stack([np.arctan2(v, u), np.arctan2(w, np.hypot(u, v))], axis=-1)
        off = (data.angles - model + np.pi) % (2.0 * np.pi) - np.pi
        return off.reshape(len(x), -1) / BEARING

    return Reference(*descend(residual, data.truth, 1e-5))
