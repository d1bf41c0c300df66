"""The table of explanations. Other packages add entries through the entry point `optloc.explanations`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from optloc.advice import readings, rows_and_noise, station_errors, target_heights
from optloc.advice.change import Change, MisfitCase
from optloc.advice.suspects import Suspects
from optloc.base.registry import Registry


@dataclass(frozen=True, slots=True)
class PossibleCause:
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
    changes: Callable[[MisfitCase, Suspects], Iterator[Change]]


# Prices by how often a cause is seen: odds of 3, 10, 30 and 100 to 1.
_COMMON, _USUAL, _RARE, _SELDOM = 2.2, 4.6, 6.8, 9.2

LATE_PRICE = _USUAL
"""Price of late signals, which are a distribution of errors and no change of values."""

EXPLANATIONS: Registry[PossibleCause] = Registry(
    "optloc.explanations",
    lambda value: isinstance(value, PossibleCause),
    {
        "offset": PossibleCause("constant error of one station", _USUAL, station_errors.offsets),
        "outlier": PossibleCause("one wrong row", _USUAL, rows_and_noise.single_outliers),
        "sign-station": PossibleCause("opposite sign of one station", _RARE, station_errors.signs),
        "scale": PossibleCause("wrong scale of one station", _RARE, station_errors.scales),
        "step": PossibleCause("offset of one station from some time on", _RARE, station_errors.steps),
        "rotation": PossibleCause("axes of one station are turned in space", _USUAL, station_errors.rotations),
        "drift": PossibleCause("drift of one station", _RARE, station_errors.drifts),
        "period": PossibleCause("one station is off by whole periods", _RARE, station_errors.periods),
        "swapped": PossibleCause("two stations are exchanged", _RARE, station_errors.exchanges),
        "reference": PossibleCause("another reference station", _RARE, station_errors.references),
        "moved": PossibleCause("one station is at another position", _RARE, station_errors.moves),
        "outliers": PossibleCause("two wrong rows", 2.0 * _USUAL, rows_and_noise.pairs_of_outliers),
        "noise": PossibleCause("larger noise of a kind or station", _USUAL, rows_and_noise.levels),
        "unit": PossibleCause("another unit of the values", _USUAL, readings.units),
        "coordinate-unit": PossibleCause("another unit of the coordinates", _SELDOM, readings.coordinate_units),
        "sense": PossibleCause("another sense of azimuths", _COMMON, readings.senses),
        "declination": PossibleCause("all azimuths are turned", _USUAL, readings.declinations),
        "sign": PossibleCause("opposite sign of all values", _COMMON, readings.signs),
        "speed": PossibleCause("another speed of the wave", _USUAL, readings.speeds),
        "lat-lon": PossibleCause("latitude and longitude are exchanged", _RARE, readings.swapped_coordinates),
        "height": PossibleCause("missing or wrong heights", _USUAL, target_heights.heights),
    },
)
"""Explanations by name."""
