"""What the reproduction of a paper gives: text, tables and pictures, and how they are written to a folder."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from optloc.base.errors import InvalidProblem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

S = TypeVar("S")

Tick = Callable[[], None]
"""Called after each piece of work."""

Size = Literal["quick", "full"]
"""How much is drawn."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text cells.

    Parameters
    ----------
    name : str
        Name of its files.
    title : str
        What it shows.
    header : tuple of str
        One name for each column.
    rows : tuple of tuple of str
        Cells.
    note : str
        How to read it.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Return the table with its note."""
        rule = ("---", *["---:"] * (len(self.header) - 1))
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.header, rule, *self.rows)]
        return "\n".join(lines) + (f"\n\n{self.note}" if self.note else "")


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure and what it shows.

    Parameters
    ----------
    name : str
        Name of its file.
    title : str
        What it shows.
    figure : matplotlib.figure.Figure
        The drawing.
    """

    name: str
    title: str
    figure: Figure


@dataclass(frozen=True, slots=True)
class Report:
    """A reproduced paper.

    Parameters
    ----------
    title : str
        Title of the page.
    facts : str
        Sample size, seed and whatever else is needed to make it again.
    opening, closing : str
        Text before and behind tables and pictures, in Markdown.
    tables : tuple of Table
        In reading order.
    pictures : tuple of Picture
        In reading order.
    """

    title: str
    facts: str
    opening: str
    closing: str
    tables: tuple[Table, ...]
    pictures: tuple[Picture, ...]

    def markdown(self) -> str:
        """Return the page that holds everything."""
        parts = [f"# {self.title}", self.made(), self.opening]
        parts += [f"## {p.title}\n\n![{p.title}]({p.name}.png)" for p in self.pictures]
        parts += [f"## {table.title}\n\n{table.markdown()}" for table in self.tables]
        return "\n\n".join([*parts, self.closing]).rstrip() + "\n"

    def made(self) -> str:
        """Return the sentence that says when and how the numbers were made."""
        return f"optloc {version('optloc')}, {datetime.now(UTC):%Y-%m-%d}, {self.facts}."


@dataclass(frozen=True, slots=True)
class Plan:
    """A reproduction that is ready to run.

    Parameters
    ----------
    work : int
        Number of pieces of about equal work.
    run : callable
        ``(tick) -> Report``; calls ``tick()`` after each piece.
    """

    work: int
    run: Callable[[Tick], Report]


@dataclass(frozen=True, slots=True)
class Study(Generic[S]):
    """How a paper is made again, in any sample size.

    Parameters
    ----------
    sizes : dict of "quick", "full" to sample
        What is drawn in either size.
    work : callable
        ``(sample) -> int``, the number of pieces of about equal work.
    run : callable
        ``(sample, seed, tick) -> Report``.
    """

    sizes: dict[Size, S]
    work: Callable[[S], int]
    run: Callable[[S, int, Tick], Report]

    def plan(self, sample: S, seed: int) -> Plan:
        """Return the reproduction with a sample of any size; the seed decides all draws.

        Raises
        ------
        InvalidProblem
            Where matplotlib is missing: before the work, not after it.
        """
        canvas(1.0, 1.0)
        return Plan(self.work(sample), partial(self.run, sample, seed))


def canvas(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches; raise InvalidProblem where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "reproduce", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure(figsize=(width, height), layout="constrained")


def write(report: Report, folder: Path) -> list[Path]:
    """Write README.md with everything, and every table as .csv and every picture as .png beside it.

    Parameters
    ----------
    report : Report
        What was reproduced.
    folder : Path
        Made where it does not exist.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InvalidProblem
        Where the folder cannot be written.
    """
    page = folder / "README.md"
    tables = [(folder / f"{table.name}.csv", table) for table in report.tables]
    pictures = [(folder / f"{picture.name}.png", picture) for picture in report.pictures]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page.write_text(report.markdown(), encoding="utf-8")
        for path, table in tables:
            with path.open("w", encoding="utf-8", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows([table.header, *table.rows])
        for path, picture in pictures:
            picture.figure.savefig(path, dpi=120)
    except OSError as error:
        raise InvalidProblem(
            f"the folder cannot be written ({error.strerror or error})", str(folder), "choose another place"
        ) from None
    return [page, *(path for path, _ in tables), *(path for path, _ in pictures)]
