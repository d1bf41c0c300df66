"""How a file states the values of a problem: units and wave speed, for messages that name a line of the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Written:
    """Units of the values in a file. A problem in memory is in SI units.

    Parameters
    ----------
    units : mapping of str to float
        Size of one unit of the values by kind, in SI units; negative if the sign of the values is turned.
    speed : float, optional
        Speed, m/s, by which times are multiplied.
    there_and_back : bool
        Whether the times are of both ways, so that the stated speed of the wave is twice `speed`.
    noise_has_unit : bool
        Whether the noise is text with a separate unit, so that it stays if the unit of the values changes.
    place_unit : float, optional
        Size of one unit of the coordinates of the stations, m.
    place_keys : tuple of str
        Keys of the coordinates in the rows of the stations, such as ``("x", "y")``; empty if the rows are in another
        file or have more keys than the name and these.
    """

    units: Mapping[str, float] = field(default_factory=dict)
    speed: float | None = None
    there_and_back: bool = False
    noise_has_unit: bool = False
    place_unit: float | None = None
    place_keys: tuple[str, ...] = ()
