"""Files of other programs as tables: CSV and Parquet, JSON of mlat-server, logs of KrakenSDR."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from math import sqrt
from pathlib import Path
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import at_most, decoded, json_of, read_bytes
from optloc.files.table import Table, csv, of_rows, parquet

_TEXT, _JSON = (".csv", ".tsv", ".txt", ".log"), (".json", ".jsonl", ".ndjson")
# What begins a log of KrakenSDR, which has no header: milliseconds since 1970, and after the fields below one number
# for each degree.
_KRAKEN = re.compile(rb"\d{13}\s*,(\s*[^,\n]*,){15,}")
_FIELDS = "time_ms bearing_deg confidence power frequency array latency station lat lon heading_deg".split()
# mlat-server keeps seconds since 1970, arrivals in microseconds and their variances in their squares.
_CLUSTER = ("ecef_x_m", "ecef_y_m", "ecef_z_m", "toa_us", "sigma_us")


def read_table(path: Path) -> Table:
    """Return the table of a file, whatever program wrote it; raise InvalidProblem where it is none that is known.

    What separates the fields of a CSV file is seen from its header.
    """
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq"):
        return parquet(path, {})
    if suffix in _JSON:
        return _json(path)
    if suffix not in _TEXT and path.is_file():
        known = "use .csv, .tsv, .txt, .json or .parquet, and .geojson for stations"
        raise InvalidProblem(f"files of type {path.suffix or path.name!r} are unknown", str(path), known)
    data = read_bytes(path, lines=True)
    for begins, reader in _LOGS:
        if begins.match(data):
            return reader(decoded(data, path.name), path.name)
    found = csv(path, None, {})
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one")
    return found


# Logs without a header of their own.


def _kraken(text: str, source: str) -> Table:
    """Return the bearings of a KrakenSDR log, clockwise from the front of the array, beside the heading of this."""
    rows = []
    for number, line in enumerate(text.splitlines()):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",", len(_FIELDS))]
        place = f"{source}, row {number + 1}"
        if len(cells) <= len(_FIELDS):
            raise InvalidProblem(f"the row has {len(cells)} fields", place, "a row of KrakenSDR has 17 and more")
        rows.append(dict(zip(_FIELDS, cells, strict=False)))
    return of_rows(rows, source, {})


_LOGS: tuple[tuple[re.Pattern[bytes], Callable[[str, str], Table]], ...] = ((_KRAKEN, _kraken),)
"""How each log begins, and what reads it."""


# Records in JSON: one document, or one on each line.


def _json(path: Path) -> Table:
    text = decoded(read_bytes(path, lines=True), path.name)
    lines = [line for line in text.splitlines() if line.strip()]
    # Lines that are documents each are a log; a document of one line may be either.
    several = len(lines) > 1 and all(line.lstrip().startswith("{") and line.rstrip().endswith("}") for line in lines)
    if not several:
        return records(json_of(text, path.name, Decimal), path.name)
    return records([json_of(line, f"{path.name}, line {i + 1}", Decimal) for i, line in enumerate(lines)], path.name)


def records(data: Any, source: str) -> Table:
    """Return the table of records in JSON: a list of objects, or an object of objects, whose keys are names."""
    if isinstance(data, Mapping) and "cluster" in data:
        data = [data]
    if isinstance(data, Mapping) and isinstance(data.get("aircraft"), list):
        advice = "give receptions instead, such as mlat-server writes with --dump-pseudorange"
        raise InvalidProblem("aircraft.json has positions of aircraft, no measurements", source, advice)
    if isinstance(data, Mapping):
        held = [value for value in data.values() if isinstance(value, list)]
        if len(held) == 1 and not any(isinstance(value, Mapping) for value in data.values()):
            data = held[0]
        else:
            data = [{"name": name, **value} for name, value in data.items() if isinstance(value, Mapping)]
    if not isinstance(data, list) or not data or not all(isinstance(row, Mapping) for row in data):
        raise InvalidProblem("there is no list of records", source, "write it as a list of objects, or as CSV")
    rows = list(_clusters(data, source)) if any("cluster" in row for row in data) else [_flat(row) for row in data]
    at_most("cells", sum(map(len, rows)), source)
    return of_rows(rows, source, {})


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with what is nested in it by longer names; lists stay out."""
    out: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            out |= {f"{key}_{inner}": cell for inner, cell in _flat(value).items()}
        elif isinstance(value, Decimal):
            out[str(key)] = str(value)
        elif isinstance(value, str | int | float | None) and not isinstance(value, bool):
            out[str(key)] = value
    return out


def _clusters(data: Sequence[Mapping[str, Any]], source: str) -> Iterator[dict[str, Any]]:
    """Yield the receptions of an mlat-server dump of pseudoranges, with the place of each receiver in ECEF."""
    for i, row in enumerate(data):
        place = f"{source}, row {i + 1}"
        cluster = row.get("cluster")
        if not isinstance(cluster, list):
            raise InvalidProblem("there is no cluster of receptions, which other rows have", place, "leave it out")
        for cells in cluster:
            numbers = isinstance(cells, list) and all(type(cell) in (int, float, Decimal) for cell in cells)
            if not numbers or len(cells) < len(_CLUSTER) - 1:
                raise InvalidProblem(f"{str(cells)[:80]} is no reception", place, "write [x, y, z, microseconds]")
            reals = [float(cell) for cell in cells]
            reception = dict(zip(_CLUSTER, [*reals[:4], *(sqrt(max(cell, 0.0)) for cell in reals[4:5])], strict=False))
            name = "/".join(f"{cell:.0f}" for cell in reals[:3])
            yield {"message": i + 1, "icao": str(row.get("icao", "")) or None, "station": name} | reception
