"""What ``optloc list`` prints: any table of entries that have a summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.units import UNITS
from optloc.cli.fixed import bar
from optloc.cli.output import dumps
from optloc.models import MODELS
from optloc.papers import Size, paper, planned, write
from optloc.papers import Table as PaperTable


def _kinds() -> list[dict[str, str]]:
    return [
        {
            "kind": name,
            "stations": str(model.stations),
            "dimensions": " ".join(str(d) for d in model.dimensions),
            "units": " ".join(UNITS[model.quantity]),  # type: ignore[index]  # models hold known quantities only
            "summary": model.summary,
        }
        for name, model in MODELS.items()
    ]


def _formulations() -> list[dict[str, str]]:
    from optloc.solvers.methods import FORMULATIONS

    return _entries("formulation", FORMULATIONS)


def _solvers() -> list[dict[str, str]]:
    from optloc.solvers.methods import SOLVERS
    from optloc.study.methods import backends

    found = {
        name: {"solver": name, "role": f"back end, {entry.kind}", "version": entry.version, "summary": entry.summary}
        for name, entry in backends().items()
    }
    return [*_entries("solver", SOLVERS), *found.values()]


def _methods() -> list[dict[str, str]]:
    from optloc.solvers.methods import METHODS

    return [{"method": name, "summary": stages} for name, stages in METHODS.items()]


def _baselines() -> list[dict[str, str]]:
    from optloc.study.baselines import BASELINES

    return _entries("baseline", BASELINES)


def _executors() -> list[dict[str, str]]:
    from optloc.study.execute import EXECUTORS

    return _entries("executor", EXECUTORS)


def _studies() -> list[dict[str, str]]:
    import tomllib

    from optloc.study.plan import shipped

    texts = {name: tomllib.loads(entry.read_text(encoding="utf-8")) for name, entry in shipped().items()}
    return [{"study": name, "summary": data.get("title", data["name"])} for name, data in texts.items()]


def _datasets() -> list[dict[str, str]]:
    from optloc.datasets import available
    from optloc.datasets.catalogue import ENTRIES

    here = available()
    return [
        {
            "dataset": name,
            "here": "yes" if name in here else "no",
            "licence": entry.licence,
            "summary": entry.description,
        }
        for name, entry in ENTRIES.items()
    ]


def _demos() -> list[dict[str, str]]:
    from optloc.cli.first_steps import titles

    return [{"demo": name, "summary": title} for name, title in titles().items()]


def _starters() -> list[dict[str, str]]:
    from optloc.cli.first_steps import starters

    return [{"starter": name, "summary": starter.summary} for name, starter in starters().items()]


def _entries(title: str, table: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return name and the text fields of every entry, its summary last."""
    rows = []
    for name, entry in table.items():
        names = getattr(type(entry), "__dataclass_fields__", {}) or {"summary": None}
        texts = {field: getattr(entry, field) for field in names if field != "summary"}
        shown = {field: _text(value) for field, value in texts.items() if _text(value) is not None}
        rows.append({title: name} | shown | {"summary": str(entry.summary)})
    return rows


def _text(value: Any) -> Any:
    if isinstance(value, bool | int | float | str):
        return str(value)
    if isinstance(value, tuple | list | frozenset | set) and all(isinstance(v, str | int) for v in value):
        return " ".join(str(v) for v in value)
    return None


LISTS: dict[str, Callable[[], list[dict[str, str]]]] = {
    "kinds": _kinds,
    "formulations": _formulations,
    "solvers": _solvers,
    "methods": _methods,
    "baselines": _baselines,
    "executors": _executors,
    "studies": _studies,
    "datasets": _datasets,
    "demos": _demos,
    "starters": _starters,
}


def run_list(what: str, as_json: bool) -> int:
    """Print one of the tables."""
    if what not in LISTS:
        raise InvalidProblem(f"there is no list of {what!r}", "list", nearest(what, LISTS))
    rows = LISTS[what]()
    if as_json:
        typer.echo(dumps(rows))
        return 0
    _print(rows, Console())
    return 0


def _print(rows: list[dict[str, str]], console: Console) -> None:
    """Print entries as a table, or one below the other where they are too long for one."""
    title, *names = dict.fromkeys(name for row in rows for name in row)
    if sum(max(len(row.get(name, "")) for row in rows) for name in names) > 4 * console.width:
        for row in rows:
            console.print(f"[bold]{row[title]}[/bold]: {row['summary']}", highlight=False)
            for name in names[:-1]:
                console.print(Padding(f"{name}: {row.get(name, '')}", (0, 0, 0, 4)), highlight=False)
        return
    table = Table()
    table.add_column(title, no_wrap=True)
    for name in names:
        table.add_column(name)
    for row in rows:
        table.add_row(row[title], *(row.get(name, "") for name in names))
    console.print(table)


# What ``optloc reproduce`` does.

SIZES: tuple[Size, ...] = ("quick", "full")


def run_reproduce(name: str, size: str, out: Path | None, seed: int, quiet: bool) -> int:
    """Make the tables and pictures of a paper again, print the tables, and return the exit code."""
    paper(name)
    chosen = next((known for known in SIZES if known == size), None)
    if chosen is None:
        raise InvalidProblem(f"there is no size {size!r}", "--size", nearest(size, SIZES))
    folder = Path(f"optloc-{name}") if out is None else out
    _usable(folder)
    plan = planned(name, chosen, seed)
    with bar(name, plan.work, quiet) as advance:
        report = plan.run(lambda: advance(1))
    written = write(report, folder)
    if not quiet:
        console = Console()
        for table in report.tables:
            console.print(_shown(table))
        console.print(f"{len(written)} files are in {folder}; begin with README.md.", highlight=False, markup=False)
    return 0


def _usable(folder: Path) -> None:
    """Make the folder before the work, so that a place that cannot be written is known at once."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidProblem(
            f"the folder cannot be made ({error.strerror or error})", str(folder), "choose another place"
        ) from None


def _shown(table: PaperTable) -> Table:
    shown = Table(title=table.title, title_justify="left", caption=table.note, caption_justify="left")
    for i, name in enumerate(table.header):
        shown.add_column(name, justify="right" if i else "left", overflow="fold")
    for row in table.rows:
        shown.add_row(*row)
    return shown
