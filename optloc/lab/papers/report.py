"""A paper made again: its study, its tables and figures, and the page that quotes them.

A paper is one module with a `STUDY` (two where the simulation is long) and one page, ``NAME.md`` beside it: Markdown
with the essay, the titles and the notes. The page names cells of the recomputed tables where it states a number, so
that prose and tables cannot disagree. In it

- ``table("slow")`` is a table, whose title is the heading above it and whose note is the text below it;
- ``cell("slow", "line fit", "mean error, km")`` is a cell as it stands: table, first cells of the row, column;
- ``value(...)`` is the first number of a cell, ``value(..., part=1)`` the second; ``digits`` rounds what is made of it;
- ``made``, ``seed`` and ``sample`` say how the numbers were made, and ``scene`` is the module of the paper.
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
from optloc.problem import InvalidProblem
from optloc.show import ABSENT, Picture, TextTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

S = TypeVar("S")

Tick = Callable[[], None]
"""Called after each piece of work."""

Size = Literal["quick", "full"]
"""How much is drawn."""


@dataclass(frozen=True, slots=True)
class Report:
    """A reproduced paper.

    Parameters
    ----------
    page : str
        The whole page in Markdown.
    tables : tuple of TextTable
        With the titles and notes that they have on the page.
    pictures : tuple of Picture
        The figures that the page shows.
    """

    page: str
    tables: tuple[TextTable, ...]
    pictures: tuple[Picture, ...]

    def markdown(self) -> str:
        """Return the page that holds everything."""
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

    def reproduction(self, sample: S, seed: int) -> Reproduction:
        """Return the reproduction with a sample of any size; the seed decides all draws.

        Raises
        ------
        InvalidProblem
            Where matplotlib is missing: before the work, not after it.
        """
        canvas(1.0, 1.0)  # raises where there is none
        return Reproduction(self.work(sample), partial(self.run, sample, seed))


# The page: a Markdown template whose numbers are cells of the tables.


def tabulate(name: str, header: Iterable[str], rows: Iterable[tuple[str, ...]]) -> TextTable:
    """Return a table whose title and note stand on the page of its paper."""
    return TextTable(name, "", tuple(header), tuple(rows))


def typeset(name: str, sample: object, seed: int, tables: Sequence[TextTable], figures: Mapping[str, Figure]) -> Report:
    """Return the report of a paper: its page filled from the tables, and what the page says of each of them.

    Parameters
    ----------
    name : str
        The paper; its page is ``NAME.md`` beside this module.
    sample : object
        How much was drawn.
    seed : int
        What decided the draws.
    tables : sequence of TextTable
        Everything that the page quotes.
    figures : mapping of str to matplotlib.figure.Figure
        By the names that the page gives to their files.
    """
    made = f"optloc {version('optloc')}, {datetime.now(UTC):%Y-%m-%d}"
    page = render(name, {each.name: each for each in tables}, made=made, seed=seed, sample=sample)
    pictures = []
    for file, figure in figures.items():
        shown = re.search(rf"!\[(.*)\]\({file}\.png\)", page)
        assert shown is not None, f"the page of {name} does not show {file}"
        pictures.append(Picture(file, shown[1], figure))
    return Report(page, tuple(_entitle(each, page) for each in tables), tuple(pictures))


def render(name: str, tables: Mapping[str, TextTable], *, made: str, seed: int, sample: object) -> str:
    """Return the page of a paper, filled from tables.

    Parameters
    ----------
    name : str
        The paper.
    tables : mapping of str to TextTable
        By name.
    made : str
        Program and day.
    seed, sample : int, object
        How the tables were drawn.
    """
    import jinja2

    # Markdown, not HTML: nothing is to be escaped. A misspelt name raises instead of leaving a hole in a sentence.
    house = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False)  # noqa: S701
    house.filters["digits"] = digits
    house.globals.update(
        table=lambda key: tables[key].markdown(),
        cell=lambda key, *place: tables[key].cell(*place),
        value=lambda key, *place, part=0: tables[key].value(*place, part=part),
        scene=import_module(f"optloc.lab.papers.{name}"),
    )
    text = files("optloc.lab.papers").joinpath(f"{name}.md").read_text(encoding="utf-8")
    return _wrap(house.from_string(text).render(made=made, seed=seed, sample=sample)) + "\n"


def _wrap(page: str) -> str:
    """Return a page whose paragraphs and items are broken at 120 characters, whatever was filled in."""
    out = []
    for block in page.strip().split("\n\n"):
        if block.startswith(("#", "|", "!")):
            out.append(block)
            continue
        items = []
        for item in re.split(r"\n(?=- |\d+\. )", block):
            lead = re.match(r"- |\d+\. ", item)
            indent = " " * len(lead[0]) if lead else ""
            items.append(fill(" ".join(item.split()), 120, subsequent_indent=indent, break_on_hyphens=False))
        out.append("\n".join(items))
    return "\n\n".join(out)


def digits(number: float, count: int = 3) -> str:
    """Return a number with so many significant digits and no exponent, a dash where there is none."""
    if number == 0.0 or not isfinite(number):
        return "0" if number == 0.0 else ABSENT
    rounded = float(f"{number:.{count - 1}e}")  # first, since 9.96 has a digit more when it is 10
    return f"{rounded:.{max(count - 1 - floor(log10(abs(rounded))), 0)}f}"


def _entitle(table: TextTable, page: str) -> TextTable:
    """Return a table with the heading above it and the text below it on a page."""
    before, _, after = page.partition(table.markdown())
    title = before.rpartition("\n## ")[2].partition("\n")[0]
    # One line: a page breaks its lines for those who write it, a terminal for those who read it.
    return replace(table, title=title, note=" ".join(after.partition("\n## ")[0].split()))


# Figures: what those of several papers share.


class Ink:
    """The palette of Okabe and Ito, which the colour-blind can tell apart."""

    BLACK, GREY, BLUE, SKY = "#000000", "#7F7F7F", "#0072B2", "#56B4E9"
    RED, ORANGE, GREEN, PINK = "#D55E00", "#E69F00", "#009E73", "#CC79A7"


def canvas(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches; raise InvalidProblem where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InvalidProblem(
            "pictures need matplotlib", "reproduce", "install it with: pip install 'optloc[plot]'"
        ) from None
    return Figure(figsize=(width, height), layout="constrained")


def scale(ax: Axes) -> None:
    """Make the axis of errors logarithmic, with plain numbers at 1, 2 and 5 of every decade."""

    def between(value: float, _: float) -> str:
        low, high = ax.get_ylim()
        crowded = high > 1e4 * low  # of more than four decades the names of the decades alone can be read
        return f"{value:g}" if not crowded and f"{value:.0e}"[0] in "25" else ""

    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(between)


def label(ax: Axes, across: str, up: str) -> None:
    """Name both axes and draw a faint grid."""
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.grid(visible=True, which="both", alpha=0.25)  # faint: the curves are what is looked at


def explain(figure: Figure, columns: int | None = None) -> None:
    """Put one legend for all panels below them; a name that several panels share stands once."""
    found = [ax.get_legend_handles_labels() for ax in figure.axes]
    shown = {name: handle for handles, names in found for handle, name in zip(handles, names, strict=True)}
    figure.legend(
        list(shown.values()), list(shown), loc="outside lower center", ncols=columns or len(shown), frameon=False
    )


def percent(share: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * share:.1f} %"


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
        Where a file cannot be written; then none is.
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
