"""A suggestion of the advice, pasted into a problem file as a user does it."""

from __future__ import annotations

import re

TOP = frozenset({"propagation_speed", "wind", "covariance", "title"})
"""Keys that stand before the first table of a file."""


def pasted(text: str, lines: str) -> str:
    """Return the text of a problem file with the lines of a suggestion.

    Keys before the first header of the lines belong to each table of measurements, or to the top of the file. They
    replace keys of the same name. Tables with a header are appended at the end.
    """
    start = re.search(r"^\[", lines, re.MULTILINE)
    keys, tables = (lines[: start.start()], lines[start.start() :]) if start else (lines, "")
    for line in keys.splitlines():
        key = line.partition("=")[0].strip()
        if key in TOP:
            text = re.sub(rf"^{key}\s*=.*\n", "", text, flags=re.MULTILINE)
            text = f"{line}\n{text}"
        elif key:
            text = re.sub(rf"^{key}\s*=.*\n", "", text, flags=re.MULTILINE)
            text = text.replace("[[measurements]]\n", f"[[measurements]]\n{line}\n")
    return f"{text}\n{tables}" if tables else text
