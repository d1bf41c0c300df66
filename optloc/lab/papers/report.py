"""Reproduction of a paper: its simulation, its tables and figures, and the page with their numbers.

A paper is one module with a `STUDY` (two modules for a long simulation) and one page, the file ``NAME.md`` in the same
folder. The page is a Markdown template with the text, the titles and the notes. Where the page states a number, it
names a cell of the recomputed tables, so that text and tables always agree. The template has these functions:

- ``table("slow")`` is a table; its title is the heading above it, and its note is the text below it;
- ``cell("slow", "line fit", "mean error, km")`` is the text of a cell: table, first cells of the row, column;
- ``value(...)`` is the first number of a cell, ``value(..., part=1)`` the second; ``digits`` rounds the result;
- ``made``, ``seed`` and ``sample`` are version and date, seed and sizes; ``scene`` is the module of the paper.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.resources import files
from math import floor, isfinite, log10
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from optloc.files import make_folder, replace_together, write_text, written
from optloc.show import ABSENT, Picture, TextTable, figure_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

S = TypeVar("S")

Tick = Callable[[], None]
"""Function that is called after each piece of work, to show progress."""

Size = Literal["quick", "full"]
"""Size of the samples."""


@dataclass(frozen=True, slots=True)
class Report:
    """A reproduced paper.

    Parameters
    ----------
    page : str
        The whole page in Markdown.
    tables : tuple of TextTable
        The tables, with their titles and notes from the page.
    pictures : tuple of Picture
        The figures of the page.
    """

    page: str
    tables: tuple[TextTable, ...]
    pictures: tuple[Picture, ...]

    def markdown(self) -> str:
        """Return the whole page."""
        return self.page


@dataclass(frozen=True, slots=True)
class Reproduction:
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
    """Reproduction of a paper in any sample size.

    Parameters
    ----------
    sizes : dict of "quick", "full" to sample
        Sample of each size.
    work : callable
        ``(sample) -> int``, the number of pieces of about equal work.
    run : callable
        ``(sample, seed, tick) -> Report``.
    """

    sizes: dict[Size, S]
    work: Callable[[S], int]
    run: Callable[[S, int, Tick], Report]

    def reproduction(self, sample: S, seed: int) -> Reproduction:
        """Return the reproduction with a sample of any size; `seed` is the seed of all random numbers.

        Raise InvalidProblem if matplotlib is missing: before the work, not after it.
        """
        canvas(1.0, 1.0)  # raises if matplotlib is missing
        return Reproduction(self.work(sample), partial(self.run, sample, seed))


# The page: a Markdown template whose numbers are cells of the tables.


def tabulate(name: str, header: Iterable[str], rows: Iterable[tuple[str, ...]]) -> TextTable:
    """Return a table without title and note; `typeset` takes them from the page of the paper."""
    return TextTable(name, "", tuple(header), tuple(rows))


def typeset(name: str, sample: object, seed: int, tables: Sequence[TextTable], figures: Mapping[str, Figure]) -> Report:
    """Return the report of a paper: its page with the numbers of the tables, and the tables with titles of the page.

    Parameters
    ----------
    name : str
        The paper; its page is the file ``NAME.md`` in the folder of this module.
    sample : object
        Sizes of the samples.
    seed : int
        Seed of the draws.
    tables : sequence of TextTable
        All tables of the page.
    figures : mapping of str to matplotlib.figure.Figure
        Figures by the names of their files on the page.
    """
    made = f"optloc {version('optloc')}, {datetime.now(UTC):%Y-%m-%d}"
    page = render(name, {table.name: table for table in tables}, made=made, seed=seed, sample=sample)
    pictures = []
    for file, figure in figures.items():
        image = re.search(rf"!\[(.*)\]\({file}\.png\)", page)
        assert image is not None, f"the page of {name} does not show {file}"
        pictures.append(Picture(file, image[1], figure))
    return Report(page, tuple(_entitle(table, page) for table in tables), tuple(pictures))


def render(name: str, tables: Mapping[str, TextTable], *, made: str, seed: int, sample: object) -> str:
    """Return the page of a paper with the numbers of tables.

    Parameters
    ----------
    name : str
        The paper.
    tables : mapping of str to TextTable
        Tables by name.
    made : str
        Version of optloc and date.
    seed, sample : int, object
        Seed and sizes of the samples.
    """
    import jinja2

    # Markdown needs no escapes of HTML. A misspelt name raises an error instead of leaving a gap in a sentence.
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False)  # noqa: S701
    environment.filters["digits"] = digits
    # Functions that a page calls in its text.
    environment.globals.update(
        table=lambda key: tables[key].markdown(),
        cell=lambda key, *key_path: tables[key].cell(*key_path),
        value=lambda key, *key_path, part=0: tables[key].value(*key_path, part=part),
        scene=import_module(f"optloc.lab.papers.{name}"),
    )
    text = files("optloc.lab.papers").joinpath(f"{name}.md").read_text(encoding="utf-8")
    return _wrap(environment.from_string(text).render(made=made, seed=seed, sample=sample)) + "\n"


def _wrap(page: str) -> str:
    """Return a page whose paragraphs and items are wrapped at 120 characters.

    Lines change their length when the numbers are inserted.
    """
    blocks = []
    for block in page.strip().split("\n\n"):
        if block.startswith(("#", "|", "!")):
            blocks.append(block)
            continue
        items = []
        for item in re.split(r"\n(?=- |\d+\. )", block):
            bullet = re.match(r"- |\d+\. ", item)
            indent = " " * len(bullet[0]) if bullet else ""
            items.append(fill(" ".join(item.split()), 120, subsequent_indent=indent, break_on_hyphens=False))
        blocks.append("\n".join(items))
    return "\n\n".join(blocks)


def digits(number: float, count: int = 3) -> str:
    """Return a number with `count` significant digits and no exponent; a dash if it is not finite."""
    if number == 0.0 or not isfinite(number):
        return "0" if number == 0.0 else ABSENT
    rounded = float(f"{number:.{count - 1}e}")  # round first: 9.96 gets another digit when it becomes 10
    return f"{rounded:.{max(count - 1 - floor(log10(abs(rounded))), 0)}f}"


def _entitle(table: TextTable, page: str) -> TextTable:
    """Return a table with its title and note: the heading above it and the text below it on a page."""
    before, _, after = page.partition(table.markdown())
    title = before.rpartition("\n## ")[2].partition("\n")[0]
    # One line: the page wraps lines for its authors, and a terminal wraps them for its readers.
    return replace(table, title=title, note=" ".join(after.partition("\n## ")[0].split()))


# Common parts of the figures of papers.


class Ink:
    """The palette of Okabe and Ito, which colour-blind readers can distinguish."""

    BLACK, GREY, BLUE, SKY = "#000000", "#7F7F7F", "#0072B2", "#56B4E9"
    RED, ORANGE, GREEN, PINK = "#D55E00", "#E69F00", "#009E73", "#CC79A7"


def canvas(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches; raise InvalidProblem if matplotlib is not installed."""
    return figure_class()(figsize=(width, height), layout="constrained")


