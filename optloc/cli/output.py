"""What commands print and write: numbers with their errors, sentences, tables, JSON, pictures, a progress bar."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.text import Text

from optloc.base import outputs
from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.outputs import claim, is_stream, visible, written
from optloc.base.types import Array
from optloc.compute.progress import Reporter
from optloc.files.writer import write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG = logging.getLogger("optloc.write")

Columns = dict[str, Array]
"""A long table: columns (rows,) by name, in SI units and degrees, NaN where there is no number."""

PICTURES = (".png", ".svg", ".pdf")
"""Types of pictures that commands write."""

# What a coordinate that an equality holds may have as its sigma, as a share of it: rounding.
_HELD = 1e-12


class Screen(Console):
    """The terminal, or whatever standard output is: names of strangers are printed letter by letter and do nothing."""

    def __init__(self, *, stderr: bool = False, quiet: bool = False) -> None:
        super().__init__(stderr=stderr, quiet=quiet, markup=False, emoji=False)

    def render_str(self, text: str, **style: Any) -> Text:
        """Return text as it is shown: what would steer the terminal is spelled."""
        return super().render_str(visible(text), **style)

    def on_broken_pipe(self) -> None:
        """Let the command end: the reader of a pipe has gone."""
        raise BrokenPipeError


def say(console: Console, line: str) -> None:
    """Print a line as it is: rich would colour its numbers, take brackets for marks and break it."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def say_all(console: Console, sentences: Sequence[str]) -> None:
    """Print what a result says in words, each with a capital letter and a full stop."""
    for text in sentences:
        say(console, f"{text[0].upper()}{text[1:]}.")


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, rounded to it; a constraint may leave it none."""
    unit = unit if unit != "1" else ""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{value:.10g} {unit} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    # Two digits of the standard deviation, none behind the point of one above 10.
    digits = int(max(0, 1 - np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f} {unit}"


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: arrays as lists, what is not finite as null."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def dumps(value: Any) -> str:
    """Return strict JSON."""
    # NaN and infinity are no JSON: they were made null, and a leftover is a mistake.
    return json.dumps(plain(value), allow_nan=False, indent=2)


def records(columns: Columns) -> list[dict[str, Any]]:
    """Return a table as one record for each row, ready for JSON."""
    lists = {name: plain(values) for name, values in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def join_tables(parts: Sequence[Columns]) -> Columns:
    """Return tables below each other; a column that one lacks is NaN there."""
    names = dict.fromkeys(name for part in parts for name in part)
    sizes = [len(next(iter(part.values()))) for part in parts]
    return {
        name: np.concatenate([part.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)])
        for name in names
    }


def covariance_columns(covariance: Array, axes: str) -> Columns:
    """Return the upper triangles of covariances (n, d, d) along named axes."""
    d = covariance.shape[-1]
    return {f"cov_{axes[i]}{axes[j]}": covariance[:, i, j] for i in range(d) for j in range(i, d)}


def geodetic_columns(frame: Frame, position: Array, covariance: Array) -> Columns:
    """Return latitude and longitude (degrees), height (metres) and covariance along east, north, up."""
    if not frame.geodetic:
        return {}
    with np.errstate(invalid="ignore"):  # epochs without a fix are NaN
        lat, lon, height = frame.to_geodetic(position)
        axes = frame.enu_axes(position)
    local = axes @ covariance @ np.swapaxes(axes, -1, -2)
    degrees = {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "height": height}
    return degrees | covariance_columns(local, "enu")


def write_text(path: Path, text: str) -> None:
    """Write a text file, or standard output where the path is "-"; raise InvalidProblem where that fails."""
    if str(path) == "-":
        sys.stdout.write(text + "\n")
        return
    outputs.write_text(path, text + "\n")
    LOG.info("wrote %s", path)


def write_table(path: Path, columns: Columns) -> None:
    """Write a long table as CSV or Parquet, by the ending of its name; NaN is an empty cell."""
    if is_csv(path):
        write_csv(path, columns, for_people=True)
    else:
        import pyarrow as pa
        from pyarrow import parquet

        # from_pandas: NaN is a missing value.
        table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
        with written(path) as file:
            parquet.write_table(table, file)
    LOG.info("wrote %s: %d rows", path, len(next(iter(columns.values()))))


def is_csv(path: Path) -> bool:
    """Return whether a table goes to CSV; what has no ending, such as a pipe, gets that too."""
    return path.suffix.lower() == ".csv" or is_stream(path)


def claim_outputs(
    *others: Path | None, table: Path | None = None, picture: Path | None = None, inputs: Sequence[Path] = ()
) -> None:
    """Refuse outputs of a command that cannot or must not be written, before the work.

    Parameters
    ----------
    *others : Path, optional
        Files of text.
    table, picture : Path, optional
        Files whose endings say their types.
    inputs : sequence of Path
        What the command reads, beside what was read already.
    """
    if table is not None and not is_csv(table) and table.suffix.lower() not in {".parquet", ".pq"}:
        what = f"results of type {table.suffix or table.name!r} are unknown"
        raise InvalidProblem(what, str(table), "use .csv or .parquet")
    if picture is not None and picture.suffix.lower() not in PICTURES and not is_stream(picture):
        what = f"pictures of type {picture.suffix or picture.name!r} are unknown"
        raise InvalidProblem(what, str(picture), f"use {', '.join(PICTURES[:-1])} or {PICTURES[-1]}")
    claim(table, picture, *others, inputs=inputs)


def write_picture(figure: Figure, path: Path) -> None:
    """Write a picture; raise InvalidProblem where that fails."""
    from optloc.plot import save

    save(figure, path)
    LOG.info("wrote %s", path)


@contextmanager
def bar(title: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """Yield a function that moves a progress bar on standard error; it is drawn on terminals only."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    # Results may be piped from standard output; one step is too short for a bar.
    console = Screen(stderr=True)
    shown = console.is_terminal and not quiet and total > 1
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=console, disable=not shown, transient=True) as progress:
        task = progress.add_task(title, total=total)
        yield lambda n: progress.update(task, advance=n)


@contextmanager
def meter(title: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that is told how much of how much is done: a bar on terminals, elsewhere a line now and then."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console, known = Screen(stderr=True), [0, 0]
    lines = Reporter(lambda: f"{title}: {known[0]} of about {known[1]}")
    lines.muted = quiet or console.is_terminal
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*parts, console=console, disable=quiet or not console.is_terminal, transient=True) as progress:
        task = progress.add_task(title, total=None)

        def tell(done: int, total: int) -> None:
            known[:] = done, total
            progress.update(task, completed=done, total=total)

        lines.begin()
        try:
            yield tell
        finally:
            lines.end()
