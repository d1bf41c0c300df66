"""Suggestions as a user would write them: each is solved, and its cost is compared with the promised cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.advice.change import MisfitCase
from optloc.advice.fits import changed
from optloc.advice.scores import Scored
from optloc.problem.problem import Problem
from optloc.solvers.solution import solve

# Method of the solution: the starts and the search of `auto`, without its proof.
_METHOD = "searched"
# Difference of costs that changes no decision.
_SAME = 0.1


def verified(case: MisfitCase, found: Sequence[Scored]) -> tuple[Scored, ...]:
    """Return the explanations with the cost of a solution after the change, without those that it does not confirm.

    A solver starts without the result of the comparison. If it finds a better position, its cost counts.
    """
    out = []
    for one in found:
        cost = solved_cost(case, one)
        # residuals of late rows have no chi-square
        if not np.isfinite(one.cost):
            out.append(one)
        elif cost <= one.cost + _SAME:
            out.append(replace(one, cost=min(cost, one.cost), score=one.score + min(cost, one.cost) - one.cost))
    return tuple(sorted(out, key=lambda one: one.score))


def solved_cost(case: MisfitCase, one: Scored) -> float:
    """Return the cost of a solution after a change, with its parameters as estimated; infinite if it fails."""
    return float(np.sum(solve(_problem(case, one), _METHOD).cost))


def _problem(case: MisfitCase, one: Scored) -> Problem:
    """Return the problems (K,) after a change."""
    own = case if one.change.base is None else replace(case, base=one.change.base)
    return changed(own, [one.change], one.theta[None])
