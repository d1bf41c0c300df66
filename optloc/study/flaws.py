"""Errors that measurements suffer and no method is told: constant ones of every station, gross ones of a few."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.bias import with_bias
from optloc.errors import InvalidProblem
from optloc.files.words import join, nearest
from optloc.problem import Problem
from optloc.study.amounts import sigma_of
from optloc.study.document import Amount, ScenarioTable
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Flaw:
    """Errors of the stations in rows of one kind.

    Parameters
    ----------
    name : str
        Name of the unknown that holds them.
    size : float
        Their standard deviation; of gross ones how large they are.
    share : float, optional
        Probability that a station has a gross error; None: every station has a small one.
    late : bool
        Whether gross errors are positive.
    """

    name: str
    size: float
    share: float | None = None
    late: bool = False


def flawed(problem: Problem, table: ScenarioTable, where: str) -> tuple[Problem, tuple[Flaw, ...]]:
    """Return the problem as it really is, with the errors that no method is told, and what they are.

    Parameters
    ----------
    problem : Problem
        As methods get it.
    table : ScenarioTable
        The scenario.
    where : str
        Its place, for complaints.

    Raises
    ------
    InvalidProblem
        For a kind that the problem lacks, or a size that is not positive.
    """
    place, found = join(where, "error"), []
    offset, outliers = table.error.offset, table.error.outliers
    if offset is not None:
        sizes = _sizes(problem, offset, join(place, "offset"))
        found += [Flaw(f"unmodelled {kind}", size) for kind, size in sizes.items()]
    if outliers is not None:
        sizes = _sizes(problem, outliers.size, join(place, "outliers"))
        found += [Flaw(f"gross {kind}", size, outliers.share, outliers.late) for kind, size in sizes.items()]
    for flaw in found:
        problem = with_bias(problem, flaw.name, kind=flaw.name.partition(" ")[2])
    return problem, tuple(found)


def errors_of(
    flaws: tuple[Flaw, ...], lengths: dict[str, int], rng: np.random.Generator, size: int
) -> dict[str, Array]:
    """Return the errors (size, stations) of each flaw; a station that is off is off in all kinds.

    Parameters
    ----------
    flaws : tuple of Flaw
        From `flawed`.
    lengths : dict of str to int
        Number of stations in each.
    rng : Generator
        Decides the draw.
    size : int
        Number of trials.
    """
    small = [flaw for flaw in flaws if flaw.share is None]
    drawn: dict[str, Array] = {f.name: f.size * rng.standard_normal((size, lengths[f.name])) for f in small}
    most = max(lengths.values(), default=0)
    chance, sign = rng.random((size, most)), np.where(rng.random((size, most)) < 0.5, -1.0, 1.0)
    for flaw in flaws:
        if flaw.share is not None:
            off = (chance < flaw.share) * (1.0 if flaw.late else sign) * flaw.size
            drawn[flaw.name] = off[:, : lengths[flaw.name]]
    return drawn


def _sizes(problem: Problem, given: Amount | dict[str, Amount], where: str) -> dict[str, float]:
    """Return sizes in SI units by kind."""
    kinds = [rows.kind for rows in problem.rows]
    named = given if isinstance(given, dict) else dict.fromkeys(kinds, given)
    for kind in named:
        if kind not in kinds:
            raise InvalidProblem(f"no rows are of kind {kind!r}", where, nearest(kind, kinds))
    return {kind: sigma_of(kind, amount, where) for kind, amount in named.items()}
