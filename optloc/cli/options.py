"""Options and exit codes that several commands share, and the conversion of option values."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context
from importlib.resources import files
from io import TextIOWrapper
from math import isnan, nan
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from optloc.base.errors import InvalidProblem, nearest, status_named
from optloc.base.inputs import STANDARD_INPUT, access, budget_of, relax_budget
from optloc.base.outputs import refuse_address, remove_unnamed, replace_files, visible
from optloc.base.types import Status
from optloc.base.units import LARGEST
from optloc.cli.completion import choices, complete, stages, statuses
from optloc.kernels.progress import keep_quiet

if TYPE_CHECKING:
    from optloc.files.constraint_table import ConstraintTable

BAD_INPUT = 2
"""Exit code for wrong arguments or a wrong file; shells and typer use the same code."""

FIRST, ANSWERS, MORE = "First steps", "Answers", "More"
"""Panels of commands in the help."""

STOPPED, READER_GONE = 130, 141
"""Exit codes after Ctrl-C and after a closed pipe: 128 plus the number of the signal, as in shells."""

EXIT_CODES = "Exit codes: 0 all statuses are ok or allowed, 1 a status is not ok, 2 bad input, 130 stopped by Ctrl-C."


def run_process(command: Callable[[], Any]) -> None:
    """Run a command as a whole process and exit; Ctrl-C and a closed pipe end it without a traceback."""
    code: Any = 0  # for `sys.exit`: a number or None, or a text
    ignored = signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None)  # as with nohup
    try:
        _prepare()
        if not ignored:
            signal.signal(signal.SIGINT, _interrupt)
        command()
    except SystemExit as end:
        code = end.code
    except KeyboardInterrupt:
        code = STOPPED
    except Exception:
        # Some libraries replace KeyboardInterrupt by another exception.
        if signal.getsignal(signal.SIGINT) is not end_at_once:
            raise
        code = STOPPED
    finally:
        if not ignored:
            signal.signal(signal.SIGINT, end_at_once)
    sys.exit(_flush(code))


# Seconds that a command may take to end after Ctrl-C: a library may swallow the exception, a compiler may run a minute.
_PATIENCE = 8.0


def _interrupt(*_: Any) -> None:
    """Let the command clean up after Ctrl-C for a few seconds; a second Ctrl-C ends the process at once."""
    signal.signal(signal.SIGINT, end_at_once)
    watch = Timer(_PATIENCE, end_at_once)
    watch.daemon = True
    watch.start()
    raise KeyboardInterrupt


def end_at_once(*_: Any) -> None:
    """End the process without output, and remove partly written files."""
    remove_unnamed()
    os._exit(STOPPED)


def _unraisable(found: Any) -> None:
    """End the process after Ctrl-C during the destruction of an object: Python would only print it and go on."""
    if isinstance(found.exc_value, KeyboardInterrupt):
        end_at_once()
    sys.__unraisablehook__(found)


# Width limits in characters within which tables are readable, for any value of the environment.
_NARROWEST, _WIDEST = 20, 1000


def _prepare() -> None:
    """Set up standard streams and terminal width so that no output can fail, and collect garbage less often."""
    # Imports and stored machine code make a million objects that live until the end; to search them takes 0.2 s.
    gc.set_threshold(50_000, 20, 20)
    # The lowest free number is opened: 0, 1 and 2 are the standard streams.
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        pass  # occupy the number of a closed stream, so that the next opened file does not get it
    os.close(number)
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  (until the end)
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  (until the end)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # print ? for characters outside the encoding, such as ±
    for name in ("COLUMNS", "LINES"):
        size = os.environ.get(name)
        if size is not None:
            valid = size.isascii() and size.isdigit() and len(size) < 10
            os.environ[name] = str(min(max(int(size), _NARROWEST), _WIDEST)) if valid else "80"
    sys.unraisablehook = _unraisable
    # A font without a character draws a box; the user cannot act on this warning.
    warnings.filterwarnings("ignore", message=r"Glyph .* missing from font")


def _flush(code: Any) -> Any:
    """Flush standard output, and return the exit code."""
    try:
        sys.stdout.flush()
    except OSError as error:
        # Close the stream, or Python flushes again at exit and prints an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if isinstance(error, BrokenPipeError):
            return READER_GONE
        return _print_bad_input(f"Standard output cannot be written ({error.strerror or error}).")
    return code


class CommandGroup(TyperGroup):
    """Command group that prints bad input as one line, without a traceback."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command that the arguments name; print wrong arguments as one line."""
        standalone = kwargs.pop("standalone_mode", True)
        try:
            # Settings of one command, such as --force, end with the command: a process may run several.
            code = copy_context().run(super().main, *args, **{**kwargs, "standalone_mode": False})
        except Exception as error:
            # Usage errors. Their module differs between releases of typer, but all have format_message.
            if not standalone or not hasattr(error, "format_message"):
                raise
            code = _print_bad_input(_usage(error))
        if not standalone:
            return code
        sys.exit(code if isinstance(code, int) else 0)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Return the arguments left; without arguments, print the help and end with exit code 0."""
        if not args and not ctx.resilient_parsing:  # completion parses without arguments, too
            typer.echo(ctx.get_help(), nl=False)
            raise typer.Exit
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; bad input and system errors give exit code 2, Ctrl-C gives 130."""
        try:
            with access(anew=True):
                return super().invoke(ctx)
        except InvalidProblem as error:
            raise typer.Exit(_print_bad_input(str(error))) from None
        except BrokenPipeError:
            raise typer.Exit(READER_GONE) from None
        except MemoryError:
            raise typer.Exit(_print_bad_input("There is not enough memory; solve fewer epochs at once.")) from None
        except OSError as error:
            raise typer.Exit(_print_bad_input(f"{error.filename or 'optloc'}: {error.strerror or error}.")) from None
        except KeyboardInterrupt:
            typer.echo("Stopped.", err=True)
            raise typer.Exit(STOPPED) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the named command; raise InvalidProblem with the nearest name for an unknown command."""
        known = self.list_commands(ctx)
        if args and args[0] not in known:
            raise InvalidProblem(f"there is no command {args[0]!r}", ctx.command_path, nearest(args[0], known))
        return super().resolve_command(ctx, args)


def _print_bad_input(sentence: str) -> int:
    """Print one line on standard error, and return the exit code of bad input."""
    typer.echo(visible(" ".join(sentence.split())), err=True)
    return BAD_INPUT


def _usage(error: Any) -> str:
    """Return a sentence on wrong arguments that names similar options, or refers to the help."""
    path = error.ctx.command_path if getattr(error, "ctx", None) is not None else "optloc"
    close = ", ".join(getattr(error, "possibilities", None) or ())
    if close:
        return f"{path}: {error.message.rstrip('.')}; did you mean {close}?"
    return f"{path}: {error.format_message().strip().rstrip('.')}; see {path} --help."


def example(*lines: str) -> str:
    """Return the examples at the end of a help text."""
    return "[bold]Examples[/bold]\n\n" + "\n\n".join(f"[cyan]{line}[/cyan]" for line in lines)


def start_log(wanted: bool) -> bool:
    """Send the log of optloc to standard error, and return `wanted`: whether all steps are logged, or only warnings."""
    log = logging.getLogger("optloc")
    # A process may run several commands (tests), each with a different standard error.
    for old in [handler for handler in log.handlers if handler.name == "command line"]:
        log.removeHandler(old)
    handler = logging.StreamHandler(sys.stderr)
    handler.name = "command line"
    # Time since the start of the process: the duration of a step is the difference of two lines.
    handler.setFormatter(logging.Formatter("%(relativeCreated)6.0f ms  %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO if wanted else logging.WARNING)
    return wanted


def shipped_problems() -> dict[str, Path]:
    """Return the paths of the problem files in this package, by name."""
    return {path.stem: path for path in sorted(Path(str(files("optloc") / "scenarios")).glob("*.toml"))}


def find_problem(path: Path) -> Path:
    """Return the path, or the path of the shipped problem with this name if no such file exists."""
    # Only a bare word can be the name of a shipped problem; a folder or an ending marks a path.
    if path == STANDARD_INPUT or path.name != str(path) or path.suffix or path.exists():
        return path
    known = shipped_problems()
    if str(path) in known:
        return known[str(path)]
    what = "there is no such file, and no shipped problem with this name"
    raise InvalidProblem(what, str(path), nearest(str(path), list(known)))


ProblemPath = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Problem file (TOML, format = 2), name of a shipped problem, or - for standard input.",
        callback=find_problem,
    ),
]
Outside = Annotated[
    bool,
    typer.Option(
        "--outside",
        callback=lambda wanted: relax_budget(outside=wanted),
        help="Allow the file to read files outside its folder.",
    ),
]
Budget = Annotated[
    str | None,
    typer.Option(
        "--budget",
        metavar="NAME=N,...",
        callback=lambda text: text and relax_budget(budget=budget_of(text, "--budget")),
        help="Raise the limits of files: bytes, text (bytes of a document), rows, columns, cells, nesting, unknowns.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print only JSON on standard output.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw stations, fix and 95 % ellipse.")]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="OUT",
        help="Write all results: .csv, .parquet, .geojson, .kml, .gpx, .cot, .nmea, .yaml (ROS) or .g2o; see "
        "[bold]optloc list formats[/bold]. - is standard output, as CSV.",
    ),
]
Html = Annotated[
    Path | None,
    typer.Option(
        "--html",
        metavar="OUT.html",
        help="Write an HTML page with an interactive map and a list of the positions; - is standard output.",
    ),
]
Allow = Annotated[
    str | None,
    typer.Option(
        "--allow",
        metavar="STATUS,...",
        help="Statuses that give exit code 0 as well as ok, such as curved,unproven.",
        autocompletion=statuses,
    ),
]
Force = Annotated[
    bool, typer.Option("--force", callback=replace_files, help="Overwrite existing files, but never an input file.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", callback=keep_quiet, help="Print only errors.")]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", callback=start_log, help="Log each step and its duration on standard error."),
]


def name_in(what: str, text: str, *flags: str) -> Any:
    """Return an option, or an argument without flags, whose value is a name in the table `what` of `optloc list`.

    `text` is the help, and `flags` are the spellings of the option.
    """
    given: dict[str, Any] = {"metavar": "NAME", "autocompletion": complete(what)}
    words = f"{text}; see [bold]optloc list {what}[/bold]."
    return typer.Option(*flags, help=words, **given) if flags else typer.Argument(help=words, **given)


def choice(metavar: str, text: str, *flags: str) -> Any:
    """Return an option whose value is one of the choices of a metavar such as "rms|volume|axis"; `text` is the help."""
    return typer.Option(*flags, metavar=metavar, help=text, autocompletion=choices(metavar))


Method = Annotated[
    str,
    typer.Option(
        "--method",
        "-m",
        metavar="NAME",
        help="Method of the fix, or stages such as gtrs+lsr; see [bold]optloc list methods[/bold].",
        autocompletion=stages,
    ),
]
Geodetic = Annotated[
    bool, typer.Option("--geodetic", help="The coordinates are latitude, longitude (deg) and height (m).")
]
Height = Annotated[
    str | None,
    typer.Option(
        "--height",
        metavar="H",
        help="Known height above the ellipsoid, or along z of a frame that is not on Earth: 500, or '1640 ft'. "
        "A list has the floors on one of which the target is: '0 m, 3.5 m, 7 m'.",
    ),
]
AboveGround = Annotated[bool, typer.Option("--above-ground", help="The target is above the ellipsoid.")]
Box = Annotated[
    str | None,
    typer.Option(
        "--box",
        metavar="LOW:HIGH",
        help="Region of the target, metres in the frame: X,Y[,Z]:X,Y[,Z]; inf means no bound.",
    ),
]
Constraint = Annotated[
    list[str] | None,
    typer.Option(
        "--constraint",
        metavar="'KIND KEY=VALUE ...'",
        help="Limit of the position or velocity, such as 'disc x=3 km y=2 km radius=500 m'. Repeat the option for "
        "more limits; see [bold]optloc list constraints[/bold].",
        autocompletion=complete("constraints"),
    ),
]
NoiseFromData = Annotated[
    str | None,
    choice(
        "auto|kind|station|pair",
        "Estimate the noise of each kind, station or pair; +epoch adds an error that their rows of an epoch share. "
        "auto: the grouping that explains the data best.",
        "--noise-from-data",
    ),
]
RescaleNoise = Annotated[
    bool,
    typer.Option(
        "--rescale-noise",
        help="Estimate one factor of the noise from all epochs, and use it if the stated noise is wrong.",
    ),
]


LateFromData = Annotated[
    bool,
    typer.Option(
        "--late-from-data",
        help="Estimate the share of late rows and their mean delay from all epochs, and fix with this loss.",
    ),
]


Explain = Annotated[
    bool,
    typer.Option("--explain", help="Fix again with the error that explains most of the misfit, and print the change."),
]


def coordinates(
    text: str, where: str, advice: str = "write them as 1200,800,50", *, bounds: bool = False
) -> list[float]:
    """Return the numbers of a list such as 1200,800,50; with `bounds`, numbers may be infinite.

    Raises
    ------
    InvalidProblem
        For other texts; the message names the option `where` and has the text `advice`.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [nan]
    # inf means no bound; NaN passes all comparisons.
    if any(map(isnan, values)) or not (bounds or all(abs(v) <= LARGEST for v in values)):
        raise InvalidProblem(f"{text!r} is not a list of numbers", where, advice)
    return values


