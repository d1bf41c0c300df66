"""Starts along faces: on the face, near its minima, and the same for faces in one batch."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import constraints
from optloc.linear.constraints import faces, levels
from optloc.solvers.face_starts import limited_to, spread_along, structure


def with_bounds(*bounds):
    return replace(ranges_to(PLACE, 2.0), constraints=tuple(bounds))


def cost(x):
    away = np.linalg.norm(x[:, None] - SQUARE, axis=-1)
    return (((away - np.linalg.norm(PLACE - SQUARE, axis=1)) / 2.0) ** 2).sum(-1)


@pytest.mark.parametrize(
    "bounds",
    [
        constraints.half_plane([1.0, 0.0], -400.0),
        constraints.disc([-900.0, 200.0], 100.0),
        constraints.box([-500.0, -500.0], [-300.0, -200.0]),
    ],
    ids=["half-plane", "disc", "box"],
)
def test_starts_are_on_their_faces(bounds):
    problem = with_bounds(*bounds)
    sides = faces(problem)
    found = spread_along(problem, sides, PLACE[None, None], np.array([100.0]))
    assert len(found) == len(sides) - 1
    for side, starts in zip(sides[1:], found, strict=True):
        own = starts[0][np.isfinite(starts[0]).all(-1)]
        assert len(own) or len(side) > 1
        if len(own):
            assert np.abs(levels(problem.take(np.zeros(len(own), dtype=int)), side, own)[0]).max() < 1e-3


def test_a_start_is_near_each_minimum_along_a_line():
    problem = with_bounds(*constraints.half_plane([1.0, 0.0], -400.0))
    (found,) = spread_along(problem, faces(problem), PLACE[None, None], np.array([np.inf]))
    line = np.stack([np.full(6001, -400.0), np.linspace(-3e3, 3e3, 6001)], axis=-1)
    values = cost(line)
    lowest = np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])) + 1
    own = found[0][np.isfinite(found[0]).all(-1)]
    for k in lowest:
        assert np.abs(own[:, 1] - line[k, 1]).min() < 400.0


def test_faces_of_the_same_quantities_are_one_batch():
    problem = with_bounds(*constraints.box([0.0, 0.0], [100.0, 200.0]))
    sides = faces(problem)
    same = [side for side in sides[1:] if len(side) == 1 and side[0].constraint == 0]
    assert len({structure(problem, side) for side in same}) == 1
    limited, face = limited_to(problem, same, np.zeros(3, dtype=int), [1, 2])
    assert np.ravel(limited.constraints[0].lower).tolist() == [0.0, 100.0, 100.0]
    assert face[0].side == "equal"
