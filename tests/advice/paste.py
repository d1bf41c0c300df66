"""A suggestion of the advice, pasted into a problem file as a user does it."""

from __future__ import annotations

import re

TOP = frozenset({"propagation_speed", "wind", "covariance", "title"})
"""Keys that stand before the first table of a file."""
_AZIMUTHS, _DIFFERENCES = ('kind = "azimuth"', 'kind = "bearing"'), ('kind = "tdoa"', 'kind = "groa"')
KINDS = {"azimuth": _AZIMUTHS, "declination": _AZIMUTHS, "positive": _DIFFERENCES}
"""Lines of the tables of measurements into which a key belongs; all tables without an entry."""


def pasted(text: str, lines: str) -> str:
    """Return the text of a problem file with the lines of a suggestion.

    Keys before the first header of the lines belong to the tables of measurements, or to the top of the file. Keys
    below a header that the file has, such as ``[stations]``, go there. Keys replace keys of the same name, and rows of
    stations replace the rows with the same names. Other tables are appended at the end.
    """
    blocks = re.split(r"^(?=\[)", text, flags=re.MULTILINE)
    added = []
    for part in re.split(r"^(?=\[)", lines, flags=re.MULTILINE):
        header, _, rest = part.partition("\n") if part.startswith("[") else ("", "", part)
        if header.startswith("[["):
            added.append(part)
            continue
        for row, name in re.findall(r'^  (\{ name = ("[^"]*"), .*\},)$', rest, re.MULTILINE):
            pattern = re.compile(rf"^  \{{ name = {re.escape(name)},.*$", re.MULTILINE)
            blocks = [pattern.sub(f"  {row}", one) if one.startswith(header) else one for one in blocks]
        rest = re.sub(r"^rows = \[\n(  .*\n)*\]\n", "", rest, flags=re.MULTILINE)
        for line in filter(None, map(str.strip, rest.splitlines())):
            key = line.partition("=")[0].strip()
            wanted = header or ("" if key in TOP else "[[measurements]]")
            kinds = KINDS.get(key, ("",))
            for i, block in enumerate(blocks):
                if (block.startswith(wanted) if wanted else i == 0) and any(kind in block for kind in kinds):
                    blocks[i] = _with_key(block, key, line)
    return "".join(blocks) + "".join(f"\n{one}" for one in added)


def without_rows(text: str, members: tuple[int, ...]) -> str:
    """Return the text of a problem file without some rows of the measurements, numbers in the order of the file."""
    head, mark, rest = text.partition("[[measurements]]")
    lines = (mark + rest).splitlines(keepends=True)
    rows = [i for i, line in enumerate(lines) if line.startswith("  { ")]
    dropped = {rows[i] for i in members}
    return head + "".join(line for i, line in enumerate(lines) if i not in dropped)


def _with_key(block: str, key: str, line: str) -> str:
    """Return a table with a line for a key, in the place of the line that has the key."""
    block = re.sub(rf"^{key}\s*=.*\n", "", block, flags=re.MULTILINE)
    head, _, rest = block.partition("\n")
    return f"{head}\n{line}\n{rest}"
