"""Coordinate frames of positions: Cartesian, Earth-centred Earth-fixed (ECEF), and local east-north-up (ENU).

The ellipsoid is WGS 84. Latitudes and longitudes are geodetic, in radians. Heights are above the ellipsoid, in metres.
The library pymap3d, imported at its first use, converts geodetic coordinates to ECEF. The inverse is Bowring's method.
It uses only additions, products and square roots. They have the same bits on every processor, and they take a tenth of
the time of sines and angles.

Sources: NGA, World Geodetic System 1984, NGA.STND.0036 (2014), for the ellipsoid; B. R. Bowring,
Transformation from spatial to geographical coordinates, Survey Review 23 (1976), for the inverse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optloc.base.arrays import Portable, atan2, cos, product, sin
from optloc.base.errors import InvalidProblem
from optloc.base.types import Amount
from optloc.base.units import in_si

__all__ = ["CARTESIAN", "ECEF", "Frame", "check_geodetic", "ecef_to_geodetic", "geodetic_to_ecef"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Frame:
    """Coordinate frame of stations and targets.

    Parameters
    ----------
    kind : {"cartesian", "ecef", "enu"}
        Arbitrary Cartesian axes (2-D or 3-D), Earth-centred Earth-fixed (3-D), or east, north, up at `origin` (a 2-D
        problem is in the plane up = 0).
    origin : tuple of float (latitude, longitude, height), optional
        In rad, rad, m; for an ENU frame only. :meth:`enu` takes degrees.

    Raises
    ------
    InvalidProblem
        For an unknown kind, for an origin that is missing, not allowed, or outside its range.
    """

    kind: Literal["cartesian", "ecef", "enu"]
    origin: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Check the kind and the origin."""
        if self.kind not in ("cartesian", "ecef", "enu"):
            raise InvalidProblem(f"unknown frame {self.kind!r}", "frame", "known are cartesian, ecef, enu")
        if (self.origin is not None) != (self.kind == "enu"):
            verb = "needs an" if self.kind == "enu" else "has no"
            raise InvalidProblem(f"the frame '{self.kind}' {verb} origin", "frame", "only 'enu' has one")
        if self.origin is not None:
            check_geodetic(*self.origin, where="origin of the ENU frame")

    @classmethod
    def enu(cls, *, lat_deg: float, lon_deg: float, height: Amount = 0.0) -> Frame:
        """Return the east-north-up frame at a geodetic point: degrees; height in metres or text such as "1640 ft"."""
        metres = float(in_si(height, "length", "height", place=True))
        return cls("enu", (math.radians(lat_deg), math.radians(lon_deg), metres))

    @property
    def geodetic(self) -> bool:
        """Return whether positions have a latitude, a longitude and a height; False for a Cartesian frame."""
        return self.kind != "cartesian"

    def rotation_to_ecef(self) -> Array:
        """Return the rotation matrix R of ``p_ecef = R p + o``.

        Returns
        -------
        ndarray, shape (3, 3)
            The columns are the axes of this frame in ECEF.
        """
        return _rotation_at(self._place())

    def origin_ecef(self) -> Array:
        """Return the origin o of ``p_ecef = R p + o`` in metres, shape (3,)."""
        return _origin_at(self._place())

    def to_ecef(self, position: ArrayLike) -> Array:
        """Return positions of this frame as ECEF positions.

        Parameters
        ----------
        position : array_like, shape (..., 3), or (..., 2) in an ENU frame
            Metres.

        Returns
        -------
        ndarray, shape (..., 3)
            Metres.
        """
        return product(self._spatial(position), self.rotation_to_ecef().T) + self.origin_ecef()

    def from_ecef(self, position: ArrayLike) -> Array:
        """Return ECEF positions, shape (..., 3) in metres, as positions of this frame."""
        # Subtract before the rotation, because rotated coordinates with the size of the Earth are rounded to a
        # nanometre.
        return product(_vectors(position, (3,)) - self.origin_ecef(), self.rotation_to_ecef())

    def to_geodetic(self, position: ArrayLike) -> tuple[Array, Array, Array]:
        """Return latitude, longitude (rad) and height (m), each of shape (...), of positions of this frame."""
        return ecef_to_geodetic(self.to_ecef(position))

    def from_geodetic(
        self, lat: ArrayLike, lon: ArrayLike, height: ArrayLike, *, where: str = "position", first_row: int = 0
    ) -> Array:
        """Return geodetic points as positions of this frame.

        Parameters
        ----------
        lat, lon, height : array_like, shape (...)
            Radians, radians, metres.
        where, first_row
            As for :func:`check_geodetic`.

        Returns
        -------
        ndarray, shape (..., 3)
            Metres.
        """
        check_geodetic(lat, lon, height, where=where, first_row=first_row)
        return self.from_ecef(geodetic_to_ecef(lat, lon, height))

    def enu_axes(self, position: ArrayLike) -> Array:
        """Return the local east, north and up axes at points of this frame.

        Stations without stated axes use them. They convert the covariance C of a fix to ``A @ C @ A.T`` along east,
        north and up. In Cartesian frames, and in two dimensions, they are the axes of the frame.

        Parameters
        ----------
        position : array_like, shape (..., d)
            Metres; d is 2 or 3.

        Returns
        -------
        ndarray, shape (..., d, d)
            Rows are unit vectors expressed in this frame.
        """
        p = _vectors(position, (2, 3))
        d = p.shape[-1]
        # Without an Earth, and in two dimensions, the local axes are the axes of the frame.
        if not self.geodetic or (self.kind == "enu" and d == 2):
            return np.broadcast_to(np.eye(d), (*p.shape, d)).copy()
        return product(_axes_in_ecef(*_directions(self.to_ecef(p))), self.rotation_to_ecef())

    def _place(self) -> tuple[float, float, float] | None:
        """Return the origin (latitude, longitude, height) in rad, rad, m; None for ECEF.

        Raise InvalidProblem for a Cartesian frame, which has no place on Earth.
        """
        if not self.geodetic:
            raise InvalidProblem(
                "a cartesian frame has no place on Earth", "frame", "use the frame 'ecef', or 'enu' with its origin"
            )
        return self.origin

    def _spatial(self, position: ArrayLike) -> Array:
        """Return positions (..., 2 or 3) as positions (..., 3); the third coordinate of an ENU plane is zero."""
        p = _vectors(position, (2, 3) if self.kind == "enu" else (3,))
        return p if p.shape[-1] == 3 else np.concatenate([p, np.zeros_like(p[..., :1])], axis=-1)


