"""The verb ``optloc plot``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optloc.cli.group import example
from optloc.cli.options import Method, Quiet, Verbose

WHAT = "fix, landscape, convergence, residuals, biases, bound, track or accuracy."


def _pictures() -> list[str]:
    from optloc.cli.pictures import PICTURES

    return list(PICTURES)


EXAMPLES = example(
    "optloc plot landscape site.toml",
    "optloc plot convergence demo --out story.svg",
    "optloc plot residuals flight.toml --out residuals.pdf",
    "optloc plot accuracy shootout-study",
)


def plot(
    what: Annotated[str, typer.Argument(metavar="WHAT", autocompletion=_pictures, help=WHAT)],
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Problem file, name of a shipped problem, or folder of a study.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Picture to write: .png, .svg or .pdf; WHAT.png by default.")
    ] = None,
    method: Method = "auto",
    epoch: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Epoch that is drawn, or case of a study; the first by default.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw a picture of a problem and its fix.

    fix: stations, fix, 95 % ellipse and alternatives. landscape: the cost over the place of the target. convergence:
    where iterations from many starts end. residuals: by station. biases: of a run against time, with 95 %. bound: map
    of the Cramer-Rao bound. track: of a run. accuracy: errors of a study's methods against the bound.
    """
    from optloc.cli.pictures import Asked, run_plot

    place = Path(f"{what}.png") if out is None else out
    raise typer.Exit(run_plot(what, Asked(file, place, method, epoch), quiet))
