"""What commands share: how they end, their help, the options that several have, and how their values are read."""

from __future__ import annotations

import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable
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
from optloc.base.outputs import remove_unnamed, replace_files, visible
from optloc.base.types import Status
from optloc.base.units import LARGEST
from optloc.kernels.progress import keep_quiet

if TYPE_CHECKING:
    from optloc.files.schema import ConstraintTable

BAD_INPUT = 2
"""Exit code of whatever is wrong with the arguments or a file: what shells and typer use for wrong usage."""

FIRST, ANSWERS, MORE = "First steps", "Answers", "More"
"""Panels of commands in the help."""

STOPPED, READER_GONE = 130, 141
"""Exit codes after Ctrl-C, and where the reader of a pipe has gone: 128 and the signal's number, as shells count."""

EXIT_CODES = "Exit codes: 0 everything is ok or allowed, 1 some status is not ok, 2 bad input, 130 stopped by Ctrl-C."


def run_process(command: Callable[[], Any]) -> None:
    """Run a command as the whole of a process, and end it: quietly wherever Ctrl-C or the end of a pipe finds it."""
    code: Any = 0
    ignored = signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None)  # as under nohup
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
        # Some libraries make another exception of Ctrl-C.
        if signal.getsignal(signal.SIGINT) is not end_at_once:
            raise
        code = STOPPED
    finally:
        if not ignored:
            signal.signal(signal.SIGINT, end_at_once)
    sys.exit(_flush(code))


# Seconds that a command is given to end after Ctrl-C: a library may swallow it, or a compiler go on for a minute.
_PATIENCE = 8.0


def _interrupt(*_: Any) -> None:
    """Let the command end in its own way, if it does so soon; a second Ctrl-C does not wait for it."""
    signal.signal(signal.SIGINT, end_at_once)
    watch = Timer(_PATIENCE, end_at_once)
    watch.daemon = True
    watch.start()
    raise KeyboardInterrupt


def end_at_once(*_: Any) -> None:
    """End the process without a word, and without what is half written."""
    remove_unnamed()
    os._exit(STOPPED)


def _unraisable(found: Any) -> None:
    """End where Ctrl-C was pressed while an object was cleared away, which Python would print and go on."""
    if isinstance(found.exc_value, KeyboardInterrupt):
        end_at_once()
    sys.__unraisablehook__(found)


# Columns of text between which tables can be read, whatever the environment says of the terminal.
_NARROWEST, _WIDEST = 20, 1000


def _prepare() -> None:
    """Make standard streams and the width of the terminal such that nothing that is printed can fail."""
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        pass  # a stream that is closed: the next file that is opened must not become it
    os.close(number)
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  (until the end)
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  (until the end)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # what its encoding lacks, such as ±, becomes a question mark
    for name in ("COLUMNS", "LINES"):
        said = os.environ.get(name)
        if said is not None:
            wide = said.isascii() and said.isdigit() and len(said) < 10
            os.environ[name] = str(min(max(int(said), _NARROWEST), _WIDEST)) if wide else "80"
    sys.unraisablehook = _unraisable
    # A picture shows a box where its font has no such sign, and no one can do anything about it.
    warnings.filterwarnings("ignore", message=r"Glyph .* missing from font")


def _flush(code: Any) -> Any:
    """Write what is still to be printed, and return the exit code."""
    try:
        sys.stdout.flush()
    except OSError as error:
        # Python would try again, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if isinstance(error, BrokenPipeError):
            return READER_GONE
        return _refuse(f"standard output cannot be written ({error.strerror or error}).")
    return code


