"""Units of files and tables. They are converted to SI units and radians on input, and back on output.

Inside optloc lengths are in metres, angles in radians, times in seconds and speeds in metres per second. Three
conversions are more than a factor:

* A propagation time (``ns``) becomes a length by multiplication with the propagation speed. The default is the speed of
  light in vacuum; sound in air has about 343 m/s.
* A gain ratio in ``dB`` becomes a ratio of ranges. The amplitude is proportional to ``1 / r``. The level at station b
  relative to station a, ``20 log10(A_b / A_a)``, is therefore ``20 log10(r_a / r_b)``. In decibels of power,
  ``10 log10(P_b / P_a)``, it is the same number. A quantity that is a level stays in decibels.
* A frequency in ``Hz`` minus its carrier becomes a range rate. A receding emitter lowers the received frequency,
  ``f = f_c (1 - r' / c)``, so ``r_a' = -(c / f_c) (f_a - f_c)``. A difference of two frequencies becomes
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
from optloc.base.sound import sound_in_air, sound_in_water

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
"""Physical quantity of a number. It determines the valid units."""

AzimuthConvention = Literal["east-counterclockwise", "north-clockwise", "north-counterclockwise"]
"""Zero direction and sense of azimuths. The first convention is used inside optloc."""

SPEED_OF_LIGHT: Final = 299_792_458.0
"""Speed of light in vacuum in m/s (exact, SI)."""

LARGEST: Final = 1e30
"""Largest absolute value of a number in a file or a problem, in any unit. The visible universe is 1e27 m wide, and a
tenth power of this number does not overflow. A standard deviation must not be below its inverse."""

# Separate, because a length can be given as a time, which is multiplied by the propagation speed.
_TIME: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12}
# Metres. The foot is exact by definition since 1959, the nautical mile since 1929.
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
        # One neper is a factor e in amplitude, which is 20 log10(e) decibels.
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
"""Known units of each quantity and their size in SI. Units of time for lengths are in seconds, ``Hz`` is in 1/s.
``dB`` for a ratio, or for a ratio of powers, is logarithmic (see the module docstring)."""

SI_UNIT: Final[Mapping[Quantity, str]] = MappingProxyType({q: next(iter(table)) for q, table in UNITS.items()})
"""Unit of each quantity inside optloc. Levels are in decibels, which SI accepts."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """Conversion from a unit of a file to SI: ``offset + factor * u``, or a decibel conversion.

    Parameters
    ----------
    factor : float
        SI units per unit of the file, with sign. For decibels: nepers per decibel.
    offset : float
        SI value of zero in the file.
    logarithmic : bool
        Whether the file has logarithms. The SI value is then ``exp(factor * u)``.
    """

    factor: float
    offset: float = 0.0
    logarithmic: bool = False

    def to_si(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return values (...) of the file as SI values.

        Angles are not wrapped: 350 deg stays above pi.
        """
        u = np.asarray(values, dtype=np.float64)
        if self.logarithmic:
            # Values that overflow become infinite. A later check rejects them and names their row.
            with np.errstate(over="ignore"):
                return np.exp(self.factor * u)
        return self.offset + self.factor * u

    def from_si(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return SI values (...) in the unit of the file."""
        z = np.asarray(values, dtype=np.float64)
        return np.log(z) / self.factor if self.logarithmic else (z - self.offset) / self.factor

    def slope(self, values_si: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return the derivative d(SI) / d(file unit), with sign.

        A covariance C in file units becomes ``slope[:, None] * C * slope`` in SI. The sign matters for the off-diagonal
        terms of clockwise azimuths and frequency differences.

        Parameters
        ----------
        values_si : array_like, shape (...), optional
            The measured values in SI, which a logarithmic unit needs.

        Returns
        -------
        ndarray, shape (...) or ()
            The derivative at `values_si`.
        """
        if not self.logarithmic:
            return np.asarray(self.factor)
        if values_si is None:
            raise InvalidProblem(
                "an error in dB has no fixed size as a ratio",
                "sigma",
                "give the measured values too, or state the error in unit '1'",
            )
        return self.factor * np.asarray(values_si, dtype=np.float64)

    def sigma_to_si(self, sigma: ArrayLike, values_si: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return standard deviations (...) in SI, to first order at the measured values `values_si` (...).

        Only logarithmic units need the measured values.
        """
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
    """Return the conversion of a unit to SI.

    Parameters
    ----------
    unit : str
        One of ``UNITS[quantity]``.
    quantity : {"length", "angle", "ratio", "level", "speed", "time", "frequency", "power", "plain"}
        Physical quantity of the numbers.
    propagation_speed : float
        Speed in m/s that converts propagation times to lengths and frequencies to speeds.
    carrier : float, optional
        Carrier frequency in Hz, required for a speed in Hz.
    convention : {"east-counterclockwise", "north-clockwise", "north-counterclockwise"}
        Convention of azimuths. A compass bearing A becomes ``pi / 2 - A``, an angle A anticlockwise from north
        ``pi / 2 + A``.
    where : str, optional
        Location that error messages name.

    Returns
    -------
    Conversion
        Conversion from the file to SI.

    Raises
    ------
    InvalidProblem
        For an unknown unit, quantity or convention, and for a speed or carrier that is not positive.
    """
    _check_options(unit, quantity, propagation_speed, convention, where)
    factor = UNITS[quantity][unit]
    # A propagation time becomes the path length.
    if quantity == "length" and unit in _TIME:
        return Conversion(factor * propagation_speed)
    if unit == "dB" and quantity == "ratio":
        # The amplitude is inversely proportional to the range, so 20 decibels are a factor of ten in range.
        return Conversion(math.log(10) / 20, logarithmic=True)
    if unit == "dB" and quantity == "power":
        return Conversion(math.log(10) / 10, logarithmic=True)
    if unit == "Hz" and quantity == "speed":
        if carrier is None or not 1.0 / LARGEST <= carrier <= LARGEST:
            given = "is missing" if carrier is None else f"must be positive, not {carrier:g} Hz"
            raise InvalidProblem(
                f"the carrier frequency {given}",
                where,
                "a frequency in Hz needs its carrier to give a speed",
            )
        # Negative, because the received frequency of a receding emitter is lower.
        return Conversion(-propagation_speed / carrier)
    if quantity == "angle" and convention != "east-counterclockwise":
        # North is a quarter turn from the x axis. A compass counts clockwise.
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
    """Return values of any shape in SI; the options are as for :func:`conversion`."""
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
    """Return standard deviations of any shape in SI.

    The options are as for :func:`conversion`. Decibels also need the measured values in SI: to first order, a
    standard deviation of s dB is ``ratio * s * ln(10) / 20``.
    """
    return conversion(unit, quantity, propagation_speed=propagation_speed, carrier=carrier, where=where).sigma_to_si(
        sigma, values_si
    )


def split_amount(value: float | str, quantity: Quantity, where: str) -> tuple[float, str]:
    """Return the number and the unit of an amount such as ``"30 ns"``; the unit is empty for a number without a unit.

    Raises
    ------
    InvalidProblem
        If there is no number, or if it is beyond `LARGEST`.
    """
    # A number from a TOML file is converted to text first, so that both cases use the same code.
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
    """Return an amount with its SI unit as an example for a message, with the number of the user if it is valid."""
    return f'"{text if abs(number) <= LARGEST else 1.5} {SI_UNIT[quantity]}"'


def _contains_text(value: Any) -> bool:
    """Return whether a list, or a nested list, contains text."""
    return isinstance(value, list | tuple) and any(isinstance(each, str) or _contains_text(each) for each in value)


def in_si(value: Any, quantity: Quantity, where: str, *, deviation: bool = False, place: bool = False) -> Any:
    """Return numbers in SI units. Each number may be given as text with a unit.

    Parameters
    ----------
    value : array_like, str, or sequence of str
        Numbers without a unit are in SI units. ``"20 ns"`` for a length is multiplied by the speed of light.
    quantity : Quantity
        Physical quantity of the numbers.
    where : str
        Argument that error messages name.
    deviation : bool
        Whether the numbers are standard deviations. Decibels of a ratio are then refused, because their size depends on
        the ratio.
    place : bool
        Whether the numbers are coordinates or heights. Units of time are then refused.

    Returns
    -------
    float, array (...) or the value
        The value itself if it contains no text.

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
        unit_conversion = conversion(unit, quantity, where=where)
        return float(unit_conversion.sigma_to_si(number) if deviation else unit_conversion.to_si(number))
    if _contains_text(value):
        numbers = [in_si(each, quantity, where, deviation=deviation, place=place) for each in value]
        try:
            return np.array(numbers, dtype=float)
        except ValueError:
            raise InvalidProblem("the numbers do not form an array", where, "give numbers of one shape") from None
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        numbers = [in_si(str(each), quantity, where, deviation=deviation, place=place) for each in value.flat]
        return np.reshape(numbers, value.shape)
    return value


def _check_options(unit: str, quantity: str, propagation_speed: float, convention: str, where: str | None) -> None:
    """Raise if an argument of `conversion` is unknown or out of range; `where` is the location that messages name."""
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
