"""Figures of matplotlib as SVG that stands in the text of a page."""

from __future__ import annotations

import re
from io import StringIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_IDENTITY = re.compile(r'\bid="([^"]*)"')
_METHOD = re.compile(r'<g id="(method-\d+)"')


def svg_text(figure: Figure) -> str:
    """Return a figure as an SVG file, with text as text and equal bytes for equal figures."""
    from matplotlib import rc_context

    text = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "optloc"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def inline(figure: Figure, name: str, title: str) -> str:
    """Return a figure as an element of a page.

    Identities are made unique by the name of the figure, lines of methods get a class, and the width is that of the
    place where it stands.
    """
    text = svg_text(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _METHOD.sub(r'<g class="\1"', text)
    known = set(_IDENTITY.findall(text))
    text = _IDENTITY.sub(lambda m: f'id="{name}-{m[1]}"', text)
    text = re.sub(r"url\(#([^)]*)\)", lambda m: f"url(#{name}-{m[1]})", text)
    text = re.sub(r'href="#([^"]*)"', lambda m: f'href="#{name}-{m[1]}"' if m[1] in known else m[0], text)
    opening, rest = text.split(">", 1)
    opening = re.sub(r'\s(width|height)="[^"]*"', "", opening)
    opening = re.sub(r"\s+", " ", opening)
    return f'{opening} role="img" aria-label="{_quoted(title)}">{rest}'


def _quoted(text: str) -> str:
    from html import escape

    return escape(text, quote=True)
