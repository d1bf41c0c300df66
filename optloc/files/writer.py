"""Writing of CSV tables, and of a problem file with other measured values in its original units and signs."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import read_bytes
from optloc.base.outputs import GrowingFile, claim, replace_together, write_text, written
from optloc.base.types import Array
from optloc.files.reader import Draft, draft
from optloc.files.table import Table, is_empty

# Columns of measurements that are written again; optloc does not use other columns.
_COLUMNS = ("kind", "epoch", "time", "target", "a", "b", "z", "sigma", "weight", "correction")


# First characters that make a spreadsheet read a cell as a formula: OWASP, "CSV injection".
_FORMULA = tuple("=+-@\t\r\n")


def write_csv(path: Path, columns: Mapping[str, Any], *, for_people: bool = False) -> None:
    """Write columns as CSV, NaN as an empty cell; raise InvalidProblem if that fails.

    With `for_people`, text that a spreadsheet would read as a formula gets an apostrophe. Without it, text is
    unchanged, so that optloc can read the file again.
    """
    from pyarrow import csv

    with written(path) as file:
        csv.write_csv(_table(columns, for_people), file)


def _table(columns: Mapping[str, Any], for_people: bool) -> Any:
    """Return columns as a table of pyarrow; with `for_people`, texts are harmless in a spreadsheet."""
    import pyarrow as pa

    cells = {name: harmless_column(values) for name, values in columns.items()} if for_people else columns

    def column(values: Any) -> Any:
        """Return values as a column of pyarrow; mixed types become text."""
        try:
            return pa.array(values, from_pandas=True)
        except (pa.ArrowException, OverflowError):
            # Write columns of mixed type, or numbers with many digits, as text.
            return pa.array([None if is_empty(value) else str(value) for value in values])

    return pa.table({name: column(values) for name, values in cells.items()})


def harmless(text: str) -> str:
    """Return the text of a cell, with an apostrophe if a spreadsheet would read it as a formula.

    Numbers are unchanged.
    """
    if not text.startswith(_FORMULA):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def harmless_column(values: Any) -> Any:
    """Return a column with harmless texts."""
    if isinstance(values, np.ndarray) and values.dtype.kind != "O":
        return values
    return [harmless(value) if isinstance(value, str) else value for value in values]


class GrowingTable:
    """A CSV file for people that grows row by row; each added row is complete on disk.

    Parameters
    ----------
    path : Path
        The table; see `optloc.base.outputs.GrowingFile`.

    Attributes
    ----------
    rows : int
        Number of rows in the file.
    when : float
        Time of the last addition by the monotonic clock, s.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.file, self.rows, self.when = path, GrowingFile(path), 0, -math.inf

    def add(self, columns: Mapping[str, Any]) -> None:
        """Append rows with the same columns each time; raise InvalidProblem if that fails."""
        from pyarrow import csv

        table, lines = _table(columns, for_people=True), BytesIO()
        csv.write_csv(table, lines, csv.WriteOptions(include_header=not self.rows))
        self.file.append(lines.getvalue())
        self.rows, self.when = self.rows + table.num_rows, monotonic()


