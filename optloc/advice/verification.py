"""Suggestions as a user would write them: each is solved, and its cost is compared with the promised cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optloc.advice.fits import changed
from optloc.advice.scores import Scored
from optloc.solvers.solution import solve

# Method of the solution: the starts and the search of `auto`, without its proof.
_METHOD = "searched"
# Difference of costs that changes no decision.
_SAME = 0.1


def verified(found: Sequence[Scored]) -> tuple[Scored, ...]:
    """Return the explanations with the cost of a solution after the change, without those that it does not confirm.

    A solver starts without the result of the comparison. If it finds a better position, its cost counts.
    """
    out = []
    for one in found:
        # residuals of late rows have no chi-square, and larger noise suggests no other position
        if not np.isfinite(one.cost) or one.change.cause == "noise":
            out.append(one)
            continue
        cost = solved_cost(one)
        if cost <= one.cost + _SAME:
            out.append(replace(one, cost=min(cost, one.cost), score=one.score + min(cost, one.cost) - one.cost))
    return tuple(sorted(out, key=lambda one: one.score))


def solved_cost(one: Scored) -> float:
    """Return the cost of a solution after a change, with its parameters as estimated; infinite if it fails."""
    return float(np.sum(solve(changed(one.case, [one.change], one.theta[None]), _METHOD).cost))