def scale(ax: Axes) -> None:
    """Make the axis of errors logarithmic, with plain numbers at 1, 2 and 5 of every decade."""

    def between(value: float, _: float) -> str:
        low, high = ax.get_ylim()
        crowded = high > 1e4 * low  # beyond four decades there is room for the labels of decades only
        return f"{value:g}" if not crowded and f"{value:.0e}"[0] in "25" else ""

    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(between)


def label(ax: Axes, across: str, up: str) -> None:
    """Label both axes and draw a faint grid; `across` is the label of the x axis, and `up` the label of the y axis."""
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.grid(visible=True, which="both", alpha=0.25)  # faint, so that the curves dominate


def explain(figure: Figure, columns: int | None = None) -> None:
    """Draw one legend for all panels below them; a label of several panels appears once."""
    entries = [ax.get_legend_handles_labels() for ax in figure.axes]
    by_name = {name: handle for handles, names in entries for handle, name in zip(handles, names, strict=True)}
    figure.legend(
        list(by_name.values()), list(by_name), loc="outside lower center", ncols=columns or len(by_name), frameon=False
    )


def percent(share: float) -> str:
    """Return a share (0 to 1) as text in per cent."""
    return f"{100.0 * share:.1f} %"


def write(report: Report, folder: Path) -> list[Path]:
    """Write the page as README.md, and in the same folder every table as .csv and every picture as .png.

    Parameters
    ----------
    report : Report
        The reproduced paper.
    folder : Path
        Output folder; created if it does not exist.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InvalidProblem
        If a file cannot be written; then no file is written.
    """
    page = folder / "README.md"
    tables = [(folder / f"{table.name}.csv", table) for table in report.tables]
    pictures = [(folder / f"{picture.name}.png", picture) for picture in report.pictures]
    make_folder(folder)
    with replace_together():
        write_text(page, report.markdown())
        for path, table in tables:
            with written(path) as file, file.open("w", encoding="utf-8", newline="") as lines:
                csv.writer(lines, lineterminator="\n").writerows([table.header, *table.rows])
        for path, picture in pictures:
            with written(path) as file:
                picture.figure.savefig(file, dpi=120)
    return [page, *(path for path, _ in tables), *(path for path, _ in pictures)]
