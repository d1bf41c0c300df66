"""Residuals and constraints of a problem as CasADi expressions, for nonlinear programs.

They use the same models and the same indices as the numerical code. Letters: m rows, p or q numbers that are parameters
of the expressions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.linear.constraints import bounded, conjunction, decisive_epochs
from optloc.linear.evaluate import Terms, block_links, given, join
from optloc.models.primitives import wrap
from optloc.models.surfaces import SURFACES
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem


def parameters(problem: Problem) -> Array:
    """Return the numbers (p,) that the symbolic residual of a single problem needs in addition to x and z."""
    values = [np.zeros(0)]
    for links in block_links(problem):
        inputs = given(problem, links)
        values.extend(np.ravel(inputs[seed] + np.zeros(links.block.count)) for seed in sorted(inputs))
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
    for links, start in zip(block_links(problem), problem.starts, strict=True):
        # `parameters` sorts as well, so that numbers and symbols have the same order.
        seeds = sorted(given(problem, links))
        for i in range(links.block.count):
            inputs = {seed: p[used + j * links.block.count + i] for j, seed in enumerate(seeds)}
            for feed in links.feeds:
                rows = np.arange(links.block.count)[feed.rows]
                # Row by row, because symbols are scalars; the expression is built once for each structure.
                for at in np.flatnonzero(rows == i):
                    gain = np.broadcast_to(feed.gain, feed.column.shape)[at]
                    inputs[feed.seed] = inputs.get(feed.seed, 0.0) + float(gain) * x[int(feed.column[at])]
            value = links.model.h(*join(problem, links.model, inputs))
            # The same order as in `optloc.linear.evaluate`: first scaled, then shifted.
            value = value * (1.0 + _total(links.gains, i, x)) + _total(links.adds, i, x)
            misfit = z[start + i] - value
            out.append(wrap(misfit) if links.model.period is not None else misfit)
        used += len(seeds) * links.block.count
    return out


def _total(terms: Terms, row: int, x: Any) -> Any:
    """Return the sum of the linear terms of a row at the vector x, as an expression."""
    return sum(float(terms.coefficient[i]) * x[int(terms.column[i])] for i in np.flatnonzero(terms.row == row))


def bounds(problem: Problem) -> Array:
    """Return the numbers (q,) that the symbolic constraints of a single problem need: coefficients, lower, upper."""
    values = [np.zeros(0)]
    for band in conjunction(problem):
        values += [np.ravel(band.coefficients), np.ravel(band.lower), np.ravel(band.upper)]
    return np.concatenate(values)


def constrained(problem: Problem, x: Any, p: Any, length: Any) -> tuple[list[Any], list[Any]]:
    """Return the equalities c(x) = 0 and inequalities d(x) >= 0 of a problem as CasADi expressions.

    Parameters
    ----------
    problem : Problem
        A single problem; only its structure enters the expressions.
    x : casadi.SX (size, 1)
        Parameter vector.
    p : casadi.SX (q, 1)
        Numbers in the order of `bounds`.
    length : casadi.SX
        Unit of length: divisor of quantities in metres.
    """
    equal: list[Any] = []
    more: list[Any] = []
    used = 0
    for band in conjunction(problem):
        surface, count = SURFACES[band.kind], band.coefficients.shape[-1]
        c = tuple(p[used + i] for i in range(count))
        lower, upper = p[used + count], p[used + count + 1]
        used += count + 2
        unit = length if surface.unit == "m" else 1.0
        for epoch in decisive_epochs(problem, band):
            others = None if band.other is None else _states(problem, band.other, x)
            value = bounded(problem, band, _states(problem, band.target, x), c, epoch, others)
            # Whether a side exists is part of the structure; its value is a parameter.
            if np.all(band.lower == band.upper):
                equal.append((value - lower) / unit)
                continue
            if np.isfinite(band.lower).all():
                more.append((value - lower) / unit)
            if np.isfinite(band.upper).all():
                more.append((upper - value) / unit)
    return equal, more


def _states(problem: Problem, target: int, x: Any) -> list[tuple[Any, ...]]:
    """Return the state of a target in the vector x as tuples of symbols: position, velocity, acceleration."""
    names = state_names(target, len(problem.motions), problem.motions[target].order)
    starts = [problem.layout.find(name)[0].start for name in names]
    return [tuple(x[start + i] for i in range(problem.dimension)) for start in starts]
