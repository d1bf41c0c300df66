"""The commands of ``optloc``: arguments and help texts. Each command calls the module that does the work."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from optloc.cli.doctor import doctor
from optloc.cli.extensions import PictureRequest, extensions
from optloc.cli.from_table import EXAMPLES as CONVERSIONS, convert, table_hints, takes_table
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
    Constraint,
    DataSetExecutor,
    DataSetJobs,
    DataSetScheduler,
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
    choice,
    constraints,
    example,
    find_problem,
    is_data_set,
    name_in,
    refuse_options,
    run_process,
)

# Import heavy libraries inside the commands, so that --help prints without delay.

app = typer.Typer(
    cls=CommandGroup,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,  # an internal error of optloc prints the whole traceback
    help="Position fixes from time, gain, angle and Doppler measurements, with covariance and status.",
    epilog=f"{EXIT_CODES} With --install-completion, the Tab key completes commands, options and values.\n\n"
    + example("optloc demo", "optloc new tdoa --out site.toml", "optloc fix site.toml --plot fix.png"),
)


def main() -> None:
    """Run the command line."""
    run_process(app)


def _print_version(wanted: bool) -> None:
    """Print the version and end, if `--version` is given."""
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
        typer.Option(metavar="MODULE", help="Python file or module to run first; it adds kinds, losses or solvers."),
    ] = None,
) -> None:
    import os
    import sys

    import numpy as np

    from optloc.base.registry import load_plugin

    # On a terminal, compile in a child process, so that the first answers come without delay. Elsewhere, and in
    # studies, do not leave a background process behind.
    if sys.stderr is not None and sys.stderr.isatty() and context.invoked_subcommand != "study":
        os.environ.setdefault("OPTLOC_COMPILE", "child")
    # A status reports values that are not finite, so NumPy warnings are redundant.
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
        "optloc fix site.toml --constraint 'keep-out-disc lat=47.1 lon=8.2 radius=1 km'",
        "optloc fix toa.csv --stations sites.csv --sigma '20 ns'",
        "optloc fix arrivals --out fixes --stations sites.csv --sigma '20 ns' --executor dask",
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
    constraint: Constraint = None,
    noise: NoiseFromData = None,
    rescale: RescaleNoise = False,
    late: LateFromData = False,
    explain: Explain = False,
    allow: Allow = None,
    executor: DataSetExecutor = None,
    scheduler: DataSetScheduler = None,
    jobs: DataSetJobs = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Fix the target of a problem file, of a measurement table or of a data set, at each epoch.

    Options such as --height add to the constraints of the file. A table needs --stations and --sigma. A data set is a
    folder of Parquet tables; its fixes are written to the folder --out, and a stopped run continues.
    """
    more, passing = constraints(height, above_ground, box, constraint or ()), allowed(allow)
    files = {"geojson_path": geojson, "plot": plot, "html": html}
    estimated = {"noise_from_data": noise, "rescale_noise": rescale, "late_from_data": late, "explain": explain}
    clusters = {"executor": executor, "scheduler": scheduler, "jobs": jobs}
    if is_data_set(file):
        from optloc.cli.data_set import executor_of, run_data_set

        refuse_options({"geojson": geojson, "plot": plot, "html": html, **estimated}, "a data set does not use it")
        by = executor_of(executor, scheduler, jobs)
        code = run_data_set(file, out, method, more, given, by, as_json=as_json, quiet=quiet, allow=passing)
        raise typer.Exit(code)
    refuse_options(clusters, "it is for data sets, which are folders of Parquet files")
    from optloc.cli.fix import run_fix

    code = run_fix(
        file,
        method,
        more,
        as_json=as_json,
        out=out,
        **files,
        quiet=quiet,
        noise=noise,
        rescale=rescale,
        late=late,
        explain=explain,
        allow=passing,
        table=table_hints(file, given),
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
    model: Annotated[str, name_in("motions", "Motion model, such as cv or csm", "--model")] = "cv",
    filter_: Annotated[str, name_in("trackers", "Filter", "--filter")] = "iekf",
    loss: Annotated[str | None, name_in("losses", "Robust loss that weights the rows of a scan", "--loss")] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            metavar="SD",
            help="Standard deviation of the process noise, SI units; for csm the largest acceleration. "
            "[bold]optloc list motions[/bold] shows the defaults.",
        ),
    ] = None,
    memory: Annotated[
        float, typer.Option(metavar="SECONDS", help="Correlation time of accelerations (singer, csm).")
    ] = 10.0,
    out: Out = None,
    as_json: Json = False,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw track, sigma and NIS.")] = None,
    html: Html = None,
    gap: TrackGap = None,
    gate: Annotated[float, typer.Option(metavar="SIGMAS", help="Reject rows further from the prediction.")] = 5.0,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y[,Z],VX...", help="Known state at the first scan, if you have it.")
    ] = None,
    start_sigma: Annotated[
        str | None,
        typer.Option(metavar="P[,V[,A]]", help="Standard deviations of --start: position, velocity, acceleration."),
    ] = None,
    height: Height = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Track the targets of a problem file or of a table over time. Fixes of the first scans start the tracks.

    You need no first guess. A table needs --stations and --sigma.
    """
    from optloc.cli.track import TrackOptions, rules, run_track

    wanted = TrackOptions(model, filter_, noise, memory, rules(gate, gap, loss), start, start_sigma, loss)
    files = {"out": out, "plot": plot, "html": html}
    hints, more = table_hints(file, given), constraints(height, False, None)
    raise typer.Exit(run_track(file, wanted, **files, as_json=as_json, quiet=quiet, table=hints, more=more))


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
    """Locate several emitters if the rows have no emitter labels. A channel is one kind at its stations."""
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
        Path, typer.Option(metavar="OUT.toml", help="Problem file to write; rows go to CSV files in its folder.")
    ],
    velocity: TrueVelocity = None,
    geodetic: Geodetic = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    trials: Annotated[int, typer.Option(min=1, help="Number of independent trials; each becomes an epoch.")] = 1,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate measurements of a target at a known position and write them as a problem file."""
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
    constraint: Constraint = None,
    status: StatusShares = False,
    trials: SimulatedFixes = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers of --status.")] = 0,
    as_json: Json = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Print the Cramer-Rao bound: no unbiased estimate is more accurate.

    If the epochs of a run share unknowns (a motion, biases), the bound after the first 1, 2, ... epochs is printed as
    well. With --map, the bound is drawn as a map over target positions instead. With --status, measurements are
    simulated; the share of fixes with each status is printed, or drawn as a map. Exact constraints, such as
    --constraint 'height exactly=2 m', lower the bound; other constraints do not change it.
    """
    more = constraints(None, False, None, constraint or ())
    if status:
        from optloc.cli.crlb import Simulated, run_status

        wanted = Simulated(map_, at, height, extent, velocity, trials, seed, geodetic)
        raise typer.Exit(run_status(file, wanted, as_json=as_json, quiet=quiet, more=more))
    # A map needs no true position: it is drawn around the stations, or around the fix.
    if map_ is not None:
        from optloc.cli.crlb import run_map

        drawn = run_map(file, map_, at, height, extent, velocity, geodetic=geodetic, dilution=dilution, more=more)
        raise typer.Exit(drawn)
    from optloc.cli.crlb import run_crlb

    code = run_crlb(file, at, velocity, geodetic=geodetic, as_json=as_json, plot=plot, quiet=quiet, more=more)
    raise typer.Exit(code)


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
    by: Annotated[str, choice("station|pair|kind", "Groups of the health table.", "--by")] = "station",
    method: Annotated[
        str | None, typer.Option("--method", "-m", help="Method of the fixes; choose a method that resists outliers.")
    ] = None,
    no_solve: Annotated[bool, typer.Option("--no-solve", help="Only read the file.")] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Write the health table: .csv or .parquet; - is standard output.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="OUT.svg", help="Draw the residuals.")] = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Summarise a file or a table (rows, redundancy, geometry) and check the health of its stations over many epochs.

    Each epoch is fixed. Each station is compared with the other stations: bias, scale, noise, outliers.
    """
    from optloc.cli.check import CheckOptions, run_check

    asked = CheckOptions(not no_solve, method, by, out, plot)
    raise typer.Exit(run_check(file, as_json, asked, quiet=quiet, table=table_hints(file, given)))


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
        Path | None, typer.Option(metavar="OUT", help="Picture to write: .png, .svg or .pdf; by default NAME.png.")
    ] = None,
    method: Method = "auto",
    epoch: Annotated[
        str | None, typer.Option(metavar="LABEL", help="Epoch to draw, or case of a study; by default the first.")
    ] = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw a picture of a problem and its fix.

    fix: stations, fix, 95 % ellipse and alternatives. landscape: the cost over target positions. convergence: the end
    points of iterations from many starts. residuals: residuals by station. biases: biases of a run against time, with
    95 % intervals. bound: map of the Cramer-Rao bound. track: track of a run. accuracy: errors of the methods of a
    study against the bound.
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
        Path | None, typer.Option(metavar="OUT.png", help="Picture of the fix; by default optloc-demo.png.")
    ] = None,
    as_json: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run three examples (a fix, an ambiguity, a registration), or fix one shipped problem."""
    from optloc.cli.starters import run_demo

    raise typer.Exit(run_demo(name, plot, as_json=as_json, quiet=quiet))


@app.command(
    rich_help_panel=FIRST,
    epilog=example("optloc new tdoa", "optloc new satellites --out site.toml", "optloc list starters"),
)
def new(
    kind: Annotated[str, name_in("starters", "A measurement kind (tdoa, range, ...) or a common mixture")],
    out: Annotated[
        Path | None, typer.Option(metavar="OUT.toml", help="File to write; by default standard output.")
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a commented example problem file. You can fix it as it is, then replace its numbers by yours."""
    from optloc.cli.starters import run_new

    raise typer.Exit(run_new(kind, out, quiet=quiet))


