"""Rules of a track, and the result of one scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from optloc.base.types import Status
from optloc.tracking.updates import Updated

# Gate in standard deviations: one of two million good rows is rejected.
_USUAL = 5.0
Event = Literal["starting", "started", "restarted", ""]


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules for the rejection of rows and for the restart of a track.

    Parameters
    ----------
    gate : float
        Rows more than this many standard deviations from the prediction are rejected; infinite for no gate.
    patience : int
        A track ends after this number of successive scans in which most rows were rejected. It also ends after four
        times this number of scans if half of the rows were rejected, or if the innovations are as large as in this
        case.
    gap : float, optional
        Seconds without a valid row after which a track ends. Without this value, a track ends when the standard
        deviation of the predicted position exceeds both the spread of the stations and the range of the target.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, for starts.
    starts : str
        Method of `optloc.solve` for starts: "robust" if rows may have gross errors.
    """

    gate: float = _USUAL
    patience: int = 5
    gap: float | None = None
    speed: float | None = None
    rate: float | None = None
    starts: str = "auto"

    @property
    def most(self) -> float:
        """Return the largest squared innovation of a row that counts, in sigmas squared.

        It is the squared gate, at most the square of the usual gate (25).
        """
        return float(min(self.gate, _USUAL) ** 2)


@dataclass(frozen=True, slots=True)
class Entry:
    """Result of one scan.

    Parameters
    ----------
    time : float
        Seconds.
    updated : Updated
        State after the scan, NIS and number of used rows; NaN before the first start. The covariance includes errors
        that last for many scans.
    code : Status
        Ok. Too few rows: no valid row, the state is only predicted. Rejected: most rows failed the gate or are not
        finite. Misfit: innovations or lasting errors are much larger than stated. Unbounded: the position is too
        uncertain. Ambiguous: the start has alternatives. Numerical: the update failed.
    rejected : int
        Number of rejected rows.
    event : "starting", "started", "restarted" or ""
        "starting": the scan is part of a start. "started", "restarted": the state is a new fix. Empty: a normal update.
    reason : str
        A sentence that explains the status or the event, if necessary.
    """

    time: float
    updated: Updated
    code: Status
    rejected: int = 0
    event: Event = ""
    reason: str = ""

    @property
    def label(self) -> str:
        """Return the event, or the status if there is no event or if a start is not ok."""
        return self.event if self.event and self.code == Status.OK else self.code.label


# The label of a scan has another meaning than the status of a fix: the state also contains the scans before it.
_SENTENCES: Mapping[str, str] = {
    Status.OK.label: "Use it: the rows of the scan agree with the predicted state, and its covariance is valid.",
    "starting": "There is no state yet: this scan is a part of the start of the track.",
    "started": "Use it: the state is the fix of this scan and of the scans before it.",
    "restarted": "Use it: the state is a new fix of the last scans. The track before it was lost.",
    "lost": "There is no state: the track has ended, and the next scans start a new track.",
    Status.TOO_FEW_ROWS.label: "Use it with its larger covariance: the scan has no valid row, so the state is only "
    "predicted.",
    Status.REJECTED.label: "Most rows of the scan did not pass the gate or are not finite; check the outliers, and try "
    "a robust loss.",
    Status.MISFIT.label: "Do not use it: the innovations are larger than the stated noise allows; check sigma, the "
    "process noise and the motion model.",
    Status.UNBOUNDED.label: "Do not use it: the position is too uncertain to follow, so the track ends; add stations "
    "or measurements.",
    Status.AMBIGUOUS.label: "Several states of the start fit the scans about equally well; wait for more scans, or "
    "give a start.",
    Status.NUMERICAL.label: "The update failed, so the state is only predicted; the reason names the cause.",
    Status.CURVED.label: "The state of the start is right, but its covariance is not valid; wait for more scans.",
}


def scan_sentence(label: str) -> str:
    """Return the sentence of the label of a scan (`Entry.label`): whether to use its state, and what helps.

    A label that has the same meaning as the status of a fix has the sentence of the status.
    """
    return _SENTENCES.get(label) or Status[label.upper().replace(" ", "_")].sentence
