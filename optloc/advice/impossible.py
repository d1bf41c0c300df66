"""Values that no position has, and constraints that the data contradict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from optloc.advice.change import Change, MisfitCase
from optloc.advice.fits import fit
from optloc.advice.wording import no_words
from optloc.base.types import Array, Rows
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import violation, violation_names
from optloc.model_checks.cause import Advice
from optloc.models import MODELS
from optloc.problem.chart import tail_probability
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

# Number of standard deviations beyond which a value is impossible.
_IMPOSSIBLE_SIGMAS = 6.0
# Chi-square probability from which the values fit.
_FITS = 1e-3
# Violation from which a position is outside: far above the tolerance of solvers.
_OUTSIDE = 1e-6


def constraint_advice(case: MisfitCase) -> Iterator[Advice]:
    """Yield advice if the values fit without the constraints, but only at positions that violate them."""
    free = replace(case, base=replace(case.base, constraints=()))
    found = fit(free, [Change("constraint", no_words)])
    cost, dof = found.cost.sum(), case.dof.sum()
    p = float(tail_probability(np.array([cost]), np.array([dof]))[0]) if np.isfinite(cost) else 0.0
    if p >= _FITS and bool((_violation(case, found.x[0]) > _OUTSIDE).any()) and _is_refuted(case):
        names = violation_names(case.base)
        seen = (
            f"the values fit without the constraints ({names}; p = {p:.2g}), but no position was found that meets both"
        )
        yield Advice("constraint", seen, "check their values; heights must be above the ellipsoid, not above the sea")


def _violation(case: MisfitCase, x: Array) -> Array:
    """Return the violation (K,) of the constraints at the positions `x` (K, size)."""
    return violation(case.base, x)


def _is_refuted(case: MisfitCase) -> bool:
    """Return whether the fixes as given do not fit or violate the constraints."""
    if not np.isfinite(case.x).all():
        return True
    cost = equations_at(case.base, case.x).cost.sum()
    return bool(tail_probability(np.array([cost]), np.array([case.dof.sum()]))[0] < _FITS)


def _impossible_rows(problem: Problem) -> Iterator[tuple[Rows, int, float]]:
    """Yield the rows of a kind, the number of an impossible value among them, and the distance of its stations, m.

    A difference is impossible if it exceeds the distance of its stations. A range or a sum of ranges is impossible
    below this distance; a range has one station, so its limit is zero. Rows with an unknown emission time or a bias are
    omitted, because this unknown can shift their values. A value counts only beyond `_IMPOSSIBLE_SIGMAS`.
    """
    sigma = np.sqrt(variances(problem.noise, problem.count)).reshape(-1, problem.count)
    observed, weight = (np.reshape(a, (-1, problem.count)) for a in (problem.observed, problem.weight))
    position = problem.stations.position
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        ranges, part = MODELS[rows.kind].ranges, slice(start, start + rows.count)
        if ranges not in ((1, -1), (1, 0), (1, 1)) or MODELS[rows.kind].emission or _is_biased(problem, part):
            continue
        # stations at rest have positions for one epoch only, number 0
        moving = rows.epoch if position.shape[-3] > 1 else np.zeros_like(rows.epoch)
        apart = np.zeros(rows.count)
        if ranges[1]:
            line = position[..., moving, rows.a, :] - position[..., moving, rows.b, :]
            apart = np.sqrt((line**2).sum(-1)).reshape(-1, rows.count)[0]
        value = observed[:, part] * np.ones((len(observed), 1))
        over = np.abs(value) - apart if ranges == (1, -1) else apart - value
        bad = (over > _IMPOSSIBLE_SIGMAS * sigma[:, part]) & (weight[:, part] > 0.0)
        for i in np.flatnonzero(bad.any(0)):
            yield rows, int(i), float(apart[i])


def _is_biased(problem: Problem, part: slice) -> bool:
    """Return whether a bias of the problem affects a row in the slice `part`, so that any value is possible."""
    return any(((bias.row >= part.start) & (bias.row < part.stop)).any() for bias in problem.biases)


def impossible_advice(problem: Problem) -> Iterator[Advice]:
    """Yield advice about the first value that no position can have, and the number of other impossible values."""
    found = list(_impossible_rows(problem))
    if not found:
        return
    rows, i, apart = found[0]
    names, value = problem.stations.names, float(np.reshape(rows.z - rows.correction, (-1, rows.count))[0, i])
    more = f"; so are {len(found) - 1} more" if len(found) > 1 else ""
    if MODELS[rows.kind].ranges == (1, -1):
        seen = f"the {rows.kind} of {names[rows.a[i]]} and {names[rows.b[i]]} is {value:.4g} m"
        seen += f", but the stations are {apart:.4g} m apart: no position has this difference{more}"
    else:
        seen = f"the {rows.kind} at {names[rows.a[i]]} is {value:.4g} m, less than possible at any position{more}"
    yield Advice(
        "impossible", seen, "check the unit of the values and of the stations, and the positions of the stations"
    )
