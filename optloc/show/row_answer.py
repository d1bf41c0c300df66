"""The sections of one row of a table of fixes or scans: can I use it, where, how sure, why not.

The answer of a fix, the marks of maps and exports, the live map, tracks and separated emitters all have these sections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import NOTES, Array, Status
from optloc.problem.chart import CARTESIAN, CURVED, NAMES
from optloc.problem.fix import Fix
from optloc.show.answer_texts import (
    CURVED_ROW,
    NOT_DETERMINED,
    extent_rows,
    motion_rows,
    origin_rows,
    place_rows,
    sure_rows,
)
from optloc.show.columns import (
    RESCALED,
    ROBUST,
    TAILS,
    UNCHECKED,
    Columns,
    covariance_columns,
    geodetic_columns,
)
from optloc.show.fix_answer import AnswerSection, FixAnswer, Row, Verdict, status_named, verdict_of_label
from optloc.show.knowledge import has_place, known_rows

_NOTED = {Status.TAILS: TAILS, Status.ROBUST: ROBUST, Status.RESCALED: RESCALED}
NO_POSITION = "none"
"""Text of the position of a fix that has none."""
KNOWN_POSITION = "known, as stated"
"""Text of the position of a target whose position is not an unknown, such as a beacon."""


def row_answer(
    columns: Columns, i: int, fix: Fix | None = None, *, sentence: str = "", title: str = "", where: Sequence[Row] = ()
) -> FixAnswer:
    """Return the answer of one row of a table, without details.

    Parameters
    ----------
    columns : dict of str to array
        Table of fixes or scans. A table without covariances, findings or reasons gives an answer without them.
    i : int
        Number of the row.
    fix : Fix, optional
        The fix of the row, if it has one state. It adds directions, ranges and intervals of fixes whose ellipse is not
        valid.
    sentence : str
        Sentence of the status; by default the sentence of the fix, or of `Status` without one.
    title : str
        Title of the answer.
    where : sequence of (str, str)
        Further rows of the section "where".
    """
    words = sentence or ("" if fix is None else fix.sentence)
    sections = (
        AnswerSection("use", use_rows(columns, i, words)),
        AnswerSection("where", (*_where_rows(columns, i, fix), *where)),
        AnswerSection("how sure", _sure_rows(columns, i, fix)),
        AnswerSection("why not", why_rows(columns, i)),
    )
    return FixAnswer(title, row_verdict(columns, i), tuple(one for one in sections if one.rows))


def row_verdict(columns: Columns, i: int) -> Verdict:
    """Return whether to use a row: a row without redundancy with care, other rows according to their status."""
    verdict = verdict_of_label(str(columns["status"][i]))
    return "care" if verdict == "good" and _unchecked(columns, i) else verdict


def _unchecked(columns: Columns, i: int) -> bool:
    """Return whether row `i` has no redundancy."""
    return "unchecked" in columns and bool(columns["unchecked"][i])


def _findings(columns: Columns, i: int) -> list[Status]:
    """Return the findings of row `i`."""
    names = str(columns["findings"][i]).split("; ") if "findings" in columns and columns["findings"][i] else []
    return [found for found in map(status_named, names) if found is not None]


def use_rows(columns: Columns, i: int, sentence: str = "") -> tuple[Row, ...]:
    """Return the rows of the first section: the status with its notes, and the sentence of the status."""
    label = str(columns["status"][i])
    status = status_named(label)
    notes = [UNCHECKED] * _unchecked(columns, i) + [_NOTED[one] for one in _findings(columns, i) if one in _NOTED]
    words = sentence or ("" if status is None else status.sentence)
    return (("status", "; ".join([label, *notes])), *((("", words),) if words else ()))


def _where_rows(columns: Columns, i: int, fix: Fix | None) -> tuple[Row, ...]:
    """Return the rows of the second section: position, velocity and emission time."""
    place = place_rows(columns, i)
    if not place:
        return (("position", _missing_place(fix)),)
    return (*place, *motion_rows(columns, i), *origin_rows(columns, i))


def _missing_place(fix: Fix | None) -> str:
    """Return the text of an absent position: it is known, the data do not determine it, or the fix has none."""
    if fix is None:
        return NO_POSITION
    slots = (*fix.layout.shared, *fix.layout.local)
    if not any(slot.name.partition("[")[0] == "position" for slot in slots):
        return KNOWN_POSITION
    return NOT_DETERMINED if known_rows(fix) else NO_POSITION


def _sure_rows(columns: Columns, i: int, fix: Fix | None) -> tuple[Row, ...]:
    """Return the rows of the third section: standard deviations, the 95 % radius, and valid intervals.

    Without a valid position, the section has the directions and ranges that the data determine.
    """
    known = [] if fix is None else known_rows(fix)
    curved = "chart" in columns and columns["chart"][i] == NAMES[CURVED]
    intervals = [CURVED_ROW] * curved if fix is None else extent_rows(fix)
    without_place = bool(known) and fix is not None and not has_place(fix)
    return (*sure_rows(columns, i), *(known if without_place else [*intervals, *known]))


def why_rows(columns: Columns, i: int) -> tuple[Row, ...]:
    """Return the rows of the fourth section: the reason of the status, and other findings."""
    status = columns["status"][i]
    reason = str(columns["reason"][i] or "") if "reason" in columns else ""
    others = [one.label for one in _findings(columns, i) if one.label != status and one not in NOTES]
    rows = [("reason", reason)] if reason else []
    return (*rows, ("also found", ", ".join(others))) if others else tuple(rows)


class RowSource(NamedTuple):
    """A row of a table, with what its answer needs.

    - columns: the table.
    - number: number of the row.
    - sentence: sentence of the status; empty for the sentence of `Status`.
    - fixes: batch with the fix of the row, if each row of the table is a fix; else None.
    - item: number of the fix in the batch.
    """

    columns: Columns
    number: int
    sentence: str = ""
    fixes: Fix | None = None
    item: int = 0

    @property
    def answer(self) -> FixAnswer:
        """Return the answer of the row."""
        return row_answer(self.columns, self.number, self._fix, sentence=self.sentence)

    @property
    def status_sentence(self) -> str:
        """Return the sentence of the status, as in the answer; empty for an unknown status."""
        fix = None if self.sentence else self._fix
        words = self.sentence or ("" if fix is None else fix.sentence)
        return dict(use_rows(self.columns, self.number, words)).get("", "")

    @property
    def _fix(self) -> Fix | None:
        """Return the fix of the row; None without one, or if it adds nothing to the row."""
        # A fix with status `ok` and a valid ellipse adds nothing to its row.
        label, chart = (self.columns[name][self.number] if name in self.columns else "" for name in ("status", "chart"))
        enough = label == Status.OK.label and chart in {"", NAMES[CARTESIAN]}
        return None if self.fixes is None or enough else self.fixes[self.item]


def state_table(frame: Frame, position: Array, covariance: Array, rates: Array | None = None, **texts: Any) -> Columns:
    """Return the table of states that are known by their numbers only.

    Parameters
    ----------
    frame : Frame
        Frame of the positions.
    position : array (n, d)
        Positions, m; NaN if unknown.
    covariance : array (n, m, m)
        Covariances of the state, m^2: m = d for the position, or m >= 2 d for position and velocity; NaN if unknown.
    rates : array (n, d), optional
        Velocities, m/s.
    **texts
        Other columns (n), such as `status` and `reason`.
    """
    d = position.shape[-1]
    columns: Columns = {name: np.asarray(values, dtype=object) for name, values in texts.items()}
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    known = covariance.shape[-1] >= 2 * d
    for k, axis in enumerate("xyz"[:d]):
        columns |= {axis: position[:, k], f"sigma_{axis}": sigma[:, k]}
        if rates is not None:
            unknown = np.full(len(position), np.nan)
            columns |= {f"v{axis}": rates[:, k], f"sigma_v{axis}": sigma[:, d + k] if known else unknown}
    placed = covariance[:, :d, :d]
    return columns | covariance_columns(placed, "xyz") | geodetic_columns(frame, position, placed)
