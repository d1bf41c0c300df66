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


def _kinematic(size: Size, seed: int) -> Plan:
    from optloc.papers.kinematic.study import SIZES, plan

    return plan(SIZES[size], seed)


def _bistatic(size: Size, seed: int) -> Plan:
    from optloc.papers.bistatic.study import SIZES, plan

    return plan(SIZES[size], seed)


def _satellites(size: Size, seed: int) -> Plan:
    from optloc.papers.satellites.study import SIZES, plan

    return plan(SIZES[size], seed)


def _angles(size: Size, seed: int) -> Plan:
    from optloc.papers.angles.study import SIZES, plan

    return plan(SIZES[size], seed)


PAPERS: dict[str, Paper] = {
    "angles": Paper(
        "manoeuvring targets by azimuth and elevation with the current statistical model",
        "Liu Zhe, Wei Junhu, Huang Wenzhun, Huang Shiqi: location and tracking by log-likelihood estimation (Chinese)",
        _angles,
    ),
    "registration": Paper(
        "biases of moving stations from time differences and gain ratios, many epochs",
        "Journal of Electronics and Information Technology 39 (2017), TDOA and GROA error registration",
        _registration,
    ),
    "kinematic": Paper(
        "static, uniform and accelerated models of distant targets from time differences, with and without row names",
        "Missiles and Space Vehicles 2024/5, doi:10.7654/j.issn.2097-1974.20240501",
        _kinematic,
    ),
    "bistatic": Paper(
        "slow targets by one receiver and one illuminator of opportunity, from excess path and direction",
        "Southwest China Institute of Electronic Technology, simplified NLS for single-station location",
        _bistatic,
    ),
    "satellites": Paper(
        "ships by the time differences of three satellites at a known height, four Kalman filters",
        "modified covariance extended Kalman filtering for passive location and tracking by three satellites",
        _satellites,
    ),
}


def paper(name: str) -> Paper:
    """Return a paper by its name; raise InvalidProblem for an unknown one."""
    if name not in PAPERS:
        raise InvalidProblem(f"there is no paper {name!r}", "reproduce", nearest(name, list(PAPERS)))
    return PAPERS[name]
