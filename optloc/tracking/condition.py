"""Condition of a track between two scans: its state, the fit of its last scans, and the rules that end it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Status
from optloc.solvers.verdict.findings import Finding, objections
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.lasting import LastingErrors
from optloc.tracking.rivals import Rival
from optloc.tracking.start import Beginning, Fit
from optloc.tracking.track import State

# Length of the window for the judgement of a track, in units of `Rules.patience` scans.
_WINDOW = 4
# Limits of the mean squared innovation, as a share of the squared gate. A half: half of the rows are beyond the gate,
# because at any position some rows agree by chance; the track is lost. A quarter (5 sigma: two and a half times as
# large as stated): no covariance is valid.
_LOST, _DOUBTFUL = 0.5, 0.25
# Lasting error of the stations, in standard deviations of their rows, that refutes the stated noise. On real tracks,
# errors up to four occurred, and the increased covariances covered them.
_LASTING = 5.0


class Recent:
    """Fit of the rows of the last scans to the prediction: their windowed NIS.

    NIS is the normalised innovation squared. The squared innovation of a row counts at most as the squared
    gate.
    """

    def __init__(self, rules: Rules) -> None:
        """Start with an empty window."""
        # The window must separate a lost track from a few gross errors in succession, even with one row per scan. If
        # one row in ten is a gross error, ten of twenty occur in one window of a million.
        self.scans: deque[Fit] = deque(maxlen=_WINDOW * rules.patience)
        # Rules of the track; largest squared innovation of a row that counts; number of scans since the start.
        self.rules, self.most, self.since = rules, rules.most, 0
        # Mean squared innovation as a share of the squared gate; 0 with too few rows.
        self.share = 0.0
        # Reason why the position is too uncertain; lasting error of the stations in sigmas; number of other states of
        # the start.
        self.vague, self.lasting, self.rivals = "", 0.0, 0

    def begin(self, start: Beginning) -> None:
        """Add the rows of a start. If they agree, the earlier scans are deleted; otherwise they still count."""
        if start.code == Status.OK:
            self.scans.clear()
        self.add(start.fit)
        self.since = 0

    def add(self, fit: Fit) -> None:
        """Add the fit of the rows of one scan: sum of their squared innovations in sigmas, and their number."""
        square, count = fit
        if count > 0:
            self.scans.append((min(square, self.most * count), count))
            self.since += 1
        total, rows = 0.0, 0
        for square, count in self.scans:
            total, rows = total + square, rows + count
        assert self.scans.maxlen is not None
        self.share = total / (self.most * rows) if rows >= self.scans.maxlen else 0.0

    @property
    def lost(self) -> bool:
        """Return whether the track is lost: the window is full, and as bad as with half of its rows beyond the gate.

        Scans before the last start do not count: the window must be full since then.
        """
        return self.since >= len(self.scans) == self.scans.maxlen and self.share > _LOST

    @property
    def sentence(self) -> str:
        """Return a sentence about the size of the innovations."""
        times = np.sqrt(self.share * self.most)
        return (
            f"the innovations of the last {len(self.scans)} scans are {times:.2g} times as large as their stated sigmas"
        )

    def judge(self, entry: Entry) -> Entry:
        """Return the entry of a scan with the status that follows from the last scans.

        The status is replaced only if it is ok.
        """
        found = objections(_FINDINGS, self) if entry.code == Status.OK else []
        return replace(entry, code=found[0][0], reason=found[0][1]) if found else entry


_FINDINGS = (
    Finding(Status.UNBOUNDED, lambda recent: recent.vague, lambda recent: [recent.vague]),
    Finding(Status.MISFIT, lambda recent: recent.share > _DOUBTFUL, lambda recent: [recent.sentence]),
    Finding(
        Status.MISFIT,
        lambda recent: recent.lasting > _LASTING,
        lambda recent: [f"errors that last for many scans are {recent.lasting:.2g} times as large as the stated noise"],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda recent: recent.rivals,
        lambda recent: [f"{recent.rivals} other state{'s' * (recent.rivals > 1)} of the start may be the right state"],
    ),
)
"""Findings about a scan from the scans before it."""


@dataclass(slots=True)
class Condition:
    """Condition of a track between two scans.

    - state: state after the last scan; None before a start.
    - last_row: time of the last valid row, s.
    - recent: fit of the last scans.
    - lasting: errors that last from scan to scan.
    - rivals: other states of the start that the scans do not refute.
    - why: reason why the last state was given up; empty without a reason.
    - missed: number of successive scans in which the gate rejected most rows.
    - fresh: True until a given state has its first row.
    """

    state: State | None
    last_row: float
    recent: Recent
    lasting: LastingErrors
    rivals: tuple[Rival, ...] = ()
    why: str = ""
    missed: int = 0
    fresh: bool = False

    @classmethod
    def of(cls, state: State | None, last_row: float, rules: Rules) -> Condition:
        """Return the condition of a track before its first scan; `state` is None if the track needs a start."""
        return cls(state, last_row, Recent(rules), LastingErrors(_WINDOW * rules.patience))

    def take(self, entry: Entry, fit: Fit, gated: int) -> None:
        """Update the condition by a scan.

        `entry` is the result of the scan. `fit` is the sum of squared innovations (sigmas) and the number of its
        rows. `gated` is the number of rows that the gate rejected.
        """
        # Rows that are not finite have no information about the state: only rows that the gate rejected end a track. A
        # scan without rows does not change the count.
        used = int(entry.updated.count)
        self.missed = self.missed + 1 if gated > used else self.missed * int(used == 0)
        self.last_row = entry.time if used else self.last_row
        self.recent.add(fit)
        self.state = State(entry.time, entry.updated.mean, entry.updated.cov)

    def judged(self, entry: Entry, cov: Array, vague: str) -> Entry:
        """Return the entry with the covariance `cov` (n, n), lasting errors included, and its status.

        `vague` is the reason why the position is too uncertain to follow; empty if it is not.
        """
        self.recent.vague, self.recent.lasting, self.recent.rivals = vague, 0.0, len(self.rivals)
        if cov is not entry.updated.cov:
            self.recent.lasting = self.lasting.size
            entry = replace(entry, updated=replace(entry.updated, cov=cov))
        return self.recent.judge(entry)

    def judge(self, vague: str) -> None:
        """Give up the state if the track is lost, its position is too uncertain, or a rival is more likely.

        `vague` is the reason why the position is too uncertain; empty if it is not. The reason is stored in `why`.
        """
        if vague:
            self.state, self.why = None, vague
        elif self.missed >= self.recent.rules.patience:
            self.state, self.why = None, f"most rows of {self.missed} scans did not fit the prediction"
        elif self.recent.lost:
            self.state, self.why = None, self.recent.sentence
        elif any(rival.leads for rival in self.rivals):
            self.state, self.why = None, "another state of the start explains the scans better"