def allowed(text: str | None) -> tuple[Status, ...]:
    """Return the statuses that an option adds to `ok`; raise InvalidProblem for an unknown status."""
    return tuple(status_named(one) for one in text.split(",")) if text else ()


def constraints(
    height: str | None, above_ground: bool, box: str | None, texts: Sequence[str] = ()
) -> dict[str, ConstraintTable]:
    """Return the constraints that options add to a file, by the name of the option.

    Parameters
    ----------
    height : str, optional
        Known height: a number of metres, or a number and a unit.
    above_ground : bool
        Whether the height is at least zero.
    box : str, optional
        Least and greatest coordinates, metres: ``0,0,-inf:5000,5000,inf``.
    texts : sequence of str
        Further constraints, such as ``disc x=3 km y=2 km radius=500 m``.
    """
    # the help needs no schema
    from optloc.files.constraint_table import ConstraintTable, constraint_of_text, height_table

    found = {}
    if height is not None:
        found["--height"] = height_table(height)
    if above_ground:
        found["--above-ground"] = ConstraintTable(kind="above-ground")
    if box is not None:
        if ":" not in box:
            raise InvalidProblem(f"{box!r} has one corner", "--box", "write two corners, such as 0,0:5000,4000")
        advice = "write a corner as 1200,800 or 1200,800,50"
        low, high = (coordinates(corner, "--box", advice, bounds=True) for corner in box.split(":", 1))
        found["--box"] = ConstraintTable(kind="box", min=low, max=high)
    for i, text in enumerate(texts):
        # The place in messages has a number only if there are several.
        place = "--constraint" if len(texts) == 1 else f"--constraint {i + 1}"
        found[place] = constraint_of_text(text, place)
    return found


