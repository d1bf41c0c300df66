"""Problems as a user states them: stations, rows in the units of a file, and the text of the problem file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import optloc

Array = np.ndarray
LIGHT, SOUND = 299_792_458.0, 343.0
LENGTHS = ("tdoa", "toa", "range", "range_sum")
DIFFERENCES = ("tdoa", "groa")
"""Kinds with a second station that all rows share."""
_METRES = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_RADIANS = {"rad": 1.0, "deg": np.pi / 180.0}
# WGS 84.
_MAJOR, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563


@dataclass(frozen=True)
class Data:
    """Stations and rows of one file in SI units and radians, as the file states them; E epochs, each with R rows.

    Azimuths are as the file counts them: `azimuth` names the convention.

    - place (n, d): positions of the stations, m; `geodetic` (n, 3): latitude, longitude, degrees, and height, m.
    - velocity (n, d) of the stations, m/s, for range rates.
    - kind, a, b (R,): kind and stations of the rows of an epoch; b is -1 without a second station.
    - z (E, R), sigma (R,): for time differences sigma is that of an arrival.
    - own_sigma: whether the noise is stated with its own unit.
    - time (E,): seconds.
    - level: a height that the file states as exact, m.
    - place_unit: the unit of the coordinates of the stations.
    """

    place: Array
    kind: tuple[str, ...]
    a: Array
    b: Array
    z: Array
    sigma: Array
    time: Array
    speed: float = LIGHT
    unit: str = "m"
    own_sigma: bool = False
    azimuth: str = "north-clockwise"
    level: float | None = None
    geodetic: Array | None = None
    velocity: Array | None = None
    place_unit: str = "m"

    @property
    def stations(self) -> int:
        """Return the number of stations."""
        return len(self.place)

    @property
    def lengths(self) -> Array:
        """Return which rows (R,) are lengths."""
        return np.array([kind in LENGTHS for kind in self.kind])

    def of(self, kind: str) -> Array:
        """Return which rows (R,) have a kind."""
        return np.array([one == kind for one in self.kind])

    def size(self, unit: str) -> float:
        """Return a unit of length or time in metres; times are multiplied by the speed of the wave."""
        return _METRES[unit] if unit in _METRES else SECONDS[unit] * self.speed

    def with_unit(self, rows: Array, meant: float, stated: float) -> Data:
        """Return the file whose rows state another unit than their values have; sizes of the units in SI."""
        factor = np.where(rows, stated / meant, 1.0)
        sigma = self.sigma if self.own_sigma else self.sigma * factor
        return replace(self, z=self.z * factor, sigma=sigma)


def ecef(geodetic: Array) -> Array:
    """Return ECEF positions (..., 3), m, of latitudes and longitudes in degrees and heights in metres."""
    lat, lon, h = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1]), geodetic[..., 2]
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    n = _MAJOR / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    out = [(n + h) * np.cos(lat) * np.cos(lon), (n + h) * np.cos(lat) * np.sin(lon), (n * (1.0 - e2) + h) * np.sin(lat)]
    return np.stack(out, axis=-1)


def predicted(data: Data, x: Array, place: Array | None = None) -> Array:
    """Return the rows (..., E, R) for targets (..., E, d), without the emission time of arrivals.

    `place` (..., n, d) replaces the positions of the stations.
    """
    place = data.place if place is None else place
    shape = (*np.broadcast_shapes(x.shape[:-2], place.shape[:-2]), x.shape[-2], len(data.kind))
    out = np.empty(shape)
    for kind in dict.fromkeys(data.kind):
        rows = np.flatnonzero(data.of(kind))
        rows = slice(None) if len(rows) == len(data.kind) else rows
        p = x[..., :, None, :] - place[..., None, data.a[rows], :]
        r = np.sqrt((p**2).sum(-1)) if kind not in ("azimuth", "elevation") else p[..., 0]
        if data.b[0] >= 0:
            second = x[..., :, None, :] - place[..., None, data.b[rows], :]
            q = np.sqrt((second**2).sum(-1))
        if kind in ("range", "toa"):
            value = r
        elif kind == "tdoa":
            value = r - q
        elif kind == "range_sum":
            value = r + q
        elif kind == "groa":
            value = r / q
        elif kind == "azimuth":
            value = np.arctan2(p[..., 1], p[..., 0])
            if data.azimuth != "east-counterclockwise":
                value = (np.pi / 2.0 - value) * (1.0 if data.azimuth == "north-clockwise" else -1.0)
        elif kind == "elevation":
            value = np.arctan2(p[..., 2], np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2))
        else:
            value = -(p * data.velocity[data.a[rows]]).sum(-1) / r
        out[..., rows] = value
    return out


def names(data: Data) -> list[str]:
    """Return the names of the stations."""
    return [f"S{i}" for i in range(data.stations)]


def text(data: Data) -> str:
    """Return the text of the problem file."""
    lines = ["format = 2"]
    # times of a second need a statement, because light goes around the Earth in less
    if data.speed != LIGHT or (data.unit in SECONDS and np.abs(data.z).max() > 1e8):
        lines.append(f"propagation_speed = {data.speed!r}")
    lines += ["", "[stations]", *([f'unit = "{data.place_unit}"'] if data.place_unit != "m" else []), "rows = ["]
    lines += [f"  {{ {one} }}," for one in _station_rows(data)] + ["]"]
    if data.geodetic is None and data.place.shape[1] == 3 and np.linalg.norm(data.place[0]) > 6e6:
        lines[1:1] = ["[frame]", 'kind = "ecef"'] if data.speed == LIGHT else []
    if data.level is not None:
        lines += ["", "[[constraints]]", 'kind = "height"', f'exactly = "{data.level!r} m"']
    for kind in dict.fromkeys(data.kind):
        lines += ["", *_measurements(data, kind)]
    return "\n".join(lines) + "\n"


def _station_rows(data: Data) -> list[str]:
    """Return the inline tables of the stations without braces."""
    keys = "xyz" if data.geodetic is None else ("lat_deg", "lon_deg", "height")
    out = []
    for i, name in enumerate(names(data)):
        values = data.place[i] / data.size(data.place_unit) if data.geodetic is None else data.geodetic[i]
        pairs = [f'name = "{name}"', *(f"{key} = {float(v)!r}" for key, v in zip(keys, values, strict=False))]
        if data.velocity is not None:
            pairs += [f"v{axis} = {float(v)!r}" for axis, v in zip("xyz", data.velocity[i], strict=False)]
        out.append(", ".join(pairs))
    return out


def _measurements(data: Data, kind: str) -> list[str]:
    """Return the lines of the measurements of one kind."""
    mine = np.flatnonzero(data.of(kind))
    unit = {"groa": "1", "azimuth": "deg", "elevation": "deg", "range_rate": "m/s"}.get(kind, data.unit)
    size = data.size(unit) if kind in LENGTHS else _RADIANS.get(unit, 1.0)
    sigma = float(data.sigma[mine[0]])
    stated = f'"{sigma!r} m"' if data.own_sigma and kind in LENGTHS else repr(sigma / size)
    out = ["[[measurements]]", f'kind = "{kind}"', f'unit = "{unit}"']
    out.append(f"{'arrival_sigma' if kind == 'tdoa' else 'sigma'} = {stated}")
    if kind == "azimuth":
        out.append(f'azimuth = "{data.azimuth}"')
    second = {int(data.b[j]) for j in mine}
    if second != {-1} and len(second) == 1:
        out.append(f'b = "S{second.pop()}"')
    out.append("rows = [")
    for e in range(len(data.z)):
        when = f"time = {float(data.time[e])!r}, " if len(data.z) > 1 else ""
        for j in mine:
            own = f'b = "S{data.b[j]}", ' if second and second != {-1} else ""
            value = float(data.z[e, j])
            if kind == "azimuth":
                value %= 2.0 * np.pi
            out.append(f'  {{ {when}a = "S{data.a[j]}", {own}z = {value / size!r} }},')
    return [*out, "]"]


def loaded(data: Data, folder: Path) -> optloc.Problem:
    """Return the problem that optloc reads from the file of the data."""
    file = folder / "problem.toml"
    file.write_text(text(data), encoding="utf-8")
    return optloc.load(file)
