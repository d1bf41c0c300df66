"""Figures of pages: how methods look, panels, and figures of matplotlib as SVG that stands in the text of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any

from optloc.show.pictures.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, YELLOW, figure_class, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# How methods look in every figure of a report: a colour, a mark and a dash each, told apart without colour too.

# Colours and marks together repeat after 24 methods, and then the dashes differ: 96 methods look different. Dashes
# change every second method, and once more where the colours begin again.
_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW, BLACK, GREY)
_MARKS = "osD^vP*X<>hp"
_DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))


@dataclass(frozen=True, slots=True)
class Look:
    """The look of a method.

    Parameters
    ----------
    number : int
        Of the method, in the order of the report.
    name : str
        The method.
    colour, mark : str
        As matplotlib takes them.
    dash : str or tuple
        Line style of matplotlib.
    """

    number: int
    name: str
    colour: str
    mark: str
    dash: str | tuple[float, tuple[float, ...]]

    @property
    def dashes(self) -> str:
        """Return its dashes as SVG has them, at twice the size of a figure; empty of a whole line."""
        return "" if isinstance(self.dash, str) else " ".join(f"{2 * length:g}" for length in self.dash[1])

    @property
    def line(self) -> str:
        """Return the identity of the method's lines in SVG, by which a page finds them."""
        return f"method-{self.number}"


def marks(methods: list[str]) -> dict[str, Look]:
    """Return the look of every method."""
    return {
        name: Look(i, name, _COLOURS[i % len(_COLOURS)], _MARKS[i % len(_MARKS)], _DASHES[(i // 2 + i // 8) % 4])
        for i, name in enumerate(methods)
    }


Looks = dict[str, Look]

# Inches, with texts of 8 to 10 points: two panels beside each other on a desk, one on a phone, and both can be read.
SIZE = (5.2, 3.5)
# Letters of a name with which only two columns of a legend fit the width of a figure; inches of one of its lines.
_WIDE, _LEGEND_LINE = 22, 0.16


def panel(title: str, size: tuple[float, float] = SIZE) -> tuple[Figure, Axes]:
    """Return an empty figure of one panel with a grid."""
    figure, (axes,) = panels("", 1, size)
    if title:
        axes.set_title(literal(title), fontsize=10)
    return figure, axes


def panels(title: str, count: int, size: tuple[float, float] = SIZE) -> tuple[Figure, list[Axes]]:
    """Return an empty figure of panels with grids side by side."""
    figure = figure_class()(figsize=(count * size[0], size[1]), layout="constrained")
    made = figure.subplots(1, count, squeeze=False).ravel().tolist()
    for axes in made:
        axes.grid(color=GREY, alpha=0.3, linewidth=0.6)
        axes.set_axisbelow(True)
    if title:
        figure.suptitle(literal(title), fontsize=10)
    return figure, made


def with_legend(figure: Figure) -> Figure:
    """Return a figure with a legend of the methods of all its panels below them."""
    shown: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    # Names of 22 letters leave room for two columns a panel, shorter ones for three.
    columns = len(figure.axes) * (2 if max(map(len, shown), default=0) > _WIDE else 3)
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=columns, frameon=False, fontsize=7)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + _LEGEND_LINE * -(-len(shown) // columns))
    figure.set_layout_engine("constrained")
    return figure


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


# Figures of matplotlib as SVG that stands in the text of a page.

_IDENTITY = re.compile(r'\bid="([^"]*)"')
_METHOD = re.compile(r'<g id="(method-\d+)"')


def svg_text(figure: Figure) -> str:
    """Return a figure as an SVG file, with text as text and equal bytes for equal figures."""
    from matplotlib import rc_context

    text = StringIO()
    # Text stays text, to be found and read aloud; the salt makes identities depend on the figure alone.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "optloc"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    figure.set_layout_engine("none")  # what is drawn again stays where it is: to find the place takes as long
    return text.getvalue()


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure as SVG that stands in the text of a page, and its name."""

    name: str
    svg: str


def inline(picture: Picture) -> Drawing:
    """Return a figure as an element of a page.

    Identities are made unique by the name of the figure, lines of methods get a class, and the width is that of the
    place where it stands.
    """
    name, text = picture.name, svg_text(picture.figure)
    text = text[text.index("<svg") :]
    # Every figure would bring its own: who made it, and when.
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _METHOD.sub(r'<g class="\1"', text)
    # Identities of one page must differ, and matplotlib gives equal ones to equal shapes of two figures.
    known = set(_IDENTITY.findall(text))
    text = _IDENTITY.sub(lambda m: f'id="{name}-{m[1]}"', text)
    text = re.sub(r"url\(#([^)]*)\)", lambda m: f"url(#{name}-{m[1]})", text)
    text = re.sub(r'href="#([^"]*)"', lambda m: f'href="#{name}-{m[1]}"' if m[1] in known else m[0], text)
    opening, rest = text.split(">", 1)
    opening = re.sub(r'\s(width|height)="[^"]*"', "", opening)
    opening = re.sub(r"\s+", " ", opening)
    return Drawing(name, f'{opening} role="img" aria-label="{escape(picture.title)}">{rest}')