# Data sets.

_DATA_SETS = "Data sets"
DataSetExecutor = Annotated[
    str | None,
    typer.Option(
        "--executor",
        "-x",
        metavar="NAME",
        help="Where the partitions of a data set are fixed: local (this process), dask or ray.",
        rich_help_panel=_DATA_SETS,
    ),
]
DataSetScheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Running cluster, such as tcp://host:8786; implies dask.",
        rich_help_panel=_DATA_SETS,
    ),
]
DataSetJobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        "-j",
        min=1,
        max=1024,  # a larger number is a typing error
        help="Processes of a local cluster; all processors by default.",
        rich_help_panel=_DATA_SETS,
    ),
]


def is_data_set(path: Path) -> bool:
    """Return whether a path is a folder, or an address of an object store, whose error names data sets."""
    refuse_address(path)
    return path.is_dir()


def refuse_options(given: Mapping[str, Any], why: str) -> None:
    """Raise InvalidProblem for the first option with a value; `given` has values by name, and `why` is the reason."""
    stated = next((name for name, value in given.items() if value), None)
    if stated is not None:
        raise InvalidProblem(f"this option has no use here: {why}", f"--{stated.replace('_', '-')}", "remove it")


# Station placement.

Choose = Annotated[
    int | None, typer.Option("--choose", "-k", min=1, help="Number of candidates to add to the fixed stations.")
]
Costs = Annotated[
    float | None, typer.Option("--cost", min=0.0, metavar="SUM", help="Largest total cost of the candidates.")
]
Criterion = Annotated[
    str | None,
    choice(
        "rms|volume|axis",
        "Criterion: mean-square error, or volume or longest axis of the error ellipsoid.",
        "--criterion",
    ),
]
FailOne = Annotated[bool | None, typer.Option("--fail-one/--no-fail", help="Design for the worst loss of one station.")]
PlaceOfInterest = Annotated[
    str | None,
    typer.Option(metavar="X,Y[,Z]", help="Single position of interest; by default the fix of the problem file."),
]
AmbiguityDraws = Annotated[
    int, typer.Option(min=0, help="Number of simulated fixes at each position for the ambiguity check; 0 for no check.")
]
PlacementMap = Annotated[
    Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw the bound before and after.")
]


