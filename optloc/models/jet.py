"""Forward-mode differentiation: a value with its sparse partial derivatives, batched over arrays."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from optloc.models.namespace import namespace


@dataclass(frozen=True, slots=True, eq=False)
class Jet:
    """A number and its partial derivatives with respect to named seeds.

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
        value, theirs = _parts(other)
        ratio = self.value / value
        inverse = 1.0 / value
        # (u / v)' = u' / v - (u / v) v' / v: the ratio is at hand, and no square is formed that could overflow.
        return Jet(ratio, _sum(_scale(self.partials, inverse), _scale(theirs, -ratio * inverse)))

    def __rtruediv__(self, other: Any) -> Jet:
        ratio = other / self.value
        return Jet(ratio, _scale(self.partials, -ratio / self.value))


def sqrt(u: Jet) -> Jet:
    """Return the square root."""
    root = namespace(u.value).sqrt(u.value)
    return Jet(root, _scale(u.partials, 0.5 / root))


def sin(u: Jet) -> Jet:
    """Return the sine."""
    xp = namespace(u.value)
    return Jet(xp.sin(u.value), _scale(u.partials, xp.cos(u.value)))


def cos(u: Jet) -> Jet:
    """Return the cosine."""
    xp = namespace(u.value)
    return Jet(xp.cos(u.value), _scale(u.partials, -xp.sin(u.value)))


def log(u: Jet) -> Jet:
    """Return the natural logarithm."""
    return Jet(namespace(u.value).log(u.value), _scale(u.partials, 1.0 / u.value))


def exp(u: Jet) -> Jet:
    """Return the exponential."""
    value = namespace(u.value).exp(u.value)
    return Jet(value, _scale(u.partials, value))


def hypot(u: Any, v: Any) -> Jet:
    """Return ``sqrt(u^2 + v^2)``."""
    (p, du), (q, dv) = _parts(u), _parts(v)
    # The derivative is the unit vector; at the origin it is NaN, as it should be.
    length = namespace(p).hypot(p, q)
    return Jet(length, _sum(_scale(du, p / length), _scale(dv, q / length)))


def atan2(u: Any, v: Any) -> Jet:
    """Return the angle of the vector (v, u), radians."""
    (p, du), (q, dv) = _parts(u), _parts(v)
    squared = p * p + q * q
    return Jet(namespace(p).atan2(p, q), _sum(_scale(du, q / squared), _scale(dv, -p / squared)))


def _parts(other: Any) -> tuple[Any, dict[int, Any]]:
    return (other.value, other.partials) if isinstance(other, Jet) else (other, {})


def _scale(partials: dict[int, Any], factor: Any) -> dict[int, Any]:
    return {k: v * factor for k, v in partials.items()}


def _sum(left: dict[int, Any], right: dict[int, Any]) -> dict[int, Any]:
    # Most operands are constants or single seeds: dictionaries are copied where both have entries only.
    if not right:
        return left
    total = dict(left)
    for k, v in right.items():
        total[k] = total[k] + v if k in total else v
    return total
