"""The commands that make papers again and list what there is: reproduce, list, schema."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optloc.cli.app import MORE, app
from optloc.cli.group import example
from optloc.cli.options import Json, Quiet, Verbose


@app.command(
    rich_help_panel=MORE,
    epilog=example("optloc reproduce registration", "optloc reproduce registration --size full --out tables"),
)
def reproduce(
    name: Annotated[
        str,
        typer.Argument(metavar="PAPER", help="Name of a paper: angles, bistatic, kinematic, registration, satellites."),
    ],
    size: Annotated[str, typer.Option(metavar="quick|full", help="Two minutes, or the sample sizes of the paper.")] = (
        "quick"
    ),
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where tables and pictures go; optloc-PAPER by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Decides all draws.")] = 1,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make the simulations of a paper again: tables and pictures with printed value, reproduced value and bound."""
    from optloc.cli.reproduce import run_reproduce

    raise typer.Exit(run_reproduce(name, size, out, seed, quiet))


def _tables() -> list[str]:
    from optloc.cli.listing import LISTS

    return list(LISTS)


@app.command(
    "list", rich_help_panel=MORE, epilog=example("optloc list kinds", "optloc list methods", "optloc list starters")
)
def list_(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            autocompletion=_tables,
            help="kinds, formulations, solvers, methods, baselines, executors, studies, datasets, demos or starters.",
        ),
    ],
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """List measurement kinds, methods, solvers with the back ends found here, and everything else that has a name."""
    from optloc.cli.listing import run_list

    raise typer.Exit(run_list(what, as_json))


@app.command(rich_help_panel=MORE, epilog=example("optloc schema > optloc.schema.json"))
def schema(verbose: Verbose = False) -> None:
    """Print the JSON schema of problem files, from which editors complete and check them."""
    from optloc.cli.output import dumps
    from optloc.files import schema as of_files

    typer.echo(dumps(of_files()))
