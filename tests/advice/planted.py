"""Random problems, each with one planted cause of a misfit, or with none.

A draw is decided by the name of its pair (cause, kind) and a seed. Seeds below 1000 are for development; the measured
rates use seeds from 5000 on. Draws use elementwise arithmetic only, so they have the same bits on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from advice.scene import LENGTHS, LIGHT, SOUND, Array, Data, ecef, predicted

DEVELOPMENT, JUDGED = 0, 5000
"""First seeds of development and of the measured rates."""
PERIODS = (1.0, 1e-3)
"""Seconds that a clock may be off by as a whole: a second, and the period of a satellite's code."""


@dataclass(frozen=True)
class Draw:
    """A problem with its planted cause.

    - cause: None for data without a mistake; stations: the numbers of its stations.
    - data: the file; right: the same file without the mistake.
    - truth (E, d): positions of the target, m.
    - size: of the mistake, in standard deviations of a row or as a factor.
    """

    pair: str
    seed: int
    cause: str | None
    stations: tuple[int, ...]
    data: Data
    right: Data
    truth: Array
    size: float


Planted = tuple[Data, tuple[int, ...], float]
"""A file with a mistake, the stations of the mistake and its size."""


@dataclass(frozen=True)
class Scene:
    """A file without mistakes, and the positions (E, d) of its target."""

    data: Data
    truth: Array


# Arrays of stations.


def _spread(rng: np.random.Generator, n: int, d: int, extent: float) -> Array:
    """Return stations (n, d) at random, at least a tenth of the extent apart."""
    out: list[Array] = []
    while len(out) < n:
        one = rng.uniform(-1.0, 1.0, d) * extent * np.array([1.0, 1.0, 0.5])[:d]
        if all(np.sqrt(((one - other) ** 2).sum()) > 0.15 * extent for other in out):
            out.append(one)
    return np.array(out)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _local(rng: np.random.Generator, kind: str, epochs: int, d: int, *, extra: int) -> Scene:
    """Return a scene with Cartesian axes; `extra` stations more than the fewest for the kind."""
    sound = kind in ("tdoa", "toa", "range") and rng.random() < 0.25
    extent = _log_uniform(rng, 5.0, 2e3 if sound else 2.5e5)
    n = min(10, {"range": d, "range_sum": d + 1, "azimuth": 2, "azel": 2, "range_rate": d}.get(kind, d + 1) + extra)
    place = _spread(rng, n, d, extent)
    reach = np.array([1.3, 1.3, 0.7])[:d]
    truth = rng.uniform(-1.0, 1.0, (epochs, d)) * extent * reach
    return Scene(_rows(rng, kind, place, epochs, extent, SOUND if sound else LIGHT), truth)


def _rows(rng: np.random.Generator, kind: str, place: Array, epochs: int, extent: float, speed: float) -> Data:
    """Return rows without values: every station, or every pair with the first station, at each epoch."""
    n = len(place)
    if kind in ("tdoa", "groa", "range_sum"):
        a, b, kinds = np.arange(1, n), np.zeros(n - 1, int), (kind,) * (n - 1)
    elif kind == "azel":
        a, kinds = np.tile(np.arange(n), 2), ("azimuth",) * n + ("elevation",) * n
        b = np.full(2 * n, -1)
    else:
        a, b, kinds = np.arange(n), np.full(n, -1), (kind,) * n
    if kind in LENGTHS:
        sigma = extent * _log_uniform(rng, 3e-5, 3e-3)
    elif kind in ("azimuth", "azel"):
        sigma = np.radians(_log_uniform(rng, 0.2, 3.0))
    else:
        sigma = _log_uniform(rng, 0.01, 0.05) if kind == "groa" else _log_uniform(rng, 0.05, 0.5)
    units = ["m", "m", "km", "ft"] if speed == LIGHT else ["m", "m", "s", "ms"]
    unit = str(rng.choice([*units, "ns", "us"] if speed == LIGHT else units))
    velocity = None
    if kind == "range_rate":
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        velocity = rng.uniform(20.0, 250.0, n)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        velocity = velocity[:, : place.shape[1]]
    return Data(
        place,
        kinds,
        a,
        b,
        np.zeros((epochs, len(a))),
        np.full(len(a), sigma),
        np.arange(epochs) * _log_uniform(rng, 1.0, 60.0),
        speed,
        unit,
        bool(rng.random() < 0.3),
        velocity=velocity,
    )


