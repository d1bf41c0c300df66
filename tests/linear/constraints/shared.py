"""Small problems that the tests of constraints share."""

from dataclasses import replace

import numpy as np

from optloc import assemble, measured

PLANE = np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0], [1000.0, 1000.0]])
SPACE = np.column_stack([PLANE, [0.0, 80.0, 20.0, 150.0]])
SIGMA = 10.0


def ranges_to(target, limits=(), sigma=SIGMA, z=None):
    """Return the problem of exact ranges (or of given ones) to a target, with constraints."""
    stations = PLANE if len(target) == 2 else SPACE
    z = np.linalg.norm(stations - np.asarray(target), axis=1) if z is None else z
    return assemble(stations, measured("range", z, a=range(4), sigma=sigma), constraints=limits)


def flat(problem, *limits):
    """Return the flat batch of a problem with other constraints."""
    return replace(problem, constraints=limits).flat()