class CommandGroup(TyperGroup):
    """Commands whose bad input is a sentence, not a traceback."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command that the arguments name; what is wrong with them is one line."""
        standalone = kwargs.pop("standalone_mode", True)
        try:
            # What a command decides, such as --force, ends with it: a process may run several.
            code = copy_context().run(super().main, *args, **{**kwargs, "standalone_mode": False})
        except Exception as error:
            # Usage errors. Their classes have another home in each release of typer, but all can be spelled.
            if not standalone or not hasattr(error, "format_message"):
                raise
            code = _refuse(_usage(error))
        if not standalone:
            return code
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; malformed input and what the system refuses end in exit code 2, Ctrl-C in 130."""
        try:
            with access(anew=True):
                return super().invoke(ctx)
        except InvalidProblem as error:
            raise typer.Exit(_refuse(str(error))) from None
        except BrokenPipeError:
            raise typer.Exit(READER_GONE) from None
        except MemoryError:
            raise typer.Exit(_refuse("There is not enough memory for this; ask for less at once.")) from None
        except OSError as error:
            raise typer.Exit(_refuse(f"{error.filename or 'optloc'}: {error.strerror or error}.")) from None
        except KeyboardInterrupt:
            typer.echo("Stopped.", err=True)
            raise typer.Exit(STOPPED) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that is named; raise InvalidProblem where there is none, naming the nearest."""
        known = self.list_commands(ctx)
        if args and args[0] not in known:
            raise InvalidProblem(f"there is no command {args[0]!r}", ctx.command_path, nearest(args[0], known))
        return super().resolve_command(ctx, args)


def _refuse(sentence: str) -> int:
    """Print one line on standard error, and return the exit code of bad input."""
    typer.echo(visible(" ".join(sentence.split())), err=True)
    return BAD_INPUT


def _usage(error: Any) -> str:
    """Return what is wrong with the arguments, and where help is."""
    path = error.ctx.command_path if getattr(error, "ctx", None) is not None else "optloc"
    close = ", ".join(getattr(error, "possibilities", None) or ())
    if close:
        return f"{path}: {error.message.rstrip('.')}; did you mean {close}?"
    return f"{path}: {error.format_message().strip().rstrip('.')}; see {path} --help."


def example(*lines: str) -> str:
    """Return an epilogue of examples for a help text."""
    return "[bold]Examples[/bold]\n\n" + "\n\n".join(f"[cyan]{line}[/cyan]" for line in lines)


def start_log(wanted: bool) -> bool:
    """Let optloc's log go to standard error, with all its steps where that is wanted."""
    log = logging.getLogger("optloc")
    # One process may run several commands, in tests for instance, each with a standard error of its own.
    for old in [handler for handler in log.handlers if handler.name == "command line"]:
        log.removeHandler(old)
    handler = logging.StreamHandler(sys.stderr)
    handler.name = "command line"
    # Time since the start of the process: what a step took is the difference of two lines.
    handler.setFormatter(logging.Formatter("%(relativeCreated)6.0f ms  %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO if wanted else logging.WARNING)
    return wanted


def shipped_problems() -> dict[str, Path]:
    """Return the problem files that come with optloc, by name."""
    return {path.stem: path for path in sorted(Path(str(files("optloc") / "scenarios")).glob("*.toml"))}


def find_problem(path: Path) -> Path:
    """Return the path, or that of the shipped problem of this name where no such file is there."""
    # A bare word that is no file may be the name of a shipped problem; a path or a name with an ending never is.
    if path == STANDARD_INPUT or path.name != str(path) or path.suffix or path.exists():
        return path
    known = shipped_problems()
    if str(path) in known:
        return known[str(path)]
    what = "there is no such file, and no shipped problem of this name"
    raise InvalidProblem(what, str(path), nearest(str(path), list(known)))


ProblemPath = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Problem file (TOML, format = 2), the name of a shipped one, or - for standard input.",
        callback=find_problem,
    ),
]
Outside = Annotated[
    bool,
    typer.Option(
        "--outside",
        callback=lambda wanted: relax_budget(outside=wanted),
        help="Let the file name files that are not beneath its own folder.",
    ),
]
Budget = Annotated[
    str | None,
    typer.Option(
        "--budget",
        metavar="NAME=N,...",
        callback=lambda text: text and relax_budget(budget=budget_of(text, "--budget")),
        help="Let files hold more: bytes, text (bytes of a document), rows, columns, cells, nesting, unknowns.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output and nothing else.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw stations, fix and 95 % ellipse.")]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="OUT",
        help="Write all of it: .csv, .parquet, .geojson, .kml, .gpx, .cot, .nmea, .yaml (ROS) or .g2o, as "
        "[bold]optloc list formats[/bold] describes them.",
    ),
]
Html = Annotated[
    Path | None, typer.Option("--html", metavar="OUT.html", help="Write a page with a map that moves; Earth only.")
]
Allow = Annotated[
    str | None,
    typer.Option(
        "--allow", metavar="STATUS,...", help="Statuses that pass beside ok (exit code 0), such as curved,unproven."
    ),
]
Force = Annotated[
    bool, typer.Option("--force", callback=replace_files, help="Write over files that exist; never over what is read.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", callback=keep_quiet, help="Print nothing but errors.")]
Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=start_log, help="Say on standard error what is done, and how long it takes."
    ),
]


