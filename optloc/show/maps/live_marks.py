"""Marks of a live map: the content of the feed from which the page draws the latest fixes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array
from optloc.show.formats.marks import Mark, ellipse95
from optloc.show.maps.map_marks import map_row

# Decimals of a degree, and of a metre, in the feed: a tenth of a millimetre.
_DEGREES, _METRES = 9, 4


def live_mark(frame: Frame, mark: Mark, trail: Sequence[Array] = ()) -> dict[str, Any]:
    """Return a mark as JSON values for a live map.

    Parameters
    ----------
    frame : Frame
        Frame of the positions.
    mark : Mark
        The latest fix of a target.
    trail : sequence of array (d,)
        Positions of the same target, m, the oldest first.

    Returns
    -------
    dict
        `name`, `time`, `status`, `look`, `place`, `copied`, `size` and `note` as in `MapRow`. `sentence` is the
        sentence of the status. `at` is longitude and latitude, degrees, or x and y, m. `trail` has the same for each
        position. `ellipse` has the semi-axes of the 95 % ellipse, m, and the bearing of the long axis, degrees; None
        without a valid covariance.
    """
    source = mark.row
    row = map_row(frame, source.columns, source.number, mark.name, mark.time, dated=mark.dated)
    texts = {name: getattr(row, name) for name in ("name", "time", "status", "look", "place", "copied", "size", "note")}
    axes = None
    if mark.covers:
        axes = list(ellipse95(mark.level))
    places = [_place(frame, position) for position in trail]
    texts["sentence"] = source.status_sentence
    return {**texts, "at": _place(frame, mark.position), "ellipse": axes, "trail": places}


def _place(frame: Frame, position: Array) -> list[float]:
    """Return longitude and latitude, degrees, of a position (d,), m; x and y, m, if the frame is not on Earth."""
    if not frame.geodetic:
        return [round(float(value), _METRES) for value in position[:2]]
    lat, lon, _ = frame.to_geodetic(position)
    return [round(float(np.degrees(value)), _DEGREES) for value in (lon, lat)]
