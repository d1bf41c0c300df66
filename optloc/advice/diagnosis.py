"""All checks of a fix together: advice, observability, reliability, and the health of stations over many fixes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optloc.advice.advising import advise
from optloc.base.errors import InvalidProblem
from optloc.base.types import Status
from optloc.bounds.rank import Observability, observability
from optloc.model_checks.cause import Advice
from optloc.model_checks.evidence import Reliability, reliability
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.station_health.stations import Health, health

# Least number of fixes for statistics of stations: with ten fixes the standard error of a noise level is a quarter of
# it.
_FEW = 10
# Most fixes of a batch that get advice: each takes about ten milliseconds.
_ADVISED = 20


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Findings of the checks of a fix; ``print`` shows them as sentences.

    Parameters
    ----------
    status : tuple of str
        Label of each status that occurs; for several fixes with the number of fixes.
    advice : tuple of Advice
        Possible causes, and remedies. For a batch: for the first twenty fixes that are not ``ok``, without repetitions.
    observability : Observability, optional
        Unknowns that data and priors determine. None for a batch, and without a fix.
    reliability : Reliability, optional
        For each station the error that would not be noticed, and its effect. None for a batch, and without a fix.
    health : Health, optional
        Statistics of stations over the fixes. None for fewer than ten fixes, and if stations do not check each other.
    """

    status: tuple[str, ...]
    advice: tuple[Advice, ...]
    observability: Observability | None
    reliability: Reliability | None
    health: Health | None

    def __str__(self) -> str:
        """Return the findings, one sentence a line."""
        return "\n".join(self.sentences)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return the findings, one sentence each."""
        return tuple(_sentences(self))


def diagnose(problem: Problem, fix: Fix) -> Diagnosis:
    """Return the causes of a status, the unknowns that the data determine, and the errors that would not be noticed.

    Parameters
    ----------
    problem : Problem
        One problem, a run, or a batch (...) of problems.
    fix : Fix
        Its fix, of the same batch.

    Returns
    -------
    Diagnosis
        Advice, observability, reliability and health of stations, as far as they apply.

    Raises
    ------
    InvalidProblem
        If the fix does not belong to this problem.
    """
    label = [status.label for status in np.ravel(fix.statuses)]
    counts = tuple(name if len(label) == 1 else f"{name}: {label.count(name)}" for name in dict.fromkeys(label))
    single = not problem.batch_shape and not fix.shape
    known = single and bool(np.isfinite(fix.x).all()) and fix.x.shape == (problem.layout.size,)
    return Diagnosis(
        counts,
        tuple(_advice(problem, fix)),
        observability(problem, fix.x) if known else None,
        reliability(problem, fix.x, fix.suspects) if known else None,
        _health(problem, fix),
    )


def _advice(problem: Problem, fix: Fix) -> Iterator[Advice]:
    """Yield the advice on each fix that is not `ok`, without repetitions; in a batch, on the first twenty of them."""
    if not problem.batch_shape:
        yield from advise(problem, fix)
        return
    if fix.shape != problem.batch_shape:
        raise InvalidProblem(
            f"fixes of shape {fix.shape} for problems of shape {problem.batch_shape}",
            "fix",
            "give the fix of this problem",
        )
    flat, fixes = problem.flat(), fix.flat()
    doubtful = np.flatnonzero(fixes.code != Status.OK)[:_ADVISED]
    found = advise(flat.take(doubtful), fixes[doubtful]) if len(doubtful) else []
    yield from dict.fromkeys(one for each in found for one in each)


def _health(problem: Problem, fix: Fix) -> Health | None:
    """Return the statistics of stations; None for few fixes, or if stations do not check each other."""
    many = int(np.prod(problem.batch_shape)) if problem.batch_shape else problem.epochs
    if many < _FEW or not (problem.batch_shape or separable(problem)):
        return None
    try:
        return health(problem, fix=fix)
    except InvalidProblem:
        return None


def _sentences(found: Diagnosis) -> Iterator[str]:
    """Yield the findings as sentences."""
    yield f"status {', '.join(found.status)}"
    for one in found.advice:
        yield f"{one.seen}: {one.advice}"
    if found.observability is not None:
        yield from found.observability.sentences
    if found.reliability is not None:
        weak = [
            name
            for name, least in zip(found.reliability.names, found.reliability.least, strict=True)
            if np.isinf(least)
        ]
        if weak:
            yield f"no other measurement checks {', '.join(weak)}"
    if found.health is not None:
        yield from found.health.sentences
