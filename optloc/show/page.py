"""HTML pages: one self-contained file from the templates of this package, with interactive maps.

Python prepares the values, and templates write the HTML. Templates escape all texts except the style sheets and scripts
that `asset` reads, and the SVG of figures.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256

from optloc.show.drawing import Drawing, Look
from optloc.show.fix_answer import FixAnswer
from optloc.show.maps.canvas import Canvas
from optloc.show.render import asset, environment
from optloc.show.sheet import Sheet


@dataclass(frozen=True, slots=True)
class PagePart:
    """A section of a page. The page shows the parts of a section in the order of this list and omits empty parts.

    Parameters
    ----------
    name, title : str
        Id and heading of the section.
    text : str
        A paragraph.
    tables : sequence of Sheet
        Tables.
    drawings : sequence of Drawing
        Figures, side by side if the width allows.
    wide : bool
        Whether each figure has the whole width.
    maps : sequence of Canvas or Drawing
        Interactive maps, or figures of maps.
    headings : bool
        Whether interactive maps have their titles as headings.
    folded : sequence of Sheet
        Tables that are folded until the reader opens them.
    source : str
        Text of a study file, folded until the reader opens it.
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
        """Return whether the section has an interactive map and so needs the script of maps."""
        return any(isinstance(one, Canvas) for one in self.maps)


def write_page(
    title: str,
    parts: Sequence[PagePart],
    *,
    opening: Sequence[str] = (),
    facts: str = "",
    methods: Iterable[Look] = (),
    live: bool = False,
    answers: Sequence[FixAnswer] = (),
) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    title : str
        Title of the page.
    parts : sequence of PagePart
        Sections of the page; if there are several, the page begins with links to them.
    opening : sequence of str
        Paragraphs above the sections.
    facts : str
        A paragraph in small print above the sections.
    methods : iterable of Look
        Methods for a legend that stays visible.
    live : bool
        Whether the map requests new fixes from its server once a second.
    answers : sequence of FixAnswer
        Answers as text above the sections; they need no script.
    """
    page = environment().get_template("page.html")
    moving = any(part.moving for part in parts)
    names = ["page.js", *(_MAP_SCRIPTS if moving else ()), *(["live.js"] if live else ())]
    scripts = ['"use strict";\n' + "".join(asset(name) for name in names)]
    return page.render(
        title=title,
        parts=parts,
        opening=opening,
        facts=facts,
        methods=list(methods),
        answers=answers,
        styles=[asset(name) for name in ("page.css", *(("map.css",) if moving else ()))],
        scripts=scripts,
        policy=_policy(scripts, live=live),
    )


# Scripts of interactive maps in the order in which they must run.
_MAP_SCRIPTS = ("map_labels.js", "map_list.js", "map.js")


def _policy(scripts: Sequence[str], *, live: bool) -> str:
    """Return the Content-Security-Policy of a page: its own scripts only, no network except for a live map.

    A browser runs only the scripts whose hashes are in the policy. Figures of matplotlib have styles in attributes, so
    styles need no hash.
    """
    hashes = " ".join(f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in scripts)
    connect = "'self'" if live else "'none'"
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; connect-src {connect}; "
        "base-uri 'none'; form-action 'none'"
    )


# A row has about 200 bytes, so that the table adds at most a fifth of a megabyte.
LISTED = 1000
"""Number of fixes that the table of a page shows completely; of more, it shows the first and the last."""
