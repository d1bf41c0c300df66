"""Files of other programs as tables: CSV, Parquet, nested records such as JSON, and logs such as of KrakenSDR."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from math import sqrt
from pathlib import Path
from typing import Any

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import check_budget, decoded, json_of, read_bytes
from optloc.files import detections, pick_files
from optloc.files.columns import any_unit, stem
from optloc.files.table import Table, csv, of_rows, parquet

# mlat-server writes seconds since 1970, arrivals in microseconds, and variances in microseconds squared.
_CLUSTER = ("ecef_x_m", "ecef_y_m", "ecef_z_m", "toa_us", "sigma_us")
# Names of lists with two or three coordinates of one point.
_POINTS = ("position", "pos", "xyz", "ecef")
# Characters of a record that a message shows.
_SHOWN = 80

Row = dict[str, Any]


def records(data: Any, source: str) -> Table:
    """Return the table of nested records: a list of objects, an object of objects by name, or one object.

    Names of nested objects are joined by "_". Each object in a list is a row, and repeats the values outside the list.
    Lists of equal length in one object are columns. A list of coordinates is x, y and z.

    Raises
    ------
    InvalidProblem
        If there are no records, or the lists of an object have different lengths.
    """
    if isinstance(data, Mapping) and isinstance(data.get("aircraft"), list):
        advice = "give receptions, such as the output of mlat-server with --dump-pseudorange"
        raise InvalidProblem("aircraft.json has positions of aircraft, not measurements", source, advice)
    if isinstance(data, Mapping):
        named = data and all(isinstance(value, Mapping) for value in data.values())
        data = [{"name": name, **value} for name, value in data.items()] if named else [data]
    if not isinstance(data, list) or not data or not all(isinstance(row, Mapping) for row in data):
        raise InvalidProblem("there is no list of records", source, "write a list of objects, or CSV")
    if any("cluster" in row for row in data):
        rows = list(_clusters(data, source))
    else:
        rows = [row for i, record in enumerate(data) for row in _rows(record, f"{source}, row {i + 1}")]
    check_budget("cells", sum(map(len, rows)), source)
    if not any(rows):
        raise InvalidProblem("there is no list of records", source, "write a list of objects, or CSV")
    return of_rows(rows, source, {})


def with_lists(table: Table) -> Table:
    """Return a table without lists in cells: each list item becomes a row, as in `records`."""
    lists = [name for name, column in table.columns.items() if column.dtype == object and _holds_list(column)]
    if not lists:
        return table
    columns = {name: column.tolist() for name, column in table.columns.items()}
    columns |= {name: [_list_of(cell) for cell in columns[name]] for name in lists}
    rows = [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]
    found = [row for i, one in enumerate(rows) for row in _rows(one, f"{table.source}, row {i + 1}")]
    check_budget("cells", sum(map(len, found)), table.source)
    return replace(of_rows(found, table.source, {}), others=table.others, notes=table.notes)


def _holds_list(column: Any) -> bool:
    """Return whether the first cell that is not empty has a list."""
    first = next((cell for cell in column if cell is not None and str(cell).strip()), None)
    return isinstance(_list_of(first), list)


def _list_of(cell: Any) -> Any:
    """Return the list in a cell that has JSON or Python text of a list, else the cell."""
    text = cell.strip() if isinstance(cell, str) else ""
    if not (text.startswith("[") and text.endswith("]")):
        return cell
    with suppress(ValueError, RecursionError):
        return json.loads(text, parse_float=Decimal)
    with suppress(ValueError, SyntaxError, RecursionError, MemoryError):
        return ast.literal_eval(text)
    return cell


def _rows(record: Mapping[str, Any], place: str) -> list[Row]:
    """Return the rows of one record: one row, or one row for each item of its lists.

    `place` is the place for messages.
    """
    # `shared` has the values that all rows repeat, and `inner` the rows of objects in lists. `parallel` has lists of
    # numbers or text, which become columns.
    shared: Row = {}
    inner: list[Row] = []
    parallel: dict[str, list[Any]] = {}
    for key, value in _flat(record, place):
        if not isinstance(value, list):
            _put(shared, key, value, place)
        elif not value:
            continue
        elif all(isinstance(item, Mapping) for item in value):
            inner += [_inside(row, key, record) for item in value for row in _rows(item, place)]
        elif stem(key) in _POINTS and len(value) in (2, 3) and all(_is_number(item) for item in value):
            for axis, item in zip("xyz", value, strict=False):
                _put(shared, _axis_name(key, axis), _cell(item), place)
        elif any(isinstance(item, list | Mapping) for item in value):
            _put(shared, key, json.dumps(value, default=str), place)
        else:
            parallel[key] = [_cell(item) for item in value]
    if len({len(items) for items in parallel.values()}) > 1:
        sizes = ", ".join(f"{key} has {len(items)}" for key, items in parallel.items())
        raise InvalidProblem(f"the lists have different lengths: {sizes}", place, "use equal lengths")
    parallel_rows = [dict(zip(parallel, cells, strict=True)) for cells in zip(*parallel.values(), strict=True)]
    rows = [*inner, *parallel_rows]
    return [shared | row for row in rows] if rows else [shared]


def _flat(record: Mapping[str, Any], place: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names and values of a record; names of nested objects are joined by "_".

    `prefix` is the joined name of the outer objects.
    """
    for key, value in record.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flat(value, place, f"{name}_")
        else:
            yield name, value if isinstance(value, list) else _cell(value)


