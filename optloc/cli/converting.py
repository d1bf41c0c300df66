"""What ``optloc convert`` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from optloc.cli.output import dumps, write_text
from optloc.convert import Converted, convert
from optloc.errors import InvalidProblem


def run_convert(file: Path, out: Path, column: list[str], *, as_json: bool, quiet: bool, **options: Any) -> int:
    """Convert a file, say what was made of it, and return the exit code."""
    columns = {}
    for pair in column:
        role, sign, name = pair.partition("=")
        if not (role and sign and name):
            raise InvalidProblem(f"{pair!r} names no column", "--column", "write ROLE=NAME, such as station=receiver")
        columns[role] = name
    found = convert(file, out, columns=columns, **options)
    if as_json:
        write_text(Path("-"), dumps(_record(found)))
    elif not quiet:
        _show(found, Console(), out)
    return 0


def _record(found: Converted) -> dict[str, Any]:
    about = {"files": [str(path) for path in found.written], "notes": list(found.notes)}
    if found.loaded is None:
        return about
    problem = found.loaded.problem
    return about | {"stations": problem.stations.count, "epochs": problem.epochs, "rows": problem.count}


def _show(found: Converted, console: Console, out: Path) -> None:
    for note in found.notes:
        console.print(f"{note[0].upper()}{note[1:]}.", highlight=False, markup=False, soft_wrap=True)
    if found.loaded is None:
        line = f'{out} is a table of stations: name it in a problem file, [stations] file = "{out.name}".'
    else:
        problem = found.loaded.problem
        held = f"{problem.count} rows of {problem.epochs} epochs at {problem.stations.count} stations"
        line = f"{', '.join(str(path) for path in found.written)}: {held}. Next: optloc check {out}."
    console.print(line, highlight=False, markup=False, soft_wrap=True)
