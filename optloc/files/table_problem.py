"""A measurement table as a problem: its interpretation, and the equivalent problem file with CSV tables."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import replace_together, write_text
from optloc.base.types import Array
from optloc.files.cell_text import Decimals
from optloc.files.constraint_table import ConstraintTable
from optloc.files.reader import Loaded, assemble
from optloc.files.roles import ColumnPlaces
from optloc.files.schema import document_of
from optloc.files.table import Table
from optloc.files.words import Words
from optloc.files.writer import write_csv

# Options by the key of a problem file that they become.
_KEYS = {
    "sigma": "--sigma",
    "unit": "--unit",
    "wind": "--wind",
    "propagation_speed": "--wave-speed",
    "two_way": "--turn-around",
    "turn_around": "--turn-around",
}
# Largest number of characters in the name of a temporary file.
_LETTERS = 40


@dataclass(frozen=True, slots=True)
class Section:
    """One table of measurements in a problem file.

    kind: measurement kind. columns: columns (m,) by name. unit: unit of the values. sigma: standard deviation as text,
    or None if it is a column. text: description of the readings. lines: further lines of the section.
    """

    kind: str
    columns: Mapping[str, Any]
    unit: str
    sigma: str | None
    text: str
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class TableProblem:
    """The interpretation of a measurement table, before anything is written.

    Parameters
    ----------
    source : Path
        The table.
    sections : tuple of Section
        The measurements.
    places : ColumnPlaces
        The stations.
    about : tuple of (str, str)
        Report for the user: keyword and text.
    notes : tuple of str
        Assumptions, and data that were left out.
    lines : tuple of str
        Further lines of the problem file, before its tables.
    after : tuple of str
        Further lines of the problem file, after its tables.
    height : str
        Line of the constraint on the height, or empty.
    uses : mapping of str to str
        Role of each used column.
    frame : tuple of str
        Lines of the frame; empty for the frame of the stations.
    events : mapping of str to array (n,)
        Columns epoch, time and target of all n rows of the table, also of rows without a reading.
    """

    source: Path
    sections: tuple[Section, ...]
    places: ColumnPlaces
    about: tuple[tuple[str, str], ...]
    notes: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    height: str = ""
    uses: Mapping[str, str] = field(default_factory=dict)
    frame: tuple[str, ...] = ()
    events: Mapping[str, Any] = field(default_factory=dict)

    @property
    def as_read(self) -> dict[str, Any]:
        """Return the interpretation of the table as a JSON value.

        It has the unit of the stations if results in it are expected: not metres, and not on Earth.
        """
        pairs = [list(pair) for pair in self.about]
        other = self.places.unit if self.places.frame == "cartesian" and self.places.unit != "m" else None
        found = {"understood": pairs, "notes": list(self.notes), "columns": dict(self.uses)}
        return found if other is None else found | {"unit": other}

    def read(self, more: Mapping[str, ConstraintTable] | None = None) -> Loaded:
        """Return the problem, equal to the problem that `read` returns for the written files.

        `more` has constraints by their place for messages, such as "--height".
        """
        # Use the name of the table, limited to characters that are valid on all systems.
        out = Path(f"{re.sub(r'[^A-Za-z0-9_-]', '_', self.source.stem)[:_LETTERS]}.toml")
        names = [path.name for path in self.tables(out)]
        # A stated height, also above a terrain, replaces an assumed one.
        level = any(table.kind in ("height", "terrain") for table in (more or {}).values())
        chosen = replace(self, height="") if level else self
        # As in a file, replace characters that are not valid Unicode.
        text = chosen.text(names).encode("utf-8", "replace").decode("utf-8")
        file = document_of(text, out.name)
        sheets = (self.places.columns, *(section.columns for section in self.sections))
        stations, *tables = (_table(name, columns) for name, columns in zip(names, sheets, strict=True))
        try:
            made = assemble(file, stations, tables, out.name, values=True, more=more)
            loaded = replace(made, loaded=replace(made.loaded, source=self.source.name)).plausible("table")
        except InvalidProblem as error:
            raise InvalidProblem(error.what, self._place(error.where, out.name, names), error.advice) from None
        # of S minus P, the report names the speeds of both waves
        speed = loaded.speed if any(word == "wave" for word, _ in self.about) else ""
        return replace(loaded, table=self.as_read, speed=speed)

    def _place(self, where: str | None, file: str, names: Sequence[str]) -> str | None:
        """Return the place of an error for the user of the table: an option, or the table.

        The problem file `file` and its tables `names` are not on the disk. The rows of a table were rearranged, so its
        numbers of rows are left out.
        """
        if where is None or not where.startswith((file, *names)):
            return where
        option = next((option for key, option in _KEYS.items() if where.endswith(f"key '{key}'")), None)
        if option is not None:
            return option
        if where.startswith(names[0]):
            return where.replace(names[0], self.places.source or f"stations of {self.source.name}", 1)
        return self.source.name

    def write(self, out: Path) -> tuple[Path, ...]:
        """Write a problem file and its tables, and return their paths."""
        tables = self.tables(out)
        with replace_together():
            for path, columns in zip(tables, (self.places.columns, *(s.columns for s in self.sections)), strict=True):
                write_csv(path, {name: _written(column) for name, column in columns.items()})
            write_text(out, self.text([path.name for path in tables]))
        return (out, *tables)

    def tables(self, out: Path) -> tuple[Path, ...]:
        """Return the paths of the tables of a problem file: stations, then the rows of each kind."""
        many = len(self.sections) > 1
        names = ("stations", *(section.kind if many else "rows" for section in self.sections))
        return tuple(out.with_name(f"{out.stem}-{name}.csv") for name in names)

    def text(self, names: Sequence[str]) -> str:
        """Return the text of the problem file; `names` are the names of its tables."""
        # JSON and TOML strings agree, except for escapes of characters beyond 16 bits; do not escape them.
        quoted = partial(json.dumps, ensure_ascii=False)
        lines = [f"# Made from {quoted(self.source.name)} by optloc convert.", "format = 2"]
        frame = self.frame or (f'kind = "{self.places.frame}"',)
        lines += [f"title = {quoted(self.source.stem)}", *self.lines, "", "[frame]", *frame]
        lines += ["", "[stations]", f"file = {quoted(names[0])}", f'unit = "{self.places.unit}"']
        for section, name in zip(self.sections, names[1:], strict=True):
            lines += ["", "[[measurements]]", f'kind = "{section.kind}"                         # {section.text}']
            lines += [f"file = {quoted(name)}", f'unit = "{section.unit}"', *section.lines]
            lines += [f"sigma = {quoted(section.sigma)}"] if section.sigma is not None else []
        lines += [*self.after, *(["", "[[constraints]]", 'kind = "height"', self.height] if self.height else [])]
        return "\n".join(lines) + "\n"


def _written(column: Any) -> Any:
    """Return a column in the form for a file: decimals as text with all their digits."""
    return column.texts() if isinstance(column, Decimals) else column


def _table(name: str, columns: Mapping[str, Any]) -> Table:
    """Return columns as the table that a reader of the file would return.

    Times become text, since they may be labels.
    """
    import pyarrow as pa

    def read(key: str, column: Any) -> Array | Words:
        """Return a column as the reader of a CSV file would return it."""
        if isinstance(column, Decimals):
            return column.floats()
        if key == "time":
            return np.asarray(pa.array(column).cast(pa.string()).to_numpy(zero_copy_only=False))
        return column if isinstance(column, Words) else np.asarray(column)

    read_columns = {key: read(key, column) for key, column in columns.items()}
    return Table(name, read_columns, len(read_columns[next(iter(read_columns))]))


@dataclass(frozen=True, slots=True)
class Converted:
    """The result of a conversion.

    written: written files. loaded: problem that they contain, None for stations alone. notes: assumptions, and data
    that were left out. as_read: interpretation of the table as a JSON value.
    """

    written: tuple[Path, ...]
    loaded: Loaded | None
    notes: tuple[str, ...] = ()
    as_read: Mapping[str, Any] = field(default_factory=dict)


def no_sigma(example: str, rows: str = "rows") -> InvalidProblem:
    """Return the error for a table without standard deviations.

    `example` is a value for --sigma, and `rows` is the kind of the readings; "rows" if there is one kind.
    """
    advice = f"state it with --sigma '{example}' (or metres); --sigma estimate finds it from many epochs"
    what = "the rows" if rows == "rows" else f"the readings of {rows}"
    return InvalidProblem(f"the accuracy of {what} is unknown", "--sigma", advice)
