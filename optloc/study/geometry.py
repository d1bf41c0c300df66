"""Where stations and targets of a trial are: rules of a study file turned into positions."""

from __future__ import annotations

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.words import Units, join
from optloc.frames import Frame
from optloc.study.document import Amount, LayoutTable, TruthTable
from optloc.types import Array

Rng = np.random.Generator


def metres(values: list[Amount], where: str, count: int | None = None) -> Array:
    """Return amounts of length as an array; raise InvalidProblem where their number is not `count`."""
    if count is not None and len(values) != count:
        raise InvalidProblem(f"{len(values)} numbers do not fit {count} dimensions", where, "give one for each")
    return np.array([Units("length").plain(value, "m", where) for value in values])


def placed(layout: LayoutTable, where: str, rng: Rng, count: int) -> Array:
    """Return the stations of trials.

    Parameters
    ----------
    layout : LayoutTable
        The rule.
    where : str
        Place to name.
    rng : Generator
        Used where they are random.
    count : int
        Number of draws.

    Returns
    -------
    array (count, s, d)
        Metres; of rules without a draw all are equal.
    """
    s, d = layout.stations, layout.dimension
    if layout.placement == "given":
        return np.broadcast_to(_given(layout, where), (count, s, d))
    box = metres(layout.box[:d], join(where, "box"), d)
    if layout.placement in ("random", "frozen"):
        return rng.uniform(-0.5, 0.5, (count, s, d)) * box
    centre = int(layout.placement == "star")
    angle = 2.0 * np.pi * np.arange(s - centre) / max(s - centre, 1)
    unit = np.stack([np.cos(angle), np.sin(angle), (-1.0) ** np.arange(s - centre)], axis=-1)[:, :d]
    ring = np.concatenate([np.zeros((centre, d)), 0.5 * unit * box])
    return np.broadcast_to(ring, (count, s, d))


def _given(layout: LayoutTable, where: str) -> Array:
    place = join(where, "places")
    if layout.places is None or len(layout.places) != layout.stations:
        found = 0 if layout.places is None else len(layout.places)
        raise InvalidProblem(f"{found} places do not fit {layout.stations} stations", place, "give one for each")
    if any(len(point) != layout.dimension for point in layout.places):
        raise InvalidProblem(f"a place has not {layout.dimension} coordinates", place, "give metres")
    return np.array(layout.places, dtype=float)


_KEYS = {
    "fixed": ("at", "at_deg"),
    "box": ("box", "centre"),
    "shell": ("distance", "elevation_deg"),
    "hull": (),
    "area": ("lat_deg", "lon_deg", "height"),
}
_ANY = {"kind", "speed", "velocity"}


def check_truth(truth: TruthTable, frame: Frame, dimension: int, where: str) -> None:
    """Refuse a truth whose keys do not belong to its kind, or that the frame cannot hold."""
    foreign = sorted(truth.model_fields_set - _ANY - set(_KEYS[truth.kind]))
    if foreign:
        advice = f"it takes {', '.join(_KEYS[truth.kind])}" if _KEYS[truth.kind] else "it takes none"
        raise InvalidProblem(f"a truth of kind {truth.kind!r} has no key {foreign[0]!r}", where, advice)
    needed = {"fixed": (), "box": ("box",), "shell": ("distance",), "hull": (), "area": ("lat_deg", "lon_deg")}
    for key in needed[truth.kind]:
        if getattr(truth, key) is None:
            raise InvalidProblem(f"a truth of kind {truth.kind!r} needs the key {key!r}", where, "add it")
    if truth.kind == "fixed" and (truth.at is None) == (truth.at_deg is None):
        raise InvalidProblem("a fixed truth has one place", where, "give at, or at_deg on Earth")
    if (truth.at_deg is not None or truth.kind == "area") and not (frame.geodetic and dimension == 3):
        advice = "give a frame of the Earth, or metres"
        raise InvalidProblem("latitude and longitude need a frame on Earth in three dimensions", where, advice)
    places(truth, frame, np.zeros((1, 2, dimension)) + 1.0, where, np.random.default_rng(0))


