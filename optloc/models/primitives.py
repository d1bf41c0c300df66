"""Elements of measurement functions: components of points, elementary functions, and forward-mode derivatives.

A point is a tuple of components. Each component is a number, an array, a symbol or a Jet, so one formula serves all
uses. The letter t is a target and a is a station.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from optloc.base.arrays import library

# The function `namespace` selects the elementary functions for a value: of NumPy, CasADi, Jet or an array-API library.


def namespace(value: Any) -> Any:
    """Return the module with ``sqrt sin cos atan2 hypot`` for a value.

    Measurement functions call it, so that one formula works for numbers, symbols and derivatives.

    Parameters
    ----------
    value : Jet, casadi.SX, casadi.MX, casadi.DM, float or array
        Any operand of a measurement function.

    Returns
    -------
    module
        A namespace with the array-API names of the elementary functions.
    """
    get_namespace = getattr(value, "__elementary__", None)
    if get_namespace is not None:
        return get_namespace()
    if type(value).__module__.startswith("casadi"):
        return sys.modules["casadi"]
    return library(value)


Components = tuple[Any, ...]

# Semi-major axis in metres and flattening: defining constants of WGS 84.
WGS84_A = 6378137.0
WGS84_F = 1.0 / 298.257223563
# Its squared eccentricity.
_E2 = WGS84_F * (2.0 - WGS84_F)


@dataclass(frozen=True, slots=True)
class Point:
    """A target or a station as tuples of components. Only the fields that a measurement kind needs are set.

    Parameters
    ----------
    position : tuple of d numbers
        Metres, in the problem's frame.
    velocity : tuple of d numbers, optional
        Metres per second.
    axes : tuple of d tuples of d numbers, optional
        Unit vectors of the local frame, expressed in the problem's frame.
    ecef : tuple of 3 numbers, optional
        The same position, Earth-centred Earth-fixed, metres.
    up : tuple of 3 numbers, optional
        Unit normal of the ellipsoid at the position, in the problem's frame.
    medium : Layers or Atmosphere, optional
        Medium of the waves (`optloc.models.medium`).
    acceleration : tuple of d numbers, optional
        Metres per second squared.
    span : tuple of 2 float, optional
        First and last time of the run, seconds after the time of the position and the velocity.
    other : Point, optional
        Another target, for quantities of two targets.
    """

    position: Components
    velocity: Components | None = None
    axes: tuple[Components, ...] | None = None
    ecef: Components | None = None
    up: Components | None = None
    medium: Any = None
    acceleration: Components | None = None
    span: tuple[float, float] | None = None
    other: Point | None = None


def dot(u: Components, v: Components) -> Any:
    """Return the inner product of two component tuples."""
    total = u[0] * v[0]
    for p, q in zip(u[1:], v[1:], strict=True):
        total = total + p * q
    return total


def subtract(u: Components, v: Components) -> Components:
    """Return the componentwise difference ``u - v``."""
    return tuple(p - q for p, q in zip(u, v, strict=True))


def norm(u: Components) -> Any:
    """Return the Euclidean length of a component tuple."""
    squared = dot(u, u)
    return namespace(squared).sqrt(squared)


def distance(t: Point, a: Point) -> Any:
    """Return the range between two points, metres."""
    return norm(subtract(t.position, a.position))


def range_rate(t: Point, a: Point) -> Any:
    """Return the rate of the range between two points, metres per second."""
    assert t.velocity is not None
    assert a.velocity is not None
    line = subtract(t.position, a.position)
    return dot(line, subtract(t.velocity, a.velocity)) / norm(line)


def local(t: Point, a: Point) -> Components:
    """Return the vector from station to target in the axes of the station, metres."""
    return within(subtract(t.position, a.position), a)


def within(line: Components, a: Point) -> Components:
    """Return a vector of the problem's frame in the axes of the station."""
    return line if a.axes is None else tuple(dot(axis, line) for axis in a.axes)


