"""Units of files and tables, converted to SI and radians at the border only.

Inside optloc every length is in metres, angle in radians, time in seconds and speed in metres per
second. Three conversions are more than a factor:

* A propagation time (``ns``) is a length once multiplied by the propagation speed: light in vacuum
  unless told otherwise, some 343 m/s for sound in air.
* A gain ratio in ``dB`` is a ratio of ranges. Amplitude falls with ``1 / r``, so the level at
  station b above the level at station a, ``20 log10(A_b / A_a)``, is ``20 log10(r_a / r_b)``. Decibels of
  power, ``10 log10(P_b / P_a)``, are the same number. A quantity that is itself a level stays in decibels.
* A frequency in ``Hz``, less its carrier, is a range rate: a receding emitter lowers the received
  frequency, ``f = f_c (1 - r' / c)``, so ``r_a' = -(c / f_c) (f_a - f_c)``, and a difference of two frequencies is
  ``r_a' - r_b' = -(c / f_c) (f_a - f_b)``.

Sources: BIPM, The International System of Units, 9th edition (2019), sections 2.3.1 and 4, for c, the
nautical mile, the knot, degrees and the decibel; the international foot of 1959 for foot, yard and mile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optloc.base.errors import InvalidProblem, nearest

__all__ = [
    "LARGEST",
    "SI_UNIT",
    "SPEED_OF_LIGHT",
    "UNITS",
    "AzimuthConvention",
    "Conversion",
    "Quantity",
    "conversion",
    "sigma_to_si",
    "sound_in_air",
    "sound_in_water",
    "to_si",
]

Quantity = Literal["length", "angle", "ratio", "level", "speed", "time", "frequency", "power", "plain"]
"""What a number measures; it decides which units make sense."""

AzimuthConvention = Literal["east-counterclockwise", "north-clockwise", "north-counterclockwise"]
"""Where azimuth zero is and which way it grows; the first is the one used in memory."""

SPEED_OF_LIGHT: Final = 299_792_458.0
"""Speed of light in vacuum in m/s (exact, SI)."""

LARGEST: Final = 1e30
"""What no number is beyond that a file or a problem holds, in any unit: the visible universe is 1e27 m wide, and a
tenth power is still no overflow. As spread, no number is below its inverse."""

# Apart, because a length may be given as a time too: it is multiplied by the speed of propagation.
_TIME: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12}
# Exact by definition since 1959, as the nautical mile since 1929, in metres.
_FOOT: Final = 0.3048
_NAUTICAL_MILE: Final = 1852.0

UNITS: Final[Mapping[Quantity, Mapping[str, float]]] = MappingProxyType(
    {
        "length": {
            "m": 1.0,
            "km": 1e3,
            "cm": 1e-2,
            "mm": 1e-3,
            "ft": _FOOT,
            "yd": 3 * _FOOT,
            "mi": 5280 * _FOOT,
            "nmi": _NAUTICAL_MILE,
            **_TIME,
        },
        "angle": {
            "rad": 1.0,
            "mrad": 1e-3,
            "deg": math.pi / 180,
            "arcmin": math.pi / 10_800,
            "arcsec": math.pi / 648_000,
        },
        "ratio": {"1": 1.0, "dB": 1.0},
        # A neper is a factor e of amplitudes, 20 log10(e) decibels.
        "level": {"dB": 1.0, "Np": 20.0 / math.log(10)},
        "speed": {
            "m/s": 1.0,
            "km/s": 1e3,
            "km/h": 1 / 3.6,
            "ft/s": _FOOT,
            "mph": 5280 * _FOOT / 3600,
            "kn": _NAUTICAL_MILE / 3600,
            "Hz": 1.0,
        },
        "time": {**_TIME, "min": 60.0, "h": 3600.0},
        "frequency": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9},
        "power": {"1": 1.0, "dB": 1.0},
        "plain": {"1": 1.0},
    }
)
"""Known units of each quantity and their size in SI; times that stand for lengths are in seconds,
``Hz`` in 1/s and ``dB`` of a ratio, or of a ratio of powers, is logarithmic (see the module's text)."""

SI_UNIT: Final[Mapping[Quantity, str]] = MappingProxyType({q: next(iter(table)) for q, table in UNITS.items()})
"""The unit of each quantity in memory; levels are in decibels, which SI accepts."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """The map from numbers in a file to numbers in memory: ``offset + factor * u``, or a decibel.

    Parameters
    ----------
    factor : float
        SI units in one unit of the file, with sign; for decibels, nepers in one decibel.
    offset : float
        Value in SI of the file's zero.
    logarithmic : bool
        Whether the file holds a logarithm: memory then holds ``exp(factor * u)``.
    """

    factor: float
    offset: float = 0.0
    logarithmic: bool = False

    def to_si(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert values of any shape to SI.

        Angles are not wrapped: 350 deg stays above pi.
        """
        u = np.asarray(values, dtype=np.float64)
        if self.logarithmic:
            # What is too large becomes infinite, and is refused where its row is known.
            with np.errstate(over="ignore"):
                return np.exp(self.factor * u)
        return self.offset + self.factor * u

    def from_si(self, values: ArrayLike) -> NDArray[np.float64]:
        """Convert SI values of any shape to the file's unit."""
        z = np.asarray(values, dtype=np.float64)
        return np.log(z) / self.factor if self.logarithmic else (z - self.offset) / self.factor

    def slope(self, values_si: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return d(SI) / d(file unit), with sign.

        A covariance C in file units becomes ``slope[:, None] * C * slope`` in SI. The sign matters for
        the cross terms of clockwise azimuths and frequency differences.

        Parameters
        ----------
        values_si : array_like, shape (...), optional
            The measured values in SI; a logarithmic unit needs them.

        Returns
        -------
        ndarray, shape (...) or ()
            Slope, to first order at `values_si`.
        """
        if not self.logarithmic:
            return np.asarray(self.factor)
        if values_si is None:
            raise InvalidProblem(
                "an error in dB has no fixed size as a ratio",
                "sigma",
                "give the measured values with it, or state the error in unit '1'",
            )
        return self.factor * np.asarray(values_si, dtype=np.float64)

    def sigma_to_si(self, sigma: ArrayLike, values_si: ArrayLike | None = None) -> NDArray[np.float64]:
        """Convert standard deviations to SI, to first order at the measured values."""
        scaled: NDArray[np.float64] = np.abs(self.slope(values_si)) * np.asarray(sigma, dtype=np.float64)
        return scaled


def conversion(
    unit: str,
    quantity: Quantity,
    *,
    propagation_speed: float = SPEED_OF_LIGHT,
    carrier: float | None = None,
    convention: AzimuthConvention = "east-counterclockwise",
    where: str | None = None,
) -> Conversion:
    """Look up how a unit becomes SI.

    Parameters
    ----------
    unit : str
        One of ``UNITS[quantity]``.
    quantity : {"length", "angle", "ratio", "level", "speed", "time", "frequency", "power", "plain"}
        What the numbers measure.
    propagation_speed : float
        Speed in m/s that turns propagation times into lengths and frequencies into speeds.
    carrier : float, optional
        Carrier frequency in Hz; needed when a speed is given in Hz.
    convention : {"east-counterclockwise", "north-clockwise", "north-counterclockwise"}
        For azimuths: a compass bearing A is ``pi / 2 - A`` in memory, an angle A anticlockwise from north
        ``pi / 2 + A``.
    where : str, optional
        Place to name when something is wrong.

    Returns
    -------
    Conversion
        The map between file and memory.

    Raises
    ------
    InvalidProblem
        Unknown unit, quantity or convention; a speed or carrier that is not positive.
    """
    _check_options(unit, quantity, propagation_speed, convention, where)
    factor = UNITS[quantity][unit]
    # A travel time stands for the way that it takes.
    if quantity == "length" and unit in _TIME:
        return Conversion(factor * propagation_speed)
    if unit == "dB" and quantity == "ratio":
        # Amplitude falls with the range, so that 20 decibels are a factor of ten in range.
        return Conversion(math.log(10) / 20, logarithmic=True)
    if unit == "dB" and quantity == "power":
        return Conversion(math.log(10) / 10, logarithmic=True)
    if unit == "Hz" and quantity == "speed":
        if carrier is None or not 1.0 / LARGEST <= carrier <= LARGEST:
            given = "is missing" if carrier is None else f"must be positive, not {carrier:g} Hz"
            raise InvalidProblem(
                f"the carrier frequency {given}",
                where,
                "a frequency in Hz is a speed only beside its carrier",
            )
        # Negative: a receding emitter is heard at a lower frequency.
        return Conversion(-propagation_speed / carrier)
    if quantity == "angle" and convention != "east-counterclockwise":
        # North is a quarter turn from the x axis; a compass turns the other way.
        return Conversion(-factor if convention == "north-clockwise" else factor, offset=math.pi / 2)
    return Conversion(factor)


def to_si(
    values: ArrayLike,
    unit: str,
    quantity: Quantity,
    *,
    propagation_speed: float = SPEED_OF_LIGHT,
    carrier: float | None = None,
    convention: AzimuthConvention = "east-counterclockwise",
    where: str | None = None,
) -> NDArray[np.float64]:
    """Convert values of any shape to SI; the options are those of :func:`conversion`."""
    return conversion(
        unit, quantity, propagation_speed=propagation_speed, carrier=carrier, convention=convention, where=where
    ).to_si(values)


def sigma_to_si(
    sigma: ArrayLike,
    unit: str,
    quantity: Quantity,
    *,
    values_si: ArrayLike | None = None,
    propagation_speed: float = SPEED_OF_LIGHT,
    carrier: float | None = None,
    where: str | None = None,
) -> NDArray[np.float64]:
    """Convert standard deviations of any shape to SI.

    The options are those of :func:`conversion`; decibels also need the measured values in SI, since a
    sigma of s dB is, to first order, a sigma of ``ratio * s * ln(10) / 20``.
    """
    return conversion(unit, quantity, propagation_speed=propagation_speed, carrier=carrier, where=where).sigma_to_si(
        sigma, values_si
    )


def split_amount(value: float | str, quantity: Quantity, where: str) -> tuple[float, str]:
    """Return the number and the unit of an amount such as ``"30 ns"``; the unit of a bare number is empty.

    Raises
    ------
    InvalidProblem
        Where there is no number, or it is beyond `LARGEST`.
    """
    # A number that TOML read is spelled again: one way for both.
    text, _, unit = str(value).strip().partition(" ")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= LARGEST:
        what = f"{value!r} is beyond {LARGEST:g}" if math.isfinite(number) else f"{value!r} is no amount"
        raise InvalidProblem(what, where, f"write a number and a unit, such as {example_of(number, text, quantity)}")
    return number, unit.strip()


def example_of(number: float, text: str, quantity: Quantity) -> str:
    """Return an amount with its SI unit to be copied: the number that was written, if it is one."""
    return f'"{text if abs(number) <= LARGEST else 1.5} {SI_UNIT[quantity]}"'


def _holds_text(value: Any) -> bool:
    """Return whether a list, or a list in it, holds text."""
    return isinstance(value, list | tuple) and any(isinstance(each, str) or _holds_text(each) for each in value)


def in_si(value: Any, quantity: Quantity, where: str, *, deviation: bool = False, place: bool = False) -> Any:
    """Return numbers in SI units, where a number may be text with a unit.

    Parameters
    ----------
    value : array_like, str, or sequence of str
        Bare numbers are in SI units. ``"20 ns"`` of a length is multiplied by the speed of light.
    quantity : Quantity
        What the numbers measure.
    where : str
        Argument to name.
    deviation : bool
        The numbers are standard deviations: decibels of a ratio are refused, because their size depends on the ratio.
    place : bool
        The numbers are coordinates or heights: units of time are refused.

    Returns
    -------
    float, array (...) or the value
        The value itself where no part of it is text.

    Raises
    ------
    InvalidProblem
        For text that is not a number with a unit of the quantity.
    """
    if isinstance(value, str):
        number, unit = split_amount(value, quantity, where)
        if not unit:
            example = example_of(number, value.strip(), quantity)
            raise InvalidProblem(f"{value!r} has no unit", where, f"write it with its unit, such as {example}")
        if place and unit in _TIME:
            raise InvalidProblem(f"{value!r} is a time", where, 'give a length, such as "1.5 km"')
        found = conversion(unit, quantity, where=where)
        return float(found.sigma_to_si(number) if deviation else found.to_si(number))
    if _holds_text(value):
        numbers = [in_si(each, quantity, where, deviation=deviation, place=place) for each in value]
        try:
            return np.array(numbers, dtype=float)
        except ValueError:
            raise InvalidProblem("the numbers are not an array", where, "give numbers of one shape") from None
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        numbers = [in_si(str(each), quantity, where, deviation=deviation, place=place) for each in value.flat]
        return np.reshape(numbers, value.shape)
    return value


# Where sound is slow or quick: the temperatures, salinities and depths that the formulas were made for.
_AIR, _WATER, _SALT, _DEEP = (-60.0, 60.0), (-2.0, 40.0), (0.0, 45.0), (0.0, 1000.0)


def sound_in_air(celsius: float) -> float:
    """Return the speed of sound in dry air, m/s: that of an ideal gas, 331.3 m/s at 0 deg C.

    Moist air is quicker, by 0.35 % at the most at 20 deg C: the speed may be left open by a bias of the form "scale".

    Raises
    ------
    InvalidProblem
        For a temperature outside -60 to 60 deg C.
    """
    _within("the temperature of air", celsius, _AIR, "deg C")
    return 331.3 * math.sqrt(1.0 + celsius / 273.15)


def sound_in_water(celsius: float, salinity: float = 35.0, depth: float = 0.0) -> float:
    """Return the speed of sound in water, m/s.

    Parameters
    ----------
    celsius : float
        Temperature, -2 to 40 deg C.
    salinity : float
        Grams of salt in a kilogram of water, 0 to 45; 35 in the sea, 0 in fresh water.
    depth : float
        Metres below the surface, 0 to 1000.

    Raises
    ------
    InvalidProblem
        Outside these.

    References
    ----------
    H. Medwin, "Speed of sound in water: a simple equation for realistic parameters", J. Acoust. Soc. Am. 58 (1975).
    """
    _within("the temperature of water", celsius, _WATER, "deg C")
    _within("the salinity", salinity, _SALT, "g/kg")
    _within("the depth", depth, _DEEP, "m")
    pure = 1449.2 + 4.6 * celsius - 0.055 * celsius**2 + 0.00029 * celsius**3
    return pure + (1.34 - 0.010 * celsius) * (salinity - 35.0) + 0.016 * depth


def _within(name: str, value: float, ends: tuple[float, float], unit: str) -> None:
    if not ends[0] <= value <= ends[1]:
        what = f"{name} is {value:g} {unit}, outside {ends[0]:g} to {ends[1]:g}"
        raise InvalidProblem(what, "propagation speed", "give the speed itself, metres per second")


def _check_options(unit: str, quantity: str, propagation_speed: float, convention: str, where: str | None) -> None:
    if quantity not in UNITS:
        raise InvalidProblem(f"unknown quantity {quantity!r}", where, nearest(quantity, list(UNITS)))
    if unit not in UNITS[quantity]:  # type: ignore[index]  # just checked
        table = list(UNITS[quantity])  # type: ignore[index]
        raise InvalidProblem(f"unknown unit {unit!r} for the quantity {quantity!r}", where, nearest(unit, table))
    if convention not in get_args(AzimuthConvention):
        advice = nearest(convention, list(get_args(AzimuthConvention)))
        raise InvalidProblem(f"unknown azimuth convention {convention!r}", where, advice)
    if not 1.0 / LARGEST <= propagation_speed <= LARGEST:
        what = f"the propagation speed is {propagation_speed:g} m/s"
        raise InvalidProblem(what, where, "give a positive number of metres per second")