# Bounds and shares of statuses, at a position or as a map.

TruePlace = Annotated[
    str | None, typer.Option(metavar="X,Y[,Z]", help="Position of the target, metres; by default the fix.")
]
TrueVelocity = Annotated[str | None, typer.Option(metavar="X,Y[,Z]", help="Velocity of a moving target, m/s.")]
MapPath = Annotated[
    Path | None, typer.Option("--map", metavar="OUT", help="Map to write: .png, .svg, .pdf, .geojson or .html.")
]
MapHeight = Annotated[
    str | None,
    typer.Option(
        metavar="H", help="Height of the map, such as '1640 ft'; by default the height of --at or of the fix."
    ),
]
MapExtent = Annotated[
    str | None, typer.Option(metavar="X0,X1,Y0,Y1", help="Limits of the map: metres, or degrees on Earth.")
]
StatusShares = Annotated[bool, typer.Option("--status", help="Simulate fixes, and print the share of each status.")]
SimulatedFixes = Annotated[
    int | None, typer.Option(min=1, help="Number of simulated fixes at each position; by default 200, or 50 for a map.")
]


# Several emitters, and gaps of tracks.

SeenShare = Annotated[float, typer.Option(metavar="P", help="Probability that an emitter gives a row in a channel.")]
FalseRows = Annotated[
    float, typer.Option("--false", metavar="N", help="Mean number of false rows in a channel and epoch.")
]
EmitterCount = Annotated[
    str, typer.Option(metavar="N|auto", help="Number of emitters; auto estimates the most likely number.")
]
SearchRegion = Annotated[
    str | None,
    typer.Option("--region", metavar="LOW:HIGH", help="Search region, metres: X,Y[,Z]:X,Y[,Z]."),
]
TrackGap = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Longest time without rows; then the track ends, and a new fix starts another. By default, the track "
        "ends when the prediction is less certain than the extent of the stations.",
    ),
]
