"""The description of an answer, which all outputs render: text, HTML, the command line, pages and dictionaries.

A `FixAnswer` has five sections in a fixed order: can I use it, where, how sure, why not and what to do, details. Its
renderers are in `optloc.show.render`; no other module formats a fix for people.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from optloc.base.types import ANSWERED, Status
from optloc.model_checks.cause import Advice

SECTIONS = ("use", "where", "how sure", "why not", "details")
"""Names of the sections in the order in which every output prints them."""

TEXT_COLUMNS = {"fix", "emitter", "epoch", "target", "status", "name", "member", "estimate", "suspect", "method"}
"""Columns of words, which are aligned to the left; columns of numbers are aligned to the right."""

Section = Literal["use", "where", "how sure", "why not", "details"]
Verdict = Literal["good", "care", "bad"]
Row = tuple[str, str]


class FixSheet(NamedTuple):
    """A table of text with a title.

    - title: title above the table; may be empty.
    - head: names of the columns; empty if each row is a label with its text.
    - rows: cells of each row.
    - ends: numbers of the rows after which a section ends, for a line between sections.
    """

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    ends: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class AnswerSection:
    """One section of an answer.

    Parameters
    ----------
    name : str
        One of `SECTIONS`.
    rows : tuple of (str, str)
        Labels with their texts; a row with an empty label continues the row above.
    sheets : tuple of FixSheet
        Tables below the rows.
    """

    name: Section
    rows: tuple[Row, ...] = ()
    sheets: tuple[FixSheet, ...] = ()


@dataclass(frozen=True, slots=True)
class FixAnswer:
    """The text about a fix, or about a batch of fixes, without any formatting.

    Parameters
    ----------
    title : str
        Title; may be empty.
    verdict : "good", "care" or "bad"
        Whether to use the answer: yes, with care, or no.
    sections : tuple of AnswerSection
        The sections in the order of `SECTIONS`; empty sections are absent.
    advice : tuple of Advice
        Advice that the data give beyond the sentence of the status. It belongs to the section "why not".
    """

    title: str
    verdict: Verdict
    sections: tuple[AnswerSection, ...]
    advice: tuple[Advice, ...] = field(default=())

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the labels of all rows in order, without continuation rows."""
        return tuple(label for section in self.sections for label, _ in section.rows if label)

    def section(self, name: Section) -> AnswerSection:
        """Return a section by name; an empty section if the answer has none of this name."""
        return next((one for one in self.sections if one.name == name), AnswerSection(name))

    @property
    def main(self) -> tuple[FixSheet, ...]:
        """Return the tables above the advice: can I use it, where, how sure, why not."""
        return self._merged([one for one in self.sections if one.name != "details"], self.title)

    @property
    def details(self) -> tuple[FixSheet, ...]:
        """Return the tables below the advice: the details."""
        return self._merged([one for one in self.sections if one.name == "details"], "Details")

    @staticmethod
    def _merged(sections: Sequence[AnswerSection], title: str) -> tuple[FixSheet, ...]:
        """Return the rows of sections as one table, until a section has tables; these follow the rows."""
        out: list[FixSheet] = []
        rows: list[Row] = []
        ends: list[int] = []
        for section in sections:
            rows += section.rows
            ends.append(len(rows) - 1)
            if section.sheets:
                out += [FixSheet(title, (), rows, tuple(ends))] if rows else []
                # Only the first table has the title of the answer.
                title = "" if rows else title
                out += section.sheets
                rows, ends = [], []
        return (*out, FixSheet(title, (), rows, tuple(ends))) if rows else tuple(out)


def verdict_of(status: Status) -> Verdict:
    """Return whether to use a fix of this status: yes for `ok`, with care for other answers, else no.

    A `misfit` has a position, but its sentence says not to use it.
    """
    if status is Status.OK:
        return "good"
    return "care" if status in ANSWERED and status is not Status.MISFIT else "bad"


def verdict_of_label(label: str) -> Verdict:
    """Return whether to use a row of a table: like its status; the first state of a track like a good fix."""
    status = status_named(label)
    if status is None:
        return "good" if label in _GOOD_EVENTS else "care"
    return verdict_of(status)


# Labels of scans of a track that are no status of a fix, and need no care.
_GOOD_EVENTS = {"started", "starting"}


def status_named(label: str) -> Status | None:
    """Return the status with a label, such as "too few rows"; None for other texts, such as the events of a track."""
    return _BY_LABEL.get(label)


_BY_LABEL = {status.label: status for status in Status}


def advice_lines(advice: Sequence[Advice]) -> list[str]:
    """Return observations with their advice as lines of text, and the lines to copy into a problem file."""
    lines = ["Advice"] if advice else []
    for one in advice:
        lines.append(f"  {one.seen[0].upper()}{one.seen[1:]}.")
        lines.append(f"  {one.advice[0].upper()}{one.advice[1:]}{':' if one.toml else '.'}")
        lines += [f"      {line}" for line in one.toml.splitlines()]
    return lines
