"""Rules of a track, and what becomes of one scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from optloc.base.types import Status
from optloc.tracking.updates import Updated

# Gate, standard deviations: of a good row one in two million is left out.
_USUAL = 5.0
Event = Literal["starting", "started", "restarted", ""]


@dataclass(frozen=True, slots=True)
class Rules:
    """When a row is left out and when a track begins anew.

    Parameters
    ----------
    gate : float
        Rows further than this many standard deviations from the prediction are left out; infinite for none.
    patience : int
        So many scans in succession of whose rows most were left out end a track; so do four times as many of whose
        rows half were, or whose innovations are as large on the whole as if half were.
    gap : float, optional
        Seconds without a valid row that end a track. Without it a gap ends a track where the predicted position has a
        standard deviation beyond the spread of the stations, and beyond the range of the target.
    speed, rate : float, optional
        Prior standard deviation of each coordinate of velocity (m/s) and acceleration (m/s^2), about zero, for starts.
    starts : str
        By which starts are solved, as `optloc.solve`: "robust" where rows may be gross errors.
    """

    gate: float = _USUAL
    patience: int = 5
    gap: float | None = None
    speed: float | None = None
    rate: float | None = None
    starts: str = "auto"

    @property
    def most(self) -> float:
        """Return the squared innovation that a row counts as at most: that of the gate, or of the usual one."""
        return float(min(self.gate, _USUAL) ** 2)


@dataclass(frozen=True, slots=True)
class Entry:
    """What became of one scan.

    Parameters
    ----------
    time : float
        Seconds.
    updated : Updated
        State after the scan, with errors that last in its covariance; NIS and rows used; NaN before the first start.
    code : Status
        Ok; too few rows where none was valid and the state was only predicted; rejected where most rows did not pass
        the gate or are not finite; misfit where innovations or lasting errors are much larger than stated; unbounded
        where the position is too vague; ambiguous where a start has alternatives; numerical where the update failed.
    rejected : int
        Rows left out.
    event : "starting", "started", "restarted" or ""
        The scan is one that a start needed; the state is a new fix; or nothing special.
    reason : str
        A sentence where the status or the event needs one.
    """

    time: float
    updated: Updated
    code: Status
    rejected: int = 0
    event: Event = ""
    reason: str = ""

    @property
    def label(self) -> str:
        """Return the event, else the status, in words; a start that is not clean is called by its status."""
        return self.event if self.event and self.code == Status.OK else self.code.label