CARTESIAN: Final = Frame("cartesian")
"""Arbitrary Cartesian axes, without a place on Earth."""

ECEF: Final = Frame("ecef")
"""Earth-centred, Earth-fixed, WGS 84."""


def geodetic_to_ecef(lat: ArrayLike, lon: ArrayLike, height: ArrayLike) -> Array:
    """Return ECEF positions (..., 3), metres, of latitude, longitude (rad) and height (m), each of shape (...)."""
    from pymap3d import geodetic2ecef

    given = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (lat, lon, height)))
    # Simulated scenes on Earth must have the same bits everywhere, so `Portable` computes the sines.
    place = geodetic2ecef(*(v.view(Portable) for v in given), deg=False)
    return np.stack(np.broadcast_arrays(*map(np.asarray, place)), axis=-1)


def ecef_to_geodetic(position: ArrayLike) -> tuple[Array, Array, Array]:
    """Return latitude, longitude and height of ECEF positions.

    Parameters
    ----------
    position : array_like, shape (..., 3)
        Metres.

    Returns
    -------
    lat, lon, height : ndarray, shape (...)
        Radians, radians in [-pi, pi], metres.
    """
    p = _vectors(position, (3,))
    (sine, cosine), (east, north) = _directions(p)
    height = (
        np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2) * cosine
        + p[..., 2] * sine
        - _MAJOR * np.sqrt(1.0 - _SQUARED_ECCENTRICITY * sine**2)
    )
    return np.asarray(atan2(sine, cosine)), np.asarray(atan2(east, north)), np.asarray(height)


# Semi-axes of WGS 84, metres, and its squared eccentricity.
_MAJOR, _MINOR = 6378137.0, 6356752.31424518
_SQUARED_ECCENTRICITY = 1.0 - (_MINOR / _MAJOR) ** 2
# Iterations of Bowring's method from the geocentric direction: only rounding error remains at all heights above -6000
# km.
_STEPS = 3


