"""A fix of ranges in a frame on Earth, as the tests of pictures, pages and formats show it."""

from functools import cache

import numpy as np

from optloc import Frame, assemble, measured, solve

ENU = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
PLACES = np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0], [1000.0, 1100.0]])
TRUTH = np.array([300.0, 400.0])
# Errors of the rows, metres: known residuals, and a fix off the truth.
ERRORS = np.array([2.0, -1.0, 1.0, -2.0])


@cache
def ranged():
    """Return a problem of four ranges in the plane, and its fix."""
    z = np.linalg.norm(TRUTH - PLACES, axis=-1) + ERRORS
    problem = assemble(PLACES, measured("range", z, a=np.arange(4), sigma=2.0), frame=ENU)
    return problem, solve(problem)


@cache
def unbounded():
    """Return a fix of three bearings of a target 1000 km away at 30 degrees, of which the direction is known only."""
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    target = 1e6 * np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    z = np.arctan2(*(target - stations).T[::-1])
    return solve(assemble(stations, measured("azimuth", z, a=[0, 1, 2], sigma=1e-3), frame=ENU))
