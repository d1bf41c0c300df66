"""Magnetic declination: the angle from true north to magnetic north, east positive; compass bearings need it added.

The declination at a position and date comes from the World Magnetic Model, with the coefficients of the library
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
from optloc.files.schema import DeclinationTable
from optloc.files.settings import Units

_DATE = re.compile(r"\s*(\d{4}-\d\d-\d\d)")
_GIVE = 'give the declination as an angle, such as "4 deg"'
# Decimals of degrees of positions: 100 m, over which the declination changes by less than a millidegree.
_DIGITS = 3


def date_of(given: Any, where: str) -> date | None:
    """Return the date of a declination that is stated as a date; None for an angle.

    `given` is an angle with or without unit, a date, text such as "2026-06-01", or the table of a problem file. `where`
    is the place for messages. Raise InvalidProblem for text that begins like a date but is not a date.
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
        raise InvalidProblem(f"{text!r} is not a date", where, 'write it as in "2026-06-01"') from None


def declination_of(
    given: Any, convention: str | None, unit: str | None, where: str, advice: str = "remove it"
) -> tuple[float, date | None]:
    """Return the declination of bearings in radians, or zero and the date that determines the declination.

    `given` is as in `date_of`. `convention` is of the bearings; angles from the x axis are rejected with `advice`.
    `unit` is the unit of a plain number. `where` is the place for messages.
    """
    if convention == "east-counterclockwise":
        raise InvalidProblem("angles from the x axis have no declination", where, advice)
    day = date_of(given, where)
    return (0.0, day) if day is not None else (angle_of(given, unit, where), None)


def angle_of(given: float | str, unit: str | None, where: str) -> float:
    """Return a declination in radians; `unit` is the unit of a plain number, which None rejects."""
    angle = Units("angle").plain(given, unit, where)
    if abs(angle) > np.pi:
        what = f"a declination of {np.degrees(angle):.6g} deg is more than half a turn"
        raise InvalidProblem(what, where, "give it between -180 and 180 deg, east positive")
    return angle


def declinations(position: Array, frame: Frame, day: date, where: str) -> Array:
    """Return the declination (n,) at positions by the World Magnetic Model, radians, east positive.

    Parameters
    ----------
    position : array (n, 2 or 3)
        Metres; two coordinates are at the height of the origin.
    frame : Frame
        A frame on Earth.
    day : date
        Date of the bearings.
    where : str
        Place for messages.

    Raises
    ------
    InvalidProblem
        If the frame is not on Earth, or pygeomag is not installed. Also if no model is valid at the date, or the place
        is too close to a magnetic pole.
    """
    if not frame.geodetic:
        raise InvalidProblem("a declination by date needs stations on Earth", where, _GIVE)
    model, year = _model(day, where)
    flat = np.zeros((len(position), 3 - position.shape[-1]))
    lat, lon, height = frame.to_geodetic(np.concatenate([position, flat], axis=-1))
    # A compass needs the declination to a tenth of a degree, and the model is accurate to 0.3.
    places = np.stack([np.degrees(lat).round(_DIGITS), np.degrees(lon).round(_DIGITS), np.round(height / 1e3, 1)], -1)
    distinct, index = np.unique(places, axis=0, return_inverse=True)
    found = [model.calculate(glat=p[0], glon=p[1], alt=p[2], time=year) for p in distinct.tolist()]
    dark = next((p for p, one in zip(distinct.tolist(), found, strict=True) if one.in_blackout_zone), None)
    if dark is not None:
        what = f"a compass does not work at {dark[0]:g}, {dark[1]:g} deg, too close to a magnetic pole"
        raise InvalidProblem(what, where, _GIVE)
    return np.radians([one.d for one in found])[index.reshape(-1)]


def _model(day: date, where: str) -> tuple[Any, float]:
    """Return the model that is valid at a date, and the date in years, such as 2026.5.

    Raise InvalidProblem if pygeomag is not installed, or no model is valid. `where` is the place for messages.
    """
    try:
        import pygeomag
    except ImportError:
        what = "a declination by date needs the library pygeomag"
        raise InvalidProblem(what, where, f"pip install 'optloc[magnetic]', or {_GIVE}") from None
    try:
        model = pygeomag.GeoMag(base_year=day.year)
        model.life_span  # noqa: B018  # reads the coefficients; raises for an unknown year
    except (ValueError, OSError):
        what = f"no World Magnetic Model of pygeomag {pygeomag.__version__} is valid on {day.isoformat()}"
        raise InvalidProblem(what, where, f"{_GIVE}, or install a newer pygeomag") from None
    return model, float(pygeomag.calculate_decimal_year(day))
