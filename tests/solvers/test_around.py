"""Starts all around curved bounds."""

from dataclasses import replace

import numpy as np
import pytest
from linear.constraints.shared import flat, ranges_to

from optloc import Motion, constraints
from optloc.linear.constraints import Level, exact, levels
from optloc.solvers.around import starts_around, starts_on_equalities

TARGET = np.array([400.0, 300.0])


@pytest.mark.parametrize(
    ("limits", "side"),
    [
        (constraints.disc(TARGET, 50.0), "upper"),
        (constraints.polyline(TARGET + np.array([[0.0, 0.0], [90.0, 0.0], [90.0, 90.0]]), 9.0), (1, 0, "upper")),
        (constraints.keep_out_polygon(TARGET + np.array([[0.0, 0.0], [90.0, 0.0], [90.0, 90.0]])), 1),
    ],
)
def test_starts_are_on_the_bound(limits, side):
    problem, level = flat(ranges_to(TARGET), *limits), Level(0, side)
    found = starts_around(problem, (level,), np.array([0]), TARGET[None])[0]
    many = problem.take(np.zeros(len(found), dtype=int))
    assert len(found) >= 3
    assert levels(many, (level,), found)[0] == pytest.approx(0.0, abs=1e-9)


def test_a_plane_needs_no_more_starts():
    problem = flat(ranges_to(TARGET), *constraints.half_plane([1.0, 0.0], 5.0))
    assert starts_around(problem, (Level(0, "upper"),), np.array([0]), TARGET[None]).shape == (1, 0, 2)
    assert starts_on_equalities(problem, TARGET[None, None]).shape == (1, 0, 2)


def test_starts_on_the_ground_are_the_lows_of_the_cost():
    x = np.linspace(0.0, 1000.0, 21)
    ground = constraints.terrain(x, x, 50.0 * np.sin(x[:, None] / 90.0) * np.cos(x / 70.0), exactly=2.0)
    problem = flat(ranges_to([400.0, 300.0, 90.0]), *ground)
    found = starts_on_equalities(problem, np.array([[[400.0, 300.0, 90.0]]]))[0]
    many = problem.take(np.zeros(len(found), dtype=int))
    assert 0 < len(found) <= 12
    good = np.isfinite(found).all(-1)
    assert levels(many.take(np.flatnonzero(good)), exact(problem), found[good])[0] == pytest.approx(0.0, abs=1e-6)
    assert np.hypot(*(found[good][0, :2] - [400.0, 300.0])) < 100.0


def test_two_targets_are_put_around_their_middle():
    problem = flat(replace(ranges_to(TARGET), motions=(Motion(), Motion())), *constraints.separation(0, 1, 8.0, 8.0))
    found = starts_on_equalities(problem, np.array([[[0.0, 0.0, 4.0, 2.0]]]))[0]
    assert 0.5 * (found[:, :2] + found[:, 2:]) == pytest.approx(np.tile([2.0, 1.0], (len(found), 1)))
    assert np.hypot(*(found[:, 2:] - found[:, :2]).T) == pytest.approx(8.0)
