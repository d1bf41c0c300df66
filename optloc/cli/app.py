"""The commands of ``optloc`` with their arguments and help; what each does is in the module that it calls."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from optloc.cli.doctor import doctor
from optloc.cli.extensions import PictureRequest, extensions
from optloc.cli.from_table import EXAMPLES as CONVERSIONS, convert, table_told, takes_table
from optloc.cli.options import (
    ANSWERS,
    EXIT_CODES,
    FIRST,
    MORE,
    AboveGround,
    Allow,
    Box,
    Budget,
    CommandGroup,
    EmitterCount,
    Explain,
    FalseRows,
    Force,
    Geodetic,
    Height,
    Html,
    Json,
    LateFromData,
    MapExtent,
    MapHeight,
    MapPath,
    Method,
    NoiseFromData,
    Out,
    Outside,
    Plot,
    ProblemPath,
    Quiet,
    RescaleNoise,
    SearchRegion,
    SeenShare,
    SimulatedFixes,
    StatusShares,
    TrackGap,
    TruePlace,
    TrueVelocity,
    Verbose,
    allowed,
    constraints,
    example,
    find_problem,
    name_in,
    run_process,
)

# Heavy libraries are imported inside the commands, so that --help answers at once.

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,  # a mistake of optloc shows its whole traceback
    help="Position fixes from time, gain, angle and Doppler measurements, with covariance and verdict.",
    epilog=f"{EXIT_CODES} With --install-completion the Tab key completes commands, options and their values.\n\n"
    + example("optloc demo", "optloc new tdoa --out site.toml", "optloc fix site.toml --plot fix.png"),
)


def main() -> None:
    """Run the command line."""
    run_process(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        try:
            typer.echo(f"optloc {version('optloc')}")
        except PackageNotFoundError:
            typer.echo("optloc 0 (not installed)")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    plugin: Annotated[
        list[str] | None,
        typer.Option(metavar="MODULE", help="Run a Python file or module first that adds kinds, losses, solvers."),
    ] = None,
) -> None:
    import os
    import sys

    import numpy as np

    from optloc.base.registry import load_plugin

    # Who looks on sees answers at once. Elsewhere, and in studies, nothing is left running that nobody asked for.
    if sys.stderr is not None and sys.stderr.isatty() and context.invoked_subcommand != "study":
        os.environ.setdefault("OPTLOC_COMPILE", "child")
    # What has no value is judged, and its status says so; a warning of NumPy beside it would tell nobody anything.
    context.with_resource(np.errstate(all="ignore"))
    for name in plugin or ():
        load_plugin(name)


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc fix site.toml",
        "optloc fix flight.toml --out fixes.csv",
        "optloc fix flight.toml --out fixes.kml",
        "optloc fix site.toml --html map.html",
        "optloc fix site.toml --json | jq .fixes",
        "optloc fix site.toml --height '1640 ft'",
        "optloc fix toa.csv --stations sites.csv --sigma '20 ns'",
    ),
)
@takes_table
def fix(
    file: ProblemPath,
    method: Method = "auto",
    as_json: Json = False,
    geojson: Annotated[Path | None, typer.Option(metavar="OUT", help="Write GeoJSON; - is standard output.")] = None,
    plot: Plot = None,
    out: Out = None,
    html: Html = None,
    height: Height = None,
    above_ground: AboveGround = False,
    box: Box = None,
    noise: NoiseFromData = None,
    rescale: RescaleNoise = False,
    late: LateFromData = False,
    explain: Explain = False,
    allow: Allow = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Fix the target of a problem file, or of a table of readings, at every epoch if there are several.

    Options such as --height add to the constraints of the file. A table needs --stations and --sigma.
    """
    from optloc.cli.fix import run_fix

    more, passing = constraints(height, above_ground, box), allowed(allow)
    files = {"geojson_path": geojson, "plot": plot, "out": out, "html": html}
    code = run_fix(
        file,
        method,
        more,
        as_json=as_json,
        **files,
        quiet=quiet,
        noise=noise,
        rescale=rescale,
        late=late,
        explain=explain,
        allow=passing,
        table=table_told(file, given),
    )
    raise typer.Exit(code)


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc track flight.toml --out track.csv --plot track.png",
        "optloc track flight.toml --model csm --noise 30 --filter ekf",
        "optloc track flight.toml --json | jq '.scans[-1]'",
        "optloc track messages.csv --stations sites.csv --sigma '20 ns'",
    ),
)
@takes_table
def track(
    file: ProblemPath,
    model: Annotated[str, name_in("motions", "How the target moves, such as cv or csm", "--model")] = "cv",
    filter_: Annotated[str, name_in("trackers", "How a scan updates the state", "--filter")] = "iekf",
    loss: Annotated[str | None, name_in("losses", "Weigh the rows of a scan by a robust loss", "--loss")] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            metavar="SD",
            help="Standard deviation, SI units, of what drives the target, or csm's largest acceleration; by default "
            "what [bold]optloc list motions[/bold] says.",
        ),
    ] = None,
    memory: Annotated[
        float, typer.Option(metavar="SECONDS", help="Time over which accelerations last (singer, csm).")
    ] = 10.0,
    out: Out = None,
    as_json: Json = False,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw track, sigma and NIS.")] = None,
    html: Html = None,
    gap: TrackGap = None,
    gate: Annotated[float, typer.Option(metavar="SIGMAS", help="Rows further from the prediction are left out.")] = 5.0,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y[,Z],VX...", help="Known state at the first scan; needs none.")
    ] = None,
    start_sigma: Annotated[
        str | None, typer.Option(metavar="P[,V[,A]]", help="Its standard deviations: position, velocity, acceleration.")
    ] = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Track the targets of a problem file, or of a table, through its scans, from fixes of its first ones.

    It needs no guess. A table needs --stations and --sigma.
    """
    from optloc.cli.track import TrackOptions, rules, run_track

    wanted = TrackOptions(model, filter_, noise, memory, rules(gate, gap, loss), start, start_sigma, loss)
    files = {"out": out, "plot": plot, "html": html}
    told = table_told(file, given)
    raise typer.Exit(run_track(file, wanted, **files, as_json=as_json, quiet=quiet, table=told))


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc separate site.toml --detection 0.9 --false 1",
        "optloc separate site.toml --emitters 2 --region 0,0:20e3,30e3",
    ),
)
def separate(
    file: ProblemPath,
    detection: SeenShare = 0.9,
    false: FalseRows = 1.0,
    emitters: EmitterCount = "auto",
    region: SearchRegion = None,
    as_json: Json = False,
    outside: Outside = False,
    budget: Budget = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find several emitters when no row says which emitter it came from; a channel is one kind at its stations."""
    from optloc.cli.separate import run_separate

    raise typer.Exit(run_separate(file, detection, false, emitters, region, as_json=as_json, quiet=quiet))


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example("optloc simulate site.toml --truth 1200,800,50 --seed 7 --trials 100 --out trials.toml"),
)
def simulate(
    file: ProblemPath,
    truth: Annotated[str, typer.Option(metavar="X,Y[,Z]", help="True position, metres in the frame of the file.")],
    out: Annotated[
        Path, typer.Option(metavar="OUT.toml", help="Problem file to write; rows go to CSV files beside it.")
    ],
    velocity: TrueVelocity = None,
    geodetic: Geodetic = False,
    seed: Annotated[int, typer.Option(min=0, help="Decides the draw.")] = 0,
    trials: Annotated[int, typer.Option(min=1, help="Independent draws; each becomes an epoch.")] = 1,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw measurements of a known target and write them as a problem file."""
    from optloc.cli.crlb import run_simulate

    raise typer.Exit(run_simulate(file, truth, velocity, out, geodetic=geodetic, seed=seed, trials=trials, quiet=quiet))


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc crlb site.toml --at 1200,800,50",
        "optloc crlb site.toml",
        "optloc crlb flight.toml --at 200e3,300e3,0 --plot bound.png",
        "optloc crlb site.toml --map bound.html --height '1200 m'",
        "optloc crlb site.toml --map bound.geojson --extent 11,11.5,47.6,48",
        "optloc crlb site.toml --status --map share.png --height '1200 m'",
    ),
)
def crlb(
    file: ProblemPath,
    at: TruePlace = None,
    velocity: TrueVelocity = None,
    geodetic: Geodetic = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw the bound of a run against time.")
    ] = None,
    map_: MapPath = None,
    height: MapHeight = None,
    extent: MapExtent = None,
    dilution: Annotated[bool, typer.Option("--dilution", help="Map the geometric dilution of precision.")] = False,
    status: StatusShares = False,
    trials: SimulatedFixes = None,
    seed: Annotated[int, typer.Option(min=0, help="Decides the draws of --status.")] = 0,
    as_json: Json = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Print the Cramer-Rao bound: the accuracy that no unbiased estimate beats.

    Of a run whose epochs share unknowns (a motion, biases) it is also given after its first 1, 2, ... epochs.
    With --map it is drawn over the place of the target instead.
    With --status measurements are simulated, and the share of each status of their fixes is given, or mapped.
    """
    if status:
        from optloc.cli.crlb import Simulated, run_status

        wanted = Simulated(map_, at, height, extent, velocity, trials, seed, geodetic)
        raise typer.Exit(run_status(file, wanted, as_json=as_json, quiet=quiet))
    # A map needs no truth: it is drawn around the stations, or the place of the fix.
    if map_ is not None:
        from optloc.cli.crlb import run_map

        raise typer.Exit(run_map(file, map_, at, height, extent, velocity, geodetic=geodetic, dilution=dilution))
    from optloc.cli.crlb import run_crlb

    raise typer.Exit(run_crlb(file, at, velocity, geodetic=geodetic, as_json=as_json, plot=plot, quiet=quiet))


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc check flight.toml --plot health.svg --out health.csv",
        "optloc check toa.csv --stations sites.csv --sigma '20 ns'",
    ),
)
@takes_table
def check(
    file: ProblemPath,
    as_json: Json = False,
    by: Annotated[str, typer.Option(metavar="station|pair|kind", help="Whose health is told.")] = "station",
    method: Annotated[
        str | None, typer.Option("--method", "-m", help="How epochs are fixed; a method that resists outliers.")
    ] = None,
    no_solve: Annotated[bool, typer.Option("--no-solve", help="Only read the file.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="OUT", help="Write station health as .csv or .parquet.")] = None,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="OUT.svg", help="Draw the residuals.")] = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Say what a file or a table holds (rows, redundancy, geometry) and, of many epochs, how healthy its stations are.

    Each epoch is fixed, and each station compared with what the others say: bias, scale, noise, outliers.
    """
    from optloc.cli.check import CheckOptions, run_check

    asked = CheckOptions(not no_solve, method, by, out, plot)
    raise typer.Exit(run_check(file, as_json, asked, quiet=quiet, table=table_told(file, given)))


@app.command(
    rich_help_panel=ANSWERS,
    epilog=example(
        "optloc plot landscape site.toml",
        "optloc plot convergence demo --out story.svg",
        "optloc plot residuals flight.toml --out residuals.pdf",
        "optloc plot accuracy shootout-study",
    ),
)
def plot(
    what: Annotated[str, name_in("pictures", "Picture")],
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Problem file, name of a shipped problem, or folder of a study.",
            callback=find_problem,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Picture to write: .png, .svg or .pdf; NAME.png by default.")
    ] = None,
    method: Method = "auto",
    epoch: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Epoch that is drawn, or case of a study; the first by default.")
    ] = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw a picture of a problem and its fix.

    fix: stations, fix, 95 % ellipse and alternatives. landscape: the cost over the place of the target. convergence:
    where iterations from many starts end. residuals: by station. biases: of a run against time, with 95 %. bound: map
    of the Cramer-Rao bound. track: of a run. accuracy: errors of a study's methods against the bound.
    """
    from optloc.cli.pictures import run_plot

    place = Path(f"{what}.png") if out is None else out
    raise typer.Exit(run_plot(what, PictureRequest(file, place, method, epoch), quiet))


@app.command(
    rich_help_panel=FIRST, epilog=example("optloc demo", "optloc demo ambiguous --plot two.png", "optloc list demos")
)
def demo(
    name: Annotated[str | None, name_in("demos", "A shipped problem")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Where to draw the fix; optloc-demo.png by default.")
    ] = None,
    as_json: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Walk through a fix, two possible places and a registration; or fix one shipped problem."""
    from optloc.cli.starters import run_demo

    raise typer.Exit(run_demo(name, plot, as_json=as_json, quiet=quiet))


@app.command(
    rich_help_panel=FIRST,
    epilog=example("optloc new tdoa", "optloc new satellites --out site.toml", "optloc list starters"),
)
def new(
    kind: Annotated[str, name_in("starters", "A measurement kind (tdoa, range, ...) or a common mixture")],
    out: Annotated[
        Path | None, typer.Option(metavar="OUT.toml", help="File to write; standard output by default.")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a problem file with comments that can be fixed as it is, to begin with."""
    from optloc.cli.starters import run_new

    raise typer.Exit(run_new(kind, out, quiet=quiet))


app.command(rich_help_panel=FIRST, epilog=example(*CONVERSIONS))(convert)


# The names of the lists are known without making one of them.
def _lists() -> list[str]:
    from optloc.cli.listing import lists

    return list(lists())


@app.command(
    "list", rich_help_panel=MORE, epilog=example("optloc list kinds", "optloc list methods", "optloc list starters")
)
def list_(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            autocompletion=_lists,
            help="kinds, formulations, solvers, methods, losses, trackers, motions, baselines, formats, executors, "
            "studies, papers, datasets, pictures, demos or starters.",
        ),
    ],
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """List measurement kinds, methods, solvers with the back ends found here, and everything else that has a name."""
    from optloc.cli.listing import run_list

    raise typer.Exit(run_list(what, as_json))


@app.command(
    "compile",
    rich_help_panel=MORE,
    epilog=example("optloc compile", "optloc compile --check", "optloc compile --wheel dist"),
)
def compile_(
    check: Annotated[bool, typer.Option("--check", help="Compile nothing: only say what there is.")] = False,
    wheel: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Pack it as a wheel for computers of this platform.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make the machine code of all kernels for this computer at once, which takes minutes and is kept on disk."""
    if wheel is not None:
        from optloc.cli.wheel import run_wheel

        raise typer.Exit(run_wheel(wheel, quiet=quiet))
    from optloc.cli.compile import run_compile

    raise typer.Exit(run_compile(check, as_json, quiet=quiet))


@app.command(rich_help_panel=MORE, epilog=example("optloc schema > optloc.schema.json"))
def schema(verbose: Verbose = False) -> None:
    """Print the JSON schema of problem files, from which editors complete and check them."""
    from optloc.cli.output import dumps
    from optloc.files.schema import schema as of_files

    typer.echo(dumps(of_files()))


app.command(rich_help_panel=MORE, epilog=example("optloc doctor", "optloc doctor --json"))(doctor)

for one in extensions():
    one.commands(app)
