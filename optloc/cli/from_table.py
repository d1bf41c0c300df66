"""The command ``optloc convert``, and the options for measurement tables that several commands share."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optloc.base.errors import InvalidProblem
from optloc.base.time_scales import TIME_SCALES
from optloc.cli.completion import choices
from optloc.cli.options import Budget, Force, Height, Json, Quiet, Verbose
from optloc.cli.wave import WAVE_OPTIONS, wave_options

if TYPE_CHECKING:
    from rich.console import Console

    from optloc.files.constraint_table import ConstraintTable
    from optloc.files.reader import Loaded
    from optloc.files.table_import import ColumnHints
    from optloc.files.table_problem import Converted, TableProblem
    from optloc.files.wave_speed import WaveOptions

_TABLES = (".csv", ".tsv", ".txt", ".log", ".json", ".jsonl", ".ndjson", ".parquet", ".pq", ".rnx", ".obs")
# RINEX observation files end in the year, such as site1230.21o.
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
    """Return an option of the panel "A table" with a value; `metavar` is the name of the value in the help."""
    return typer.Option(*flags, metavar=metavar, help=text, rich_help_panel=PANEL)


def _choice(metavar: str, text: str, flag: str) -> Any:
    """Return an option of the panel "A table" whose value is one of the choices of the metavar."""
    return typer.Option(flag, metavar=metavar, help=text, rich_help_panel=PANEL, autocompletion=choices(metavar))


def _flag(text: str, flag: str) -> Any:
    """Return an option of the panel "A table" without a value."""
    return typer.Option(flag, help=text, rich_help_panel=PANEL)


_TEXT = str | None
# Options by field of `optloc.files.table_import.ColumnHints`. All commands that read tables use this list.
_OPTIONS: dict[str, Any] = {
    "stations": Annotated[
        Path | None, _option("FILE", "File of station positions: GeoJSON, CSV, Parquet or JSON.", "--stations")
    ],
    "sigma": Annotated[
        _TEXT,
        _option(
            "AMOUNT",
            "Standard deviation of each row: '20 ns', '6 m', 'range=6 m,azimuth=2 deg', or estimate.",
            "--sigma",
        ),
    ],
    "columns": Annotated[
        list[str] | None,
        _option(
            "ROLE=NAME",
            "Column of a role, if its name is not clear: message, station, time, target, reference, sigma, heading, "
            "or a kind; epoch, satellite, pseudorange, x, y, z; name, lat, lon, height, depth; p, s, phase. Repeat "
            "the option for more columns; message=set+msg joins two.",
            "--column",
        ),
    ],
    "ignore": Annotated[
        list[str] | None,
        _option(
            "COLUMN",
            "Column to leave out, although it may be a measurement. Repeat the option for more columns.",
            "--ignore",
        ),
    ],
    "time_unit": Annotated[
        _TEXT, _option("UNIT", "Unit of the time column, if its name does not end in the unit.", "--time-unit")
    ],
    "time_scale": Annotated[
        _TEXT,
        _choice(
            "|".join(TIME_SCALES),
            "Scale of numbers in the time column, for dates in UTC; without a unit, they are seconds.",
            "--time-scale",
        ),
    ],
    "unit": Annotated[
        _TEXT, _option("UNIT", "Unit of the values, if the column name does not end in the unit.", "--unit")
    ],
    "what": Annotated[
        _TEXT,
        _option(
            "WHAT",
            "Content: arrivals, picks, sp, excess, pseudoranges, stations or a kind; by default from the column names.",
            "--as",
        ),
    ],
    "frame": Annotated[
        _TEXT, _choice("cartesian|ecef", "Frame of stations with x, y, z; by default cartesian.", "--frame")
    ],
    "missing": Annotated[
        _TEXT,
        _option("N,...", "Numbers that mean no reading, such as 0,-1,9999, or none.", "--missing"),
    ],
    "average": Annotated[bool, _flag("Average repeated readings of one measurement.", "--average")],
    "azimuth": Annotated[
        _TEXT,
        _option(
            "CONVENTION",
            "Convention of bearings: north-clockwise, north-counterclockwise, east-counterclockwise, or bow-clockwise, "
            "which adds the heading column.",
            "--azimuth",
        ),
    ],
    "declination": Annotated[
        _TEXT,
        _option(
            "ANGLE|DATE", "Magnetic declination of bearings, east positive: '4 deg', or 2026-06-01.", "--declination"
        ),
    ],
    "positive": Annotated[
        _TEXT,
        _choice(
            "a-farther|b-farther",
            "Sign of the differences: positive if a, or b, is farther from the target.",
            "--positive",
        ),
    ],
    "reference": Annotated[_TEXT, _option("STATION", "Reference station of all differences.", "--reference")],
    "vp": Annotated[
        _TEXT, _option("SPEED", "Speed of P waves, such as '6 km/s', or a table of layers, such as crust.csv.", "--vp")
    ],
    "vs": Annotated[_TEXT, _option("SPEED", "Speed of S waves, such as '3.5 km/s'; with layers 'vp/1.73'.", "--vs")],
    "window": Annotated[
        _TEXT, _option("TIME", "Time within which readings belong to one epoch, such as '0.1 s'.", "--window")
    ],
    "still": Annotated[bool, _flag("The target does not move: all readings form one epoch.", "--still")],
    "zone": Annotated[
        _TEXT, _option("NAME", "Time zone of dates without a zone, such as UTC or Europe/Rome.", "--zone")
    ],
    "navigation": Annotated[
        Path | None, _option("FILE", "RINEX navigation file for RINEX observations or an Android log.", "--navigation")
    ],
    "system": Annotated[_TEXT, _choice("G|E|J", "Satellite system: GPS (default), Galileo or QZSS.", "--system")],
    "turned": Annotated[
        bool, _flag("Satellite positions are in ECEF axes at reception, not at transmission.", "--turned")
    ],
    "mask": Annotated[_TEXT, _option("ANGLE", "Lowest elevation of satellites; by default 10 deg.", "--mask")],
}


_FLAGS = ("average", "still", "turned", "two_way")


def takes_table(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the table options. The command receives their values as one mapping, `given`."""
    command_signature = signature(command, eval_str=True)

    @wraps(command)
    def taking(**values: Any) -> None:
        """Run the command with the values of the table options as one mapping."""
        given = {name: values.pop(name) for name in _OPTIONS}
        named = {"columns": columns_of(given["columns"]), "ignore": tuple(given["ignore"] or ())}
        wave = wave_options(values)
        command(**values, given=given | named | {"wave": wave})

    # typer reads the options from the signature: replace the parameter `given` by one parameter for each table option.
    kept = [entry for entry in command_signature.parameters.values() if entry.name != "given"]
    table_options = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=False if name in _FLAGS else None, annotation=kind)
        for name, kind in {**_OPTIONS, **WAVE_OPTIONS}.items()
    ]
    taking.__signature__ = command_signature.replace(parameters=[*kept, *table_options])  # type: ignore[attr-defined]  # what typer reads
    taking.__annotations__ = {entry.name: entry.annotation for entry in (*kept, *table_options)}
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
        typer.Option(
            metavar="OUT.toml",
            help="Problem file to write, with CSV files in its folder. Without it, nothing is written.",
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Table of measurements; satellite positions are computed at its times (UTC)."
        ),
    ] = None,
    height: Height = None,
    as_json: Json = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    given: Any = None,
) -> None:
    """Convert a table of measurements, stations or orbits to a problem file, and print how it is understood."""
    raise typer.Exit(_run(file, out, {**given, "times": times, "height": height}, as_json, quiet))


