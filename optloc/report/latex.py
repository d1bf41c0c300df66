"""Tables for papers: LaTeX with the rules of booktabs."""

from __future__ import annotations

from optloc.papers.report import Table

_SPECIAL = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\ensuremath{<}",
    ">": r"\ensuremath{>}",
    "≤": r"\ensuremath{\le}",
    "±": r"\ensuremath{\pm}",
    "·": r"\ensuremath{\cdot}",
    "×": r"\ensuremath{\times}",
    "µ": r"\ensuremath{\mu}",
    "–": "--",
    "°": r"\ensuremath{^\circ}",
}
_RAISED = dict(zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True))


def escaped(text: str) -> str:
    """Return text as LaTeX sets it."""
    out, power = [], ""
    for sign in [*text, ""]:
        if sign in _RAISED and sign:
            power += _RAISED[sign]
            continue
        if power:
            out.append(rf"\ensuremath{{^{{{power}}}}}")
            power = ""
        out.append(_SPECIAL.get(sign, sign))
    return "".join(out)


def latex(table: Table, words: int = 1) -> str:
    """Return a table that breaks across pages; it needs the packages booktabs and longtable.

    Parameters
    ----------
    table : Table
        Text cells.
    words : int
        How many columns at the left are words; the others stand to the right.
    """
    columns = "l" * words + "r" * (len(table.header) - words)
    head = " & ".join(map(escaped, table.header)) + r" \\"
    rows = [" & ".join(map(escaped, row)) + r" \\" for row in table.rows]
    caption = escaped(f"{table.title}. {table.note}".strip())
    lines = [
        "% needs \\usepackage{booktabs, longtable}",
        rf"\begin{{longtable}}{{{columns}}}",
        rf"\caption{{{caption}}}\label{{tab:{table.name}}}\\",
        r"\toprule",
        head,
        r"\midrule\endfirsthead",
        r"\toprule",
        head,
        r"\midrule\endhead",
        r"\bottomrule\endlastfoot",
        *rows,
        r"\end{longtable}",
    ]
    return "\n".join(lines) + "\n"
