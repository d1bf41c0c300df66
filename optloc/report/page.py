"""A page: one HTML file that needs nothing else, from the templates of this package.

Python prepares values and templates write HTML: every text is escaped where it is written, but for what `asset` reads
and the SVG of figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

from optloc.report.figures import Drawing, Mark
from optloc.report.map import Canvas
from optloc.report.sheets import Sheet

if TYPE_CHECKING:
    from jinja2 import Environment


@dataclass(frozen=True, slots=True)
class Part:
    """A section of a page; what is empty is left out, the rest stands in this order.

    Parameters
    ----------
    name, title : str
        Its identity and its heading.
    text : str
        A paragraph.
    tables : sequence of Sheet
        Tables.
    drawings : sequence of Drawing
        Figures, side by side as the width allows.
    wide : bool
        Whether each figure has the whole width.
    maps : sequence of Canvas or Drawing
        Maps that move, and such as do not.
    headings : bool
        Whether the titles of maps that move stand above them.
    folded : sequence of Sheet
        Tables that open at a press.
    source : str
        The text of a study file, which opens at a press.
    note : str
        A paragraph in small print.
    """

    name: str
    title: str
    text: str = ""
    tables: Sequence[Sheet] = ()
    drawings: Sequence[Drawing] = ()
    wide: bool = False
    maps: Sequence[Canvas | Drawing] = ()
    headings: bool = False
    folded: Sequence[Sheet] = ()
    source: str = ""
    note: str = ""

    @property
    def moving(self) -> bool:
        """Return whether it needs the script of maps."""
        return any(isinstance(one, Canvas) for one in self.maps)


def write_page(
    title: str, parts: Sequence[Part], *, opening: Sequence[str] = (), facts: str = "", methods: Iterable[Mark] = ()
) -> str:
    """Return a page.

    Parameters
    ----------
    title : str
        Of the page.
    parts : sequence of Part
        Its sections; where there are several, links to them stand at the top.
    opening : sequence of str
        Paragraphs above them.
    facts : str
        The same in small print.
    methods : iterable of Mark
        Looks of methods for a legend that stays in view.
    """
    page = _environment().get_template("page.html")
    return page.render(title=title, parts=parts, opening=opening, facts=facts, methods=list(methods))


@cache
def _environment() -> Environment:
    # Imported where a page is written: the command line answers without it.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # Strict: a misspelt value is an error and not a hole in the page.
    made = Environment(
        loader=PackageLoader("optloc.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals["asset"] = _asset
    return made


def _asset(name: str) -> str:
    """Return a style sheet or a script, whose braces must not be read as those of a template."""
    return (files("optloc.report") / "templates" / name).read_text(encoding="utf-8")
