"""`optloc convert`, and tables in the place of problem files: the options that say what a table does not say itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optloc.base.errors import InvalidProblem
from optloc.cli.options import Budget, Force, Json, Quiet, Verbose

if TYPE_CHECKING:
    from rich.console import Console

    from optloc.files.reader import Loaded
    from optloc.files.schema import ConstraintTable
    from optloc.files.table_import import ColumnHints
    from optloc.files.table_problem import Converted, TableProblem

_TABLES = (".csv", ".tsv", ".txt", ".log", ".json", ".jsonl", ".ndjson", ".parquet", ".pq", ".rnx", ".obs")
# RINEX observations of a year, such as site1230.21o.
_YEAR = re.compile(r"\.\d\do")
PANEL = "A table"
EXAMPLES = (
    "optloc convert toa.csv --stations sites.geojson --sigma '20 ns' --out a.toml",
    "optloc convert messages.csv --stations rx.csv --as arrivals --unit ns --sigma '50 ns'",
    "optloc convert picks.csv --stations net.csv --vp '6 km/s' --vs '3.5 km/s' --sigma '0.1 s' --out b.toml",
    "optloc convert gnss.csv --column pseudorange=C1C --sigma '3 m' --out gnss.toml",
    "optloc convert site.21o --navigation site.21n --sigma '1 m' --out gnss.toml",
    "optloc convert sites.geojson --out stations.csv",
    "optloc convert iridium.tle --times passes.csv --out satellites.csv",
)


def _option(metavar: str, text: str, *flags: str) -> Any:
    return typer.Option(*flags, metavar=metavar, help=text, rich_help_panel=PANEL)


def _flag(text: str, flag: str) -> Any:
    return typer.Option(flag, help=text, rich_help_panel=PANEL)


_TEXT = str | None
# Field of `optloc.files.table_import.ColumnHints`: its option. All commands that take tables use this one list.
_OPTIONS: dict[str, Any] = {
    "stations": Annotated[
        Path | None, _option("FILE", "Where the stations are: GeoJSON, CSV, Parquet or JSON.", "--stations")
    ],
    "sigma": Annotated[
        _TEXT,
        _option("AMOUNT", "Error of each row: '20 ns', '6 m', 'range=6 m,azimuth=2 deg', or estimate.", "--sigma"),
    ],
    "columns": Annotated[
        list[str] | None,
        _option(
            "ROLE=NAME",
            "Column of a role that its name does not tell: message, station, time, target, reference, sigma, heading, "
            "or a kind; epoch, satellite, pseudorange, x, y, z; name, lat, lon, height, depth; p, s, phase. Once for "
            "each; message=set+msg joins two.",
            "--column",
        ),
    ],
    "ignore": Annotated[
        list[str] | None,
        _option("COLUMN", "Column that is left out although it may be a measurement. Once for each.", "--ignore"),
    ],
    "time_unit": Annotated[
        _TEXT, _option("UNIT", "Of the column of times, where its name does not end in it.", "--time-unit")
    ],
    "unit": Annotated[_TEXT, _option("UNIT", "Of the values, where the column's name does not end in it.", "--unit")],
    "what": Annotated[
        _TEXT,
        _option("WHAT", "arrivals, sp, pseudoranges, stations or a kind such as range; as columns tell.", "--as"),
    ],
    "frame": Annotated[
        _TEXT, _option("cartesian|ecef", "Frame of stations in x, y, z; cartesian by default.", "--frame")
    ],
    "missing": Annotated[
        _TEXT,
        _option("N,...", "Numbers that stand for no reading, such as 0,-1,9999, or none.", "--missing"),
    ],
    "average": Annotated[bool, _flag("Take the mean of several readings of the same.", "--average")],
    "azimuth": Annotated[
        _TEXT,
        _option(
            "CONVENTION",
            "Of bearings: north-clockwise, north-counterclockwise, east-counterclockwise, or bow-clockwise, to which "
            "the column of headings is added.",
            "--azimuth",
        ),
    ],
    "declination": Annotated[
        _TEXT,
        _option(
            "ANGLE|DATE", "Magnetic declination of bearings, east positive: '4 deg', or 2026-06-01.", "--declination"
        ),
    ],
    "positive": Annotated[_TEXT, _option("a-farther|b-farther", "Where differences are positive.", "--positive")],
    "reference": Annotated[_TEXT, _option("STATION", "The other station of all differences.", "--reference")],
    "vp": Annotated[_TEXT, _option("SPEED", "Of P waves, such as '6 km/s'.", "--vp")],
    "vs": Annotated[_TEXT, _option("SPEED", "Of S waves, such as '3.5 km/s'.", "--vs")],
    "window": Annotated[_TEXT, _option("TIME", "Readings within it belong together, such as '0.1 s'.", "--window")],
    "still": Annotated[bool, _flag("The target stays: all readings belong together.", "--still")],
    "zone": Annotated[_TEXT, _option("NAME", "Time zone of dates without one: UTC, Europe/Rome.", "--zone")],
    "navigation": Annotated[
        Path | None, _option("FILE", "RINEX navigation beside RINEX observations or Android's log.", "--navigation")
    ],
    "system": Annotated[_TEXT, _option("G|E|J", "Satellites that are taken; GPS by default.", "--system")],
    "turned": Annotated[
        bool, _flag("Satellites of a table are along ECEF at reception, not transmission.", "--turned")
    ],
    "mask": Annotated[_TEXT, _option("ANGLE", "Lowest elevation of satellites; 10 deg by default.", "--mask")],
}


_FLAGS = ("average", "still", "turned")


def takes_table(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the options of tables; it is given them as one mapping, `given`."""
    own = signature(command, eval_str=True)

    @wraps(command)
    def taking(**values: Any) -> None:
        given = {name: values.pop(name) for name in _OPTIONS}
        named = {"columns": columns_of(given["columns"]), "ignore": tuple(given["ignore"] or ())}
        command(**values, given=given | named)

    kept = [entry for entry in own.parameters.values() if entry.name != "given"]
    more = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=False if name in _FLAGS else None, annotation=kind)
        for name, kind in _OPTIONS.items()
    ]
    taking.__signature__ = own.replace(parameters=[*kept, *more])  # type: ignore[attr-defined]  # what typer reads
    taking.__annotations__ = {entry.name: entry.annotation for entry in (*kept, *more)}
    return taking


