"""The problems and methods of a recording, in a fixed order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from cases import CASES, Case, dense_covariance

from optloc import Problem, simulate
from optloc.solvers import METHODS, SOLVERS

# The size of the wrong measurement: every method with suspects must notice it, and no angle of the cases wraps.
GROSS_SIGMAS = 40.0
# Methods for the refinements that no named method has; a start alone gets least squares and a proof from `solve`.
REFINEMENTS = {"nlp": "roots+nlp", "taylor": "roots+taylor", "value": "roots+lsr+value"}


def shipped_methods() -> tuple[str, ...]:
    """Return the named methods, every start of optloc as a method, and one method for each further refinement."""
    starts = (word for word in own_words() if SOLVERS[word].role == "start")
    return (*METHODS, *starts, *REFINEMENTS.values())


def own_words() -> tuple[str, ...]:
    """Return the stages that optloc ships, without those of installed packages."""
    added = set(SOLVERS._added)
    return tuple(word for word in SOLVERS if word not in added)


def _clean(problem: Problem, rng: np.random.Generator) -> Problem:
    return problem


def _gross(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return the problem with one measurement that is wrong by 40 sigma: misfits, weights and suspects."""
    z, row = problem.observed.copy(), rng.integers(problem.count)
    z[row] += GROSS_SIGMAS * np.sqrt(dense_covariance(problem)[row, row])
    return problem.with_rows(z=z)


def _few(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return the problem with as few rows as unknowns: several minima and fixes without redundancy."""
    weight = np.zeros(problem.count)
    weight[rng.permutation(problem.count)[: problem.layout.size]] = 1.0
    return problem.with_rows(weight=weight)


VARIANTS: dict[str, Callable[[Problem, np.random.Generator], Problem]] = {"clean": _clean, "gross": _gross, "few": _few}


@dataclass(frozen=True)
class Scene:
    """A problem of a recording: a case with the measurements of one seed, in one variant."""

    case: str
    variant: str
    seed: int
    problem: Problem
    truth: np.ndarray


def scenes(cases: Iterable[str], variants: Iterable[str], seeds: Iterable[int]) -> Iterator[Scene]:
    """Yield the problems of a recording."""
    for name in cases:
        for variant in variants:
            for seed in seeds:
                yield _scene(name, CASES[name], variant, seed)


def _scene(name: str, case: Case, variant: str, seed: int) -> Scene:
    letters = [ord(letter) for letter in name]
    # Seed 0 has the measurements of the tests; a difference there can be looked up in them.
    problem = (
        case.problem if seed == 0 else simulate(case.problem, case.truth, np.random.SeedSequence([seed, *letters]))
    )
    rng = np.random.default_rng([seed, *letters, *map(ord, variant)])
    return Scene(name, variant, seed, VARIANTS[variant](problem, rng), case.truth)
