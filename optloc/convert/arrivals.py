"""A table of arrival times: which station heard which message when."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np

from optloc.convert.roles import Roles, unit_of
from optloc.convert.rows import Measured
from optloc.errors import InvalidProblem, nearest
from optloc.files.words import Units
from optloc.types import Array
from optloc.units import UNITS


def arrivals(roles: Roles, stations: Sequence[str], where: str, unit: str | None) -> Measured:
    """Return arrivals, each counted from the first of its message so that no digit is lost.

    Parameters
    ----------
    roles : Roles
        The table: message, station, time.
    stations : sequence of str
        Names of the known stations.
    where : str
        Where these are known from.
    unit : str, optional
        Of the times; by default what the column's name ends in, else seconds.
    """
    message, heard, times = roles.labels("message"), roles.labels("station"), roles.exact("time")
    named = roles.column("time")
    stated = unit or unit_of(named, UNITS["time"])
    unit = stated or "s"
    factor = Decimal(repr(float(Units("time").conversion(unit, "--unit").factor)))
    known = set(stations)
    for row, name in enumerate(heard.tolist()):
        if name not in known:
            place = roles.table.where(roles.column("station"), row)
            raise InvalidProblem(f"there is no station {name!r} in {where}", place, nearest(name, stations))
    _once(roles, message, heard)
    first: dict[str, Decimal] = {}
    for label, time in zip(message.tolist(), times, strict=True):
        first[label] = min(time, first.get(label, time))
    columns = {
        "epoch": message,
        "time": [float(first[label] * factor) for label in message.tolist()],
        "a": heard,
        "z": [f"{time - first[label]:f}" for label, time in zip(message.tolist(), times, strict=True)],
    }
    lone = np.unique(message, return_counts=True)[1]
    few = int((lone < 3).sum())
    assumed = () if stated else (f"the column {named!r} is taken to be in seconds; --unit says another",)
    notes = (f"{few} of {len(lone)} messages were heard by fewer than three stations",) if few else ()
    return Measured(columns, unit, "arrivals, counted from the first of each message", (*assumed, *notes))


def _once(roles: Roles, message: Array, heard: Array) -> None:
    """Raise InvalidProblem where a station hears a message twice."""
    seen: dict[tuple[str, str], int] = {}
    for row, key in enumerate(zip(message.tolist(), heard.tolist(), strict=True)):
        if key in seen:
            what = f"station {key[1]!r} hears message {key[0]!r} again, first in row {seen[key] + 1}"
            advice = "leave one of them out, or put columns together: --column message=ONE+TWO"
            raise InvalidProblem(what, roles.table.at(row), advice)
        seen[key] = row