def complete(what: str) -> Callable[[str], list[str]]:
    """Return a completion of the names in one of the tables of `optloc list`."""

    def found(incomplete: str) -> list[str]:
        # Completion runs a process for every Tab: nothing is imported before it is known what is asked.
        from optloc.cli.listing import lists

        return [next(iter(row.values())) for row in lists()[what]()]

    return found


def name_in(what: str, text: str, *flags: str) -> Any:
    """Return an option, or without flags an argument, whose value is a name in one of the tables of `optloc list`."""
    given: dict[str, Any] = {"metavar": "NAME", "autocompletion": complete(what)}
    words = f"{text}; see [bold]optloc list {what}[/bold]."
    return typer.Option(*flags, help=words, **given) if flags else typer.Argument(help=words, **given)


Method = Annotated[str, name_in("methods", "How to solve", "--method", "-m")]
Geodetic = Annotated[
    bool, typer.Option("--geodetic", help="The coordinates are latitude, longitude (deg) and height (m).")
]
Height = Annotated[
    str | None, typer.Option("--height", metavar="H", help="Known height above the ellipsoid: 500, or '1640 ft'.")
]
AboveGround = Annotated[bool, typer.Option("--above-ground", help="The target is above the ellipsoid.")]
Box = Annotated[
    str | None,
    typer.Option("--box", metavar="LOW:HIGH", help="Region, metres in the frame: X,Y[,Z]:X,Y[,Z]; inf is no bound."),
]
NoiseFromData = Annotated[
    str | None,
    typer.Option(
        "--noise-from-data",
        metavar="auto|kind|station|pair",
        help="Estimate the noise of each of these; with +epoch behind it also what their rows of an epoch share. "
        "auto: whatever explains the data best.",
    ),
]
RescaleNoise = Annotated[
    bool,
    typer.Option(
        "--rescale-noise", help="Use the common factor of the noise that all epochs show, if it is the suspect."
    ),
]


LateFromData = Annotated[
    bool,
    typer.Option(
        "--late-from-data",
        help="Fix with the loss of the share of late rows, and their mean delay, that all epochs show.",
    ),
]


Explain = Annotated[
    bool,
    typer.Option("--explain", help="Fix again with the error that explains most of a misfit, and show the change."),
]


