"""Advice on a fix: the geometry, impossible values, and the causes of a misfit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from optloc.advice.cases import case_of
from optloc.advice.causes import advice_on, causes_of
from optloc.advice.geometry import advise_on_geometry
from optloc.advice.impossible import constraint_advice, impossible_advice
from optloc.advice.verification import verified
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.model_checks.cause import Advice
from optloc.model_checks.plausibility import suspicious_values
from optloc.model_checks.single_error import joined_vector, without_unknown
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem


def advise(problem: Problem, fix: Fix | None = None) -> Any:
    """Return possible reasons why a fix is not `ok`, each with the lines of a problem file or the option that helps.

    All explanations of a misfit compete in one score; see the page on advice. One explanation is returned if all others
    score worse by a gap of 9. Otherwise the two or three that remain are returned, the best first. Advice on the
    geometry follows: stations in a plane or on a line, and missing redundancy.

    Parameters
    ----------
    problem : Problem
        One problem, a run, or a batch (...) of problems.
    fix : Fix, optional
        The fix of the problem, (k,) fixes of a run whose epochs share nothing, or the fixes of the batch. Without it,
        the comparison starts with a search.

    Returns
    -------
    tuple of Advice, or object array (...) of tuples
        Empty if nothing was found.

    Raises
    ------
    InvalidProblem
        If the fix is not a fix of this problem.
    """
    shape = problem.batch_shape
    if not shape:
        return advise_at(problem, np.full((1, problem.layout.size), np.nan) if fix is None else fix.x)
    flat, out = problem.flat(), np.empty(int(np.prod(shape)), dtype=object)
    if fix is not None and fix.shape != shape:
        raise InvalidProblem(
            f"fixes of shape {fix.shape} for problems of shape {shape}", "fix", "give one fix per problem"
        )
    x = np.full((len(out), problem.layout.size), np.nan) if fix is None else fix.flat().x
    for i in range(len(out)):
        out[i] = advise_at(flat.take(np.array([i])), x[i])
    return out.reshape(shape)


def advise_at(problem: Problem, x: Array) -> tuple[Advice, ...]:
    """Return the advice for one problem or run at a fix (size,), or at fixes (k, size of an epoch) of separate epochs.

    `x` is NaN if there is no fix.
    """
    flat, x = problem.flat(), joined_vector(problem, np.asarray(x))
    # planned rows without a measurement also count for the geometry
    geometry = tuple(advise_on_geometry(flat, x))
    # separate epochs without a fix are searched; the unknowns of a run need a value to start from
    known = np.where(np.isfinite(flat.z), flat.z, 0.0), np.where(np.isfinite(flat.z), flat.weight, 0.0)
    part, x = (flat.with_rows(*known), x) if separable(flat) else without_unknown(flat, x)
    if not bool((part.weight > 0.0).any()):
        return geometry
    # a layered medium or a wind changes nothing that an explanation would change: rows keep their rays
    return (*_on_values(part, x), *geometry)


def _on_values(problem: Problem, x: Array) -> Iterator[Advice]:
    """Yield the advice on the values of a flat batch of one problem at `x` (1, size)."""
    case = case_of(problem, x)
    found = () if case is None else verified(causes_of(case))
    if not found and case is not None and problem.constraints:
        yield from constraint_advice(case)
    # a cause that explains the data explains impossible values, too; larger noise does not
    if not found or found[0].change.cause == "noise":
        impossible = (*suspicious_values(problem), *impossible_advice(problem))
        yield from impossible
        found = () if impossible else found
    yield from advice_on(found)
