"""Published simulations, reproduced from their text: each paper has an entry, a module with a `STUDY`, and a page."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

from optloc.lab.papers.report import Report, Reproduction, Size, write
from optloc.problem import InvalidProblem, nearest
from optloc.show import TextTable

__all__ = ["PAPERS", "Paper", "Report", "Reproduction", "Size", "TextTable", "paper", "reproduction", "write"]


@dataclass(frozen=True, slots=True)
class Paper:
    """A paper that can be reproduced.

    Parameters
    ----------
    summary : str
        One line for listings.
    source : str
        Publication.
    module : str
        Module of this package with its `STUDY`.
    """

    summary: str
    source: str
    module: str


PAPERS: dict[str, Paper] = {
    "angles": Paper(
        "manoeuvring targets by azimuth and elevation with the current statistical model",
        "Liu Zhe, Wei Junhu, Huang Wenzhun, Huang Shiqi: location and tracking by log-likelihood estimation (Chinese)",
        "angles_tables",
    ),
    "registration": Paper(
        "biases of moving stations from time differences and gain ratios, many epochs",
        "Journal of Electronics and Information Technology 39 (2017), TDOA and GROA error registration",
        "registration_tables",
    ),
    "kinematic": Paper(
        "static, uniform and accelerated models of distant targets from time differences, with and without row names",
        "Missiles and Space Vehicles 2024/5, doi:10.7654/j.issn.2097-1974.20240501",
        "kinematic_tables",
    ),
    "bistatic": Paper(
        "slow targets by one receiver and one illuminator of opportunity, from excess path and direction",
        "Southwest China Institute of Electronic Technology, simplified NLS for single-station location",
        "bistatic",
    ),
    "satellites": Paper(
        "ships by the time differences of three satellites at a known height, four Kalman filters",
        "modified covariance extended Kalman filtering for passive location and tracking by three satellites",
        "satellites",
    ),
}


def paper(name: str) -> Paper:
    """Return a paper by its name; raise InvalidProblem for an unknown one."""
    if name not in PAPERS:
        raise InvalidProblem(f"there is no paper {name!r}", "reproduce", nearest(name, list(PAPERS)))
    return PAPERS[name]


def reproduction(name: str, size: Size, seed: int) -> Reproduction:
    """Return the reproduction of a paper, ready to run; only the modules of the paper are loaded.

    Raise InvalidProblem for an unknown paper, or if matplotlib is missing.
    """
    study = import_module(f"optloc.lab.papers.{paper(name).module}").STUDY
    ready: Reproduction = study.reproduction(study.sizes[size], seed)
    return ready
