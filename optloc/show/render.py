"""Renderings of an answer: plain text, HTML and a dictionary. All have the same sections, labels and words."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from optloc.base.outputs import visible
from optloc.show.fix_answer import TEXT_COLUMNS, FixAnswer, FixSheet, advice_lines

if TYPE_CHECKING:
    from jinja2 import Environment

# Characters in a line of text.
_WIDTH = 100


def text_of_answer(answer: FixAnswer) -> str:
    """Return an answer as plain text."""
    lines = [line for sheet in answer.main for line in sheet_lines(sheet)]
    lines += [visible(line) for line in advice_lines(answer.advice)]
    lines += [line for sheet in answer.details for line in sheet_lines(sheet)]
    return "\n".join(lines)


def line_of_answer(answer: FixAnswer) -> str:
    """Return an answer as one line, for descriptions of marks: the rows of each section, without tables.

    The texts are not escaped: each format escapes them in its own way.
    """
    parts = []
    for section in answer.sections:
        texts = [text for _, text in section.rows]
        if section.name == "use":
            parts += [_stopped(text) for text in texts]
        elif texts:
            parts.append(_stopped("; ".join(f"{label}: {text}" for label, text in section.rows)))
    return " ".join(parts)


def _stopped(text: str) -> str:
    """Return a text with a full stop at its end."""
    return text if text.endswith(".") else f"{text}."


def sheet_lines(sheet: FixSheet) -> Iterable[str]:
    """Yield the lines of a sheet: each column is as wide as its longest cell, and the last column is wrapped."""
    if sheet.title:
        yield visible(sheet.title)
    rows = [[visible(cell) for cell in row] for row in [*([sheet.head] if sheet.head else []), *sheet.rows]]
    widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
    indent = sum(widths) + 2 * len(widths)
    left = [not sheet.head or head in TEXT_COLUMNS for head in sheet.head or [""] * (len(widths) + 1)]
    for row in rows:
        cells = [
            f"{cell:{'<' if start else '>'}{width}}  " for cell, width, start in zip(row, widths, left, strict=False)
        ]
        lead, width = "".join(cells), max(_WIDTH - indent, 30)
        folded = [row[-1]] if len(row[-1]) <= width and row[-1].isprintable() else wrap(row[-1], width) or [""]
        yield (lead + folded[0]).rstrip()
        yield from (" " * indent + line for line in folded[1:])


def html_of_answer(answer: FixAnswer, picture: str = "") -> str:
    """Return an answer as HTML, from the template that pages use too; all texts are escaped.

    `picture` is HTML of a picture that follows the main part, for instance an SVG; empty for no picture.
    """
    module: Any = environment().get_template("answer.html").module
    return str(module.shown(answer, picture))


def html_of_sheet(sheet: FixSheet) -> str:
    """Return one sheet as an HTML table; all texts are escaped."""
    module: Any = environment().get_template("answer.html").module
    return str(module.sheet(sheet))


def dict_of_answer(answer: FixAnswer) -> dict[str, Any]:
    """Return an answer as lists and texts in JSON types: the sections in order, with their rows and tables."""
    sections = [
        {
            "section": one.name,
            "rows": [{"label": label, "text": text} for label, text in one.rows],
            "tables": [
                {"title": sheet.title, "columns": list(sheet.head), "rows": [list(row) for row in sheet.rows]}
                for sheet in one.sheets
            ],
        }
        for one in answer.sections
    ]
    advice = [{"seen": one.seen, "advice": one.advice, "toml": one.toml} for one in answer.advice]
    return {"title": answer.title, "verdict": answer.verdict, "sections": sections, "advice": advice}


@cache
def environment() -> Environment:
    """Return the environment of the templates, which reads and fills the templates of this package."""
    # Import here: commands that write no page run without jinja2.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # With StrictUndefined, a misspelt value raises an error instead of leaving a gap in the page.
    made = Environment(
        loader=PackageLoader("optloc.show"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["visible"] = visible
    made.globals["text_columns"] = TEXT_COLUMNS
    return made


def asset(name: str) -> str:
    """Return a style sheet or a script as text; its braces must not be parsed as template syntax."""
    return (files("optloc.show") / "templates" / name).read_text(encoding="utf-8")
