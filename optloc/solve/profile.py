"""The cost of a problem over the place of its target, everything else at the values that fit best."""

from __future__ import annotations

import numpy as np

from optloc.equations import equations_at
from optloc.normal import eliminated, step
from optloc.problem import Problem
from optloc.tangent import tangent
from optloc.types import Array

_STEPS = 40
_FIRST, _STUCK = 1e-3, 1e9
_SETTLED = 1e-9


def profile_cost(problem: Problem, x: Array, places: Array, held: Array) -> Array:
    """Return the profile of the maximum-likelihood cost over places.

    Coordinates of the position that are not held, velocities, biases and the unknowns of single epochs take, by damped
    Gauss-Newton steps from `x`, the values that fit best at each place.

    Parameters
    ----------
    problem : Problem
        A flat batch of one problem with one target that is sought.
    x : array (size,)
        Parameter vector that the search for the others begins at, for instance that of a fix.
    places : array (N, d)
        Positions, metres.
    held : array (c, d)
        Directions along which the position stays at its place, such as east and north.

    Returns
    -------
    array (N,)
        Weighted sum of squared residuals and prior penalties.

    References
    ----------
    S. A. Murphy and A. W. van der Vaart, "On profile likelihood", J. Am. Stat. Assoc. 95 (2000) 449-465.
    """
    layout = problem.layout
    slot, _ = layout.find("position")
    vectors = np.tile(np.asarray(x, dtype=float), (len(places), 1))
    vectors[:, slot.start : slot.start + slot.size] = places
    gradients = np.zeros((1, len(held), layout.n_shared))
    gradients[0, :, slot.start : slot.start + slot.size] = held
    space = tangent(gradients, np.ones((1, layout.n_shared)))
    with np.errstate(all="ignore"):
        cost = np.asarray(eliminated(equations_at(problem, vectors)).cost)
        if layout.n_shared > len(held):
            active, damping = np.arange(len(places)), np.full(len(places), _FIRST)
            for _ in range(_STEPS):
                before = cost[active]
                move, ok = step(equations_at(problem, vectors[active]), damping[active], space)
                tried = vectors[active] + np.where(ok[:, None], move, 0.0)
                after = np.asarray(eliminated(equations_at(problem, tried)).cost)
                better = ok & (after < before)
                vectors[active[better]], cost[active[better]] = tried[better], after[better]
                damping[active] *= np.where(better, 0.1, 10.0)
                done = better & (before - after < _SETTLED * (1.0 + after)) | (damping[active] > _STUCK)
                active = active[~done]
                if not len(active):
                    break
    return cost
