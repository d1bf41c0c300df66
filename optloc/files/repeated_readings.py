"""Repeated readings of a measurement table: an error that names the rows, or their mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from decimal import Decimal
from math import atan2, cos, degrees, radians, sin

import numpy as np

from optloc.base.arrays import first_rows
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.files.cell_text import Decimals
from optloc.files.table import Table
from optloc.files.table_import import ColumnHints, Readings
from optloc.files.words import numbered


def without_repeats(
    found: Readings, epoch: Array, hints: ColumnHints, table: Table, label: Callable[[int], str]
) -> Readings:
    """Return the readings with repeats averaged, if the user requests it; else raise InvalidProblem for a repeat.

    A repeat is a second reading of the same stations in one epoch. `epoch` (m,) is the number of epoch and target of
    each reading. `label` returns the epoch label of a table row.
    """
    ends = [numbered(end)[1] for end in (found.a, found.b, found.phase) if end is not None]
    first, group = first_rows(epoch, *ends)  # the first reading of each group of repeats, and the group of each reading
    count = len(first)
    if count == len(found.values):
        return found
    extra = len(found.values) - count
    again = np.setdiff1d(np.arange(len(found.values)), first)
    if not hints.average:
        second = int(again[0])
        one = int(first[group[second]])
        names = " and ".join(repr(str(end[second])) for end in (found.a, found.b) if end is not None)
        what = f"station {names} has a second reading of message {label(int(found.row[second]))!r}, "
        what += f"first in row {found.row[one] + 1}"
        if extra > 1:
            what += f"; {extra} repeats in total"
        advice = "use --average for the means, or distinguish messages with --column message=ONE+TWO"
        raise InvalidProblem(what, table.at(int(found.row[second])), advice)
    values = found.values.tolist()
    for number in np.unique(group[again]).tolist():
        members = np.flatnonzero(group == number).tolist()
        values[members[0]] = _mean([values[i] for i in members], found)
    kept = replace(found, values=Decimals.of(values)).take(first)
    note = f"{extra} repeated readings were averaged with the first of their message; --sigma is not changed"
    return replace(kept, notes=(*found.notes, note))


def _mean(values: Sequence[Decimal], found: Readings) -> Decimal:
    """Return the mean of values; the mean of angles is the direction of the mean unit vector."""
    if found.form.quantity != "angle":
        return sum(values, Decimal(0)) / len(values)
    # The mean of 359 and 1 degrees is 0: average unit vectors, not angles.
    radians_ = [float(value) if found.unit == "rad" else radians(float(value)) for value in values]
    mean = atan2(sum(map(sin, radians_)), sum(map(cos, radians_)))
    return Decimal(repr(mean if found.unit == "rad" else degrees(mean) % 360.0))
