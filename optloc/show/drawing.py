"""Figures of HTML pages: the line style of each method, empty panels, and matplotlib figures as inline SVG."""

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


# Line styles: each method has a colour, a mark and a dash, the same in every figure of a report. Marks and dashes also
# distinguish methods in grey print and for colour-blind readers.

# Colour and mark together repeat after 24 methods, and then the dash differs. So 96 methods look different. The dash
# changes at every second method, and once more when the colours repeat.
_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW, BLACK, GREY)
_MARKS = "osD^vP*X<>hp"
_DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))


@dataclass(frozen=True, slots=True)
class Look:
    """The line style of a method.

    Parameters
    ----------
    number : int
        Index of the method in the report.
    name : str
        Name of the method.
    colour, mark : str
        Colour and marker of matplotlib.
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
        """Return the dashes as an SVG `stroke-dasharray`, twice as long as in a figure; empty for a solid line."""
        return "" if isinstance(self.dash, str) else " ".join(f"{2 * length:g}" for length in self.dash[1])

    @property
    def line(self) -> str:
        """Return the SVG class of the method's lines, by which the script of a page finds them."""
        return f"method-{self.number}"


def marks(methods: list[str]) -> dict[str, Look]:
    """Return the line style of each method, by name.

    A method with the same place in the list always has the same style.
    """
    return {
        name: Look(i, name, _COLOURS[i % len(_COLOURS)], _MARKS[i % len(_MARKS)], _DASHES[(i // 2 + i // 8) % 4])
        for i, name in enumerate(methods)
    }


Looks = dict[str, Look]

# Inches, with texts of 8 to 10 points. Two panels fit side by side on a desktop screen and one on a phone, and texts
# stay readable on both.
SIZE = (5.2, 3.5)
# Letters: if a name is longer, only two columns of a legend fit the width of a panel. Inches: height of a legend line.
_WIDE, _LEGEND_LINE = 22, 0.16


def panel(title: str, size: tuple[float, float] = SIZE) -> tuple[Figure, Axes]:
    """Return an empty figure with one panel and a grid; `size` is in inches."""
    figure, (axes,) = panels("", 1, size)
    if title:
        axes.set_title(literal(title), fontsize=10)
    return figure, axes


def panels(title: str, count: int, size: tuple[float, float] = SIZE) -> tuple[Figure, list[Axes]]:
    """Return an empty figure with `count` panels side by side, each with a grid; `size` of a panel is in inches."""
    figure = figure_class()(figsize=(count * size[0], size[1]), layout="constrained")
    made = figure.subplots(1, count, squeeze=False).ravel().tolist()
    for axes in made:
        axes.grid(color=GREY, alpha=0.3, linewidth=0.6)
        axes.set_axisbelow(True)
    if title:
        figure.suptitle(literal(title), fontsize=10)
    return figure, made


def with_legend(figure: Figure) -> Figure:
    """Return the figure after adding one legend below all panels; it lists each method once.

    The figure becomes higher by the height of the legend, so that the panels keep about their size.
    """
    shown: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    # With names longer than 22 letters, two columns fit below a panel; with shorter names, three columns fit.
    columns = len(figure.axes) * (2 if max(map(len, shown), default=0) > _WIDE else 3)
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=columns, frameon=False, fontsize=7)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + _LEGEND_LINE * -(-len(shown) // columns))
    figure.set_layout_engine("constrained")
    return figure


@dataclass(frozen=True, slots=True)
class Picture:
    """A matplotlib figure with its file name and title.

    Parameters
    ----------
    name : str
        File name without an ending.
    title : str
        Description of the figure.
    figure : matplotlib.figure.Figure
        The figure.
    """

    name: str
    title: str
    figure: Figure


# Matplotlib figures as inline SVG.

_IDENTITY = re.compile(r'\bid="([^"]*)"')
_METHOD = re.compile(r'<g id="(method-\d+)"')


def svg_text(figure: Figure) -> str:
    """Return a figure as an SVG file; equal figures give equal bytes."""
    from matplotlib import rc_context

    text = StringIO()
    # Write text as text, so that readers can search it and screen readers can read it. With a fixed salt, ids depend
    # only on the figure.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "optloc"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    figure.set_layout_engine("none")  # Keep the layout for later drawings: computing a layout takes as long as drawing.
    return text.getvalue()


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure as inline SVG.

    Parameters
    ----------
    name : str
        Name of the figure, which begins all its ids.
    svg : str
        The SVG element.
    """

    name: str
    svg: str


def inline(picture: Picture) -> Drawing:
    """Return a figure as an inline SVG element of a page.

    The name of the figure becomes part of each id, so that ids are unique in the page. Lines of methods get a class
    instead of an id. The element has no fixed size and fills the width of its container.
    """
    name, text = picture.name, svg_text(picture.figure)
    text = text[text.index("<svg") :]
    # Remove the metadata, which matplotlib writes into each figure.
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _METHOD.sub(r'<g class="\1"', text)
    # Ids must be unique in a page, but matplotlib gives equal shapes in two figures the same id.
    known = set(_IDENTITY.findall(text))
    text = _IDENTITY.sub(lambda m: f'id="{name}-{m[1]}"', text)
    text = re.sub(r"url\(#([^)]*)\)", lambda m: f"url(#{name}-{m[1]})", text)
    text = re.sub(r'href="#([^"]*)"', lambda m: f'href="#{name}-{m[1]}"' if m[1] in known else m[0], text)
    opening, rest = text.split(">", 1)
    opening = re.sub(r'\s(width|height)="[^"]*"', "", opening)
    opening = re.sub(r"\s+", " ", opening)
    return Drawing(name, f'{opening} role="img" aria-label="{escape(picture.title)}">{rest}')
