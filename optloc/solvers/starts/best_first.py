"""Starts for every mixture of kinds that a proof can bound: minima that a best-first search of boxes finds.

The search splits the box with the lowest bound of the cost first. Letters: N problems, q minima, d coordinates, metres.
"""

from __future__ import annotations

import numpy as np

from optloc.base.types import Array, Band
from optloc.kernels.jit import enabled
from optloc.linear.constraints import is_exact
from optloc.problem.problem import Problem
from optloc.proof.best_first import FoundPlaces, find_minima
from optloc.proof.position_costs import position_costs
from optloc.proof.runs.run_costs import few_costs
from optloc.proof.scope import is_run
from optloc.solvers.certificates.position_cost import surfaces_of
from optloc.solvers.policy import LISTED_GAP
from optloc.solvers.starts.position import spread_of

# Boxes for each problem, with machine code and without: a box takes some microseconds, or a thousand times that.
# Mixtures of frequencies, times and angles take 100 to 1 500.
_BUDGET, _SLOW_BUDGET = 4000, 400
# Boxes for the few rows of a run: its best minimum is found within a hundred boxes, and the proof finds all others.
_RUN_BUDGET = 500
# Minima that are kept: a pass of a satellite has two, exact solutions of three frequencies in space up to a handful.
_MOST = 12
# Spreads of the stations around their centre that are searched if nothing bounds the cheap positions, as in a proof
# over a region.
_SPREADS = 10.0


def best_first_starts(problem: Problem) -> Array:
    """Return the minima (N, q, d) that a best-first search finds, by ascending cost; NaN after the last.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof (`optloc.proof.scope.why_unsupported`).
    """
    size, d = problem.batch_shape[0], problem.dimension
    centre, spread = spread_of(problem)
    region = centre[:, None] + _SPREADS * spread[:, None, None] * np.array([[-1.0], [1.0]])
    x = _on_planes(problem, np.broadcast_to(centre, (size, d)))
    planes, surface = surfaces_of(problem, x)
    places = FoundPlaces(x, np.broadcast_to(region, (size, 2, d)), planes, surface)
    budget = _BUDGET if enabled() else _SLOW_BUDGET
    if not is_run(problem):
        return find_minima(position_costs(problem), places, LISTED_GAP, budget, _MOST)[0]
    # A few rows of a run are enough for a start: the other rows decide between the minima.
    looks = [few_costs(problem.take(np.array([i]))) for i in range(size)]
    each = [find_minima(look, _place(places, i), LISTED_GAP, _RUN_BUDGET, _MOST)[0] for i, look in enumerate(looks)]
    return np.concatenate(each)


def _place(places: FoundPlaces, i: int) -> FoundPlaces:
    """Return the positions of problem i as a batch of one problem."""
    return FoundPlaces(*(array[i : i + 1] for array in places))


def _on_planes(problem: Problem, x: Array) -> Array:
    """Return positions (N, d), metres, moved onto the planes to which equalities restrict the target."""
    for band in problem.constraints:
        if isinstance(band, Band) and is_exact(band) and band.kind == "plane":
            # One plane after the other: oblique planes leave a remainder, which does not matter along the axes of the
            # proof.
            normal = band.coefficients
            off = np.asarray(band.lower) - (x * normal).sum(-1)
            x = x + (off / (normal**2).sum(-1))[..., None] * normal
    return x
