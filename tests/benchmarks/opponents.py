"""Opponents of the benchmark of kinds: rows of measurements in plain NumPy, and SciPy's least squares on them.

Nothing here uses optloc. `Rows` of one kind are combined by `stacked`, `through`, `with_emission` and
`with_station_errors`. The values also take arrays of JAX; the derivatives are exact and written for NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

Array = np.ndarray
# WGS 84: semi-major axis, metres, and squared eccentricity.
AXIS, ECCENTRICITY = 6378137.0, 6.69437999014e-3
# Passes of Bowring's formula for a geodetic latitude: two are exact to rounding below 100 km.
_BOWRING = 3
# Times that weights which depend on the position are computed again: each pass gains three digits.
_REWEIGHTED = 4
# A station, a slice of stations, or their numbers.
Index = Any


@dataclass(frozen=True)
class Rows:
    """Noise-free measurements of a vector x.

    Parameters
    ----------
    value : callable
        ``(x, xp=numpy) -> (m,)``.
    slope : callable
        ``x -> (m, n)``: derivative of the value.
    """

    value: Callable[..., Any]
    slope: Callable[[Array], Array]


def _ranges(stations: Array, x: Any, xp: Any = np) -> Any:
    return xp.sqrt(((x - stations) ** 2).sum(-1))


def unit_vectors(stations: Array, x: Array) -> tuple[Array, Array]:
    """Return ranges (s,) and unit vectors from the stations to x (s, d)."""
    away = x - stations
    r = np.sqrt((away**2).sum(1))
    return r, away / r[:, None]


def ranges(stations: Array, a: Index = slice(None)) -> Rows:
    """Return the rows r_a."""
    own = stations[a]
    return Rows(lambda x, xp=np: _ranges(own, x, xp), lambda x: unit_vectors(own, x)[1])


def differences(stations: Array, a: Index = slice(1, None), b: Index = 0, sign: float = -1.0) -> Rows:
    """Return the rows r_a - r_b, or with the sign 1 their sums."""

    def value(x: Any, xp: Any = np) -> Any:
        r = _ranges(stations, x, xp)
        return r[a] + sign * r[b]

    def slope(x: Array) -> Array:
        unit = unit_vectors(stations, x)[1]
        return unit[a] + sign * unit[b]

    return Rows(value, slope)


def ratios(stations: Array, a: Index = slice(1, None), b: Index = 0) -> Rows:
    """Return the rows r_a / r_b of gain ratios."""

    def value(x: Any, xp: Any = np) -> Any:
        r = _ranges(stations, x, xp)
        return r[a] / r[b]

    def slope(x: Array) -> Array:
        r, unit = unit_vectors(stations, x)
        return (unit[a] - (r[a] / r[b])[:, None] * unit[b]) / r[b]

    return Rows(value, slope)


def level_differences(stations: Array, a: Index = slice(1, None), b: Index = 0) -> Rows:
    """Return the rows 20 log10(r_b / r_a), decibels."""
    scale = 20.0 / np.log(10.0)

    def value(x: Any, xp: Any = np) -> Any:
        r = _ranges(stations, x, xp)
        return scale * xp.log(r[b] / r[a])

    def slope(x: Array) -> Array:
        r, unit = unit_vectors(stations, x)
        return scale * (unit[b] / r[b] - unit[a] / r[a][:, None])

    return Rows(value, slope)


def azimuths(stations: Array, a: Index = slice(None)) -> Rows:
    """Return angles from the x axis towards y, radians, of stations (s, 2 or 3)."""
    own = stations[a]

    def value(x: Any, xp: Any = np) -> Any:
        away = x - own
        return xp.arctan2(away[:, 1], away[:, 0])

    def slope(x: Array) -> Array:
        away = x - own
        flat = away[:, 0] ** 2 + away[:, 1] ** 2
        out = np.zeros(own.shape)
        out[:, 0], out[:, 1] = -away[:, 1] / flat, away[:, 0] / flat
        return out

    return Rows(value, slope)


def elevations(stations: Array, a: Index = slice(None)) -> Rows:
    """Return angles above the x-y plane, radians."""
    own = stations[a]

    def value(x: Any, xp: Any = np) -> Any:
        away = x - own
        return xp.arctan2(away[:, 2], xp.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2))

    def slope(x: Array) -> Array:
        away = x - own
        flat = np.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2)
        squared = (away**2).sum(1)
        out = np.empty(own.shape)
        out[:, :2] = -away[:, :2] * (away[:, 2] / (flat * squared))[:, None]
        out[:, 2] = flat / squared
        return out

    return Rows(value, slope)


def pair_with_rates(stations: Array, velocity: Array) -> Rows:
    """Return range differences of two stations at k epochs, then the rates of these differences, of (k, 2, d)."""

    def value(x: Any, xp: Any = np) -> Any:
        away = x - stations
        r = xp.sqrt((away**2).sum(-1))
        rate = -(velocity * away).sum(-1) / r
        return xp.concatenate([r[:, 0] - r[:, 1], rate[:, 0] - rate[:, 1]])

    def slope(x: Array) -> Array:
        away = x - stations
        r = np.sqrt((away**2).sum(-1))[..., None]
        unit = away / r
        rate = -(velocity * unit).sum(-1)[..., None]
        moved = -(velocity + rate * unit) / r
        return np.concatenate([unit[:, 0] - unit[:, 1], moved[:, 0] - moved[:, 1]])

    return Rows(value, slope)


def coordinates(size: int) -> Rows:
    """Return x itself: the rows of a prior."""
    one = np.eye(size)
    return Rows(lambda x, xp=np: x, lambda x: one)


# Combinations.


def stacked(*parts: Rows) -> Rows:
    """Return the rows of several kinds one after the other."""
    return Rows(
        lambda x, xp=np: xp.concatenate([part.value(x, xp) for part in parts]),
        lambda x: np.concatenate([part.slope(x) for part in parts]),
    )


def with_emission(arrivals: Rows, *others: Rows) -> Rows:
    """Return rows of (x, t) for an emission at t, metres, that delays the arrivals and none of the others."""

    def value(p: Any, xp: Any = np) -> Any:
        return xp.concatenate([arrivals.value(p[:-1], xp) + p[-1], *(rows.value(p[:-1], xp) for rows in others)])

    def slope(p: Array) -> Array:
        parts = [arrivals.slope(p[:-1]), *(rows.slope(p[:-1]) for rows in others)]
        out = np.zeros((sum(map(len, parts)), len(p)))
        out[:, :-1] = np.concatenate(parts)
        out[: len(parts[0]), -1] = 1.0
        return out

    return Rows(value, slope)


def with_station_errors(stations: Array) -> Rows:
    """Return range differences to the first of s stations, then the errors of all stations, of (x, errors)."""
    s, d = stations.shape

    def value(p: Any, xp: Any = np) -> Any:
        r = _ranges(stations + p[d:].reshape(s, d), p[:d], xp)
        return xp.concatenate([r[1:] - r[0], p[d:]])

    def slope(p: Array) -> Array:
        unit = unit_vectors(stations + p[d:].reshape(s, d), p[:d])[1]
        out = np.zeros((s - 1 + s * d, d + s * d))
        out[: s - 1, :d] = unit[1:] - unit[0]
        out[: s - 1, d : 2 * d] = unit[0]
        for i in range(1, s):
            out[i - 1, d + d * i : 2 * d + d * i] = -unit[i]
        out[s - 1 :, d:] = np.eye(s * d)
        return out

    return Rows(value, slope)


def through(rows: Rows, place: Rows) -> Rows:
    """Return rows of the unknowns that a place is made of."""
    return Rows(
        lambda p, xp=np: rows.value(place.value(p, xp), xp), lambda p: rows.slope(place.value(p)) @ place.slope(p)
    )


# The Earth.


def ecef(lat: Any, lon: Any, height: Any = 0.0, xp: Any = np) -> Any:
    """Return the position (..., 3) at a geodetic latitude and longitude, radians, and height, metres."""
    n = AXIS / xp.sqrt(1.0 - ECCENTRICITY * xp.sin(lat) ** 2)
    flat = (n + height) * xp.cos(lat)
    up = (n * (1.0 - ECCENTRICITY) + height) * xp.sin(lat)
    return xp.stack([flat * xp.cos(lon), flat * xp.sin(lon), up], -1)


def geodetic(position: Any, xp: Any = np) -> tuple[Any, Any, Any]:
    """Return latitude, longitude and height of a position in ECEF."""
    flat = xp.sqrt(position[0] ** 2 + position[1] ** 2)
    ratio = np.sqrt(1.0 - ECCENTRICITY)
    reduced = xp.arctan2(position[2], ratio * flat)
    for _ in range(_BOWRING):
        above = position[2] + ECCENTRICITY / ratio * AXIS * xp.sin(reduced) ** 3
        lat = xp.arctan2(above, flat - ECCENTRICITY * AXIS * xp.cos(reduced) ** 3)
        reduced = xp.arctan2(ratio * xp.sin(lat), xp.cos(lat))
    n = AXIS / xp.sqrt(1.0 - ECCENTRICITY * xp.sin(lat) ** 2)
    height = flat * xp.cos(lat) + position[2] * xp.sin(lat) - AXIS**2 / n
    return lat, xp.arctan2(position[1], position[0]), height


@dataclass(frozen=True)
class Tangent:
    """East, north and up at a point of the ellipsoid, or ECEF itself without a point.

    Parameters
    ----------
    lat, lon : float, optional
        Of the origin, radians.
    """

    lat: float | None = None
    lon: float = 0.0
    axes: Array = field(init=False)
    origin: Array = field(init=False)

    def __post_init__(self) -> None:
        axes, origin = np.eye(3), np.zeros(3)
        if self.lat is not None:
            (sp, cp), (sl, cl) = ((np.sin(a), np.cos(a)) for a in (self.lat, self.lon))
            axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
            origin = ecef(self.lat, self.lon)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "origin", origin)

    def geodetic(self, x: Array) -> tuple[Any, Any, Any]:
        """Return latitude, longitude and height of a position."""
        return geodetic(self.origin + self.axes.T @ x)

    def height(self) -> Rows:
        """Return the row of the height above the ellipsoid: its gradient is the vertical."""

        def value(x: Any, xp: Any = np) -> Any:
            return geodetic(self.origin + self.axes.T @ x, xp)[2][None]

        def slope(x: Array) -> Array:
            lat, lon, _ = self.geodetic(x)
            return (self.axes @ np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]))[None]

        return Rows(value, slope)

    def at_height(self, height: float) -> Rows:
        """Return the position of a latitude and a longitude at a height: an exact height leaves these two unknowns."""

        def value(p: Any, xp: Any = np) -> Any:
            return self.axes @ (ecef(p[0], p[1], height, xp) - self.origin)

        def slope(p: Array) -> Array:
            (sp, cp), (sl, cl) = ((np.sin(a), np.cos(a)) for a in p)
            w = 1.0 - ECCENTRICITY * sp**2
            meridian, normal = AXIS * (1.0 - ECCENTRICITY) / w**1.5, AXIS / np.sqrt(w)
            north = (meridian + height) * np.array([-sp * cl, -sp * sl, cp])
            east = (normal + height) * cp * np.array([-sl, cl, 0.0])
            return self.axes @ np.stack([north, east], 1)

        return Rows(value, slope)


# Least squares.


def shared_arrival(count: int, sigma: float) -> Array:
    """Return the covariance of differences to one arrival, each arrival with a standard deviation."""
    return sigma**2 * (np.eye(count) + 1.0)


def independent(*parts: tuple[int, float]) -> Array:
    """Return the covariance of independent rows: (count, standard deviation) of each kind."""
    return np.diag(np.concatenate([np.full(count, sigma**2) for count, sigma in parts]))


def joined(*blocks: Array) -> Array:
    """Return the covariance of blocks of rows that are independent of each other."""
    return np.asarray(block_diag(*blocks))


@dataclass(frozen=True)
class Opponent:
    """A least-squares problem in plain NumPy.

    Parameters
    ----------
    rows : Rows
        Of the opponent's unknowns p.
    covariance : array (m, m) or callable
        Of the rows, or a function of p.
    known : array
        Values of the last rows, which are priors: no draw changes them.
    angles : slice
        Rows whose residuals are angles.
    scale : float or "jac"
        `x_scale` of SciPy.
    """

    rows: Rows
    covariance: Array | Callable[[Array], Array]
    known: Array = field(default_factory=lambda: np.empty(0))
    angles: slice | None = None
    scale: Any = 1.0

    def covariance_at(self, p: Array) -> Array:
        """Return the covariance (m, m) of the rows, priors included."""
        return self.covariance(p) if callable(self.covariance) else self.covariance

    def draw(self, p: Array, rng: np.random.Generator) -> Array:
        """Return measurements (N, m) of unknowns p (N, n)."""
        count = len(self.rows.value(p[0])) - len(self.known)
        root = np.linalg.cholesky(self.covariance_at(p[0])[:count, :count])
        places = p[:1] if (p == p[0]).all() else p
        exact = np.broadcast_to([self.rows.value(each)[:count] for each in places], (len(p), count))
        return exact + rng.standard_normal(exact.shape) @ root.T

    def difference(self, value: Any, z: Array) -> Any:
        """Return value - z, angles between -pi and pi."""
        out = value - z
        if self.angles is not None:
            out[self.angles] = (out[self.angles] + np.pi) % (2.0 * np.pi) - np.pi
        return out

    def ready(self, z: Array, start: Array) -> Callable[[], Any]:
        """Return a call that solves measurements (m,) from a start (n,), with whitening and functions made before."""
        both = np.concatenate([z, self.known])
        if not callable(self.covariance):
            return self._ready(both, np.linalg.inv(np.linalg.cholesky(self.covariance)), start)

        def solve() -> Any:
            at = start
            for _ in range(_REWEIGHTED):
                found = self._ready(both, np.linalg.inv(np.linalg.cholesky(self.covariance_at(at))), at)()
                at = found.x
            return found

        return solve

    def _ready(self, z: Array, white: Array, start: Array) -> Callable[[], Any]:
        value, slope = self.rows.value, self.rows.slope
        if self.angles is None:

            def residual(p: Array) -> Array:
                return white @ (value(p) - z)
        else:

            def residual(p: Array) -> Array:
                return white @ self.difference(value(p), z)

        def jacobian(p: Array) -> Array:
            return white @ slope(p)

        return lambda: least_squares(residual, start, jac=jacobian, method="lm", x_scale=self.scale)
