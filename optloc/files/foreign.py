"""Files of other programs as tables: CSV and Parquet, JSON of mlat-server, logs of KrakenSDR."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import decoded, json_of, read_bytes
from optloc.files.records import records, with_lists
from optloc.files.table import Table, csv, of_rows, parquet

# How Parquet spells the types of cells that hold several values.
_NESTED = ("list<", "large_list<", "fixed_size_list<", "struct<", "map<")
_TEXT, _JSON = (".csv", ".tsv", ".txt", ".log"), (".json", ".jsonl", ".ndjson")
# What begins a log of KrakenSDR, which has no header: milliseconds since 1970, and after the fields below one number
# for each degree.
_KRAKEN = re.compile(rb"\d{13}\s*,(\s*[^,\n]*,){15,}")
_FIELDS = "time_ms bearing_deg confidence power frequency array latency station lat lon heading_deg".split()


def read_table(path: Path) -> Table:
    """Return the table of a file, whatever program wrote it; raise InvalidProblem where it is none that is known.

    What separates the fields of a CSV file is seen from its header.
    """
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq"):
        return _parquet(path)
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
    return with_lists(found)


def _parquet(path: Path) -> Table:
    """Return the table of a Parquet file; rows with lists or objects in their cells are read as records."""
    import pyarrow as pa
    from pyarrow import parquet as reader

    found = parquet(path, {})
    nested = [name for name, kind in found.others.items() if kind.startswith(_NESTED)]
    if not nested:
        return with_lists(found)
    wanted = [*found.columns, *nested]
    try:
        rows = reader.read_table(pa.BufferReader(read_bytes(path)), columns=wanted, use_threads=False).to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InvalidProblem(f"its lists cannot be read ({error})", path.name, "write it again as CSV") from None
    others = {name: kind for name, kind in found.others.items() if name not in nested}
    return replace(records(rows, path.name), others=others)


# Logs without a header of their own.


def _kraken(text: str, source: str) -> Table:
    """Return the bearings of a KrakenSDR log, clockwise from the front of the array, and the headings of the array."""
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
