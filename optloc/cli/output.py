"""Output of the commands: sentences, tables, JSON, pictures, progress bars."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from optloc.base import outputs
from optloc.base.errors import InvalidProblem
from optloc.base.frames import Frame
from optloc.base.outputs import claim, is_standard_output, is_stream, visible
from optloc.kernels.progress import Reporter, in_notebook
from optloc.show.answer_sheets import UNCHECKED_MARK
from optloc.show.columns import Columns, plain
from optloc.show.fix_answer import TEXT_COLUMNS, FixAnswer, FixSheet, advice_lines, verdict_of_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optloc.show.formats import Results

LOG = logging.getLogger("optloc.write")

PICTURES = (".png", ".svg", ".pdf")
"""Picture formats that commands write."""


class Screen(Console):
    """Console on standard output or standard error. Control characters in names from files are printed as escapes."""

    def __init__(self, *, stderr: bool = False, quiet: bool = False) -> None:
        super().__init__(stderr=stderr, quiet=quiet, markup=False, emoji=False)

    @property
    def shows_bars(self) -> bool:
        """Return whether it can show progress bars: on a terminal, but not in the output of a notebook's cell."""
        return self.is_terminal and not in_notebook()

    def render_str(self, text: str, **style: Any) -> Text:
        """Return printable text, with control characters as escapes."""
        return super().render_str(visible(text), **style)

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError to end the command after the reader has closed the pipe."""
        raise BrokenPipeError


def say(console: Console, line: str) -> None:
    """Print a line unchanged: rich would colour numbers, interpret brackets and wrap the line."""
    console.print(line, highlight=False, markup=False, soft_wrap=True)


# Least width of a column of words: words up to the second width are not split, longer words are.
_LEAST, _WORD = 8, 14
_COLOURS = {"good": "green", "care": "yellow", "bad": "red"}


def show_answer(answer: FixAnswer, console: Console) -> None:
    """Print an answer: its main tables, its advice and its details, with the status in colour."""
    for number, sheet in enumerate(answer.main):
        show_sheet(sheet, console, _COLOURS[answer.verdict] if number == 0 else "")
    for line in advice_lines(answer.advice):
        say(console, visible(line))
    for sheet in answer.details:
        show_sheet(sheet, console)


def show_sheet(sheet: FixSheet, console: Console, colour: str = "") -> None:
    """Print a sheet of an answer; `colour` is the colour of the first text of a sheet without column names."""
    # Sheets without column names have one width, so that tables of short texts are aligned.
    width = None if sheet.head else 60
    table = Table(title=sheet.title or None, title_justify="left", show_header=bool(sheet.head), min_width=width)
    needed = 1
    for place, name in enumerate(sheet.head):
        cells_of_column = [line for row in sheet.rows for line in row[place].splitlines()]
        numeric = name not in TEXT_COLUMNS
        # A number on two lines is misread. So a table that is too wide for the screen continues beyond its edge.
        words = max((len(word) for line in cells_of_column for word in line.split()), default=0)
        least = max(map(len, cells_of_column), default=0) if numeric else min(max(words, _LEAST), _WORD)
        # Headings wrap between words only: a part of a word cannot be read.
        least = max(least, *map(len, name.split()), 1)
        table.add_column(name, justify="right" if numeric else "left", min_width=least, overflow="fold")
        needed += least + 3
    for number, row in enumerate(sheet.rows):
        cells: list[str | Text] = list(row)
        if number == 0 and colour and not sheet.head:
            cells[1] = Text(row[1], style=f"bold {colour}")
        elif "status" in sheet.head:
            at = sheet.head.index("status")
            cells[at] = Text(row[at], style=_status_colour(row[at].removesuffix(UNCHECKED_MARK)))
        table.add_row(*cells, end_section=number in sheet.ends)
    console.print(table, width=needed if needed > console.width else None, crop=False)


def _status_colour(label: str) -> str:
    """Return the colour of a status: green for ok, yellow for other answers, red for no answer; "" for no status."""
    if not label:
        return ""
    return _COLOURS[verdict_of_label(label)]


def say_all(console: Console, sentences: Sequence[str]) -> None:
    """Print the sentences of a result, each with a capital letter and a full stop."""
    for text in sentences:
        say(console, f"{text[0].upper()}{text[1:]}.")


def dumps(value: Any) -> str:
    """Return a value as strict JSON text; numbers that are not finite become null."""
    # JSON has no NaN or infinity: `plain` replaces them by null, so a remaining one is a programming error.
    return json.dumps(plain(value), allow_nan=False, indent=2)


def write_text(path: Path, text: str) -> None:
    """Write a text file, or standard output for the path "-"; raise InvalidProblem if that fails."""
    if is_standard_output(path):
        sys.stdout.write(text + "\n")
        return
    outputs.write_text(path, text + "\n")
    LOG.info("wrote %s", path)


def write_table(path: Path, columns: Columns) -> None:
    """Write a table as CSV or Parquet, chosen by the file ending; NaN is an empty cell."""
    from optloc.show.formats import write_csv, write_parquet

    (write_csv if is_csv(path) else write_parquet)(path, columns)
    LOG.info("wrote %s: %d rows", path, len(next(iter(columns.values()))))


def write_results(path: Path, results: Results) -> None:
    """Write fixes or tracks in the format of the file ending."""
    from optloc.show.formats import format_of

    form = format_of(path)
    form.write(path, results)
    LOG.info("wrote %s: %d rows", path, len(results.columns["status"]))
    if form.dated and results.undated:
        LOG.warning("%s has no dates; state --time-scale for a table, or time_scale under [epochs] of a file", path)


def is_csv(path: Path) -> bool:
    """Return whether a table is written as CSV; streams without an ending, such as a pipe, get CSV too."""
    return path.suffix.lower() == ".csv" or is_stream(path)


def uses_standard_output(*paths: Path | None, as_json: bool = False) -> bool:
    """Return whether one of the outputs, or JSON, goes to standard output; raise InvalidProblem if several do.

    The command then prints its text for people to standard error.
    """
    count = sum(map(is_standard_output, paths))
    if count + as_json > 1:
        raise InvalidProblem("only one output can go to standard output", "-", "name a file for the other outputs")
    return count > 0


def claim_outputs(
    *others: Path | None,
    table: Path | None = None,
    results: tuple[Path | None, Frame] | None = None,
    picture: Path | None = None,
    inputs: Sequence[Path] = (),
) -> None:
    """Raise InvalidProblem before the work for outputs that cannot or must not be written.

    Parameters
    ----------
    *others : Path, optional
        Text files.
    table, picture : Path, optional
        Files with a type by their ending.
    results : (Path or None, Frame), optional
        File with a format by its ending, and the frame of the fixes or tracks in it.
    inputs : sequence of Path
        Further inputs of the command; inputs that were already read are recorded.
    """
    if table is not None and not is_csv(table) and table.suffix.lower() not in {".parquet", ".pq"}:
        what = f"results of type {table.suffix or table.name!r} are unknown"
        raise InvalidProblem(what, str(table), "use .csv or .parquet")
    fixes, frame = results or (None, None)
    if fixes is not None:
        from optloc.show.formats import format_of

        format_of(fixes, frame)
    if is_standard_output(picture):
        raise InvalidProblem("a picture is no text for standard output", "-", f"name a file: {', '.join(PICTURES)}")
    if picture is not None and picture.suffix.lower() not in PICTURES and not is_stream(picture):
        what = f"pictures of type {picture.suffix or picture.name!r} are unknown"
        raise InvalidProblem(what, str(picture), f"use {', '.join(PICTURES[:-1])} or {PICTURES[-1]}")
    claim(table, fixes, picture, *others, inputs=inputs)


def write_picture(figure: Figure, path: Path) -> None:
    """Write a picture; raise InvalidProblem if that fails."""
    from optloc.show.pictures import save

    save(figure, path)
    LOG.info("wrote %s", path)


@contextmanager
def bar(title: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a progress bar on standard error; only terminals show the bar.

    The argument of the function is the number of finished steps since its last call. `total` is the number of all
    steps.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    # Standard output may be piped, so the bar is on standard error. One step needs no bar.
    console = Screen(stderr=True)
    shown = console.shows_bars and not quiet and total > 1
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=console, disable=not shown, transient=True) as progress:
        task = progress.add_task(title, total=total)
        yield lambda n: progress.update(task, advance=n)


@contextmanager
def meter(title: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of the finished and the total steps: a bar on terminals, elsewhere a line every few seconds."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    # `known` has the latest numbers. On a terminal the bar shows them, so the lines are muted.
    console, known = Screen(stderr=True), [0, 0]
    lines = Reporter(lambda: f"{title}: {known[0]} of about {known[1]}")
    lines.muted = quiet or console.shows_bars
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*parts, console=console, disable=quiet or not console.shows_bars, transient=True) as progress:
        task = progress.add_task(title, total=None)

        def tell(done: int, total: int) -> None:
            """Store the finished and the total steps, and update the bar."""
            known[:] = done, total
            progress.update(task, completed=done, total=total)

        lines.begin()
        try:
            yield tell
        finally:
            lines.end()


@contextmanager
def line(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield a function of a progress text: one changing line on terminals, elsewhere a line every few seconds."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console, known = Screen(stderr=True), [""]
    lines = Reporter(lambda: known[0])
    lines.muted = quiet or console.shows_bars
    parts = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*parts, console=console, disable=quiet or not console.shows_bars, transient=True) as progress:
        task = progress.add_task("", total=None)

        def tell(text: str) -> None:
            """Store the text, and update the line."""
            known[0] = text
            progress.update(task, description=text)

        lines.begin()
        try:
            yield tell
        finally:
            lines.end()