def _directions(position: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return sine and cosine (...) of latitude, and of longitude, of ECEF positions (..., 3), without angles.

    Heights and axes need the sines and cosines only, and square roots are faster than sines.
    """
    x, y, z = np.moveaxis(position, -1, 0)
    axial = np.sqrt(x * x + y * y)
    rise, run = z, axial
    for _ in range(_STEPS):
        sine, cosine = _unit(_MINOR * rise, _MAJOR * run)
        rise = z + _SQUARED_ECCENTRICITY * _MAJOR**2 / _MINOR * (sine * sine * sine)
        # Clipped at zero: within 43 km of the centre several latitudes are possible.
        run = np.maximum(axial - _SQUARED_ECCENTRICITY * _MAJOR * (cosine * cosine * cosine), 0.0)
    return _unit(rise, run), _unit(y, x)


def _unit(y: Array, x: Array) -> tuple[Array, Array]:
    """Return sine and cosine of the angles of vectors (x, y); a vector of length zero has the angle zero."""
    length = np.sqrt(x * x + y * y)
    zero = length == 0.0
    length = length + zero
    return y / length, x / length + zero


def check_geodetic(
    lat: ArrayLike, lon: ArrayLike, height: ArrayLike = 0.0, *, where: str = "position", first_row: int = 0
) -> None:
    """Raise if a point is not on Earth.

    Parameters
    ----------
    lat, lon, height : array_like, shape (...)
        Radians, radians, metres.
    where : str
        File or argument that messages name.
    first_row : int
        Number of the first row in the user's count.

    Raises
    ------
    InvalidProblem
        For the first point with a latitude outside -90 to 90 deg, a longitude outside -180 to 360 deg, or a coordinate
        that is not finite.
    """
    slack = 1e-9  # a right angle that was converted from degrees can exceed pi / 2
    # Both conventions of longitude are valid: -180 to 180 deg and 0 to 360 deg.
    ranges = {"latitude": (lat, -90.0, 90.0), "longitude": (lon, -180.0, 360.0)}
    for name, (values, low, high) in ranges.items():
        degrees = np.degrees(np.asarray(values, dtype=np.float64)).ravel()
        # This comparison also rejects NaN.
        outside = np.flatnonzero(~((degrees >= low - slack) & (degrees <= high + slack)))
        if outside.size:
            row = outside[0]
            what = f"the {name} {degrees[row]:.10g} deg is outside {low:g} to {high:g} deg"
            raise InvalidProblem(what, _row(where, row, degrees, first_row), "check the order and unit of the columns")
    metres = np.asarray(height, dtype=np.float64).ravel()
    bad = np.flatnonzero(~np.isfinite(metres))
    if bad.size:
        what = f"the height {metres[bad[0]]:g} is not a finite number"
        raise InvalidProblem(what, _row(where, bad[0], metres, first_row), "give every place a height in metres")


def _row(where: str, row: np.intp, column: Array, first_row: int) -> str:
    """Return the location for a message: `where` and, if the column has several entries, the row as users count it."""
    return where if column.size == 1 else f"{where}, row {row + first_row}"


# Rotation and origin of a frame are constant, and constraints need them at every step, so they are cached.


@lru_cache(maxsize=64)
def _rotation_at(place: tuple[float, float, float] | None) -> Array:
    """Return the rotation (3, 3) from the frame with this origin to ECEF; the unit matrix for None (ECEF)."""
    if place is None:
        return _read_only(np.eye(3))
    lat, lon = np.array(place[0]), np.array(place[1])
    return _read_only(_axes_in_ecef((sin(lat), cos(lat)), (sin(lon), cos(lon))).T)


@lru_cache(maxsize=64)
def _origin_at(place: tuple[float, float, float] | None) -> Array:
    """Return the ECEF position (3,), metres, of an origin (rad, rad, m); zeros for None (ECEF)."""
    return _read_only(np.zeros(3) if place is None else geodetic_to_ecef(*place))


def _read_only(array: Array) -> Array:
    """Return the array as a read-only array, because the cache shares it."""
    array.flags.writeable = False
    return array


def _axes_in_ecef(lat: tuple[Array, Array], lon: tuple[Array, Array]) -> Array:
    """Return east, north, up as rows in ECEF (..., 3, 3), from (sine, cosine) of latitude and of longitude."""
    (sine, cosine), (y, x) = lat, lon
    rows = ((-y, x, np.zeros_like(x)), (-sine * x, -sine * y, cosine), (cosine * x, cosine * y, sine))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _vectors(position: ArrayLike, lengths: tuple[int, ...]) -> Array:
    """Return positions as a float array (..., d); raise InvalidProblem if d is not among the allowed `lengths`."""
    p = np.asarray(position, dtype=np.float64)
    if p.ndim == 0 or p.shape[-1] not in lengths:
        allowed = " or ".join(str(n) for n in lengths)
        what = f"positions of shape {p.shape} do not have a last axis of {allowed} coordinates"
        raise InvalidProblem(what, "position", "give x, y or x, y, z in the last axis")
    return p
