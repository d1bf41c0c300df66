"""The table of explanations. Other packages add entries through the entry point `optloc.explanations`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from optloc.advice import heights, readings, rows_and_noise, station_errors
from optloc.advice.change import Case, Change
from optloc.advice.suspects import Suspects
from optloc.base.registry import Registry


@dataclass(frozen=True, slots=True)
class Explanation:
    """A possible cause of a misfit.

    Parameters
    ----------
    summary : str
        The cause, for lists.
    price : float
        Twice the logarithm of the prior odds against this cause.
    changes : callable
        Maps a case and its suspected stations to the changes that the data choose from.
    """

    summary: str
    price: float
    changes: Callable[[Case, Suspects], Iterator[Change]]


# Prices by how often a cause is seen: odds of 3, 10, 30 and 100 to 1.
_COMMON, _USUAL, _RARE, _SELDOM = 2.2, 4.6, 6.8, 9.2

LATE_PRICE = _USUAL
"""Price of late signals, which are a distribution of errors and no change of values."""

EXPLANATIONS: Registry[Explanation] = Registry(
    "optloc.explanations",
    lambda value: isinstance(value, Explanation),
    {
        "offset": Explanation("constant error of one station", _USUAL, station_errors.offsets),
        "sign-station": Explanation("opposite sign of one station", _RARE, station_errors.signs),
        "scale": Explanation("wrong scale of one station", _RARE, station_errors.scales),
        "step": Explanation("offset of one station from some time on", _RARE, station_errors.steps),
        "rotation": Explanation("axes of one station are turned in space", _USUAL, station_errors.rotations),
        "drift": Explanation("drift of one station", _RARE, station_errors.drifts),
        "period": Explanation("one station is off by whole periods", _RARE, station_errors.periods),
        "swapped": Explanation("two stations are exchanged", _RARE, station_errors.exchanges),
        "reference": Explanation("another reference station", _RARE, station_errors.references),
        "moved": Explanation("one station is at another position", _RARE, station_errors.moves),
        "outlier": Explanation("one wrong row", _USUAL, rows_and_noise.single_outliers),
        "outliers": Explanation("two wrong rows", 2.0 * _USUAL, rows_and_noise.pairs_of_outliers),
        "noise": Explanation("larger noise of a kind or station", _USUAL, rows_and_noise.levels),
        "unit": Explanation("another unit of the values", _USUAL, readings.units),
        "coordinate-unit": Explanation("another unit of the coordinates", _SELDOM, readings.coordinate_units),
        "sense": Explanation("another sense of azimuths", _COMMON, readings.senses),
        "declination": Explanation("all azimuths are turned", _USUAL, readings.declinations),
        "sign": Explanation("opposite sign of all values", _COMMON, readings.signs),
        "speed": Explanation("another speed of the wave", _USUAL, readings.speeds),
        "lat-lon": Explanation("latitude and longitude are exchanged", _RARE, readings.swapped_coordinates),
        "height": Explanation("missing or wrong heights", _USUAL, heights.heights),
    },
)
"""Explanations by name."""
