"""The command ``optloc list``: tables of all named entries, made from the descriptions of the entries."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import UNITS
from optloc.cli.extensions import Rows, extensions
from optloc.cli.output import Screen, dumps
from optloc.models import MODELS

# A table may wrap over this number of console widths. Longer entries are easier to read as paragraphs.
_MAX_WRAPS = 4


def run_list(what: str, as_json: bool) -> int:
    """Print the list with the name `what`, and return the exit code."""
    known = lists()
    if what not in known:
        raise InvalidProblem(f"there is no list of {what!r}", "list", nearest(what, known))
    rows = known[what]()
    if as_json:
        typer.echo(dumps(rows))
        return 0
    _print(rows, Screen())
    return 0


def _print(rows: Rows, console: Console) -> None:
    """Print the entries as a table, or as paragraphs if they are too long."""
    # Entries of one table may have different fields: use all fields, in the order of their first occurrence.
    title, *names = dict.fromkeys(name for row in rows for name in row)
    widths = [max(len(row.get(name, "")) for row in rows) for name in names]
    # A table must also hold the longest word of each column; three characters separate two columns.
    texts = {name: " ".join([name, *(row.get(name, "") for row in rows)]) for name in names}
    words = {name: max(map(len, text.split())) for name, text in texts.items()}
    least = max(len(row[title]) for row in rows) + sum(words.values()) + 3 * len(names) + 4
    # Paragraphs: the table needs too many lines for each entry, or is wider than the screen.
    if sum(widths) > _MAX_WRAPS * console.width or least > console.width:
        for row in rows:
            console.print(Text.assemble((row[title], "bold"), f": {row['summary']}"), highlight=False)
            for name in (each for each in names if each != "summary" and row.get(each)):
                console.print(Padding(f"{name}: {row[name]}", (0, 0, 0, 4)), highlight=False)
        return
    table = Table()
    table.add_column(title, no_wrap=True)
    for name in names:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(row[title], *(row.get(name, "") for name in names))
    console.print(table)


# An entry shows its fields of text and numbers, and its summary at the end.


def describe(title: str, table: Mapping[str, Any]) -> Rows:
    """Return name, text fields and summary of each entry of a registry.

    `title` is the name of the first column. Entries of `table` that are dataclasses show their fields of text and
    numbers; code is left out. The summary is a field, the first line of a docstring, or the entry if it is text.
    """
    rows = []
    for name, entry in table.items():
        fields = [field for field in getattr(entry, "__dataclass_fields__", {}) if field not in ("name", "summary")]
        texts = {field: _spell(getattr(entry, field)) for field in fields}
        shown = {field: text for field, text in texts.items() if text}
        rows.append({title: name} | shown | {"summary": _summary(entry)})
    return rows


def _spell(value: Any) -> str | None:
    """Return a value of an entry as text; None for code and other values that are not text or numbers."""
    if isinstance(value, bool | int | float | str):
        return str(value)
    if isinstance(value, tuple | list | frozenset | set | Mapping) and all(isinstance(v, str | int) for v in value):
        return " ".join(str(v) for v in value)
    return None


def _summary(entry: Any) -> str:
    """Return the summary of an entry: its text, its field `summary`, or the first line of its docstring."""
    if isinstance(entry, str):
        return entry
    return str(
        getattr(entry, "summary", "") or (inspect.getdoc(entry) or "").partition("\n")[0].removeprefix("Return ")
    )


def registry(title: str, place: str) -> Callable[[], Rows]:
    """Return a function that returns the rows of a list, for a table or the result of a function.

    `title` is the name of the first column. The function imports `place`, "module:name", when it is called.
    """

    def rows() -> Rows:
        """Return the rows of the list."""
        module, _, name = place.partition(":")
        found = getattr(import_module(module), name)
        return describe(title, found() if callable(found) else found)

    return rows


def _kinds() -> Rows:
    """Return the rows of the list of measurement kinds."""
    return [
        {
            "kind": name,
            "also called": ", ".join(model.aliases),
            "stations": str(model.stations),
            "dimensions": " ".join(str(d) for d in model.dimensions),
            "units": " ".join(UNITS[model.quantity]),  # type: ignore[index]  # models hold known quantities only
            "summary": model.summary,
        }
        for name, model in MODELS.items()
    ]


def _constraints() -> Rows:
    """Return the rows of the list of constraints, with the keys of their tables and an example of the option."""
    from optloc.files.constraint_kinds import kind_names, kind_of

    found = {name: kind for name in kind_names() if (kind := kind_of(name)) is not None}
    return [
        {
            "constraint": name,
            "keys": " ".join(kind.keys),
            "example": f"--constraint '{kind.example}'" if kind.example else "",
            "summary": kind.summary,
        }
        for name, kind in found.items()
    ]


def _solvers() -> Rows:
    """Return the rows of the list of solvers, and of the installed back ends."""
    from optloc.solvers.back_ends import backends
    from optloc.solvers.methods import SOLVERS

    # Back ends of the relaxations come from installed packages, found at run time.
    found = {
        name: {"solver": name, "role": f"back end, {entry.kind}", "version": entry.version, "summary": entry.summary}
        for name, entry in backends().items()
    }
    return [*describe("solver", SOLVERS), *found.values()]


_LISTS: dict[str, Callable[[], Rows]] = {
    "kinds": _kinds,
    "constraints": _constraints,
    "formulations": registry("formulation", "optloc.solvers:FORMULATIONS"),
    "solvers": _solvers,
    "methods": registry("method", "optloc.solvers:METHODS"),
    "losses": registry("loss", "optloc.problem:LOSSES"),
    "trackers": registry("tracker", "optloc.tracking:UPDATES"),
    "motions": registry("motion", "optloc.tracking.named_models:MOTIONS"),
    "formats": registry("format", "optloc.show.formats:FORMATS"),
    "pictures": registry("picture", "optloc.cli.pictures:pictures"),
    "demos": registry("demo", "optloc.cli.starters:titles"),
    "starters": registry("starter", "optloc.cli.starters:starters"),
}


def lists() -> dict[str, Callable[[], Rows]]:
    """Return the functions of all lists by name; `optloc list` and the shell completion use them."""
    return {**_LISTS, **{name: rows for one in extensions() for name, rows in one.lists.items()}}
