"""Axes of time: dates and clock times, or a readable unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Units of other times, with their sizes, s. A unit is used if the times span more than three of it: fewer units give
# ticks such as 0.05 h.
_UNITS = (("d", 86400.0), ("h", 3600.0), ("min", 60.0))
_SPANNED = 3.0
_DAY = 86400.0


@dataclass(frozen=True, slots=True)
class TimeScale:
    """Conversion of seconds to the values of an axis.

    Parameters
    ----------
    unit : str
        "UTC" for dates, or the unit of the axis.
    size : float
        Seconds of one unit of the axis.
    offset : float
        Value of the axis at 0 s.
    """

    unit: str
    size: float = 1.0
    offset: float = 0.0

    def values(self, times: Array) -> Array:
        """Return times (k,), s, as values of the axis."""
        return np.asarray(times) / self.size + self.offset

    def name(self, panel: Axes) -> None:
        """Name the horizontal axis of a panel; for dates, its ticks are dates and clock times."""
        panel.set_xlabel(f"time ({self.unit})")
        if self.unit == "UTC":
            from matplotlib import dates

            module: Any = dates  # without types in matplotlib
            locator = module.AutoDateLocator(minticks=3, maxticks=7)
            panel.xaxis.set_major_locator(locator)
            panel.xaxis.set_major_formatter(module.ConciseDateFormatter(locator))


def time_scale(times: Array, *, dated: bool = False) -> TimeScale:
    """Return the scale of an axis for times (k,), s, which are since 1970, UTC, if `dated`; NaN times do not count."""
    known = np.asarray(times, dtype=float)
    known = known[np.isfinite(known)]
    if len(known) and dated:
        from matplotlib import dates

        # The setting `date.epoch` of matplotlib decides which day is 0.
        module: Any = dates  # without types in matplotlib
        return TimeScale("UTC", _DAY, float(module.date2num(np.datetime64("1970-01-01"))))
    span = float(np.ptp(known)) if len(known) else 0.0
    unit, size = next(((unit, size) for unit, size in _UNITS if span > _SPANNED * size), ("s", 1.0))
    return TimeScale(unit, size)
