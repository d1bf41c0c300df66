"""Starts by a search of boxes: the target of exact data is among them, on planes as well."""

from dataclasses import replace

import numpy as np
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, constraints, measured
from optloc.kernels.jit import plain
from optloc.solvers.starts.best_first import _on_planes, best_first_starts


def test_differences_are_started_at_the_target():
    r = np.linalg.norm(PLACE - SQUARE, axis=1)
    problem = assemble(SQUARE, measured("tdoa", r[1:] - r[0], a=np.arange(1, 5), b=0, sigma=5.0)).flat()
    with plain():
        found = best_first_starts(problem)
    np.testing.assert_allclose(found[0, 0], PLACE, atol=1e-2)


def test_places_are_moved_onto_a_plane_along_its_normal():
    held = tuple(constraints.box([300.0, -np.inf], [300.0, np.inf]))
    problem = replace(ranges_to(PLACE, 1.0), constraints=held)
    moved = _on_planes(problem, np.array([[0.0, 7.0], [500.0, -1.0]]))
    np.testing.assert_allclose(moved, [[300.0, 7.0], [300.0, -1.0]])