@takes_table
def convert(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Readings or pseudoranges (CSV, Parquet, JSON, RINEX, Android), GeoJSON stations, or orbits "
            "(elements, OMM, SP3).",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="OUT.toml", help="Problem file to write, with CSV files beside it; without: only look."),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Table of measurements whose times (UTC) orbits are wanted at."),
    ] = None,
    as_json: Json = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Make a problem file of a table of readings, of stations or of orbits, and say what it was taken for."""
    raise typer.Exit(_run(file, out, {**given, "times": times}, as_json, quiet))


def columns_of(pairs: Sequence[str] | None) -> dict[str, str]:
    """Return the columns of roles that --column names; raise InvalidProblem where it names none."""
    columns = {}
    for pair in pairs or ():
        role, sign, name = pair.partition("=")
        if not (role and sign and name):
            raise InvalidProblem(f"{pair!r} names no column", "--column", "write ROLE=NAME, such as station=receiver")
        columns[role] = name
    return columns


def _run(file: Path, out: Path | None, given: Mapping[str, Any], as_json: bool, quiet: bool) -> int:
    """Convert a file, say what is understood before it is written, and return the exit code."""
    from optloc.cli.output import Screen, dumps, write_text
    from optloc.files.convert import convert as written, interpret_table
    from optloc.files.table_import import ColumnHints

    told, console = ColumnHints(**given), Screen(quiet=quiet or as_json)
    if out is None:
        table_problem = interpret_table(file, told)
        _tell(table_problem, console)
        table_problem.read()
        say_next(console, f"Nothing is written: --out names the problem file, and optloc fix {file} fixes it as it is.")
        if as_json:
            write_text(Path("-"), dumps(table_problem.as_read))
        return 0
    found = written(file, out, told, tell=lambda table_problem: _tell(table_problem, console))
    if as_json:
        write_text(Path("-"), dumps(_json(found)))
    elif found.loaded is None:
        from optloc.cli.output import say_all

        say_all(console, found.notes)
        say_next(console, f'{out} is a table of stations: name it in a problem file, [stations] file = "{out.name}".')
    else:
        problem = found.loaded.problem
        held = f"{problem.count} rows of {problem.epochs} epochs at {problem.stations.count} stations"
        say_next(console, f"{', '.join(map(str, found.written))}: {held}. Next: optloc check {out}.")
    return 0


def say_next(console: Console, line: str) -> None:
    """Print a line about what comes next."""
    from optloc.cli.output import say

    say(console, line)


def _tell(table_problem: TableProblem, console: Console) -> None:
    """Print what a table is understood to be, and what was assumed."""
    from optloc.cli.output import say, say_all

    say(console, f"{table_problem.source.name} is understood as")
    width = max(len(word) for word, _ in table_problem.about)
    for word, text in table_problem.about:
        say(console, f"  {word:<{width}}  {text}")
    say_all(console, table_problem.notes)


def _json(found: Converted) -> dict[str, Any]:
    about: dict[str, Any] = {"files": [str(path) for path in found.written], "notes": list(found.notes)}
    if found.loaded is None:
        return about
    problem = found.loaded.problem
    about |= found.as_read
    return about | {"stations": problem.stations.count, "epochs": problem.epochs, "rows": problem.count}


# A table in the place of a problem file.


def table_told(file: Path, given: Mapping[str, Any]) -> ColumnHints | None:
    """Return what is said of a table, None of a problem file; raise InvalidProblem where something is said of that."""
    from optloc.files.table_import import ColumnHints

    if file.suffix.lower() in _TABLES or _YEAR.fullmatch(file.suffix.lower()):
        return ColumnHints(**given)
    said = [name for name, value in given.items() if value]
    if said:
        flag = {"what": "--as", "columns": "--column"}.get(said[0], f"--{said[0].replace('_', '-')}")
        what = f"it is for a table; {file.name} is a problem file"
        raise InvalidProblem(what, flag, "write it in the file, or name a table that ends in .csv, .json or .parquet")
    return None


def read_problem(
    file: Path,
    told: ColumnHints | None,
    more: Mapping[str, ConstraintTable] | None = None,
    *,
    values: bool = True,
    quiet: bool = False,
    on_error: bool = False,
) -> Loaded:
    """Return a problem file with more constraints, or a table with what is told of it, and say how that is understood.

    Parameters
    ----------
    file : Path
        Problem file, or table.
    told : ColumnHints, optional
        What is said of a table; None of a problem file.
    more : mapping, optional
        Further constraints.
    values : bool
        Whether a problem file needs measured values.
    quiet, on_error : bool
        Whether nothing is said of a table, and whether it is said on standard error.
    """
    from optloc.files.reader import read

    if told is None:
        return read(file, values=values, more=more)
    from optloc.cli.output import Screen
    from optloc.files.convert import interpret_table

    table_problem = interpret_table(file, told)
    _tell(table_problem, Screen(quiet=quiet, stderr=on_error))
    return table_problem.read(more or {})