def coordinates(
    text: str, where: str, advice: str = "write them as 1200,800,50", *, bounds: bool = False
) -> list[float]:
    """Return the numbers of a list such as 1200,800,50; of `bounds` some may be infinite.

    Raises
    ------
    InvalidProblem
        Naming the option `where` they were given.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [nan]
    # inf is a bound that is none; NaN would pass every comparison.
    if any(map(isnan, values)) or not (bounds or all(abs(v) <= LARGEST for v in values)):
        raise InvalidProblem(f"{text!r} is no list of numbers", where, advice)
    return values


def allowed(text: str | None) -> tuple[Status, ...]:
    """Return the statuses that an option names beside `ok`; raise InvalidProblem for an unknown one."""
    return tuple(status_named(one) for one in text.split(",")) if text else ()


def constraints(height: str | None, above_ground: bool, box: str | None) -> dict[str, ConstraintTable]:
    """Return the constraints that options add to those of a file, each behind the name of its option.

    Parameters
    ----------
    height : str, optional
        Known height: a number of metres, or a number and a unit.
    above_ground : bool
        Whether the height is at least zero.
    box : str, optional
        Least and greatest coordinates, metres: ``0,0,-inf:5000,5000,inf``.
    """
    from optloc.files.schema import ConstraintTable  # the help needs no schema

    found = {}
    if height is not None:
        found["--height"] = ConstraintTable(kind="height", exactly=height)
    if above_ground:
        found["--above-ground"] = ConstraintTable(kind="above-ground")
    if box is not None:
        if ":" not in box:
            raise InvalidProblem(f"{box!r} has one corner", "--box", "write both, such as 0,0:5000,4000")
        advice = "write a corner as 1200,800 or 1200,800,50"
        low, high = (coordinates(corner, "--box", advice, bounds=True) for corner in box.split(":", 1))
        found["--box"] = ConstraintTable(kind="box", min=low, max=high)
    return found


# Of where to put stations.

Choose = Annotated[
    int | None, typer.Option("--choose", "-k", min=1, help="Candidates to take, beyond the stations kept.")
]
Costs = Annotated[float | None, typer.Option("--cost", min=0.0, metavar="SUM", help="What they may cost together.")]
Criterion = Annotated[
    str | None,
    typer.Option(metavar="rms|volume|axis", help="Mean-square error, volume or longest axis of the ellipsoid."),
]
FailOne = Annotated[bool | None, typer.Option("--fail-one/--no-fail", help="The worst loss of any one station counts.")]
PlaceOfInterest = Annotated[
    str | None,
    typer.Option(metavar="X,Y[,Z]", help="The one place of interest; of a problem file, by default its fix."),
]
AmbiguityDraws = Annotated[
    int, typer.Option(min=0, help="Simulated fixes at each place that check for ambiguity; 0 for none.")
]
PlacementMap = Annotated[
    Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw the bound before and after.")
]


# Of bounds and shares of statuses, at a place or over a map.

TruePlace = Annotated[
    str | None, typer.Option(metavar="X,Y[,Z]", help="Position of the target, metres; the fix by default.")
]
TrueVelocity = Annotated[str | None, typer.Option(metavar="X,Y[,Z]", help="Velocity of a moving target, m/s.")]
MapPath = Annotated[
    Path | None, typer.Option("--map", metavar="OUT", help="Map it: .png, .svg, .pdf, .geojson, or .html.")
]
MapHeight = Annotated[
    str | None, typer.Option(metavar="H", help="Height of the map, such as '1640 ft'; that of --at or of the fix.")
]
MapExtent = Annotated[
    str | None, typer.Option(metavar="X0,X1,Y0,Y1", help="Limits of the map: metres, or degrees on Earth.")
]
StatusShares = Annotated[bool, typer.Option("--status", help="Simulate fixes, and give the share of each status.")]
SimulatedFixes = Annotated[int | None, typer.Option(min=1, help="Fixes at each place; 200, or 50 of a map.")]


# Of several emitters, and of gaps of tracks.

SeenShare = Annotated[float, typer.Option(metavar="P", help="Probability that an emitter is seen in a channel.")]
FalseRows = Annotated[
    float, typer.Option("--false", metavar="N", help="Mean number of false rows in a channel and epoch.")
]
EmitterCount = Annotated[str, typer.Option(metavar="N|auto", help="How many emitters; the most likely number.")]
SearchRegion = Annotated[
    str | None,
    typer.Option("--region", metavar="LOW:HIGH", help="Where they are sought, metres: X,Y[,Z]:X,Y[,Z]."),
]
TrackGap = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="A longer silence ends the track, and a new fix begins another; by default when the prediction is "
        "more uncertain than the stations are spread.",
    ),
]