app.command(rich_help_panel=FIRST, epilog=example(*CONVERSIONS))(convert)


# The names of the lists are available without computing any list.
def _lists() -> list[str]:
    """Return the names of the lists, for the completion of the command line."""
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
            help="kinds, constraints, formulations, solvers, methods, losses, trackers, motions, baselines, formats, "
            "executors, studies, papers, datasets, pictures, demos or starters.",
        ),
    ],
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """List measurement kinds, methods, solvers with installed back ends, and all other named entries."""
    from optloc.cli.listing import run_list

    raise typer.Exit(run_list(what, as_json))


@app.command(
    "compile",
    rich_help_panel=MORE,
    epilog=example("optloc compile", "optloc compile --check", "optloc compile --wheel dist"),
)
def compile_(
    check: Annotated[bool, typer.Option("--check", help="Do not compile; only print the state.")] = False,
    wheel: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Pack the machine code as a wheel for computers of this platform."),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compile the machine code of all kernels for this computer and store it on disk. It takes minutes, once."""
    if wheel is not None:
        from optloc.cli.wheel import run_wheel

        raise typer.Exit(run_wheel(wheel, quiet=quiet))
    from optloc.cli.compile import run_compile

    raise typer.Exit(run_compile(check, as_json, quiet=quiet))


@app.command(rich_help_panel=MORE, epilog=example("optloc schema > optloc.schema.json"))
def schema(verbose: Verbose = False) -> None:
    """Print the JSON schema of problem files. Editors use it to complete and check files."""
    from optloc.cli.output import dumps
    from optloc.files.schema import schema as of_files

    typer.echo(dumps(of_files()))


app.command(rich_help_panel=MORE, epilog=example("optloc doctor", "optloc doctor --json"))(doctor)

for one in extensions():
    one.commands(app)
