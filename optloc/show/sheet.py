"""Tables of pages, with text cells and with plain numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

from optloc.base.short_form import HasShortForm

if TYPE_CHECKING:
    import pandas as pd

ABSENT = "–"
"""Text of a cell without a number, for instance because a sample is too small or a trial was lost."""


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of text cells.

    Parameters
    ----------
    name : str
        File name without an ending.
    title : str
        Title of the table.
    header : tuple of str
        Name of each column.
    rows : tuple of tuple of str
        Cells of each row.
    note : str
        Explanation that is printed below the table.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Return the table in Markdown, with its note below."""
        rule = ("---", *["---:"] * (len(self.header) - 1))
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.header, rule, *self.rows)]
        return "\n".join(lines) + (f"\n\n{self.note}" if self.note else "")

    def cell(self, *place: str) -> str:
        """Return the text of a cell; `ABSENT` if the row or the column does not exist.

        Parameters
        ----------
        *place : str
            First cells of the row, then the name of the column.
        """
        *row, column = place
        # Return the first match: a caller gives only the cells that identify the row.
        found = next((cells for cells in self.rows if list(cells[: len(row)]) == row), None)
        return ABSENT if found is None or column not in self.header else found[self.header.index(column)]

    def value(self, *place: str, part: int = 0) -> float:
        """Return number `part` in the text of a cell, counted from 0; NaN if the cell has fewer numbers."""
        found = re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", self.cell(*place))
        return float(found[part]) if part < len(found) else nan


@dataclass(frozen=True, slots=True, repr=False)
class Sheet(HasShortForm):
    """A table in two forms: numbers and text.

    Parameters
    ----------
    frame : DataFrame
        Plain numbers in SI units, for CSV.
    shown : TextTable
        The same table as text, for HTML and LaTeX.
    words : int
        Number of text columns at the left.
    """

    frame: pd.DataFrame
    shown: TextTable
    words: int = 1