def columns_of(pairs: Sequence[str] | None) -> dict[str, str]:
    """Return the column of each role that --column states; raise InvalidProblem for a wrong form."""
    columns = {}
    for pair in pairs or ():
        role, sign, name = pair.partition("=")
        if not (role and sign and name):
            raise InvalidProblem(
                f"{pair!r} does not name a column", "--column", "write ROLE=NAME, such as station=receiver"
            )
        columns[role] = name
    return columns


def _run(file: Path, out: Path | None, given: Mapping[str, Any], as_json: bool, quiet: bool) -> int:
    """Convert a file, print its interpretation before writing, and return the exit code.

    `given` has the values of the table options by field of `ColumnHints`. Without `out`, nothing is written.
    """
    from optloc.cli.output import Screen, dumps, write_text
    from optloc.files.convert import convert as written, interpret_table
    from optloc.files.table_import import ColumnHints

    hints, console = ColumnHints(**given), Screen(quiet=quiet or as_json)
    if out is None:
        table_problem = interpret_table(file, hints)
        _print_interpretation(table_problem, console)
        print_warnings(table_problem.read(), console)
        say_next(
            console,
            f"Nothing is written. To write a problem file, add --out; to fix the table itself, use optloc fix {file}.",
        )
        if as_json:
            write_text(Path("-"), dumps(table_problem.as_read))
        return 0
    found = written(file, out, hints, tell=lambda table_problem: _print_interpretation(table_problem, console))
    if as_json:
        write_text(Path("-"), dumps(_json(found)))
    elif found.loaded is None:
        from optloc.cli.output import say_all

        say_all(console, found.notes)
        say_next(console, f'{out} is a table of stations. In a problem file, write [stations] file = "{out.name}".')
    else:
        print_warnings(found.loaded, console)
        problem = found.loaded.problem
        summary = f"{problem.count} rows of {problem.epochs} epochs at {problem.stations.count} stations"
        say_next(console, f"{', '.join(map(str, found.written))}: {summary}. Next: optloc check {out}.")
    return 0


