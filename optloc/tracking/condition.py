"""Condition of a track between two scans: its state, and how its last scans fit."""

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

# Scans of the window by which a track is judged, over those of `Rules.patience`.
_WINDOW = 4
# Mean squared innovation over the squared gate: a half where half of the rows are beyond the gate, as every place has
# some by chance that agree; a quarter (5 sigma: two and a half times as large as stated) where no covariance covers.
_LOST, _DOUBTFUL = 0.5, 0.25
# Lasting error of the stations, in standard deviations of their rows, that refutes the noise. On real tracks up to four
# were found, and the wider covariances covered the errors.
_LASTING = 5.0


class Recent:
    """How the rows of the last scans fit the prediction: their windowed NIS, no row further than the gate."""

    def __init__(self, rules: Rules) -> None:
        # As many scans as tell the loss of a track from a few wild rows in a row, where a scan has a single one: if one
        # row in ten is wild, ten of twenty are in one window of a million.
        self.scans: deque[Fit] = deque(maxlen=_WINDOW * rules.patience)
        self.rules, self.most, self.since = rules, rules.most, 0
        # The mean squared innovation as a share of the squared gate; 0 with too few rows.
        self.share = 0.0
        # Why the position is too vague; the lasting error of the stations in sigmas; other states of the start.
        self.vague, self.lasting, self.rivals = "", 0.0, 0

    def begin(self, start: Beginning) -> None:
        """Take the rows of a start; what did not fit before is forgotten where they agree, and else still counts."""
        if start.code == Status.OK:
            self.scans.clear()
        self.add(start.fit)
        self.since = 0

    def add(self, fit: Fit) -> None:
        """Take how the rows of one more scan fit."""
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
        """Return whether a full window is as bad as if half of its rows were beyond the gate."""
        return self.since >= len(self.scans) == self.scans.maxlen and self.share > _LOST

    @property
    def sentence(self) -> str:
        """Return how large the innovations are."""
        times = np.sqrt(self.share * self.most)
        return f"the innovations of the last {len(self.scans)} scans are {times:.2g} times as large as stated"

    def judge(self, entry: Entry) -> Entry:
        """Return a scan with the status that those before it deserve, where its own is clean."""
        found = objections(_RECENTLY, self) if entry.code == Status.OK else []
        return replace(entry, code=found[0][0], reason=found[0][1]) if found else entry


_RECENTLY = (
    Finding(Status.UNBOUNDED, lambda recent: recent.vague, lambda recent: [recent.vague]),
    Finding(Status.MISFIT, lambda recent: recent.share > _DOUBTFUL, lambda recent: [recent.sentence]),
    Finding(
        Status.MISFIT,
        lambda recent: recent.lasting > _LASTING,
        lambda recent: [f"errors that last for many scans are {recent.lasting:.2g} times as large as stated"],
    ),
    Finding(
        Status.AMBIGUOUS,
        lambda recent: recent.rivals,
        lambda recent: [f"{recent.rivals} other state{'s' * (recent.rivals > 1)} of the start may be the right one"],
    ),
)
"""All findings against a scan by those before it."""


@dataclass(slots=True)
class Condition:
    """Condition of a track between two scans.

    Parameters
    ----------
    state : State or None
        None before a start.
    heard : float
        Time of the last valid row.
    recent : Recent
        How the last scans fit.
    lasting : LastingErrors
        Errors that last from scan to scan.
    rivals : tuple of Rival
        Other states of the start that the scans do not refute.
    why : str
        Why the state before was given up.
    missed : int
        Scans in succession whose rows the gate mostly refused.
    fresh : bool
        Whether a given state has yet to meet its first row.
    """

    state: State | None
    heard: float
    recent: Recent
    lasting: LastingErrors
    rivals: tuple[Rival, ...] = ()
    why: str = ""
    missed: int = 0
    fresh: bool = False

    @classmethod
    def of(cls, state: State | None, heard: float, rules: Rules) -> Condition:
        """Return a track before its first scan."""
        return cls(state, heard, Recent(rules), LastingErrors(_WINDOW * rules.patience))

    def take(self, entry: Entry, fit: Fit, gated: int) -> None:
        """Go on by a scan of whose rows the gate refused so many."""
        # Rows that are not finite say nothing of the state: only those that the gate refused end a track. A scan
        # without rows leaves the count as it was.
        used = int(entry.updated.count)
        self.missed = self.missed + 1 if gated > used else self.missed * int(used == 0)
        self.heard = entry.time if used else self.heard
        self.recent.add(fit)
        self.state = State(entry.time, entry.updated.mean, entry.updated.cov)

    def judged(self, entry: Entry, cov: Array, vague: str) -> Entry:
        """Return a scan with its covariance (n, n) and status; `vague` is why its position is not followed."""
        self.recent.vague, self.recent.lasting, self.recent.rivals = vague, 0.0, len(self.rivals)
        if cov is not entry.updated.cov:
            self.recent.lasting = self.lasting.size
            entry = replace(entry, updated=replace(entry.updated, cov=cov))
        return self.recent.judge(entry)

    def judge(self, vague: str) -> None:
        """Give the state up where it is lost, or too vague to follow."""
        if vague:
            self.state, self.why = None, vague
        elif self.missed >= self.recent.rules.patience:
            self.state, self.why = None, f"most rows of {self.missed} scans did not fit the prediction"
        elif self.recent.lost:
            self.state, self.why = None, self.recent.sentence
        elif any(rival.leads for rival in self.rivals):
            self.state, self.why = None, "another state of the start explains the scans better"
