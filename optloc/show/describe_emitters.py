"""The answer of separated emitters of one epoch; see `optloc.show.fix_answer`."""

from __future__ import annotations

import numpy as np

from optloc.base.types import Status
from optloc.multi_target.answer import Emitters
from optloc.show.answer_sheets import state_sheet
from optloc.show.columns import Columns, fix_columns, join_tables
from optloc.show.fix_answer import AnswerSection, FixAnswer, FixSheet, Row, Verdict, verdict_of
from optloc.show.row_answer import why_rows

# Ghosts that are listed: the best ones first.
_GHOSTS = 12


def answer_of_emitters(found: Emitters, title: str = "") -> FixAnswer:
    """Return the answer of the emitters of one epoch: status, positions, reason, ghosts and costs.

    Parameters
    ----------
    found : Emitters
        The emitters.
    title : str
        Title of the answer.
    """
    status = (("status", f"{found.status.label}: {_count(found)}"), ("", found.status.sentence))
    rows: list[Row] = [("reason", found.reason)] if found.reason else []
    table: tuple[FixSheet, ...] = ()
    if found.fixes:
        columns = join_tables([fix_columns(fix) for fix in found.fixes])
        table = (_emitter_sheet(found, columns),)
        rows += _fix_reasons(columns)
    sections = (
        AnswerSection("use", status),
        AnswerSection("where", () if table else (("position", "none"),), table),
        AnswerSection("why not", tuple(rows), _ghost_sheets(found)),
        AnswerSection("details", _detail_rows(found)),
    )
    return FixAnswer(title, _verdict(found), tuple(one for one in sections if one.rows or one.sheets))


def _verdict(found: Emitters) -> Verdict:
    """Return whether to use the emitters."""
    return verdict_of(found.status) if found.fixes or found.status is Status.OK else "bad"


def _count(found: Emitters) -> str:
    """Return the number of emitters and of false rows as text."""
    false = int((found.assignment < 0).sum())
    return f"{found.count} emitter{'s' if found.count != 1 else ''}, {false} false rows"


def _emitter_sheet(found: Emitters, columns: Columns) -> FixSheet:
    """Return the table of the emitters, with the number of their rows and their chi-square.

    `columns` is the table of their fixes.
    """
    numbers = [str(i + 1) for i in range(found.count)]
    sheet = state_sheet(columns | {"label": np.array(numbers, dtype=object)}, "Emitters", found.count)
    head = ("emitter", *sheet.head[1:-1], "rows", "chi-square", sheet.head[-1])
    rows = [
        (*row[:-1], str(len(found.rows(i))), f"{float(fix.cost):.1f}", row[-1])
        for i, (fix, row) in enumerate(zip(found.fixes, sheet.rows, strict=True))
    ]
    return FixSheet(sheet.title, head, rows)


def _fix_reasons(columns: Columns) -> list[Row]:
    """Return the reasons of the fixes of single emitters; `columns` is their table."""
    texts = [(i, text) for i in range(len(columns["status"])) for label, text in why_rows(columns, i) if label]
    return [(f"emitter {i + 1}", text) for i, text in texts]


def _ghost_sheets(found: Emitters) -> tuple[FixSheet, ...]:
    """Return the table of ghosts: other positions whose assignments have about the same cost; empty without any."""
    if not found.ghosts:
        return ()
    rows = [
        (", ".join(f"{value:.1f}" for value in ghost.position), str(len(ghost.rows)), f"{ghost.gap:.1f}")
        for ghost in found.ghosts[:_GHOSTS]
    ]
    return (FixSheet("Ghosts: other positions at about the same cost", ("position, m", "rows", "cost gap"), rows),)


def _detail_rows(found: Emitters) -> tuple[Row, ...]:
    """Return the cost of the assignment with its bound, and the size of the search."""
    cost = f"{found.cost:.1f}; no other assignment costs less than {found.bound:.1f}"
    return ("cost", cost), ("margin", f"{found.margin:.1f} to another number or position"), ("boxes", str(found.boxes))
