"""Tables of pages: text cells, and the same as plain numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

ABSENT = "–"
"""What stands for a number that there is not: of a smaller sample, or of a trial that is lost."""


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of text cells.

    Parameters
    ----------
    name : str
        Name of its files.
    title : str
        What it shows.
    header : tuple of str
        One name for each column.
    rows : tuple of tuple of str
        Cells.
    note : str
        How to read it.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Return the table with its note."""
        rule = ("---", *["---:"] * (len(self.header) - 1))
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.header, rule, *self.rows)]
        return "\n".join(lines) + (f"\n\n{self.note}" if self.note else "")

    def cell(self, *place: str) -> str:
        """Return the cell of a row, named by its first cells, and a column; a dash where a sample was too small for it.

        Parameters
        ----------
        *place : str
            First cells of the row, then the name of the column.
        """
        *row, column = place
        # The first that fits: rows are told apart by as many cells as the page cares to name.
        found = next((cells for cells in self.rows if list(cells[: len(row)]) == row), None)
        return ABSENT if found is None or column not in self.header else found[self.header.index(column)]

    def value(self, *place: str, part: int = 0) -> float:
        """Return a number of such a cell, the first by default; NaN where there is none."""
        found = re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", self.cell(*place))
        return float(found[part]) if part < len(found) else nan


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table twice.

    Parameters
    ----------
    frame : DataFrame
        Plain numbers in SI units, as CSV.
    shown : TextTable
        The same as text, as HTML and LaTeX.
    words : int
        How many columns at the left are words.
    """

    frame: pd.DataFrame
    shown: TextTable
    words: int = 1