def write_measured(source: Path, out: Path, z: Array, note: str = "") -> list[Path]:
    """Write a problem file with other measured values and return the written files.

    `source` is the problem file to start from. The rows go to CSV files in the folder of `out`. `z` (trials, m) has the
    measured values of all rows in SI units, in the order of the problem; several trials become epochs. `note` is a
    remark after the title. Raise InvalidProblem if trials cannot become epochs, or a file cannot be written.
    """
    made = draft(source, values=False)
    if len(z) > 1 and (made.loaded.problem.epochs > 1 or made.moving):
        advice = "simulate one file for each trial, with different seeds"
        raise InvalidProblem("several trials of a run of epochs do not fit one file", str(out), advice)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("a simulation is written as a problem file", str(out), "use the ending .toml")
    # Omit default values, so that they stay defaults.
    settings = made.file.model_dump(exclude_defaults=True)
    settings["title"] = " ".join(part for part in (made.loaded.title, f"({note})" if note else "") if part)
    targets = (settings.get("target", {}), *settings.get("targets", {}).values())
    kept = {"stations": settings["stations"], **{f"target-{i + 1}": each for i, each in enumerate(targets)}}
    kept |= {f"constraint-{i + 1}": each for i, each in enumerate(settings.get("constraints", []))}
    copies: dict[Path, Path] = {}
    for role, section in kept.items():
        if "file" in section:
            copies |= _relocate(section, source.parent, out, role)
    tables = [out.with_name(f"{out.stem}-{i + 1}.csv") for i in range(len(made.tables))]
    claim(out, *copies, *tables, inputs=[source])
    with replace_together():
        for path, original in copies.items():
            with written(path) as file:
                file.write_bytes(read_bytes(original))
        for path, section, table in zip(tables, settings["measurements"], made.tables, strict=True):
            write_csv(path, _rows(made, table, z))
            for key in ("rows", "columns", "separator"):
                section.pop(key, None)
            section["file"] = path.name
        text = f"format = {made.file.format}\n" + toml_text({k: v for k, v in settings.items() if k != "format"})
        write_text(out, text)
    return [out, *copies, *tables]


def _relocate(section: dict[str, Any], folder: Path, out: Path, role: str) -> dict[Path, Path]:
    """Update the path of a table that is not written again, so that it is relative to the folder of the new file.

    `section` is the section that names the table, `folder` the folder of the old problem file, and `out` the new file.
    Return the copy and its original if the table is outside the new folder and must be copied; else an empty mapping.
    """
    path = folder / section["file"]
    section["file"] = os.path.relpath(path, out.parent)
    if Path(os.path.realpath(path)).is_relative_to(os.path.realpath(out.parent)):
        return {}
    # A problem file must not refer outside its folder, so copy the table into the folder.
    copy = out.with_name(f"{out.stem}-{role}{path.suffix}")
    section["file"] = copy.name
    return {copy: path}


def _rows(original: Draft, table: Table, z: Array) -> dict[str, Any]:
    """Return one table: its standard columns by their standard names, the values of all trials one below the other.

    `z` (trials, m) are the values in SI units; the table has the unit of the file.
    """
    trials = len(z)
    values = np.full((trials, table.count), np.nan)
    for chunk, number in zip(original.chunks, original.numbers, strict=True):
        if chunk.table is table:  # a table with several kinds has several chunks
            values[:, chunk.row] = chunk.unit.from_si(z[:, number] - chunk.baseline)
    known = {key: table.raw(key) for key in _COLUMNS if key != "z" and table.has(key)}
    columns: dict[str, Any] = {key: np.tile(column, trials) for key, column in known.items()}
    if trials > 1:  # each trial is an epoch; equal times would join the trials
        columns["epoch"] = np.repeat(np.arange(trials), table.count)
        columns.pop("time", None)
    return columns | {"z": values.ravel()}


def toml_text(settings: dict[str, Any], path: tuple[str, ...] = ()) -> str:
    """Return TOML text of settings: numbers and lists first, then tables.

    `path` has the names of the tables around these settings.
    """
    plain, tables = [], []
    for key, value in settings.items():
        name = (*path, key)
        # Tables of the first level get a header; deeper tables are inline, which TOML allows everywhere.
        if isinstance(value, dict) and len(path) < 1:
            tables.append(f"\n[{'.'.join(map(_key, name))}]\n" + toml_text(value, name))
        elif isinstance(value, list) and value and isinstance(value[0], dict) and not path:
            tables += [f"\n[[{_key(key)}]]\n" + toml_text(item, name) for item in value]
        elif value is not None:
            plain.append(f"{_key(key)} = {_value(value)}\n")
    return "".join([*plain, *tables])


def _key(name: str) -> str:
    """Return a key of TOML, in quotes if needed."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _value(value: Any) -> str:
    """Return a value of TOML on one line; numbers keep all their digits."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    # repr keeps all digits; JSON strings, booleans and integers are valid TOML.
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
