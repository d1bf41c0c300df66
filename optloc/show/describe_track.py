"""The answer of tracks, from the table of their scans; see `optloc.show.fix_answer`."""

from __future__ import annotations

from collections import Counter

import numpy as np

from optloc.base.types import Status
from optloc.show.answer_sheets import median_sigma, state_sheet
from optloc.show.answer_texts import motion_rows, place_rows, sure_rows
from optloc.show.columns import Columns
from optloc.show.fix_answer import AnswerSection, FixAnswer, FixSheet, Row, Verdict
from optloc.tracking.entry import scan_sentence

CLEAN = frozenset({Status.OK.label, "started", "starting"})
"""Labels of scans without a problem."""

# Reasons that are printed: a screen shows them. The remaining ones are counted.
_REASONS = 10


def answer_of_scans(columns: Columns, title: str = "") -> FixAnswer:
    """Return the answer of one track or several: statuses, last state of each target, its accuracy, and reasons.

    Parameters
    ----------
    columns : dict of str to array
        Table of the scans in order, one row for each scan. It has the state with its covariance, NaN before the start
        of a track, and the columns `epoch`, `time`, `target`, `status`, `reason`, `nis` and `rows`.
    title : str
        Title of the answer.
    """
    last = _last_states(columns)
    rows, sheet, sure = _last_texts(columns, last)
    sections = (
        AnswerSection("use", _use_rows(columns)),
        AnswerSection("where", rows, sheet),
        AnswerSection("how sure", sure),
        AnswerSection("why not", _why_rows(columns)),
        AnswerSection("details", (), (_count_sheet(columns),)),
    )
    return FixAnswer(title, _verdict(columns, last), tuple(one for one in sections if one.rows or one.sheets))


def _verdict(columns: Columns, last: list[int]) -> Verdict:
    """Return whether to use the tracks: not without a state, and with care if a scan has a problem."""
    if not last:
        return "bad"
    return "good" if set(columns["status"].tolist()) <= CLEAN else "care"


def _use_rows(columns: Columns) -> tuple[Row, ...]:
    """Return the number of scans of each status, and the sentence of the best status that occurs."""
    counts = Counter(columns["status"].tolist())
    total = sum(counts.values())
    order = sorted(counts, key=lambda label: (label != Status.OK.label, -counts[label]))
    parts = ", ".join(f"{counts[label]} {label}" for label in order)
    rows: list[Row] = [("status", f"{total} scan{'s' if total != 1 else ''}: {parts}")]
    good = [label for label in (Status.OK.label, "started") if label in counts]
    return (*rows, *(("", scan_sentence(label)) for label in good[:1]))


def _last_states(columns: Columns) -> list[int]:
    """Return the number of the last row of each target that has a state."""
    known, targets = np.isfinite(columns["x"]), columns["target"]
    found = [np.flatnonzero(known & (targets == name)) for name in dict.fromkeys(targets.tolist())]
    return [int(rows[-1]) for rows in found if len(rows)]


def _last_texts(columns: Columns, last: list[int]) -> tuple[tuple[Row, ...], tuple[FixSheet, ...], tuple[Row, ...]]:
    """Return the last states as rows and tables of the section "where", and the rows of "how sure".

    `last` are the numbers of their rows in the table.
    """
    if not last:
        return (("position", "none"),), (), ()
    if len(last) == 1:
        i = last[0]
        own: Row = ("last state", f"{columns['epoch'][i]}: {columns['status'][i]}")
        return (own, *place_rows(columns, i), *motion_rows(columns, i)), (), tuple(sure_rows(columns, i))
    chosen = {name: values[last] for name, values in columns.items()}
    return (), (state_sheet(chosen, "Last states"),), ()


def _why_rows(columns: Columns) -> tuple[Row, ...]:
    """Return the sentence of each status that needs one, and the reasons of single scans."""
    counts = Counter(columns["status"].tolist())
    rows: list[Row] = [(label, scan_sentence(label)) for label, _ in counts.most_common() if label not in CLEAN]
    named = len(set(columns["target"].tolist())) > 1
    with_reason = np.flatnonzero(columns["reason"] != "").tolist()
    for i in with_reason[:_REASONS]:
        label = f"{columns['target'][i]} {columns['epoch'][i]}" if named else f"scan {columns['epoch'][i]}"
        rows.append((label, f"{columns['status'][i]}: {columns['reason'][i]}"))
    if len(with_reason) > _REASONS:
        rows.append(("...", f"{len(with_reason) - _REASONS} more reasons; write all of them to a file"))
    return tuple(rows)


def _count_sheet(columns: Columns) -> FixSheet:
    """Return a table of the scans by target and status: number, median sigma and size of the innovations."""
    rows = []
    for (target, label), count in Counter(zip(columns["target"], columns["status"], strict=True)).items():
        inside = (columns["target"] == target) & (columns["status"] == label)
        tested = inside & np.isfinite(columns["nis"])
        # Chi-square of all scans over their rows: about one if the noise is as stated.
        used = float(columns["rows"][tested].sum())
        nis = f"{columns['nis'][tested].sum() / used:.2f}" if used else "-"
        rows.append((str(target), str(label), str(count), median_sigma(columns, inside), nis))
    return FixSheet("Scans", ("target", "status", "scans", "median sigma, m", "NIS per row"), rows)
