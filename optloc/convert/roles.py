"""Which column of a foreign table plays which role: as it is told, or as its name suggests."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from optloc.errors import InvalidProblem, nearest
from optloc.files.document import existing
from optloc.files.sources import csv, parquet
from optloc.files.table import Table
from optloc.types import Array
from optloc.units import UNITS

# Role: names that suggest it, the likeliest first; without case, unit and what is no letter.
GUESSES = {
    "message": "message msg messageid msgid pulse frame epoch event burst id",
    "station": "station receiver rx sensor anchor node site stationid receiverid sensorid",
    "time": "toa arrival timeofarrival arrivaltime rxtime time timestamp t",
    "epoch": "epoch time tgps gpstime tow t timestamp",
    "satellite": "satellite sat prn sv svid satid",
    "pseudorange": "pseudorange pr prange rho c1c prm",
    "name": "name station receiver sensor anchor beacon id site callsign",
    "x": "x satx xecef ecefx xsat",
    "y": "y saty yecef ecefy ysat",
    "z": "z satz zecef ecefz zsat",
    "lat": "lat latitude",
    "lon": "lon long lng longitude",
    "height": "height h alt altitude elevation ellipsoidalheight",
}
_UNITS = sorted({*UNITS["length"], *UNITS["angle"]}, key=len, reverse=True)
_SUFFIX = re.compile(rf"[_ \[(]+({'|'.join(_UNITS)})[\])]?$", re.IGNORECASE)


def read_table(path: Path) -> Table:
    """Return a CSV or Parquet table; what separates the fields of a CSV file is seen from its header."""
    if path.suffix.lower() in (".parquet", ".pq"):
        return parquet(existing(path), {})
    if path.suffix.lower() not in (".csv", ".tsv", ".txt") and path.is_file():
        known = "use .csv, .tsv, .txt or .parquet, and .geojson for stations"
        raise InvalidProblem(f"files of type {path.suffix or path.name!r} are unknown", str(path), known)
    with existing(path).open("rb") as stream:
        header = stream.readline()
    separator = max(b",;\t", key=header.count)
    found = csv(path, chr(separator), {})
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one")
    return found


def stem(column: str) -> str:
    """Return a column's name without case, unit and signs: "TOA_ns" is "toa"."""
    return re.sub(r"[^a-z0-9]", "", _SUFFIX.sub("", column.strip()).lower())


def unit_of(column: str, known: Iterable[str]) -> str | None:
    """Return the unit that a column's name ends in, None where it is none of those known."""
    found = _SUFFIX.search(column.strip())
    return None if found is None else {unit.lower(): unit for unit in known}.get(found.group(1).lower())


@dataclass(frozen=True, slots=True)
class Roles:
    """The columns of a table by role.

    Parameters
    ----------
    table : Table
        The table.
    told : mapping of str to str
        What the user says: column by role; several columns with "+" between them.
    """

    table: Table
    told: Mapping[str, str]

    def find(self, role: str) -> str | None:
        """Return the column of a role, None where no name suggests it; a told one that is none is InvalidProblem."""
        columns = list(self.table.columns)
        if role in self.told:
            for part in self.told[role].split("+"):
                if part not in columns:
                    advice = nearest(part, columns)
                    raise InvalidProblem(f"there is no column {part!r} for the {role}", self.table.source, advice)
            return self.told[role]
        stems = {stem(name): name for name in reversed(columns)}
        return next((stems[guess] for guess in GUESSES[role].split() if guess in stems), None)

    def column(self, role: str) -> str:
        """Return the column of a role; raise InvalidProblem where there is none."""
        found = self.find(role)
        if found is None:
            columns = ", ".join(self.table.columns)
            advice = f"name it with --column {role}=NAME; the columns are {columns}"
            raise InvalidProblem(f"no column looks like the {role}", self.table.source, advice)
        return found

    def labels(self, role: str) -> Array:
        """Return text (m,), that of several columns with "-" between it."""
        parts = [self.table.labels(part) for part in self.column(role).split("+")]
        return np.array(["-".join(row) for row in zip(*parts, strict=True)], dtype=object)

    def numbers(self, role: str) -> Array:
        """Return finite numbers (m,)."""
        return self.table.numbers(self.column(role))

    def exact(self, role: str) -> list[Decimal]:
        """Return numbers with all their digits: an instant of today in seconds has more than a float keeps."""
        name = self.column(role)
        column = self.table.raw(name)
        if column.dtype.kind == "M":
            return [Decimal(int(cell)).scaleb(-9) for cell in column.astype("datetime64[ns]").astype(np.int64)]
        out = []
        for row, cell in enumerate(column.tolist()):
            try:
                number = Decimal(str(cell).strip()) if cell is not None else Decimal("nan")
            except InvalidOperation:
                number = Decimal("nan")
            if not number.is_finite():
                what = "the cell is empty" if cell in (None, "") else f"{cell!r} is not a finite number"
                raise InvalidProblem(what, self.table.where(name, row), "give a number, or leave the row out")
            out.append(number)
        return out