def wrap(angle: Any) -> Any:
    """Return an angle wrapped to (-pi, pi], radians."""
    xp = namespace(angle)
    # Remainders differ between libraries, and symbolic remainders are not smooth. This form is smooth except at the
    # seam.
    return xp.atan2(xp.sin(angle), xp.cos(angle))


def rotate(axes: tuple[Components, ...], turn: Components) -> tuple[Components, ...]:
    """Return axes turned by a small rotation vector given in those axes.

    The rotation is the unit quaternion ``(1, turn / 2) / norm``. It agrees with the rotation vector up to third order
    and is smooth everywhere. In two dimensions `turn` has one component.

    Parameters
    ----------
    axes : tuple of d tuples of d numbers
        Unit vectors of the local frame.
    turn : tuple of 1 (plane) or 3 numbers
        Rotation vector, radians.
    """
    half = tuple(0.5 * w for w in turn)
    scale = 1.0 / (1.0 + dot(half, half))
    if len(half) == 1:
        c, s = (1.0 - half[0] * half[0]) * scale, 2.0 * half[0] * scale
        matrix: tuple[Components, ...] = ((c, s), (-1.0 * s, c))
    else:
        x, y, z = half
        xx, yy, zz = x * x, y * y, z * z
        matrix = (
            ((1.0 + xx - yy - zz) * scale, 2.0 * (x * y + z) * scale, 2.0 * (x * z - y) * scale),
            (2.0 * (x * y - z) * scale, (1.0 + yy - xx - zz) * scale, 2.0 * (y * z + x) * scale),
            (2.0 * (x * z + y) * scale, 2.0 * (y * z - x) * scale, (1.0 + zz - xx - yy) * scale),
        )
    # Rows of the matrix times the axes: each new axis is a linear combination of the old axes.
    columns = tuple(zip(*axes, strict=True))
    return tuple(tuple(dot(row, column) for column in columns) for row in matrix)


def geodetic_height(ecef: Components) -> Any:
    """Return the height above the WGS 84 ellipsoid, metres.

    The method is Bowring's parametric latitude with two fixed steps. Its error is 1e-11 m from -5 km to 1 000 km;
    rounding of doubles adds 4e-9 m. It has no branches, so it works for symbols as well as numbers. The height
    ``h = p cos(phi) + z sin(phi) - a sqrt(1 - e2 sin(phi)^2)`` is stationary in phi, so its gradient is the normal.

    References
    ----------
    B. R. Bowring, "Transformation from spatial to geographical coordinates", Survey Review 23 (1976).
    """
    if (place := _values(ecef)) is not None:
        return differential(geodetic_height(place), list(zip(ecef, geodetic_normal(place), strict=True)))
    p, sin_phi, cos_phi = _latitude(ecef)
    return p * cos_phi + ecef[2] * sin_phi - WGS84_A * namespace(p).sqrt(1.0 - _E2 * sin_phi * sin_phi)


def geodetic_normal(ecef: Components) -> Components:
    """Return the unit normal of the WGS 84 ellipsoid at a point, which is the gradient of the height.

    Its derivatives depend on the meridian radius of curvature (north-south) and on the distance from the axis
    (east-west).
    """
    if (place := _values(ecef)) is not None:
        normal = geodetic_normal(place)
        slopes = _normal_derivatives(place)
        return tuple(differential(n, list(zip(ecef, row, strict=True))) for n, row in zip(normal, slopes, strict=True))
    p, sin_phi, cos_phi = _latitude(ecef)
    return ecef[0] / p * cos_phi, ecef[1] / p * cos_phi, sin_phi


