"""Time scales: conversion of seconds of GPS time or TAI to seconds since 1970, UTC.

Seconds since 1970, UTC, have no leap seconds, as the clocks of Unix computers. A leap second has the same number as the
second after it.

Source of the leap seconds: IERS Bulletin C, in the file `leapseconds` of the IANA time zone database, release 2026f. It
is complete until 28 June 2027. Later times are converted with the last difference, so they are one second off for each
leap second that is announced after the release.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final, Literal, get_args

import numpy as np

from optloc.base.types import Array

TimeScale = Literal["unix", "utc", "gps", "tai", "none"]
"""Scale of numbers in columns of times.

- "unix", "utc": seconds since 1970, UTC, without leap seconds.
- "gps": seconds of GPS time since 6 January 1980.
- "tai": seconds of TAI since 1970, as the clocks of the Precision Time Protocol.
- "none": seconds since an unknown time, which are never shown as dates.
"""
TIME_SCALES: Final = get_args(TimeScale)

# First day of each difference of TAI and UTC: TAI - UTC was 10 s in January 1972, and each day adds one second.
_DAYS: Final = (
    "1972-01-01", "1972-07-01", "1973-01-01", "1974-01-01", "1975-01-01", "1976-01-01", "1977-01-01", "1978-01-01",
    "1979-01-01", "1980-01-01", "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01",
    "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01",
    "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
)  # fmt: skip
_FIRST_DIFFERENCE: Final = 10.0
_UNIX = np.array([datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp() for day in _DAYS])
_DIFFERENCE = _FIRST_DIFFERENCE + np.arange(len(_UNIX))
# GPS time began in 1980, when TAI - UTC was 19 s, and has no leap seconds (IS-GPS-200, section 3.3.4).
_GPS_BEGIN: Final = datetime(1980, 1, 6, tzinfo=UTC).timestamp() + 19.0


def tai_minus_utc(seconds: Array) -> Array:
    """Return TAI minus UTC (k,), s, at seconds (k,) since 1970, UTC; before 1972, the difference of January 1972."""
    return _at(np.asarray(seconds, dtype=float), _UNIX)


def unix_seconds(seconds: Array, scale: TimeScale) -> Array:
    """Return seconds (k,) of a time scale as seconds since 1970, UTC; unchanged for the scale "none"."""
    if scale in ("none", "unix", "utc"):
        return seconds
    tai = seconds + (_GPS_BEGIN if scale == "gps" else 0.0)
    return np.asarray(tai - _at(tai, _UNIX + _DIFFERENCE))


def _at(seconds: Array, begins: Array) -> Array:
    """Return TAI minus UTC (k,), s, at times (k,) of a clock; `begins` are the first times of the differences on it."""
    index = np.searchsorted(begins, seconds, side="right") - 1
    return np.asarray(_DIFFERENCE[np.maximum(index, 0)])