def say_next(console: Console, line: str) -> None:
    """Print a line about the next step."""
    from optloc.cli.output import say

    say(console, line)


def _print_interpretation(table_problem: TableProblem, console: Console) -> None:
    """Print the interpretation of a table, and the assumptions."""
    from optloc.cli.output import say, say_all

    say(console, f"{table_problem.source.name} is understood as")
    width = max(len(word) for word, _ in table_problem.about)
    for word, text in table_problem.about:
        say(console, f"  {word:<{width}}  {text}")
    say_all(console, table_problem.notes)


def _json(found: Converted) -> dict[str, Any]:
    """Return the result of a conversion as a JSON value."""
    about: dict[str, Any] = {"files": [str(path) for path in found.written], "notes": list(found.notes)}
    if found.loaded is None:
        return about
    problem = found.loaded.problem
    about |= found.as_read
    return about | {"stations": problem.stations.count, "epochs": problem.epochs, "rows": problem.count}


# Tables instead of problem files.


def table_hints(file: Path, given: Mapping[str, Any]) -> ColumnHints | WaveOptions | None:
    """Return the column hints of a table; for a problem file, the options on the wave.

    `given` has the values of the table options. Raise InvalidProblem for a problem file with options of tables.
    """
    from optloc.files.csv_formats import is_log

    if file.suffix.lower() in _TABLES or _YEAR.fullmatch(file.suffix.lower()) or is_log(file):
        return hints_of_options(given)
    wave: WaveOptions | None = given.get("wave")
    stated = [name for name, value in given.items() if value and name != "wave"]
    if stated:
        flag = {"what": "--as", "columns": "--column"}.get(stated[0], f"--{stated[0].replace('_', '-')}")
        what = f"this option is for a table; {file.name} is a problem file"
        raise InvalidProblem(
            what, flag, "write the setting in the file, or name a table with the ending .csv, .json or .parquet"
        )
    return wave


def hints_of_options(given: Mapping[str, Any]) -> ColumnHints:
    """Return the column hints of the values of the table options, `given`."""
    from optloc.files.table_import import ColumnHints

    return ColumnHints(**given)


def read_problem(
    file: Path,
    hints: ColumnHints | WaveOptions | None,
    more: Mapping[str, ConstraintTable] | None = None,
    *,
    values: bool = True,
    quiet: bool = False,
    on_error: bool = False,
) -> Loaded:
    """Return the content of a problem file with more constraints, or of a table with column hints.

    For a table, print its interpretation, unless `quiet`; with `on_error`, print to standard error. `more` has further
    constraints by the name of their option. `values` requires measured values in a problem file. `hints` has the column
    hints of a table, or the options on the wave of a problem file.
    """
    from optloc.cli.output import Screen
    from optloc.files.reader import read
    from optloc.files.wave_speed import WaveOptions

    console = Screen(quiet=quiet, stderr=on_error)
    if hints is None or isinstance(hints, WaveOptions):
        loaded = read(file, values=values, more=more, wave=hints)
    else:
        from optloc.files.convert import interpret_table

        table_problem = interpret_table(file, hints)
        _print_interpretation(table_problem, console)
        loaded = table_problem.read(more or {})
    print_warnings(loaded, console)
    return loaded


def print_warnings(loaded: Loaded, console: Console) -> None:
    """Print the sentences on values that are physically suspicious."""
    from optloc.cli.output import say

    for sentence in loaded.warnings:
        say(console, f"Warning: {sentence}.")