def _inside(row: Row, key: str, record: Mapping[str, Any]) -> Row:
    """Return a row of the list with the name `key`, with names that do not occur in the outer object `record`.

    A name that the outer object also has gets the name of the list as a prefix.
    """
    return {f"{key}_{name}" if name in record else name: value for name, value in row.items()}


def _put(row: Row, key: str, value: Any, place: str) -> None:
    """Add a value to a row; raise InvalidProblem, with the place `place`, if the row already has the key."""
    if key in row:
        raise InvalidProblem(f"the value {key!r} is given twice", place, "rename one value")
    row[key] = value


def _axis_name(key: str, axis: str) -> str:
    """Return the name of one coordinate of a list: "x_m" for "position_m", "ecef_x" for "ecef"."""
    unit = any_unit(key)
    name = f"ecef_{axis}" if stem(key) == "ecef" else axis
    return name if unit is None else f"{name}_{unit}"


def _is_number(item: Any) -> bool:
    """Return whether an item of a list is a number; booleans are not numbers."""
    return isinstance(item, int | float | Decimal) and not isinstance(item, bool)


def _cell(value: Any) -> Any:
    """Return a value as a cell: numbers with all their digits, booleans as words."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | int | float | None):
        return value
    return str(value)


def _clusters(data: Sequence[Mapping[str, Any]], source: str) -> Iterator[Row]:
    """Yield the receptions of an mlat-server dump of pseudoranges, with the ECEF position of each receiver, m.

    The name of a station is its position, since the dump has no names.
    """
    for i, row in enumerate(data):
        place = f"{source}, row {i + 1}"
        cluster = row.get("cluster")
        if not isinstance(cluster, list):
            raise InvalidProblem("there is no cluster of receptions, which other rows have", place, "remove the row")
        for cells in cluster:
            numbers = isinstance(cells, list) and all(type(cell) in (int, float, Decimal) for cell in cells)
            if not numbers or len(cells) < len(_CLUSTER) - 1:
                what = f"{str(cells)[:_SHOWN]} is not a reception"
                raise InvalidProblem(what, place, "write [x, y, z, microseconds]")
            # A fifth number is the variance of the time, microseconds squared; a negative variance counts as zero.
            reals = [float(cell) for cell in cells]
            reception = dict(zip(_CLUSTER, [*reals[:4], *(sqrt(max(cell, 0.0)) for cell in reals[4:5])], strict=False))
            name = "/".join(f"{cell:.0f}" for cell in reals[:3])
            yield {"message": i + 1, "icao": str(row.get("icao", "")) or None, "station": name} | reception


# Names of Parquet types whose cells have several values.
_NESTED = ("list<", "large_list<", "fixed_size_list<", "struct<", "map<")
_TEXT, _JSON = (".csv", ".tsv", ".txt", ".log"), (".json", ".jsonl", ".ndjson")
# Start of a KrakenSDR log, which has no header: milliseconds since 1970, the fields below, then one number for each
# degree.
_KRAKEN = re.compile(rb"\d{13}\s*,(\s*[^,\n]*,){15,}")
_FIELDS = "time_ms bearing_deg confidence power frequency array latency station lat lon heading_deg".split()


def read_table(path: Path) -> Table:
    """Return the table of a file in any known format; raise InvalidProblem for an unknown format.

    The separator of a CSV file is found from its header.
    """
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq"):
        return _parquet(path)
    if suffix in _JSON:
        return _json(path)
    if (reader := _log_reader(path)) is not None:
        return reader(decoded(read_bytes(path, lines=True), path.name), path.name)
    if suffix not in _TEXT and path.is_file():
        known = "use .csv, .tsv, .txt, .json or .parquet, and .geojson for stations"
        raise InvalidProblem(f"files of type {path.suffix or path.name!r} are unknown", str(path), known)
    found = csv(path, None, {})
    if not found.count:
        raise InvalidProblem("the table has no rows", found.source, "give at least one row")
    return with_lists(found)


def _parquet(path: Path) -> Table:
    """Return the table of a Parquet file; rows with lists or objects in cells are read as records."""
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
        raise InvalidProblem(f"the lists cannot be read ({error})", path.name, "save the table as CSV") from None
    others = {name: kind for name, kind in found.others.items() if name not in nested}
    return replace(records(rows, path.name), others=others)


# Logs without a header.


def _kraken(text: str, source: str) -> Table:
    """Return the bearings of a KrakenSDR log, clockwise from the front of the array, and the headings of the array."""
    rows = []
    for number, line in enumerate(text.splitlines()):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",", len(_FIELDS))]
        place = f"{source}, row {number + 1}"
        if len(cells) <= len(_FIELDS):
            raise InvalidProblem(f"the row has {len(cells)} fields", place, "a row of KrakenSDR has 17 or more")
        rows.append(dict(zip(_FIELDS, cells, strict=False)))
    return of_rows(rows, source, {})


_Reader = Callable[[str, str], Table]
_LOGS: tuple[tuple[re.Pattern[bytes], _Reader], ...] = (
    (_KRAKEN, _kraken),
    (pick_files.NONLINLOC, pick_files.nonlinloc),
    (pick_files.HYPO71, pick_files.hypo71),
    (pick_files.QUAKEML, pick_files.quakeml),
    (detections.EVENTS, detections.sound_events),
    (detections.CLIPS, detections.clips),
)
"""Pattern at the start of each log format, and its reader. A file of any name is recognised by its start."""
# Bytes that are read to recognise a format: comments may be before the first line with data.
_HEAD = 8192


def _log_reader(path: Path) -> _Reader | None:
    """Return the reader of a log format, by the start of the file; None for other files."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return None
    return next((reader for begins, reader in _LOGS if begins.match(head)), None)


def is_log(path: Path) -> bool:
    """Return whether the start of a file has a log format, whatever its name is."""
    return _log_reader(path) is not None


# JSON records: one document, or one document on each line.


def _json(path: Path) -> Table:
    """Return the table of a JSON file: one document, or one document on each line."""
    text = decoded(read_bytes(path, lines=True), path.name)
    lines = [line for line in text.splitlines() if line.strip()]
    # Several lines with an object each are a log; a single line may be either form.
    several = len(lines) > 1 and all(line.lstrip().startswith("{") and line.rstrip().endswith("}") for line in lines)
    if not several:
        return records(json_of(text, path.name, Decimal), path.name)
    return records([json_of(line, f"{path.name}, line {i + 1}", Decimal) for i, line in enumerate(lines)], path.name)
