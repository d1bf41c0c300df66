"""Write tables, and a problem file again with other measured values in the units and signs of its author."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import read_bytes
from optloc.base.types import Array
from optloc.files.reader import Draft, draft
from optloc.files.table import Table

# Columns of measurements that are written again; the others are of no meaning to optloc.
_COLUMNS = ("kind", "epoch", "time", "target", "a", "b", "z", "sigma", "weight", "correction")


def write_csv(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns as CSV, NaN as an empty cell; raise InvalidProblem where that fails."""
    import pyarrow as pa
    from pyarrow import csv

    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    try:
        csv.write_csv(table, path)
    except OSError as error:
        raise unwritable(path, error) from None


class GrowingTable:
    """A CSV file that grows row by row beside a table that is not finished: what a killed run had stays readable.

    Parameters
    ----------
    path : Path
        The table. Its rows stand in a file of this name with ``.partial`` behind it, each whole as soon as it is added.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.partial = path, path.with_name(f"{path.name}.partial")
        self.rows = 0

    def add(self, columns: Mapping[str, Any]) -> None:
        """Add rows, the same columns each time; raise InvalidProblem where that fails."""
        import pyarrow as pa
        from pyarrow import csv

        table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
        lines = BytesIO()
        csv.write_csv(table, lines, csv.WriteOptions(include_header=not self.rows))
        try:
            # one write without a buffer: whenever the run is killed, whole lines are there
            with self.partial.open("ab" if self.rows else "wb", buffering=0) as file:
                file.write(lines.getvalue())
        except OSError as error:
            raise unwritable(self.partial, error) from None
        self.rows += table.num_rows

    def finish(self) -> None:
        """Give the file the name of the table; raise InvalidProblem where that fails."""
        try:
            self.partial.replace(self.path)
        except OSError as error:
            raise unwritable(self.path, error) from None

    def discard(self) -> None:
        """Remove the file: the table stands in another form."""
        self.partial.unlink(missing_ok=True)


def unwritable(path: Path, error: OSError) -> InvalidProblem:
    """Return what is said of a file that cannot be written."""
    return InvalidProblem(f"the file cannot be written ({error.strerror or error})", str(path), "choose another place")


def write_measured(source: Path, out: Path, z: Array, note: str = "") -> list[Path]:
    """Write a problem file with other measured values.

    Parameters
    ----------
    source : Path
        Problem file to begin with.
    out : Path
        Problem file to write; the rows go to CSV files beside it.
    z : array (trials, m)
        Measured values of all rows in SI units, in the order of the problem. Several trials become epochs.
    note : str
        Remark behind the title.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    InvalidProblem
        Where trials cannot become epochs, or a file cannot be written.
    """
    made = draft(source, values=False)
    if len(z) > 1 and (made.loaded.problem.epochs > 1 or made.moving):
        advice = "draw once for each file, with another seed"
        raise InvalidProblem("several trials of a run of epochs do not fit one file", str(out), advice)
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("a simulation is written as a problem file", str(out), "let its name end in .toml")
    # What the author left out stays out, and takes the same defaults again.
    settings = made.file.model_dump(exclude_defaults=True)
    settings["title"] = " ".join(part for part in (made.loaded.title, f"({note})" if note else "") if part)
    written = [out]
    kept = (settings["stations"], settings.get("target", {}), *settings.get("targets", {}).values())
    for i, section in enumerate(kept):
        if "file" in section:
            written += _keep(section, source.parent, out, "stations" if i == 0 else f"target-{i}")
    for i, (section, table) in enumerate(zip(settings["measurements"], made.tables, strict=True)):
        path = out.with_name(f"{out.stem}-{i + 1}.csv")
        write_csv(path, _rows(made, table, z))
        for key in ("rows", "columns", "separator"):
            section.pop(key, None)
        section["file"] = path.name
        written.append(path)
    try:
        out.write_text("format = 1\n" + _toml({k: v for k, v in settings.items() if k != "format"}), encoding="utf-8")
    except OSError as error:
        raise unwritable(out, error) from None
    return written


def _keep(section: dict[str, Any], folder: Path, out: Path, role: str) -> list[Path]:
    """Let a section name a table that is not written again, and return the copy of it if one is needed."""
    path = folder / section["file"]
    section["file"] = os.path.relpath(path, out.parent)
    if Path(os.path.realpath(path)).is_relative_to(os.path.realpath(out.parent)):
        return []
    # A problem file names nothing beyond its folder: what is elsewhere is copied beside it.
    copy = out.with_name(f"{out.stem}-{role}{path.suffix}")
    section["file"] = copy.name
    try:
        copy.write_bytes(read_bytes(path))
    except OSError as error:
        raise unwritable(copy, error) from None
    return [copy]


def _rows(made: Draft, table: Table, z: Array) -> dict[str, Any]:
    """Return one table: its known columns under their own names, the values of each trial below each other."""
    trials = len(z)
    values = np.full((trials, table.count), np.nan)
    for chunk, number in zip(made.chunks, made.numbers, strict=True):
        if chunk.table is table:
            values[:, chunk.row] = chunk.unit.from_si(z[:, number] - chunk.baseline)
    known = {key: table.raw(key) for key in _COLUMNS if key != "z" and table.has(key)}
    columns: dict[str, Any] = {key: np.tile(column, trials) for key, column in known.items()}
    if trials > 1:  # each trial is an epoch, whose time would only say that all are one
        columns["epoch"] = np.repeat(np.arange(trials), table.count)
        columns.pop("time", None)
    return columns | {"z": values.ravel()}


def _toml(settings: dict[str, Any], path: tuple[str, ...] = ()) -> str:
    """Return TOML: numbers and lists first, then tables."""
    plain, tables = [], []
    for key, value in settings.items():
        name = (*path, key)
        # Tables of the first level get a header; deeper ones are written inline, which TOML allows everywhere.
        if isinstance(value, dict) and len(path) < 1:
            tables.append(f"\n[{'.'.join(map(_key, name))}]\n" + _toml(value, name))
        elif isinstance(value, list) and value and isinstance(value[0], dict) and not path:
            tables += [f"\n[[{_key(key)}]]\n" + _toml(item, name) for item in value]
        elif value is not None:
            plain.append(f"{_key(key)} = {_value(value)}\n")
    return "".join([*plain, *tables])


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    # repr keeps every digit; JSON spells strings, booleans and whole numbers as TOML does.
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
