"""The page of a report: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files

from optloc.papers.report import Picture
from optloc.report.figures import Mark, inline
from optloc.report.sheets import Sheet

_LONG = 60


def page(title: str, parts: Sequence[tuple[str, str, str]], opening: str, legend: str, *, maps: bool) -> str:
    """Return the whole page.

    Parameters
    ----------
    title : str
        Of the page.
    parts : sequence of (identity, title, HTML)
        Sections in reading order.
    opening : str
        HTML above them.
    legend : str
        HTML that stays in view.
    maps : bool
        Whether there are maps, which need their script.
    """
    links = "".join(f'<a href="#{name}">{escape(text)}</a>' for name, text, _ in parts if len(parts) > 1)
    body = "".join(f'<section id="{name}"><h2>{escape(text)}</h2>{inner}</section>' for name, text, inner in parts)
    scripts = ["page.js", *(["map.js"] if maps else [])]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{_file('page.css')}</style></head><body>"
        f"<h1>{escape(title)}</h1>{opening}<nav>{links}</nav>{legend}{body}"
        + "".join(f"<script>{_file(name)}</script>" for name in scripts)
        + "</body></html>\n"
    )


def _file(name: str) -> str:
    return (files("optloc.report") / name).read_text(encoding="utf-8")


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of plain text."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def table(sheet: Sheet) -> str:
    """Return a table in a box of its own that scrolls, and its note."""
    shown = sheet.shown
    head = "".join(
        f'<th scope="col"{_kind(i, sheet.words, "")}>{escape(text)}</th>' for i, text in enumerate(shown.header)
    )
    rows = "".join(
        "<tr>" + "".join(f"<td{_kind(i, sheet.words, c)}>{escape(c)}</td>" for i, c in enumerate(row)) + "</tr>"
        for row in shown.rows
    )
    note = paragraph(shown.note, "soft") if shown.note else ""
    return (
        f'<div class="scroll" tabindex="0"><table id="table-{shown.name}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


def _kind(column: int, words: int, text: str) -> str:
    names = [*(["word"] if column < words else []), *(["long"] if len(text) > _LONG else [])]
    return f' class="{" ".join(names)}"' if names else ""


def folded(text: str, inner: str) -> str:
    """Return something that opens at a press; it is open on paper."""
    return f"<details><summary>{escape(text)}</summary>{inner}</details>"


def figures(pictures: Iterable[Picture], *, wide: bool = False) -> str:
    """Return figures side by side as the width allows."""
    parts = [f'<figure id="figure-{p.name}">{inline(p.figure, p.name, p.title)}</figure>' for p in pictures]
    return f'<div class="figures{" wide" if wide else ""}">{"".join(parts)}</div>'


def legend(looks: dict[str, Mark]) -> str:
    """Return the looks of all methods as buttons that make their lines stand out."""
    parts = [
        f'<button type="button" data-method="{mark.line}" aria-pressed="false">'
        f"{_swatch(mark)}{escape(mark.name)}</button>"
        for mark in looks.values()
    ]
    return f'<div class="legend" role="toolbar" aria-label="Methods">{"".join(parts)}</div>'


def _swatch(mark: Mark) -> str:
    dash = "" if isinstance(mark.dash, str) else f' stroke-dasharray="{" ".join(f"{2 * v:g}" for v in mark.dash[1])}"'
    return (
        '<svg width="34" height="12" viewBox="0 0 34 12" aria-hidden="true">'
        f'<path d="M0 6H34" stroke="{mark.colour}" stroke-width="2.5"{dash}/>'
        f"{_SHAPES[mark.mark].format(c=mark.colour)}</svg>"
    )


_SHAPES = {
    "o": '<circle cx="17" cy="6" r="4" fill="{c}"/>',
    **{
        mark: f'<path d="{shape}" fill="{{c}}"/>'
        for mark, shape in {
            "s": "M13 2h8v8h-8z",
            "D": "M17 1l5 5l-5 5l-5-5z",
            "^": "M17 1.5l4.5 8.5h-9z",
            "v": "M17 10.5l4.5-8.5h-9z",
            "<": "M12.5 6l8.5-4.5v9z",
            ">": "M21.5 6l-8.5-4.5v9z",
            "P": "M15.5 1.5h3v3h3v3h-3v3h-3v-3h-3v-3h3z",
            "X": "M14 1.5l3 3l3-3l2 2l-3 2.5l3 2.5l-2 2l-3-3l-3 3l-2-2l3-2.5l-3-2.5z",
            "*": "M17 1l1.3 3.4h3.7l-3 2.2l1.2 3.7l-3.2-2.2l-3.2 2.2l1.2-3.7l-3-2.2h3.7z",
            "h": "M17 1.5l4 2.2v4.6l-4 2.2l-4-2.2v-4.6z",
            "p": "M17 1.5l4.5 3.3l-1.7 5.4h-5.6l-1.7-5.4z",
        }.items()
    },
}