def _earth(rng: np.random.Generator, kind: str, epochs: int, *, extra: int) -> Scene:
    """Return a scene of receivers on the ground and an aircraft, with latitudes and longitudes."""
    lat, lon = rng.uniform(-60.0, 60.0), rng.uniform(-180.0, 180.0)
    # a swap of latitude and longitude must leave latitudes that exist
    lon = lon if abs(lon) < 80.0 else lon / 3.0
    extent = _log_uniform(rng, 2e4, 2e5)
    n = min(10, 4 + extra)
    turn = np.array([1.0, 1.0 / np.cos(np.radians(lat))]) / 111e3
    flat = _spread(rng, n, 2, extent) * turn
    geodetic = np.column_stack([lat + flat[:, 0], lon + flat[:, 1], rng.uniform(0.0, 1500.0, n)])
    away = rng.uniform(-1.0, 1.0, (epochs, 2)) * extent * turn
    target = np.column_stack([lat + away[:, 0], lon + away[:, 1], rng.uniform(6e3, 12e3, epochs)])
    data = _rows(rng, kind, ecef(geodetic), epochs, extent, LIGHT)
    return Scene(replace(data, geodetic=geodetic), ecef(target))


def _satellites(rng: np.random.Generator, epochs: int, *, extra: int) -> Scene:
    """Return a scene of pseudoranges: satellites above the horizon of a receiver on the ground."""
    here = np.array([rng.uniform(-60.0, 60.0), rng.uniform(-180.0, 180.0), rng.uniform(0.0, 500.0)])
    centre = ecef(here)
    up = centre / np.sqrt((centre**2).sum())
    place: list[Array] = []
    while len(place) < min(10, 4 + extra):
        v = rng.normal(size=3)
        v /= np.sqrt((v**2).sum())
        sky = 26_560e3 * v - centre
        if (sky * up).sum() > 0.17 * np.sqrt((sky**2).sum()):
            place.append(26_560e3 * v)
    data = _rows(rng, "toa", np.array(place), epochs, 1e6, LIGHT)
    data = replace(data, sigma=np.full(len(place), _log_uniform(rng, 0.5, 8.0)), unit="m", own_sigma=False)
    truth = centre + np.concatenate([np.zeros((1, 3)), rng.normal(size=(epochs - 1, 3)) * 30.0])
    return Scene(data, truth)


def _measured(rng: np.random.Generator, scene: Scene, height: float = 0.0) -> Data:
    """Return the data with values: the rows of the truth with noise; `height` m above a plane problem."""
    data, truth = scene.data, scene.truth
    if height:
        x = np.column_stack([truth, np.full(len(truth), height)])
        place = np.column_stack([data.place, np.zeros(data.stations)])
        z = predicted(replace(data, place=place), x)
    else:
        z = predicted(data, truth)
    if "toa" in data.kind:
        z = z + rng.uniform(0.0, 1.0, (len(z), 1)) * data.speed * (1e-3 if data.speed == LIGHT else 5.0)
    if "tdoa" in data.kind:
        noise = rng.normal(size=(len(z), data.stations))
        noise = noise[:, data.a] - noise[:, data.b]
    else:
        noise = rng.normal(size=z.shape)
    return replace(data, z=z + noise * data.sigma)


# Mistakes. Each returns the file with the mistake, its stations and its size.


