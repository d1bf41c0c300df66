"""The answer of a fix, of a run with several states, or of a batch of fixes; see `optloc.show.fix_answer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Status
from optloc.bounds.rank import Observability
from optloc.problem.fix import Fix
from optloc.show.answer_sheets import (
    MOST_ROWS,
    alternative_sheet,
    bias_sheet,
    count_sheet,
    state_sheet,
    status_words,
    suspect_sheet,
)
from optloc.show.answer_texts import (
    chi_square_text,
    constraint_text,
    epoch_error_rows,
    extent_rows,
    frame_rows,
    origin_rows,
    region_rows,
)
from optloc.show.columns import UNCHECKED, Columns, active_of, fix_columns
from optloc.show.fix_answer import AnswerSection, FixAnswer, FixSheet, Row, Verdict, status_named
from optloc.show.knowledge import has_place, known_rows
from optloc.show.row_answer import row_answer, row_verdict, use_rows, why_rows

if TYPE_CHECKING:
    from optloc.model_checks.cause import Advice

# Reasons that are printed for a batch: a screen shows them. The remaining ones are counted.
_REASONS = 10


def answer_of(
    fix: Fix,
    columns: Columns | None = None,
    title: str = "",
    *,
    seen: Observability | None = None,
    unit_of: Callable[[str, str], tuple[str, float]] | None = None,
    where: Sequence[Row] = (),
    details: Sequence[Row] = (),
    advice: Sequence[Advice] = (),
    most: int = MOST_ROWS,
) -> FixAnswer:
    """Return the answer of one fix or of a batch of fixes, as all outputs show it.

    Parameters
    ----------
    fix : Fix
        One fix, or a batch.
    columns : dict of str to array, optional
        Table of the fix, see `optloc.show.columns.fix_columns`. It can have the columns `epoch` and `target`.
    title : str
        Title. By default, the label of a single fix.
    seen : Observability, optional
        Observability of the biases of a single fix.
    unit_of : callable of (name, unit), optional
        Returns the unit in which a bias is printed, and its size in SI units.
    where, details : sequence of (str, str)
        Further rows of these sections.
    advice : sequence of Advice
        Advice on the data, see `optloc.advice.advise`.
    most : int
        Number of rows that tables show completely.
    """
    columns = fix_columns(fix) if columns is None else columns
    if fix.shape:
        by = [str(name) for name in fix.label_names if name is not None]
        sheet = state_sheet(columns, f"Fixes by {', '.join(by)}" if by else "Fixes", most)
        sections = _batch_sections(fix, columns, details, sheet)
        return FixAnswer(title, _batch_verdict(fix), sections, tuple(advice))
    if not title and fix.labels is not None:
        title = f"fix {fix.labels[()]}"
    several = len(columns["x"]) > 1
    main = _states(columns, fix, where, most) if several else row_answer(columns, 0, fix, where=where).sections
    found = [*main, _details(fix, columns, seen, unit_of, details)]
    return FixAnswer(title, row_verdict(columns, 0), _present(found), tuple(advice))


def _present(sections: Sequence[AnswerSection]) -> tuple[AnswerSection, ...]:
    """Return the sections that are not empty."""
    return tuple(one for one in sections if one.rows or one.sheets)


# One fix.


def _states(columns: Columns, fix: Fix, where: Sequence[Row], most: int) -> list[AnswerSection]:
    """Return the sections of one fix with several states: its status, and the table of its states."""
    sheet = state_sheet(columns, "", most)
    # The states of one fix share its status, which is in the first row of the answer.
    kept = [j for j, head in enumerate(sheet.head) if head != "status"]
    rows = [tuple(row[j] for j in kept) for row in sheet.rows]
    table = FixSheet("States", tuple(sheet.head[j] for j in kept), rows)
    known = known_rows(fix)
    intervals = [] if known and not has_place(fix) else extent_rows(fix)
    return [
        AnswerSection("use", use_rows(columns, 0, fix.sentence)),
        AnswerSection("where", tuple(where), (table,)),
        AnswerSection("how sure", (*intervals, *known)),
        AnswerSection("why not", why_rows(columns, 0)),
    ]


def _details(
    fix: Fix,
    columns: Columns,
    seen: Observability | None,
    unit_of: Callable[[str, str], tuple[str, float]] | None,
    more: Sequence[Row],
) -> AnswerSection:
    """Return the fifth section: chi-square, certificate, regions, constraints, method, and tables."""
    rows = [("chi-square", chi_square_text(fix))]
    if hasattr(fix.certificate, "proof"):
        rows.append(("certificate", f"{fix.certificate.proof}: {fix.certificate.reason}"))
    if len(columns["x"]) == 1:
        rows += region_rows(columns, 0)
        rows += frame_rows(columns, 0) if fix.frame.geodetic else []
    rows += [("constraint", constraint_text(active)) for active in active_of(fix)]
    rows += epoch_error_rows(fix, ["emission"] if origin_rows(columns, 0) and len(columns["x"]) == 1 else [])
    rows += more
    rows.append(("stages", " → ".join(stage.name for stage in fix.stages) or "none"))
    rows += [("biases", sentence) for sentence in (() if seen is None else seen.sentences)]
    sheets = (bias_sheet(fix, seen, unit_of), suspect_sheet(fix), alternative_sheet(fix))
    return AnswerSection("details", tuple(rows), tuple(sheet for sheet in sheets if sheet is not None))


# Many fixes.


def _batch_verdict(fix: Fix) -> Verdict:
    """Return the common verdict of a batch: good if all fixes are ok and checked, bad if none has an answer."""
    if not fix.code.size or not bool(np.any(fix.answered)):
        return "bad"
    return "good" if bool((fix.code == Status.OK).all()) and not bool(np.any(fix.unchecked)) else "care"


def _batch_sections(fix: Fix, columns: Columns, details: Sequence[Row], sheet: FixSheet) -> tuple[AnswerSection, ...]:
    """Return the sections of a batch: counts in words, the table of fixes `sheet`, counts by status, and reasons."""
    if not fix.code.size:
        return (AnswerSection("use", (("status", "0 fixes"),)),)
    alone = int(np.asarray(columns["unchecked"], dtype=bool).sum())
    notes = [f"{alone if alone < len(columns['status']) else 'all'} with {UNCHECKED}"] if alone else []
    labels = Counter(columns["status"].tolist())
    use: list[Row] = [("status", status_words(columns, notes))]
    use += [("", Status.OK.sentence)] if set(labels) == {Status.OK.label} else []
    refused = [label for label, _ in labels.most_common() if label != Status.OK.label]
    why: list[Row] = [(label, one.sentence) for label in refused if (one := status_named(label)) is not None]
    rows = tuple(details)
    return _present(
        [
            AnswerSection("use", tuple(use)),
            AnswerSection("where", (), (sheet, count_sheet(columns))),
            AnswerSection("why not", (*why, *_reason_rows(columns))),
            AnswerSection("details", rows),
        ]
    )


def _reason_rows(columns: Columns) -> list[Row]:
    """Return the reasons of the fixes of a batch that are not ok, each with the name of the first fix that has it."""
    names: dict[str, list[int]] = {}
    for i in np.flatnonzero(columns["status"] != Status.OK.label).tolist():
        if columns["reason"][i]:
            names.setdefault(f"{columns['status'][i]}: {columns['reason'][i]}", []).append(i)
    own = next((name for name in ("label", "epoch", "number") if name in columns), None)
    rows: list[Row] = []
    for text, where in list(names.items())[:_REASONS]:
        label = f"{'epoch' if own == 'epoch' else 'fix'} {'' if own is None else columns[own][where[0]]}".strip()
        same = f"; the same for {len(where) - 1} more" if len(where) > 1 else ""
        rows.append((label, f"{text}{same}"))
    if len(names) > _REASONS:
        rows.append(("...", f"{len(names) - _REASONS} more reasons; write all of them to a file"))
    return rows
