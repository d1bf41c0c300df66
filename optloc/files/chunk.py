"""Rows of one kind between their file and the problem."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.files.schema import MeasurementsTable
from optloc.files.table import Table
from optloc.types import Array
from optloc.units import Conversion


@dataclass(frozen=True, slots=True)
class Chunk:
    """Rows of one kind.

    Parameters
    ----------
    kind : str
        Their kind.
    row : int array (m,)
        Row of each in its table, from 0.
    z, a, b, weight, correction : array (m,)
        As in `optloc.types.Rows`; NaN where a value is to be simulated.
    unit : Conversion
        Of z.
    slope : array (m,)
        SI units in one unit of the file, with sign.
    baseline : array (m,)
        Distance of the two stations that was added to z, metres.
    sigma : array (m,), optional
        Standard deviation of each row.
    arrival : array (s,), optional
        Standard deviation of each station's arrival.
    covariance : array (r, r), optional
        Covariance of the rows of one epoch, in the file's unit squared.
    label, time, written, target : array (m,), optional
        Columns epoch, time (seconds; as written) and target.
    excess : bool
        Whether the distance of the two stations is still to be added to z.
    table : Table
        Where the rows come from.
    """

    kind: str
    row: Array
    z: Array
    a: Array
    b: Array
    weight: Array
    correction: Array
    unit: Conversion
    slope: Array
    baseline: Array
    sigma: Array | None
    arrival: Array | None
    covariance: Array | None
    label: Array | None
    time: Array | None
    written: Array | None
    target: Array | None
    excess: bool
    table: Table


@dataclass(frozen=True, slots=True)
class Context:
    """What all rows of a section share."""

    section: MeasurementsTable
    table: Table
    stations: tuple[str, ...]
    where: str
    speed: float
    values: bool
