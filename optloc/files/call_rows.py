"""Rows of `locate`: values of an argument in SI units, with their noise and the convention of bearings.

In the functions, `word` is the name of an argument of `locate`, such as "tdoa", and `words` are the arguments with
measurements.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, NamedTuple, cast, get_args

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.types import Array, Stations
from optloc.base.units import AzimuthConvention, Conversion, Quantity, conversion
from optloc.files.by_station import ARGUMENTS, StationValues
from optloc.files.declination import declination_of, declinations
from optloc.files.settings import Units
from optloc.files.table_import import COMPASS
from optloc.files.wave_argument import Wave, check_times
from optloc.models import MODELS
from optloc.problem.build import Measured, measured

# Largest rounding of an instant as a float, as a share of its standard deviation; less has no effect.
_STEP = 0.1


@dataclass(frozen=True, slots=True)
class Receivers:
    """Stations with their frame.

    stations: stations with positions in the frame. frame: frame of the positions. level: whether the stations are on
    Earth without altitudes. extent: greatest extent of the stations along an axis, m.
    """

    stations: Stations
    frame: Frame
    level: bool
    extent: float

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the stations."""
        return self.stations.names


class North(NamedTuple):
    """Convention of bearings, such as "north-clockwise", and the declination of magnetic north; None for true north."""

    azimuth: str
    declination: Any


def check_north(north: North, given: Mapping[str, Any]) -> None:
    """Raise InvalidProblem for an unknown convention of azimuths, and for a declination without bearings.

    `given` has the measurements by argument.
    """
    known = get_args(AzimuthConvention)
    if north.azimuth not in known:
        raise InvalidProblem(f"there is no convention {north.azimuth!r}", "azimuth", nearest(north.azimuth, known))
    if north.declination is not None and "bearings" not in given:
        raise InvalidProblem("there are no bearings", "declination", "remove this argument")


def scale_of(
    word: str, unit: str, sigma: Any, words: Sequence[str], speed: float, convention: AzimuthConvention
) -> tuple[Conversion, float]:
    """Return the conversion of values to SI units, and their standard deviation in SI units.

    `word` is an argument of `locate`, such as "tdoa", and `unit` the unit of its values. `sigma` is the argument of
    `locate`, and `words` are the arguments with measurements. `convention` is the zero direction of angles.
    """
    units = Units(cast("Quantity", MODELS[ARGUMENTS[word].kind].quantity), speed)
    step = replace(units, convention=convention).conversion(unit, f"unit of {word}")
    return step, _sigma_si(per_word(sigma, word, words, "sigma"), word, units, unit)


def per_word(given: Any, word: str, words: Collection[str], name: str) -> Any:
    """Return the value of an argument for one kind of measurements; None if a mapping does not have the kind.

    `given` is the value or a mapping by kind. `word` is the kind, `words` are the kinds with measurements, and `name`
    is the name of the argument.
    """
    if isinstance(given, Mapping):
        unknown = [key for key in given if key not in words]
        if unknown:
            advice = f"use {', '.join(words)}"
            raise InvalidProblem(f"there are no measurements with the name {unknown[0]!r}", name, advice)
        return given.get(word)
    if name == "sigma" and given is not None and not isinstance(given, str) and len(words) > 1:
        example = ", ".join(f'"{each}": ...' for each in words)
        raise InvalidProblem("one number cannot be the sigma of several kinds", name, f"give {{{example}}}")
    return given


def _sigma_si(sigma: Any, word: str, units: Units, unit: str) -> float:
    """Return the standard deviation of one value, SI; raise InvalidProblem if it is missing or not positive.

    `sigma` is in `unit`, or text with a unit. `word` is the kind of measurements.
    """
    noun, default = ARGUMENTS[word].noun, units.conversion(unit, f"unit of {word}")
    if sigma is None:
        advice = f"give their standard deviation in {unit}, such as sigma=..., or as text with a unit"
        raise InvalidProblem(f"the accuracy of the {noun} is unknown", "sigma", advice)
    if not isinstance(sigma, str | float | int | np.number) or isinstance(sigma, bool):
        raise InvalidProblem(
            f"{type(sigma).__name__} is not a standard deviation", "sigma", "give a number, or optloc.measured"
        )
    number, stated_unit = units.amount(sigma if isinstance(sigma, str) else float(sigma), default, "sigma")
    value = float(stated_unit.sigma_to_si(number))
    if not value > 0.0:
        raise InvalidProblem(
            f"the standard deviation {sigma} of the {noun} is not positive", "sigma", "give a positive number"
        )
    return value