def _normal_derivatives(ecef: Components) -> tuple[Components, ...]:
    """Return the derivatives of the normal with respect to the position, one row per component, also on the axis.

    The unit is 1/m. `ecef` is a position in metres.
    """
    x, y, _ = ecef
    p, sin_phi, cos_phi = _latitude(ecef)
    squared_factor = 1.0 - _E2 * sin_phi * sin_phi
    # Derivative of the latitude along the meridian: one over the meridian radius of curvature plus the height.
    north = 1.0 / (WGS84_A * (1.0 - _E2) / (squared_factor * namespace(p).sqrt(squared_factor)) + geodetic_height(ecef))
    around = cos_phi / p
    # The latitude decreases with the distance from the axis, and so does `around`.
    bend = (sin_phi * sin_phi * north - around) / (p * p)
    mixed = -sin_phi * cos_phi * north / p
    return (
        (around + x * x * bend, x * y * bend, x * mixed),
        (x * y * bend, around + y * y * bend, y * mixed),
        (x * mixed, y * mixed, cos_phi * cos_phi * north),
    )


def _latitude(ecef: Components) -> tuple[Any, Any, Any]:
    """Return the distance from the axis, metres, and sine and cosine of the geodetic latitude, of an ECEF position."""
    x, y, z = ecef
    xp = namespace(x)
    b = WGS84_A * (1.0 - WGS84_F)
    p = xp.sqrt(x * x + y * y + 1e-12)  # a micrometre off the axis, so that the poles have a derivative
    sin_u, cos_u = _direction(z * WGS84_A, p * b)
    # Two steps of Bowring's method from the parametric latitude; `geodetic_height` gives the remaining error.
    for _ in range(2):
        up = z + (_E2 / (1.0 - _E2)) * b * sin_u * sin_u * sin_u
        out = p - _E2 * WGS84_A * cos_u * cos_u * cos_u
        sin_phi, cos_phi = _direction(up, out)
        sin_u, cos_u = _direction((1.0 - WGS84_F) * sin_phi, cos_phi)
    return p, sin_phi, cos_phi


def _direction(rise: Any, run: Any) -> tuple[Any, Any]:
    """Return sine and cosine of the angle of the vector (run, rise)."""
    length = namespace(rise).hypot(rise, run)
    return rise / length, run / length


# Forward-mode differentiation: values with sparse partial derivatives, batched over arrays.


@dataclass(frozen=True, slots=True, eq=False)
class Jet:
    """A value and its partial derivatives with respect to numbered independent variables (seeds).

    Parameters
    ----------
    value : array
        Values, any shape.
    partials : dict of seed to array
        Derivatives, broadcastable to `value`; an absent seed means zero.
    """

    value: Any
    partials: dict[int, Any]

    __array_ufunc__ = None  # numpy hands arithmetic with a Jet on the right to the Jet

    def __elementary__(self) -> ModuleType:
        """Return the module with the elementary functions of jets, for `namespace`."""
        return sys.modules[__name__]

    def __add__(self, other: Any) -> Jet:
        value, theirs = _parts(other)
        return Jet(self.value + value, _sum(self.partials, theirs))

    __radd__ = __add__

    def __neg__(self) -> Jet:
        return Jet(-self.value, {k: -v for k, v in self.partials.items()})

    def __sub__(self, other: Any) -> Jet:
        value, theirs = _parts(other)
        return Jet(self.value - value, _sum(self.partials, {k: -v for k, v in theirs.items()}))

    def __rsub__(self, other: Any) -> Jet:
        return Jet(other - self.value, {k: -v for k, v in self.partials.items()})

    def __mul__(self, other: Any) -> Jet:
        value, theirs = _parts(other)
        return Jet(self.value * value, _sum(_scale(self.partials, value), _scale(theirs, self.value)))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        """Return the quotient and its derivatives."""
        value, theirs = _parts(other)
        ratio = self.value / value
        inverse = 1.0 / value
        # (u / v)' = u' / v - (u / v) v' / v: this form uses the known ratio and has no square that could overflow.
        return Jet(ratio, _sum(_scale(self.partials, inverse), _scale(theirs, -ratio * inverse)))

    def __rtruediv__(self, other: Any) -> Jet:
        ratio = other / self.value
        return Jet(ratio, _scale(self.partials, -ratio / self.value))


