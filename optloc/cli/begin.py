"""The commands of the first minutes: demo, new, convert."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optloc.cli.app import FIRST, app
from optloc.cli.group import example
from optloc.cli.options import Json, Quiet, Verbose, names


@app.command(
    rich_help_panel=FIRST, epilog=example("optloc demo", "optloc demo ambiguous --plot two.png", "optloc list demos")
)
def demo(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            autocompletion=names("demos"),
            help="A shipped problem: demo, ambiguous, run, registration.",
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Where to draw the fix; optloc-demo.png by default.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Walk through a fix, a registration and a proof; or fix one shipped problem."""
    from optloc.cli.demo import run_demo

    raise typer.Exit(run_demo(name, plot, as_json=as_json, quiet=quiet))


@app.command(
    rich_help_panel=FIRST,
    epilog=example("optloc new tdoa", "optloc new satellites --out site.toml", "optloc list starters"),
)
def new(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            autocompletion=names("starters"),
            help="A measurement kind (tdoa, range, ...) or a common mixture; see [bold]optloc list starters[/bold].",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="OUT.toml", help="File to write; standard output by default.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over a file that exists.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a problem file with comments that can be fixed as it is, to begin with."""
    from optloc.cli.starters import run_new

    raise typer.Exit(run_new(kind, out, force=force, quiet=quiet))


@app.command(
    rich_help_panel=FIRST,
    epilog=example(
        "optloc convert toa.csv --stations sites.geojson --sigma '20 ns' --out a.toml",
        "optloc convert log.csv --column time=when --stations rx.csv --sigma '6 m' --out b.toml",
        "optloc convert gnss.csv --column pseudorange=C1C --sigma '3 m' --out gnss.toml",
        "optloc convert sites.geojson --out stations.csv",
    ),
)
def convert(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Arrival times or pseudoranges (CSV, Parquet), or GeoJSON stations.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="OUT.toml", help="Problem file to write; its tables go to CSV files beside it.")
    ],
    stations: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the stations are: GeoJSON, CSV or Parquet.")
    ] = None,
    sigma: Annotated[
        str | None, typer.Option(metavar="AMOUNT", help="Error of each row: '20 ns', '6 m', or estimate.")
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=NAME",
            help="Column of a role that its name does not tell: message, station, time; epoch, satellite, x, y, z, "
            "pseudorange; name, lat, lon, height. Give it once for each; message=set+msg joins two columns.",
        ),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", help="Of the values; by default what the column's name ends in.")
    ] = None,
    as_: Annotated[
        str | None,
        typer.Option("--as", metavar="WHAT", help="arrivals, pseudoranges or stations, where columns do not tell."),
    ] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="cartesian|ecef", help="Frame of stations in x, y, z; cartesian by default.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Read a table of arrival times or pseudoranges, or GeoJSON stations, into a problem file."""
    from optloc.cli.converting import run_convert

    options = {"stations": stations, "sigma": sigma, "unit": unit, "what": as_, "frame": frame}
    raise typer.Exit(run_convert(file, out, column or [], as_json=as_json, quiet=quiet, **options))
