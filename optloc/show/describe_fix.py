"""The answer of a fix, of a run with several states, or of a batch of fixes; see `optloc.show.fix_answer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import NOTES, Status
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
    NOT_DETERMINED,
    chi_square_text,
    constraint_text,
    epoch_error_rows,
    extent_rows,
    frame_rows,
    motion_rows,
    origin_rows,
    place_rows,
    region_rows,
    sure_rows,
)
from optloc.show.columns import RESCALED, ROBUST, TAILS, UNCHECKED, Columns, active_of, fix_columns
from optloc.show.fix_answer import AnswerSection, FixAnswer, FixSheet, Row, Section, Verdict, verdict_of
from optloc.show.knowledge import has_place, known_rows

if TYPE_CHECKING:
    from optloc.model_checks.cause import Advice

# Reasons that are printed for a batch: a screen shows them. The remaining ones are counted.
_REASONS = 10
_NO_POSITION = "none"


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
        Advice on the data, see `optloc.advise`.
    most : int
        Number of rows that tables show completely.
    """
    columns = fix_columns(fix) if columns is None else columns
    if fix.shape:
        sections = _batch_sections(fix, columns, details, most)
        return FixAnswer(title, _batch_verdict(fix), sections, tuple(advice))
    if not title and fix.labels is not None:
        title = f"fix {fix.labels[()]}"
    verdict = Status(int(fix.code))
    careful = "care" if fix.unchecked and verdict is Status.OK else verdict_of(verdict)
    found = [
        AnswerSection("use", _use_rows(fix)),
        _where(fix, columns, where, most),
        AnswerSection("how sure", _sure_rows(fix, columns)),
        AnswerSection("why not", _why_rows(fix)),
        _details(fix, columns, seen, unit_of, details),
    ]
    return FixAnswer(title, careful, _present(found), tuple(advice))


def _present(sections: Sequence[AnswerSection]) -> tuple[AnswerSection, ...]:
    """Return the sections that are not empty."""
    return tuple(one for one in sections if one.rows or one.sheets)


# One fix.


def _use_rows(fix: Fix) -> tuple[Row, ...]:
    """Return the rows of the first section: the status with its notes, and the sentence of the status."""
    verdict = Status(int(fix.code))
    noted = {Status.TAILS: TAILS, Status.ROBUST: ROBUST, Status.RESCALED: RESCALED}
    notes = [UNCHECKED] * bool(fix.unchecked) + [words for note, words in noted.items() if fix.has(note)]
    return ("status", "; ".join([verdict.label, *notes])), ("", verdict.sentence)


def _where(fix: Fix, columns: Columns, more: Sequence[Row], most: int) -> AnswerSection:
    """Return the second section: the position of a fix with one state, or the table of several states."""
    name: Section = "where"
    if len(columns["x"]) > 1:
        sheet = state_sheet(columns, "", most)
        # The states of one fix share its status, which is in the first row of the answer.
        kept = [j for j, head in enumerate(sheet.head) if head != "status"]
        rows = [tuple(row[j] for j in kept) for row in sheet.rows]
        return AnswerSection(name, tuple(more), (FixSheet("States", tuple(sheet.head[j] for j in kept), rows),))
    rows_of_place = place_rows(columns, 0)
    if not rows_of_place:
        missing = NOT_DETERMINED if known_rows(fix) else _NO_POSITION
        return AnswerSection(name, (("position", missing), *more))
    return AnswerSection(name, (*rows_of_place, *motion_rows(columns, 0), *origin_rows(columns, 0), *more))


def _sure_rows(fix: Fix, columns: Columns) -> tuple[Row, ...]:
    """Return the rows of the third section: standard deviations, the 95 % radius, and valid intervals.

    Without a valid position, the section has the directions and ranges that the data determine.
    """
    known = known_rows(fix)
    spread = sure_rows(columns, 0) if len(columns["x"]) == 1 else []
    return (*spread, *(known if known and not has_place(fix) else [*extent_rows(fix), *known]))


def _why_rows(fix: Fix) -> tuple[Row, ...]:
    """Return the rows of the fourth section: the reason of the status, and other findings."""
    verdict, reason = Status(int(fix.code)), str(fix.reason[()] or "")
    others = [one.label for one in fix.findings if one is not verdict and one not in NOTES]
    rows = [("reason", reason)] if reason else []
    return (*rows, ("also found", ", ".join(others))) if others else tuple(rows)


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


def _batch_sections(fix: Fix, columns: Columns, details: Sequence[Row], most: int) -> tuple[AnswerSection, ...]:
    """Return the sections of a batch: counts in words, the table of fixes, counts by status, and reasons."""
    if not fix.code.size:
        return (AnswerSection("use", (("status", "0 fixes"),)),)
    alone = int(np.asarray(columns["unchecked"], dtype=bool).sum())
    notes = [f"{alone if alone < len(columns['status']) else 'all'} with {UNCHECKED}"] if alone else []
    labels = Counter(columns["status"].tolist())
    use: list[Row] = [("status", status_words(columns, notes))]
    use += [("", Status.OK.sentence)] if set(labels) == {Status.OK.label} else []
    refused = [label for label, _ in labels.most_common() if label != Status.OK.label]
    why: list[Row] = [(label, Status[label.upper().replace(" ", "_")].sentence) for label in refused]
    rows = tuple(details)
    return _present(
        [
            AnswerSection("use", tuple(use)),
            AnswerSection("where", (), (state_sheet(columns, "Fixes", most), count_sheet(columns))),
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
