"""What ``optloc reproduce`` does."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table as Shown

from optloc.cli.fixing import bar
from optloc.errors import InvalidProblem, nearest
from optloc.papers import Size, Table, paper, planned, write

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


def _shown(table: Table) -> Shown:
    shown = Shown(title=table.title, title_justify="left", caption=table.note, caption_justify="left")
    for i, name in enumerate(table.header):
        shown.add_column(name, justify="right" if i else "left", overflow="fold")
    for row in table.rows:
        shown.add_row(*row)
    return shown
