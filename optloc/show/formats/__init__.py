"""Formats that fixes and tracks are written in: one table, by the ending of a file, for commands, streams and pages."""

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
    """A format of files.

    Parameters
    ----------
    endings : tuple of str
        Of names of files, the usual one first.
    summary : str
        Whose it is.
    uncertainty : str
        What of the uncertainty of a fix that is ok it carries.
    doubt : str
        What it holds of a fix that is not ok, and of alternatives.
    write : callable of (Path, Results)
        Writes a file.
    earth : bool
        Whether its positions are on Earth.
    each : callable of Mark, optional
        Returns the text of one mark, empty where it has none: what streams write.
    """

    endings: tuple[str, ...]
    summary: str
    uncertainty: str
    doubt: str
    write: Callable[[Path, Results], None]
    earth: bool = False
    each: Callable[[Mark], str] | None = None


def _text(of: Callable[[Results], str]) -> Callable[[Path, Results], None]:
    def write(path: Path, results: Results) -> None:
        text = of(results) + "\n"
        with written(path) as file:
            # as bytes: NMEA has line ends of its own
            file.write_bytes(text.encode("utf-8", errors="replace"))

    return write


def write_csv(path: Path, columns: Columns) -> None:
    """Write a long table as CSV; NaN is an empty cell."""
    from optloc.files import writer  # with the schema, which not every command needs

    writer.write_csv(path, columns, for_people=True)


def write_parquet(path: Path, columns: Columns) -> None:
    """Write a long table as Parquet; NaN is a missing value."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with written(path) as file:
        parquet.write_table(table, file)


_ROW = "status, reason and number of alternatives of each row"

FORMATS = {
    "csv": Format(
        (".csv",),
        "table, a row for each target and epoch",
        "standard deviations, covariance along the axes of the frame and along east, north, up",
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
        "maps of the web, RFC 7946",
        "95 % ellipse, or the region as it is; standard deviations as properties",
        "point with its status, no ellipse; alternatives with gap and probability",
        _text(lambda results: json.dumps(plain(geojson(results)), allow_nan=False, indent=2)),
        earth=True,
    ),
    "kml": Format(
        (".kml",),
        "Google Earth and others, OGC KML 2.2",
        "95 % ellipse, or the region as it is; covariance along east, north, up as data",
        "point in another colour with its status in its name, no ellipse; alternatives as points",
        _text(kml),
        earth=True,
    ),
    "gpx": Format(
        (".gpx",),
        "receivers and outdoor maps, GPX 1.1",
        "none of its own: words in `desc`, covariance in `extensions`",
        "waypoint with its status in its name; alternatives as waypoints; a track is interrupted",
        _text(gpx),
        earth=True,
    ),
    "cot": Format(
        (".cot",),
        "situation displays (TAK), Cursor on Target 2.0, an event a line",
        "`ce`: standard deviation along the longest axis; `le`: of the height",
        "pending, `ce` and `le` unknown (9999999); alternatives as pending events",
        _text(cot),
        earth=True,
        each=event,
    ),
    "nmea": Format(
        (".nmea",),
        "instruments, NMEA 0183: GGA and GST",
        "GST: ellipse and standard deviations of latitude, longitude, height, 1 sigma",
        "GGA with fix quality 0 and without a place; no alternatives",
        _text(nmea),
        earth=True,
        each=sentences,
    ),
    "ros": Format(
        (".yaml",),
        "robots: PoseWithCovarianceStamped of ROS as YAML, x y z and rotations, row by row",
        "covariance in the frame; 1e6 of what is not estimated",
        "a comment, with alternatives; no message",
        _text(ros),
    ),
    "g2o": Format(
        (".g2o",),
        "graph optimisation: point vertices and priors",
        "information matrix in the frame, upper triangle",
        "vertex without a prior; alternatives as comments",
        _text(g2o),
    ),
}
"""Formats by name."""


def format_of(path: Path, frame: Frame | None = None) -> Format:
    """Return the format of a file by the ending of its name; pipes and other streams without one get CSV.

    Raises
    ------
    InvalidProblem
        For an ending that none has, and for a frame without an Earth where the format needs one.
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
    """Write a fix, or a batch of them, in the format that the ending of the name says.

    Parameters
    ----------
    path : str or Path
        File to write: one of the endings of `FORMATS`. A file that exists is replaced.
    fix : Fix
        What `optloc.solve` returns.
    problem : Problem, optional
        What was solved: its stations and regions are written where the format has them.
    title : str
        What the file is called within.

    Raises
    ------
    InvalidProblem
        For an unknown ending, a place that cannot be written, or a frame without an Earth where the format needs one.
    """
    place = Path(path)
    format_of(place, fix.frame).write(place, Results(fix_columns(fix), fix.frame, (fix,), problem, title))
