"""``optloc reproduce``: simulations of a paper, repeated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer
from rich.table import Table

from optloc.cli import Force, Quiet, Screen, Verbose, choice, example, name_in
from optloc.files import claim, make_folder
from optloc.problem import InvalidProblem, nearest

EXAMPLES = example("optloc reproduce registration", "optloc reproduce registration --size full --out tables")


def reproduce(
    name: Annotated[str, name_in("papers", "Paper")],
    size: Annotated[str, choice("quick|full", "Two minutes, or the sample sizes of the paper.", "--size")] = ("quick"),
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of tables and pictures; optloc-NAME by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Repeat the simulations of a paper: tables and pictures with printed value, reproduced value and bound."""
    raise typer.Exit(_run(name, size, out, seed, quiet))


def _run(name: str, size: str, out: Path | None, seed: int, quiet: bool) -> int:
    """Repeat the simulations of a paper, print the tables, and return the exit code."""
    from optloc.cli import bar, say
    from optloc.lab.papers import Size, paper, reproduction, write

    paper(name)
    if size not in get_args(Size):
        raise InvalidProblem(f"there is no size {size!r}", "--size", nearest(size, get_args(Size)))
    folder = Path(f"optloc-{name}") if out is None else out
    # The folder is created before the work, so that a folder that is not writable is reported at once.
    make_folder(folder)
    claim(folder / "README.md")
    ready = reproduction(name, cast(Size, size), seed)
    with bar(name, ready.work, quiet) as advance:
        report = ready.run(lambda: advance(1))
    written = write(report, folder)
    console = Screen(quiet=quiet)
    for found in report.tables:
        table = Table(title=found.title, title_justify="left", caption=found.note, caption_justify="left")
        for i, heading in enumerate(found.header):
            table.add_column(heading, justify="right" if i else "left", overflow="fold")
        for row in found.rows:
            table.add_row(*row)
        console.print(table)
    say(console, f"{len(written)} files are in {folder}; read README.md first.")
    return 0
