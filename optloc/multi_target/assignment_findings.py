"""Findings about an assignment of rows to emitters: a table of statuses, tests and sentences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import PRECEDENCE, Array, Status
from optloc.problem.fix import Fix
from optloc.solvers.policy import AMBIGUOUS_GAP
from optloc.solvers.verdict.findings import Finding, objections

# Difference between cost and bound above which an assignment does not count as proven. The tolerance of the search is
# smaller even with dozens of emitters, and the gap of an ambiguity is far larger.
_PROVEN = 2.0


class Assigned(NamedTuple):
    """The numbers that decide the status of an assignment.

    Parameters
    ----------
    fixes : tuple of Fix
        Fixes of the emitters.
    gaps : tuple of float
        Costs of other positions minus the cost of the assignment, ascending.
    costs : array (n,)
        Least cost with 0, 1, 2 ... emitters.
    cost, bound : float
        Cost of the assignment, and a lower bound of the cost of all others.
    wanted : int, optional
        The given number of emitters; None if it is free.
    present, channels, least : int
        Number of channels with a row, number of all channels, and least number of channels of an emitter.
    """

    fixes: tuple[Fix, ...]
    gaps: tuple[float, ...]
    costs: Array
    cost: float
    bound: float
    wanted: int | None
    present: int
    channels: int
    least: int


def verdict(assigned: Assigned, clean: str) -> tuple[Status, str]:
    """Return the status and the reason of an assignment; `clean` is the reason if there is no finding."""
    findings = objections(_FINDINGS, assigned)
    if not findings:
        return Status.OK, clean
    # Without an assignment other findings are not relevant.
    status = findings[0][0]
    alone = status in (Status.INFEASIBLE, Status.TOO_FEW_ROWS) and not assigned.fixes
    return status, findings[0][1] if alone else "; ".join(words for _, words in findings)


def count_in_words(emitters: int) -> str:
    """Return a number of emitters as a phrase."""
    return {0: "no emitter", 1: "one emitter"}.get(emitters, f"{emitters} emitters")


def _near(assigned: Assigned) -> list[str]:
    """Return sentences about other numbers of emitters, and other positions, within the ambiguity gap."""
    n = len(assigned.fixes)
    sentences = [
        f"{count_in_words(k)} would cost only {assigned.costs[k] - assigned.cost:.1f} more"
        for k in (n - 1, n + 1)
        if assigned.wanted is None and k >= 0 and assigned.costs[k] - assigned.cost < AMBIGUOUS_GAP
    ]
    near = [gap for gap in assigned.gaps if gap < AMBIGUOUS_GAP]
    return [*sentences, f"another position costs only {near[0]:.1f} more ({len(near)} in total)"] if near else sentences


def _too_few(assigned: Assigned) -> list[str]:
    """Return a sentence: the channels with rows are too few to separate an emitter from false rows."""
    what = "no emitter can have enough" if assigned.least > assigned.channels else f"an emitter needs {assigned.least}"
    return [f"rows in {assigned.present} channels cannot separate an emitter from false rows: {what}"]


def _of_emitters(status: Status) -> Finding:
    """Return the finding that an emitter has this status, which then applies to all emitters together."""
    return Finding(
        status,
        lambda assigned: any(fix.status == status for fix in assigned.fixes),
        lambda assigned: [
            f"emitter {i}: {fix.status.label}" for i, fix in enumerate(assigned.fixes) if fix.status == status
        ],
    )


_FINDINGS = (
    Finding(
        Status.INFEASIBLE,
        lambda assigned: assigned.wanted is not None and not np.isfinite(assigned.cost),
        lambda assigned: [f"no {assigned.wanted} emitters were found that share no row"],
    ),
    Finding(Status.TOO_FEW_ROWS, lambda assigned: not assigned.fixes and assigned.present < assigned.least, _too_few),
    Finding(Status.AMBIGUOUS, lambda assigned: bool(_near(assigned)), _near),
    *(_of_emitters(status) for status in PRECEDENCE if status is not Status.OK),
    Finding(
        Status.UNPROVEN,
        lambda assigned: assigned.cost - assigned.bound > _PROVEN,
        lambda assigned: [f"not proven: another assignment may cost {assigned.cost - assigned.bound:.1f} less"],
    ),
)
"""All findings about an assignment."""
