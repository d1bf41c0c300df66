"""The same problem on CasADi symbols: residuals for nonlinear programs, from the same models and the same indices."""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.models.primitives import wrap
from optloc.problem import Problem
from optloc.states import Terms, given, joined, plans
from optloc.types import Array


def parameters(problem: Problem) -> Array:
    """Return the numbers (p,) that the symbolic residual of a single problem needs beside x and z."""
    values = [np.zeros(0)]
    for plan in plans(problem):
        inputs = given(problem, plan)
        values.extend(np.ravel(np.broadcast_to(inputs[seed], (plan.block.count,))) for seed in sorted(inputs))
    return np.concatenate(values)


def residual(problem: Problem, x: Any, p: Any, z: Any) -> list[Any]:
    """Return z - h(x) of every row as CasADi expressions; angles are wrapped.

    Parameters
    ----------
    problem : Problem
        A single problem; only its structure enters the expressions.
    x : casadi.SX (size, 1)
        Parameter vector.
    p : casadi.SX (p, 1)
        Numbers in the order of `parameters`.
    z : casadi.SX (m, 1)
        Measurements less their corrections.
    """
    out, used = [], 0
    for plan, start in zip(plans(problem), problem.starts, strict=True):
        seeds = sorted(given(problem, plan))
        for i in range(plan.block.count):
            inputs = {seed: p[used + j * plan.block.count + i] for j, seed in enumerate(seeds)}
            for feed in plan.feeds:
                rows = np.arange(plan.block.count)[feed.rows]
                for at in np.flatnonzero(rows == i):
                    gain = np.broadcast_to(feed.gain, feed.column.shape)[at]
                    inputs[feed.seed] = inputs.get(feed.seed, 0.0) + float(gain) * x[int(feed.column[at])]
            value = plan.model.h(*joined(problem, plan.model, inputs))
            value = value * (1.0 + _total(plan.gains, i, x)) + _total(plan.adds, i, x)
            misfit = z[start + i] - value
            out.append(wrap(misfit) if plan.model.period is not None else misfit)
        used += len(seeds) * plan.block.count
    return out


def _total(terms: Terms, row: int, x: Any) -> Any:
    return sum(float(terms.coefficient[i]) * x[int(terms.column[i])] for i in np.flatnonzero(terms.row == row))
