"""Command line and kernel list of this package: `optloc place` and `optloc calibrate`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from optloc.cli import (
    ANSWERS,
    AmbiguityDraws,
    Budget,
    Choose,
    Costs,
    Criterion,
    Extension,
    FailOne,
    Force,
    Json,
    KernelPart,
    Outside,
    PlacementMap,
    PlaceOfInterest,
    ProblemPath,
    Quiet,
    Verbose,
    example,
)
from optloc.sites.commands.calibrate import NETWORKS, calibrate

_PLACE = example(
    "optloc place sites.toml -k 6 --worst --fail-one --plot map.png --out chosen.toml",
    "optloc place site.toml -k 4 --at 1200,800,50",
)


def place(
    file: ProblemPath,
    choose: Choose = None,
    budget_: Costs = None,
    criterion: Criterion = None,
    worst: Annotated[
        bool | None, typer.Option("--worst/--mean", help="Use the worst place, or the mean of all places.")
    ] = None,
    fail_one: FailOne = None,
    gap: Annotated[
        float | None, typer.Option(metavar="SHARE", help="Stop at this relative gap between value and bound.")
    ] = None,
    time: Annotated[float | None, typer.Option(metavar="SECONDS", help="Time limit of the search.")] = None,
    at: PlaceOfInterest = None,
    rows: Annotated[bool, typer.Option("--rows", help="Choose single measurements instead of stations.")] = False,
    draws: AmbiguityDraws = 20,
    out: Annotated[
        Path | None, typer.Option(metavar="OUT.toml", help="Write a problem file with the chosen stations.")
    ] = None,
    plot: PlacementMap = None,
    as_json: Json = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Choose the best station sites from a list of candidates, with a proven bound for any other choice.

    FILE is a selection file (choice, candidates, targets), or a problem file. The stations of a problem file are
    the candidates.
    """
    from optloc.sites.commands.place import PlaceOptions, run_place

    wanted = PlaceOptions(choose, budget_, criterion, worst, fail_one, gap, time, at, rows, draws)
    raise typer.Exit(run_place(file, wanted, plot=plot, out=out, as_json=as_json, quiet=quiet))


def _commands(app: typer.Typer) -> None:
    """Add the commands `place` and `calibrate` to the command line."""
    app.command(rich_help_panel=ANSWERS, epilog=_PLACE)(place)
    app.command(rich_help_panel=ANSWERS, epilog=example(*NETWORKS))(calibrate)


def _kernels() -> Mapping[str, KernelPart]:
    """Return the compiled functions of this package, with an example that calls them."""
    entries = (
        *(f"optloc.sites.placement.branching.{name}" for name in ("propagate", "expand", "score", "settle")),
        "optloc.sites.placement.completions.exhaust",
    )
    return {"placements": KernelPart("placements of stations", "optloc.sites.placement", (_place,), entries)}


def _place() -> None:
    """Run a small placement that calls, and so compiles, all compiled functions of this package."""
    from optloc.cli import TARGET, problem_of
    from optloc.sites.placement import SiteSelection, place as chosen

    # one criterion is enough: the criteria differ in argument values, not in types
    chosen(SiteSelection(problem_of("toa"), TARGET[None], choose=4, gap=0.5))


EXTENSION = Extension(_commands, kernels=_kernels)