def _size(rng: np.random.Generator) -> float:
    """Return the size of an error in standard deviations with its sign: hardly visible to gross."""
    return _log_uniform(rng, 3.0, 3000.0) * rng.choice([-1.0, 1.0])


def _guilty(rng: np.random.Generator, data: Data) -> int:
    """Return the number of a station that is the first station of a row."""
    return int(rng.choice(np.unique(data.a)))


def _error(rng: np.random.Generator, data: Data) -> tuple[float, float]:
    """Return the size of an error in standard deviations, and the error in the unit of the rows."""
    size = _size(rng)
    if "azimuth" in data.kind:
        limit = np.pi * rng.uniform(0.05, 0.9) / data.sigma[0]
        size = float(np.clip(size, -limit, limit))
    if "groa" in data.kind:
        size = min(abs(size), 60.0)
    return size, size * float(data.sigma[0])


def offset(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who = _guilty(rng, data)
    size, error = _error(rng, data)
    rows = _channel(data, who)
    if data.kind[0] in ("range", "range_sum") and (data.z + error)[:, rows].min() < 0.0:
        size, error = abs(size), abs(error)  # a negative range is refused before the fix
    return replace(data, z=data.z + np.where(rows, error, 0.0)), (who,), size


def _channel(data: Data, who: int) -> Array:
    """Return the rows (R,) of a station, of one kind only: azimuths of azimuths with elevations."""
    return (data.a == who) & data.of(data.kind[0])


def sign_station(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who = _guilty(rng, data)
    return replace(data, z=np.where(_channel(data, who), -data.z, data.z)), (who,), -1.0


def scale(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who = _guilty(rng, data)
    factor = 1.0 + rng.choice([-1.0, 1.0]) * _log_uniform(rng, 1e-3, 0.3)
    return replace(data, z=np.where(_channel(data, who), factor * data.z, data.z)), (who,), factor


def drift(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who = _guilty(rng, data)
    size, error = _error(rng, data)
    late = (data.time / data.time[-1])[:, None]
    return replace(data, z=data.z + np.where(_channel(data, who), error * late, 0.0)), (who,), size


def swapped(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    i, j = (int(k) for k in rng.choice(np.unique(data.a), 2, replace=False))
    turned = np.where(data.a == i, j, np.where(data.a == j, i, data.a))
    order = np.array([np.flatnonzero((turned == s) & data.of(k))[0] for s, k in zip(data.a, data.kind, strict=True)])
    return replace(data, z=data.z[:, order]), tuple(sorted((i, j))), 0.0


def period(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who, seconds = _guilty(rng, data), float(rng.choice(PERIODS)) if data.speed == LIGHT else 1.0
    count = float(rng.choice([-1.0, 1.0]) * rng.integers(1, 4))
    error = count * seconds * data.speed
    return replace(data, z=data.z + np.where(_channel(data, who), error, 0.0)), (who,), count


def outlier(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    return _outliers(rng, data, 1)


def outliers(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    return _outliers(rng, data, 2)


def _outliers(rng: np.random.Generator, data: Data, count: int) -> Planted:
    rows = rng.choice(data.z.size, count, replace=False)
    z, size = data.z.copy(), np.inf
    for row in rows:
        one, error = _error(rng, data)
        # a negative range is refused before the fix
        negative = data.kind[row % len(data.kind)] in ("range", "range_sum") and z.flat[row] + error < 0.0
        z.flat[row] += abs(error) if negative else error
        size = min(size, abs(one))
    return replace(data, z=z), tuple(sorted({int(data.a[row % len(data.a)]) for row in rows})), size


def noise(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    factor = _log_uniform(rng, 1.5, 30.0)
    if "azimuth" in data.kind:
        # noise of bearings above ten degrees has no Gaussian law on the circle
        factor = min(factor, np.radians(12.0) / data.sigma[0])
    return replace(data, sigma=data.sigma / factor), (), factor


def noise_of_station(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who, factor = _guilty(rng, data), _log_uniform(rng, 3.0, 50.0)
    clean = predicted(data, scene.truth)
    if "toa" in data.kind:
        clean = clean + (data.z - clean).mean(-1, keepdims=True)
    z = np.where(_channel(data, who), clean + factor * (data.z - clean), data.z)
    return replace(data, z=z), (who,), factor


def unit(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    if "azimuth" in data.kind:
        turned = replace(data, z=data.z % (2.0 * np.pi))
        planted = turned.with_unit(data.of("azimuth"), 1.0, np.pi / 180.0)
        return planted, (), np.pi / 180.0
    meant = [u for u in ("m", "km", "cm", "mm", "ft") if u != data.unit]
    meant += [u for u in (("us", "ns") if data.speed == LIGHT else ("s", "ms")) if u != data.unit]
    other = str(rng.choice(meant))
    planted = data.with_unit(data.lengths, data.size(other), data.size(data.unit))
    return planted, (), data.size(data.unit) / data.size(other)


def coordinate_unit(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    stated, meant = rng.choice([("m", "km"), ("m", "mm"), ("m", "cm"), ("m", "ft"), ("km", "m"), ("cm", "m")])
    factor = data.size(stated) / data.size(meant)
    # a noise without a unit of its own would scale with the values, which then explain the data as well
    planted = replace(data, place=data.place * factor, own_sigma=True, place_unit=str(stated))
    return planted, (), factor


def compass(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return compass bearings that the file counts from the x axis, or the reverse."""
    other = "east-counterclockwise" if data.azimuth == "north-clockwise" else "north-clockwise"
    return replace(data, azimuth=other), (), 0.0


def anticlockwise(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    return replace(data, z=np.where(data.of("azimuth"), -data.z, data.z)), (), 0.0


def opposite(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    return replace(data, z=np.where(data.of("azimuth"), data.z + np.pi, data.z)), (), 0.0


def sign(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    return replace(data, z=-data.z), (), 0.0


def speed(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return values that travelled at another speed than the file states."""
    factor = 1.0 + rng.choice([-1.0, 1.0]) * _log_uniform(rng, 3e-3, 0.2)
    # lengths do not depend on the stated speed
    timed = str(rng.choice(["s", "ms"]))
    return replace(data, z=data.z * factor, sigma=data.sigma * factor, unit=timed, own_sigma=False), (), factor


def late(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return values of which a share took a detour."""
    share, mean = rng.uniform(0.15, 0.4), _log_uniform(rng, 5.0, 200.0)
    blocked = rng.random(data.z.shape) < share
    return replace(data, z=data.z + blocked * rng.exponential(mean, data.z.shape) * data.sigma), (), mean


def slant(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return ranges in the plane of a target that is above the plane."""
    span = np.sqrt(((data.place - data.place.mean(0)) ** 2).sum(1)).max()
    height = _log_uniform(rng, 0.03, 1.0) * span
    return _measured(rng, scene, height), (), height / float(data.sigma[0])


def wrong_height(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return a file that states a wrong height of the target as exact."""
    size = _size(rng)
    return replace(data, level=float(scene.truth[0, 2] + size * data.sigma[0])), (), size


def declination(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    error = np.radians(rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 20.0))
    return replace(data, z=np.where(data.of("azimuth"), data.z + error, data.z)), (), error / float(data.sigma[0])


def reference(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    """Return differences to another station than the file states: the row of this station is zero."""
    other = _guilty(rng, data)
    z = data.z - data.z[:, data.a == other]
    # the first station takes the row of the other one, in which the file has a zero
    return replace(data, z=z), (other,), 0.0


def lat_lon(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    geodetic = data.geodetic[:, [1, 0, 2]]
    return replace(data, geodetic=geodetic, place=ecef(geodetic)), (), 0.0


def moved(rng: np.random.Generator, scene: Scene, data: Data) -> Planted:
    who, d = int(rng.integers(data.stations)), data.place.shape[1]
    step = rng.normal(size=d)
    step /= np.sqrt((step**2).sum())
    span = np.sqrt(((data.place - data.place.mean(0)) ** 2).sum(1)).max()
    length = _log_uniform(rng, 0.003, 1.0) * span
    place = data.place.copy()
    place[who] += step * length
    return replace(data, place=place), (who,), length


# Pairs of a cause and a kind.

MANY = (5, 10)
"""Epochs of pairs whose cause shows only over several epochs."""
SOME = (1, 5)


@dataclass(frozen=True)
class Pair:
    """A mistake and a kind: where it is planted.

    - world: "plane", "space", "local" (either), "earth", "sky" or "any".
    - epochs: the fewest and the most.
    """

    cause: str | None
    kind: str
    plant: Callable[[np.random.Generator, Scene, Data], Planted] | None
    world: str = "local"
    epochs: tuple[int, int] = SOME
    extra: tuple[int, int] = (2, 5)


def _pairs() -> dict[str, Pair]:
    """Return the pairs by name."""
    rows = [
        *(Pair("offset", k, offset, "any") for k in ("tdoa", "toa", "range")),
        *(Pair("offset", k, offset) for k in ("azel", "groa", "range_sum")),
        Pair("offset", "azimuth", offset, "plane", extra=(2, 6)),
        Pair("offset", "toa", offset, "sky"),
        Pair("offset", "range_rate", offset, "plane", extra=(3, 6)),
        Pair("sign-station", "tdoa", sign_station, epochs=(3, 8)),
        Pair("sign-station", "azimuth", sign_station, "plane", epochs=(3, 8)),
        Pair("scale", "range", scale, epochs=MANY),
        *(Pair("drift", k, drift, epochs=MANY) for k in ("toa", "range", "tdoa")),
        *(Pair("swapped", k, swapped) for k in ("tdoa", "toa", "range", "azel")),
        Pair("swapped", "azimuth", swapped, "plane", extra=(3, 6)),
        Pair("period", "toa", period, "any"),
        Pair("period", "toa", period, "sky"),
        *(Pair("outlier", k, outlier, epochs=MANY) for k in ("tdoa", "toa", "range", "azel", "groa", "range_sum")),
        Pair("outlier", "azimuth", outlier, "plane", epochs=MANY),
        Pair("outlier", "toa", outlier, "sky", epochs=MANY),
        *(Pair("outliers", k, outliers, epochs=MANY) for k in ("tdoa", "range")),
        *(Pair("noise", k, noise) for k in ("tdoa", "toa", "range", "azel")),
        Pair("noise", "azimuth", noise, "plane"),
        Pair("noise", "range", noise_of_station, epochs=(8, 12)),
        *(Pair("unit", k, unit) for k in ("tdoa", "toa", "range", "range_sum")),
        Pair("unit", "azimuth", unit, "plane"),
        *(Pair("coordinate-unit", k, coordinate_unit) for k in ("tdoa", "range")),
        *(Pair(c, "azimuth", p, "plane") for c, p in (("compass", compass), ("anticlockwise", anticlockwise))),
        Pair("opposite", "azimuth", opposite, "plane"),
        *(Pair("compass", "azel", p) for p in (compass,)),
        *(Pair("sign", k, sign) for k in ("tdoa", "toa")),
        *(Pair("speed", k, speed, "sound") for k in ("tdoa", "toa", "range")),
        *(Pair("late", k, late, epochs=(6, 12)) for k in ("toa", "range")),
        Pair("height", "range", slant, "plane", epochs=(1, 5)),
        *(Pair("height", k, wrong_height, "level") for k in ("tdoa", "range")),
        Pair("declination", "azimuth", declination, "plane", epochs=(1, 6), extra=(3, 6)),
        Pair("reference", "tdoa", reference),
        *(Pair("lat-lon", k, lat_lon, "earth") for k in ("tdoa", "range", "toa")),
        *(Pair("moved", k, moved, epochs=(4, 8)) for k in ("tdoa", "range", "toa")),
        Pair("moved", "azimuth", moved, "plane", epochs=(4, 8)),
    ]
    clean = [
        *(Pair(None, k, None, "any") for k in ("tdoa", "toa", "range")),
        *(Pair(None, k, None) for k in ("azel", "groa", "range_sum")),
        *(Pair(None, k, None, "plane") for k in ("azimuth", "range_rate")),
        Pair(None, "toa", None, "sky"),
    ]
    shapes = [
        Pair(None, k, None, world)
        for world, k in (
            ("line", "range"),
            ("line", "tdoa"),
            ("flat", "range"),
            ("flat", "tdoa"),
            ("square", "tdoa"),
            ("square", "range"),
        )
    ]
    few = [Pair(None, k, None, "few", extra=(0, 1)) for k in ("tdoa", "range", "azimuth")]
    out = {}
    for pair in (*rows, *clean, *shapes, *few):
        name = f"{pair.cause or 'clean'} {pair.kind}"
        if pair.world in ("sky", "line", "flat", "square", "few"):
            name += f" {pair.world}"
        if pair.plant in (slant, noise_of_station):
            name += " slant" if pair.plant is slant else " station"
        assert name not in out
        out[name] = pair
    return out


PAIRS = _pairs()
"""All pairs by their names, such as "offset tdoa"; names that begin with "clean" have no mistake."""


def drawn(name: str, seed: int) -> Draw:
    """Return the draw of a pair with a seed."""
    pair = PAIRS[name]
    rng = np.random.default_rng([crc32(name.encode()), seed])
    scene = _scene(rng, pair)
    right = _measured(rng, scene)
    if pair.kind == "azimuth" and pair.cause == "compass" and rng.random() < 0.5:
        # azimuths from the x axis that the file calls a compass
        turned = replace(scene.data, azimuth="east-counterclockwise")
        scene = replace(scene, data=turned)
        right = _measured(rng, scene)
    if pair.plant is None:
        return Draw(name, seed, None, (), right, right, scene.truth, 0.0)
    data, stations, size = pair.plant(rng, scene, right)
    return Draw(name, seed, pair.cause, stations, data, right, scene.truth, size)


def _scene(rng: np.random.Generator, pair: Pair) -> Scene:
    """Return the scene of a pair."""
    epochs = int(rng.integers(pair.epochs[0], pair.epochs[1] + 1)) if rng.random() < 0.6 else pair.epochs[0]
    extra = int(rng.integers(pair.extra[0], pair.extra[1] + 1))
    world = pair.world
    if world == "any":
        world = "earth" if rng.random() < 0.3 else "local"
    if world == "earth":
        return _earth(rng, pair.kind, epochs, extra=extra)
    if world == "sky":
        return _satellites(rng, epochs, extra=extra)
    d = {"plane": 2, "space": 3, "level": 3, "line": 2, "flat": 3, "square": 2, "few": 2}.get(world, 0)
    d = d or (3 if pair.kind == "azel" else int(rng.integers(2, 4)))
    scene = _local(rng, pair.kind, epochs, d, extra=extra)
    if world == "sound" and scene.data.speed == LIGHT:
        return _scene(rng, pair)
    place = scene.data.place
    if world == "level":
        # one known height over all epochs
        scene.truth[:, 2] = scene.truth[0, 2]
        return replace(scene, data=replace(scene.data, level=float(scene.truth[0, 2])))
    if world in ("line", "flat"):
        place[:, 1 if world == "line" else 2] = 0.0
    if world == "square":
        extent = float(np.abs(place).max())
        place = extent * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
        data = _rows(rng, pair.kind, place, epochs, extent, scene.data.speed)
        return replace(scene, data=data)
    return scene
