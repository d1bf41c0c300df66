"""Speed of sound in air and in water: published formulas, each with its range of validity.

Dry air is an ideal gas. Humid air follows O. Cramer (1993). Water follows the UNESCO algorithm of C.-T. Chen and
F. J. Millero (1977).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from optloc.base.errors import InvalidProblem

__all__ = ["pressure_at", "sound_in_air", "sound_in_water"]

# Ranges of validity: air as an ideal gas, humid air (Cramer 1993), and water (UNESCO 44, section 8).
_AIR, _HUMID_AIR, _HUMIDITY = (-60.0, 60.0), (0.0, 30.0), (0.0, 100.0)
_WATER, _SALT, _DEEP = (0.0, 40.0), (0.0, 40.0), (0.0, 9500.0)
_KELVIN: Final = 273.15
# Standard atmosphere, pascals; the formula of Cramer changes by 0.05 m/s from 75 to 102 kPa.
_ATMOSPHERE: Final = 101_325.0
_CARBON_DIOXIDE: Final = 0.0004
"""Mole fraction of carbon dioxide, as in the calculator of the National Physical Laboratory; 100 ppm are 0.01 m/s."""


def sound_in_air(celsius: float, humidity: float | None = None, carbon_dioxide: float = _CARBON_DIOXIDE) -> float:
    """Return the speed of sound in air at sea level, m/s.

    Without a humidity, the air is a dry ideal gas with 331.3 m/s at 0 deg C. At 20 deg C, real air is 0.05 to 0.4 %
    faster.

    Parameters
    ----------
    celsius : float
        Temperature: -60 to 60 deg C without a humidity, 0 to 30 deg C with it.
    humidity : float, optional
        Relative humidity, percent.
    carbon_dioxide : float
        Mole fraction of carbon dioxide, for humid air.

    Raises
    ------
    InvalidProblem
        For values outside these ranges.

    References
    ----------
    O. Cramer, "The variation of the specific heat ratio and the speed of sound in air with temperature, pressure,
    humidity, and CO2 concentration", J. Acoust. Soc. Am. 93 (1993), eq. 15 and table III; vapour pressure: R. S. Davis,
    Metrologia 29 (1992).
    """
    if humidity is None:
        _check_range("the temperature of air", celsius, _AIR, "deg C")
        return 331.3 * math.sqrt(1.0 + celsius / _KELVIN)
    _check_range("the temperature of humid air", celsius, _HUMID_AIR, "deg C")
    _check_range("the relative humidity", humidity, _HUMIDITY, "%")
    t, p, kelvin, gas = celsius, _ATMOSPHERE, celsius + _KELVIN, carbon_dioxide
    saturated = math.exp(1.2378847e-5 * kelvin**2 - 1.9121316e-2 * kelvin + 33.93711047 - 6.3431645e3 / kelvin)
    # mole fraction of water vapour; the second factor is the enhancement of the vapour pressure by the other gases
    vapour = humidity / 100.0 * (1.00062 + 3.14e-8 * p + 5.6e-7 * t * t) * saturated / p
    speed = _polynomial(t, (331.5024, 0.603055, -0.000528))
    speed += _polynomial(t, (51.471935, 0.1495874, -0.000782)) * vapour
    speed += _polynomial(t, (-1.82e-7, 3.73e-8, -2.93e-10)) * p
    speed += _polynomial(t, (-85.20931, -0.228525, 5.91e-5)) * gas
    return speed - 2.835149 * vapour**2 - 2.15e-13 * p**2 + 29.179762 * gas**2 + 0.000486 * vapour * p * gas


def sound_in_water(celsius: float, salinity: float = 35.0, depth: float = 0.0) -> float:
    """Return the speed of sound in water, m/s.

    Parameters
    ----------
    celsius : float
        Temperature, 0 to 40 deg C.
    salinity : float
        Grams of salt in a kilogram of water, 0 to 40; 35 in the sea, 0 in fresh water.
    depth : float
        Depth below the surface, 0 to 9500 metres.

    Raises
    ------
    InvalidProblem
        For values outside these ranges.

    References
    ----------
    C.-T. Chen, F. J. Millero, "Speed of sound in seawater at high pressures", J. Acoust. Soc. Am. 62 (1977), as in
    N. P. Fofonoff, R. C. Millard, "Algorithms for computation of fundamental properties of seawater", UNESCO Technical
    Papers in Marine Science 44 (1983), section 8.
    """
    _check_range("the temperature of water", celsius, _WATER, "deg C")
    _check_range("the salinity", salinity, _SALT, "g/kg")
    _check_range("the depth", depth, _DEEP, "m")
    return _unesco(celsius, salinity, pressure_at(depth))


# Polynomials of the UNESCO algorithm in temperature, one for each power of the pressure in bar: pure water, and the
# terms in the salinity and in its power 1.5.
_PURE: Final = (
    (1402.388, 5.03711, -5.80852e-2, 3.3420e-4, -1.47800e-6, 3.1464e-9),
    (0.153563, 6.8982e-4, -8.1788e-6, 1.3621e-7, -6.1185e-10),
    (3.1260e-5, -1.7107e-6, 2.5974e-8, -2.5335e-10, 1.0405e-12),
    (-9.7729e-9, 3.8504e-10, -2.3643e-12),
)
_SALTY: Final = (
    (1.389, -1.262e-2, 7.164e-5, 2.006e-6, -3.21e-8),
    (9.4742e-5, -1.2580e-5, -6.4885e-8, 1.0507e-8, -2.0122e-10),
    (-3.9064e-7, 9.1041e-9, -1.6002e-10, 7.988e-12),
    (1.100e-10, 6.649e-12, -3.389e-13),
)
_MIXED: Final = ((-1.922e-2, -4.42e-5), (7.3637e-5, 1.7945e-7))


def _unesco(celsius: float, salinity: float, decibars: float) -> float:
    """Return the speed of sound, m/s, by the UNESCO algorithm; `decibars` is the pressure above the atmosphere."""
    # The algorithm is on the temperature scale of 1968, which was replaced in 1990.
    t, p = 1.00024 * celsius, decibars / 10.0
    pure, salty, mixed = (_polynomial(p, [_polynomial(t, row) for row in rows]) for rows in (_PURE, _SALTY, _MIXED))
    return pure + salty * salinity + mixed * math.pow(salinity, 1.5) + (1.727e-3 - 7.9836e-6 * p) * salinity**2


def pressure_at(depth: float) -> float:
    """Return the pressure in the sea above the atmosphere, decibars, at a depth in metres and 45 degrees of latitude.

    References
    ----------
    P. M. Saunders, "Practical conversion of pressure to depth", J. Phys. Oceanogr. 11 (1981).
    """
    # From the equator to a pole, the pressure at 1000 m changes by 0.5 %, and the speed by 0.1 m/s.
    first, second = 5.92e-3 + 5.25e-3 * 0.5, 2.21e-6
    return ((1.0 - first) - math.sqrt((1.0 - first) ** 2 - 4.0 * second * depth)) / (2.0 * second)


def _polynomial(x: float, coefficients: Sequence[float]) -> float:
    """Return a polynomial at `x`; the coefficients begin with the constant."""
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value


def _check_range(name: str, value: float, ends: tuple[float, float], unit: str) -> None:
    """Raise if a value is outside the range of validity of a formula; `name` and `unit` describe it in the message."""
    if not ends[0] <= value <= ends[1]:
        what = f"{name} is {value:g} {unit}, outside {ends[0]:g} to {ends[1]:g}"
        raise InvalidProblem(what, "wave speed", "give the speed as a number, in metres per second")
