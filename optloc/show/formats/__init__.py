"""File formats of fixes and tracks, for commands, streams and pages.

`FORMATS` lists the formats. The ending of a file name selects the format.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.frames import Frame
from optloc.base.outputs import is_stream, written
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.columns import Columns, fix_columns, plain
from optloc.show.formats.marks import Mark, Results, geojson, need_earth
from optloc.show.formats.markup import cot, event, gpx, kml
from optloc.show.formats.sentences import g2o, nmea, ros, sentences

__all__ = ["FORMATS", "Format", "Mark", "Results", "format_of", "write_csv", "write_fixes", "write_parquet"]


@dataclass(frozen=True, slots=True)
class Format:
    """A file format.

    Parameters
    ----------
    endings : tuple of str
        Endings of file names, the usual ending first.
    summary : str
        Programs or standard that use the format.
    uncertainty : str
        Uncertainty that the file contains for a fix with status `ok`.
    doubt : str
        Content of the file for other fixes, and for alternatives.
    write : callable of (Path, Results)
        Writes a file.
    earth : bool
        Whether the format needs positions on Earth.
    each : callable of Mark, optional
        Returns the text of one mark, for streams; empty if the format omits the mark.
    dated : bool
        Whether the file has the dates of fixes, if they are known.
    """

    endings: tuple[str, ...]
    summary: str
    uncertainty: str
    doubt: str
    write: Callable[[Path, Results], None]
    earth: bool = False
    each: Callable[[Mark], str] | None = None
    dated: bool = False


def _text_writer(of: Callable[[Results], str]) -> Callable[[Path, Results], None]:
    """Return a function that writes the text of a format to a file; `of` makes the text from the results."""

    def write(path: Path, results: Results) -> None:
        text = of(results) + "\n"
        with written(path) as file:
            # Write bytes: NMEA has other line ends than the operating system.
            file.write_bytes(text.encode("utf-8", errors="replace"))

    return write


def write_csv(path: Path, columns: Columns) -> None:
    """Write a table as CSV; NaN becomes an empty cell."""
    from optloc.files import writer  # Import here: the module loads the schema, which most commands do not need.

    writer.write_csv(path, columns, for_people=True)


def write_parquet(path: Path, columns: Columns) -> None:
    """Write a table as Parquet; NaN becomes a missing value."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with written(path) as file:
        parquet.write_table(table, file)


_ROW = "status, reason and number of alternatives in each row"

FORMATS = {
    "csv": Format(
        (".csv",),
        "table, one row for each target and epoch",
        "standard deviations; covariances along the axes of the frame and along east, north, up",
        _ROW,
        lambda path, results: write_csv(path, results.columns),
    ),
    "parquet": Format(
        (".parquet", ".pq"),
        "the same table for programs",
        "the same",
        "the same",
        lambda path, results: write_parquet(path, results.columns),
    ),
    "geojson": Format(
        (".geojson",),
        "web maps, RFC 7946",
        "95 % ellipse, or outline of the 95 % region; standard deviations as properties",
        "point with its status, no ellipse; alternatives with gap and probability",
        _text_writer(lambda results: json.dumps(plain(geojson(results)), allow_nan=False, indent=2)),
        earth=True,
    ),
    "kml": Format(
        (".kml",),
        "Google Earth and other maps, OGC KML 2.2",
        "95 % ellipse, or outline of the 95 % region; covariance along east, north, up as data",
        "point in another colour, its status in its name, no ellipse; alternatives as points",
        _text_writer(kml),
        earth=True,
        dated=True,
    ),
    "gpx": Format(
        (".gpx",),
        "receivers and outdoor maps, GPX 1.1",
        "no standard field: text in `desc`, covariance in `extensions`",
        "waypoint with its status in its name; alternatives as waypoints; a gap in a track",
        _text_writer(gpx),
        earth=True,
        dated=True,
    ),
    "cot": Format(
        (".cot",),
        "situation displays (TAK), Cursor on Target 2.0, one event on each line",
        "`ce`: standard deviation along the longest axis; `le`: standard deviation of the height",
        "pending event, `ce` and `le` unknown (9999999); alternatives as pending events",
        _text_writer(cot),
        earth=True,
        each=event,
    ),
    "nmea": Format(
        (".nmea",),
        "instruments, NMEA 0183: GGA and GST",
        "GST: ellipse and standard deviations of latitude, longitude, height, 1 sigma",
        "GGA with fix quality 0 and without a position; no alternatives",
        _text_writer(nmea),
        earth=True,
        each=sentences,
    ),
    "ros": Format(
        (".yaml",),
        "robots: ROS message PoseWithCovarianceStamped as YAML; covariance of x, y, z and rotations, row by row",
        "covariance in the frame; 1e6 for coordinates that are not estimated",
        "a comment, with alternatives; no message",
        _text_writer(ros),
    ),
    "g2o": Format(
        (".g2o",),
        "graph optimisation: point vertices and priors",
        "information matrix in the frame, upper triangle",
        "vertex without a prior; alternatives as comments",
        _text_writer(g2o),
    ),
}
"""Formats by name."""


def format_of(path: Path, frame: Frame | None = None) -> Format:
    """Return the format that the ending of a file name selects; for a pipe or stream without an ending, CSV.

    Raises
    ------
    InvalidProblem
        If the ending is unknown, or the format needs positions on Earth and `frame` is cartesian.
    """
    ending = path.suffix.lower()
    for name, one in FORMATS.items():
        if ending in one.endings:
            if one.earth and frame is not None:
                need_earth(frame, name, str(path))
            return one
    if is_stream(path):
        return FORMATS["csv"]
    endings = [one for each in FORMATS.values() for one in each.endings]
    what = f"results of type {path.suffix or path.name!r} are unknown"
    raise InvalidProblem(what, str(path), nearest(ending, endings))


def write_fixes(path: str | Path, fix: Fix, problem: Problem | None = None, title: str = "optloc") -> None:
    """Write a fix, or a batch of fixes, in the format that the ending of the file name selects.

    Parameters
    ----------
    path : str or Path
        File to write; its ending is one of the endings of `FORMATS`. An existing file is replaced.
    fix : Fix
        Result of `optloc.solve`.
    problem : Problem, optional
        The problem of the fix. With it, the file contains the stations and the 95 % regions if the format supports
        them.
    title : str
        Title inside the file.

    Raises
    ------
    InvalidProblem
        If the ending is unknown, the file cannot be written, or the format needs positions on Earth and the frame is
        cartesian.
    """
    place = Path(path)
    format_of(place, fix.frame).write(place, Results(fix_columns(fix), fix.frame, (fix,), problem, title))