def sqrt(u: Jet) -> Jet:
    """Return the square root of u."""
    root = namespace(u.value).sqrt(u.value)
    return Jet(root, _scale(u.partials, 0.5 / root))


def sin(u: Jet) -> Jet:
    """Return the sine of u."""
    xp = namespace(u.value)
    return Jet(xp.sin(u.value), _scale(u.partials, xp.cos(u.value)))


def cos(u: Jet) -> Jet:
    """Return the cosine of u."""
    xp = namespace(u.value)
    return Jet(xp.cos(u.value), _scale(u.partials, -xp.sin(u.value)))


def log(u: Jet) -> Jet:
    """Return the natural logarithm of u."""
    return Jet(namespace(u.value).log(u.value), _scale(u.partials, 1.0 / u.value))


def exp(u: Jet) -> Jet:
    """Return the exponential of u."""
    value = namespace(u.value).exp(u.value)
    return Jet(value, _scale(u.partials, value))


def hypot(u: Any, v: Any) -> Jet:
    """Return ``sqrt(u^2 + v^2)``."""
    (p, du), (q, dv) = _parts(u), _parts(v)
    # The derivative is the unit vector. At the origin it is undefined, so NaN is correct.
    length = namespace(p).hypot(p, q)
    return Jet(length, _sum(_scale(du, p / length), _scale(dv, q / length)))


def atan2(u: Any, v: Any) -> Jet:
    """Return the angle of the vector (v, u), radians."""
    (p, du), (q, dv) = _parts(u), _parts(v)
    squared = p * p + q * q
    return Jet(namespace(p).atan2(p, q), _sum(_scale(du, q / squared), _scale(dv, -p / squared)))


def clip(u: Any, low: float, high: float) -> Any:
    """Return u limited to the interval from `low` to `high`: a Jet, a number, an array or a CasADi symbol.

    Outside the interval the derivative is zero.
    """
    if isinstance(u, Jet):
        inside = (u.value >= low) & (u.value <= high)
        return Jet(clip(u.value, low, high), _scale(u.partials, 1.0 * inside))
    xp = namespace(u)
    if getattr(xp, "__name__", "") == "casadi":
        return xp.fmin(xp.fmax(u, low), high)
    return xp.clip(u, low, high)


def differential(value: Any, parts: Sequence[tuple[Any, Any]]) -> Any:
    """Return a value that was computed numerically, with its derivatives by the chain rule.

    Parameters
    ----------
    value : array
        The value.
    parts : sequence of (number or Jet, array)
        Quantities on which the value depends, and the derivative with respect to each.
    """
    jets = [(part, slope) for part, slope in parts if isinstance(part, Jet)]
    total: dict[int, Any] = {}
    for part, slope in jets:
        total = _sum(total, _scale(part.partials, slope))
    return Jet(value, total) if jets else value


def _values(numbers: Components) -> Components | None:
    """Return the values of numbers if at least one of them is a Jet, otherwise None."""
    return tuple(_parts(one)[0] for one in numbers) if any(isinstance(one, Jet) for one in numbers) else None


def _parts(other: Any) -> tuple[Any, dict[int, Any]]:
    """Return the value and the partial derivatives of a number or Jet; a number has no derivatives."""
    return (other.value, other.partials) if isinstance(other, Jet) else (other, {})


def _scale(partials: dict[int, Any], factor: Any) -> dict[int, Any]:
    """Return partial derivatives multiplied by a factor."""
    return {k: v * factor for k, v in partials.items()}


def _sum(first: dict[int, Any], second: dict[int, Any]) -> dict[int, Any]:
    """Return the sum of partial derivatives by seed."""
    # Most operands are constants or single seeds. The dictionary is copied only if both operands have derivatives.
    if not second:
        return first
    total = dict(first)
    for k, v in second.items():
        total[k] = total[k] + v if k in total else v
    return total