def rows_of(
    word: str, found: StationValues, sigma: float, unit: Conversion, places: Receivers, wave: Wave, *, timed: bool
) -> Measured:
    """Return measurements in SI units as rows; missing values have the weight 0.

    `word` is the kind, `sigma` the standard deviation in SI units, `unit` the unit of the values, and `wave` the wave
    of the call. `timed` is whether the values are times. Raise InvalidProblem for infinite values, or for times in a
    wrong unit.
    """
    kind = ARGUMENTS[word].kind
    a, b = np.array(found.keys, dtype=np.int64).T  # b is -1 except for time differences
    values = found.values
    if word == "toa":
        # Dates always become seconds, independent of the unit of sigma.
        unit = conversion("s", "length", propagation_speed=wave.speed) if values.dtype.kind == "M" else unit
        values = since_first(values, sigma, unit)
    z = np.asarray(unit.to_si(values), dtype=float)
    present = np.isfinite(z)
    if np.isinf(z).any():
        raise InvalidProblem("a value is infinite", word, "use NaN for missing values")
    if timed or word in ("toa", "tdoa"):
        check_times(word, z, sigma, places.extent, wave)
    columns = {"weight": present.astype(float), "a": a, "b": None if word != "tdoa" else b}
    # Differences to one station share its error, and each arrival has half of the variance of a difference. If pairs
    # form loops, this is the cautious choice: a difference that follows from others adds no information.
    noise = {"arrival_sigma": sigma / np.sqrt(2.0)} if word == "tdoa" else {"sigma": sigma}
    return measured(kind, np.where(present, z, 0.0), **columns, **noise)


def from_north(measurements: Measured, north: North, unit: str, places: Receivers) -> Measured:
    """Return rows of bearings with the declination of magnetic north and the sense of the convention.

    `unit` is the unit of a declination without a unit.
    """
    rows, east = measurements.rows.clockwise() if north.azimuth == COMPASS else measurements.rows, north.declination
    if east is None:
        return replace(measurements, rows=rows)
    if isinstance(east, bool) or not isinstance(east, str | date | float | int | np.number):
        what = f"{type(east).__name__} is not a declination"
        raise InvalidProblem(what, "declination", 'give a number, "4 deg", or a date such as "2026-06-01"')
    angle, day = declination_of(east, north.azimuth, unit, "declination")
    at = places.stations.position[0]
    more = angle if day is None else declinations(at, places.frame, day, "declination")[rows.a]
    return replace(measurements, rows=replace(rows, correction=rows.correction + more))


def since_first(times: Array, sigma: float, unit: Conversion) -> Array:
    """Return times (..., m) relative to the first arrival, in their unit (dates in seconds), before digits are lost.

    `sigma` is the standard deviation of an arrival, m. Raise InvalidProblem for floats whose rounding is too coarse for
    it.
    """
    if times.dtype.kind == "M":
        known = ~np.isnat(times)
        counted = times.astype("datetime64[ns]").astype(np.int64)
        first = np.where(known, counted, np.iinfo(np.int64).max).min(-1, keepdims=True)
        return np.where(known, (counted - first) * 1e-9, np.nan)
    if times.dtype.kind in "iu":
        return np.asarray((times - times.min(-1, keepdims=True)).astype(float))
    # Floats: `coarse` is the rounding of the largest time, m. A row without any time has nothing to subtract.
    with np.errstate(invalid="ignore"):
        coarse = np.spacing(np.fmax.reduce(np.abs(times), axis=None, initial=0.0)) * unit.factor
        first = np.fmin.reduce(times, axis=-1, keepdims=True)
        counted = np.asarray(times - np.where(np.isfinite(first), first, 0.0))
    if coarse > _STEP * sigma:
        what = f"these times are rounded to {coarse:.3g} m of path, which is too coarse for their sigma"
        advice = "give whole nanoseconds with unit='ns', numpy.datetime64, or times relative to a recent time"
        raise InvalidProblem(what, "toa", advice)
    return counted
