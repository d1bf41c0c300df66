"""Boxes that hold all cheap positions where a factor of the rows is unknown: never too small, by sampling."""

import numpy as np
import pytest

from optloc import assemble, measured, with_bias
from optloc.proof.scaled.enclosures import first_enclosed, stays_finite
from optloc.proof.scaled.scaled_proof import costs_at_scaled, scaled_costs
from optloc.proof.search_space import chart_at, empty_box

pytestmark = pytest.mark.usefixtures("plainly")

STATIONS = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 80.0], [0.0, 80.0]])
PLACE = np.array([40.0, 30.0])


def scaled(kind):
    z = 1.02 * np.linalg.norm(PLACE - STATIONS, axis=1) + np.array([0.3, -0.2, 0.1, 0.4])
    problem = assemble(STATIONS, measured(kind, z, a=np.arange(4), sigma=0.5))
    return scaled_costs(with_bias(problem, "speed", form="scale", per="kind", sigma=0.05).flat())


def test_ranges_grow_without_end_and_arrivals_do_not():
    assert not stays_finite(scaled("range").one(0))
    assert stays_finite(scaled("toa").one(0))


def test_the_box_of_ranges_holds_every_cheap_position():
    costs = scaled("range")
    own = costs.one(0)
    chart, _ = chart_at(own.cost, PLACE, empty_box(*own.cost.K.shape))
    low, high = np.zeros(3), np.zeros(3)
    level = 30.0
    assert first_enclosed(own, chart, PLACE, np.array([level]), 0.0, low, high) == 0
    places = PLACE + np.random.default_rng(0).normal(0.0, 3.0, (400, 2))
    cheap = places[costs_at_scaled(costs, places[None])[0][0] < level]
    assert 20 < len(cheap) < 400
    s = (cheap - PLACE) @ chart.back[:2, :2].T
    assert (low[:2] <= s).all()
    assert (s <= high[:2]).all()
    assert np.isfinite([low, high]).all()


def test_levels_too_high_for_the_prior_are_passed_over():
    own = scaled("range").one(0)
    chart, _ = chart_at(own.cost, PLACE, empty_box(*own.cost.K.shape))
    # at a cost of 500 a factor of the prior 0.05 may be zero, and no ball is bounded
    assert first_enclosed(own, chart, PLACE, np.array([500.0, 30.0]), 0.0, np.zeros(3), np.zeros(3)) == 1
