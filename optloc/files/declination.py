"""Magnetic declination: the angle from true north to magnetic north, east positive, which bearings of a compass lack.

The declination of a place and a date comes from the World Magnetic Model, with the coefficients of the library
pygeomag. Source: A. Chulliat et al., "The US/UK World Magnetic Model for 2025-2030", NOAA (2025).
"""

from __future__ import annotations

import re
from datetime import date
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.files.schema import DeclinationTable, Units

_DATE = re.compile(r"\s*(\d{4}-\d\d-\d\d)")
_GIVE = 'give the declination itself, such as "4 deg"'
# Digits of degrees to which places are rounded: 100 m, over which declination changes by less than a millidegree.
_DIGITS = 3


def date_of(given: Any, where: str) -> date | None:
    """Return the day of a declination that is given as one, None for an angle.

    Parameters
    ----------
    given : float, str, date or DeclinationTable
        An angle with or without unit, or a day: a date, text such as "2026-06-01", or the table of a problem file.
    where : str
        Place to name.

    Raises
    ------
    InvalidProblem
        For text that begins as a date and is none.
    """
    if isinstance(given, date):
        return given
    text = given.date if isinstance(given, DeclinationTable) else given
    found = _DATE.match(text) if isinstance(text, str) else None
    if found is None and not isinstance(given, DeclinationTable):
        return None
    try:
        return date.fromisoformat(str(text).strip()[:10] if found is None else found.group(1))
    except ValueError:
        raise InvalidProblem(f"{text!r} is no date", where, 'write it as in "2026-06-01"') from None


def declination_of(
    given: Any, convention: str | None, unit: str | None, where: str, advice: str = "leave it out"
) -> tuple[float, date | None]:
    """Return the declination of bearings in radians, or zero and the day whose declination it is.

    Parameters
    ----------
    given : float, str, date or DeclinationTable
        As of `date_of`.
    convention : str, optional
        Of the bearings; angles from the x axis are refused.
    unit : str, optional
        Of a bare number.
    where : str
        Place to name.
    advice : str
        What to do with a declination of angles from the x axis.
    """
    if convention == "east-counterclockwise":
        raise InvalidProblem("angles from the x axis have no declination", where, advice)
    day = date_of(given, where)
    return (0.0, day) if day is not None else (angle_of(given, unit, where), None)


def angle_of(given: float | str, unit: str | None, where: str) -> float:
    """Return a declination in radians; `unit` is that of a bare number, None refuses it."""
    angle = Units("angle").plain(given, unit, where)
    if abs(angle) > np.pi:
        what = f"a declination of {np.degrees(angle):.6g} deg is more than half a turn"
        raise InvalidProblem(what, where, "give it between -180 and 180 deg, east positive")
    return angle


def declinations(position: Array, frame: Frame, day: date, where: str) -> Array:
    """Return the declination (n,) at positions (n, 3) of a frame by the World Magnetic Model, radians, east positive.

    Parameters
    ----------
    position : array (n, 2 or 3)
        Metres; in the plane at the height of the frame's origin.
    frame : Frame
        A frame on Earth.
    day : date
        When.
    where : str
        Place to name.

    Raises
    ------
    InvalidProblem
        Where there is no Earth, pygeomag is not installed, no model holds on that day, or a compass does not work.
    """
    if not frame.geodetic:
        raise InvalidProblem("a declination by date needs stations on Earth", where, _GIVE)
    model, year = _model(day, where)
    flat = np.zeros((len(position), 3 - position.shape[-1]))
    lat, lon, height = frame.to_geodetic(np.concatenate([position, flat], axis=-1))
    # A compass needs its declination to a tenth of a degree, and the model holds to 0.3.
    places = np.stack([np.degrees(lat).round(_DIGITS), np.degrees(lon).round(_DIGITS), np.round(height / 1e3, 1)], -1)
    distinct, index = np.unique(places, axis=0, return_inverse=True)
    found = [model.calculate(glat=p[0], glon=p[1], alt=p[2], time=year) for p in distinct.tolist()]
    dark = next((p for p, one in zip(distinct.tolist(), found, strict=True) if one.in_blackout_zone), None)
    if dark is not None:
        what = f"a compass does not work at {dark[0]:g}, {dark[1]:g} deg, too near to a magnetic pole"
        raise InvalidProblem(what, where, _GIVE)
    return np.radians([one.d for one in found])[index.reshape(-1)]


def _model(day: date, where: str) -> tuple[Any, float]:
    """Return the model that holds on a day, and the day in years."""
    try:
        import pygeomag
    except ImportError:
        what = "a declination by date needs the library pygeomag"
        raise InvalidProblem(what, where, f"pip install 'optloc[magnetic]', or {_GIVE}") from None
    try:
        model = pygeomag.GeoMag(base_year=day.year)
        model.life_span  # noqa: B018  # reads the coefficients, which is where an unknown year is noticed
    except (ValueError, OSError):
        what = f"no World Magnetic Model of pygeomag {pygeomag.__version__} holds on {day.isoformat()}"
        raise InvalidProblem(what, where, f"{_GIVE}, or install a newer pygeomag") from None
    return model, float(pygeomag.calculate_decimal_year(day))
