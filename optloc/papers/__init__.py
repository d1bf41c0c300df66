"""Published studies, made again from their text: one line for each paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from optloc.errors import InvalidProblem, nearest
from optloc.papers.report import Plan, Report, Size, Table, write

__all__ = ["PAPERS", "Paper", "Plan", "Report", "Size", "Table", "paper", "write"]


@dataclass(frozen=True, slots=True)
class Paper:
    """A paper that can be reproduced.

    Parameters
    ----------
    summary : str
        One line for listings.
    source : str
        Publication.
    plan : callable
        ``(size, seed) -> Plan``.
    """

    summary: str
    source: str
    plan: Callable[[Size, int], Plan]


def _registration(size: Size, seed: int) -> Plan:
    from optloc.papers.registration.study import SIZES, plan

    return plan(SIZES[size], seed)


PAPERS: dict[str, Paper] = {
    "registration": Paper(
        "biases of moving stations from time differences and gain ratios, many epochs",
        "Journal of Electronics and Information Technology 39 (2017), TDOA and GROA error registration",
        _registration,
    ),
}


def paper(name: str) -> Paper:
    """Return a paper by its name; raise InvalidProblem for an unknown one."""
    if name not in PAPERS:
        raise InvalidProblem(f"there is no paper {name!r}", "reproduce", nearest(name, list(PAPERS)))
    return PAPERS[name]
