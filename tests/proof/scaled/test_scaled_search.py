"""Descents and known minima of a cost with an unknown factor, against SciPy."""

import numpy as np
import pytest
from proof.scaled.test_reduction import Look, profiled
from waves import plate

from optloc.proof.scaled.scaled_search import cost_near, descend_scaled
from optloc.proof.search_space import chart_at

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.fixture(scope="module")
def scene():
    return plate(np.random.default_rng(5), 2, 6, 0.1)


@pytest.fixture(scope="module")
def best(scene):
    return scene.minima(np.random.default_rng(0), 8)[0]


def test_a_descent_ends_at_the_minimum_of_scipy(scene, best):
    look, (cost, y) = Look(scene), best
    near, beside = look.tables.near, best[1][:2] + np.array([0.01, -0.01])
    chart, _ = chart_at(look.scaled.cost, beside, near)
    near.at[:] = 0.0
    start = cost_near(look.scaled, chart, look.tables)
    assert start == pytest.approx(profiled(scene, beside[None])[0][0], rel=1e-6)
    assert descend_scaled(look.scaled, chart, look.tables) == pytest.approx(cost, rel=1e-5)
    np.testing.assert_allclose(near.centre[:2], y[:2], atol=1e-5)


def test_a_minimum_has_surroundings_and_a_slope_has_none(scene, best):
    look, (cost, y) = Look(scene), best
    assert look.set_minimum(y[:2], cost + 25.0)
    sides = look.atlas.minima.sides[0, :2].copy()
    assert (sides > 0.1).all()
    assert (look.atlas.minima.core[0, 1, :2] >= sides).all()