def places(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return true positions of targets.

    Parameters
    ----------
    truth : TruthTable
        The rule.
    frame : Frame
        Of the positions.
    stations : array (count, s, d)
        Stations of each trial, metres.
    where : str
        Place to name.
    rng : Generator
        Used where the place is random.

    Returns
    -------
    array (count, d)
        Metres in the frame.
    """
    count, d = len(stations), stations.shape[-1]
    centre = stations.mean(1)
    if truth.kind == "hull":
        share = rng.dirichlet(np.ones(stations.shape[1]), count)
        return np.asarray((share[..., None] * stations).sum(1))
    if truth.kind == "fixed":
        return np.broadcast_to(_fixed(truth, frame, d, where), (count, d))
    if truth.kind == "area":
        spans = [np.array(span) for span in (truth.lat_deg, truth.lon_deg) if span]
        lat, lon = (np.radians(rng.uniform(span[0], span[1], count)) for span in spans)
        height = metres([truth.height], join(where, "height"))[0]
        return np.asarray(frame.from_geodetic(lat, lon, np.full(count, height)))
    if truth.kind == "box":
        assert truth.box is not None
        box = metres(truth.box, join(where, "box"), d)
        middle = centre if truth.centre is None else metres(truth.centre, join(where, "centre"), d)
        return np.asarray(middle + _turned(frame, centre, rng.uniform(-0.5, 0.5, (count, d)) * box))
    assert truth.distance is not None
    low, high = metres(truth.distance, join(where, "distance"))
    away = _directions(truth, d, count, rng) * rng.uniform(low, high, (count, 1))
    return np.asarray(centre + _turned(frame, centre, away))


def _fixed(truth: TruthTable, frame: Frame, dimension: int, where: str) -> Array:
    if truth.at is not None:
        return metres(truth.at, join(where, "at"), dimension)
    assert truth.at_deg is not None
    if len(truth.at_deg) != 3:
        raise InvalidProblem("a place on Earth has three numbers", join(where, "at_deg"), "add the height in metres")
    lat, lon, height = truth.at_deg
    return np.asarray(frame.from_geodetic(np.radians(lat), np.radians(lon), height))


def _turned(frame: Frame, at: Array, local: Array) -> Array:
    """Return vectors (count, d) along east, north and up at points as vectors of the frame."""
    return np.asarray((local[:, None, :] @ frame.enu_axes(at))[:, 0]) if frame.geodetic else local


def _directions(truth: TruthTable, d: int, count: int, rng: Rng) -> Array:
    """Return unit vectors (count, d), even on the circle, the sphere or a band of elevations of it."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if d == 2:
        return flat
    low, high = truth.elevation_deg or (-90.0, 90.0)
    sine = rng.uniform(np.sin(np.radians(low)), np.sin(np.radians(high)), count)
    return np.concatenate([flat * np.sqrt(1.0 - sine[:, None] ** 2), sine[:, None]], axis=-1)


def velocities(truth: TruthTable, dimension: int, where: str, rng: Rng, count: int) -> Array:
    """Return true velocities (count, d), metres per second."""
    units = Units("speed")
    if truth.velocity is not None:
        if len(truth.velocity) != dimension:
            raise InvalidProblem(f"the velocity has not {dimension} components", join(where, "velocity"), "give each")
        given = [units.plain(value, "m/s", join(where, "velocity")) for value in truth.velocity]
        return np.broadcast_to(np.array(given), (count, dimension))
    way = rng.standard_normal((count, dimension))
    speed = 0.0 if truth.speed is None else units.plain(truth.speed, "m/s", join(where, "speed"))
    return np.asarray(speed * way / np.linalg.norm(way, axis=-1, keepdims=True))
