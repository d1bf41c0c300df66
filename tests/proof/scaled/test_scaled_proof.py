"""Costs with an unknown speed of the wave, by formulas of their own, and the proof of the best fix."""

import numpy as np
import pytest
from proof.scaled.test_reduction import profiled
from waves import air, plate

from optloc.proof.scaled.scaled_proof import costs_at_scaled, scaled_costs

pytestmark = pytest.mark.usefixtures("plainly")


@pytest.mark.parametrize("prior", [0.1, None])
def test_a_place_costs_least_over_factor_and_emission(prior):
    rng = np.random.default_rng(1)
    for scene in (plate(rng, 2, 6, prior), air(rng, 3, 7, prior)):
        x = scene.truth + 0.1 * np.ptp(scene.place) * rng.normal(size=(4, scene.place.shape[1]))
        cost, blur = costs_at_scaled(scaled_costs(scene.problem.flat()), x[None])
        expected, factor = profiled(scene, x)
        np.testing.assert_allclose(cost[0][factor > 0.0], expected[factor > 0.0], rtol=1e-6)
        assert (blur >= 0.0).all()


def test_priors_on_the_factor_are_the_last_rows():
    scene = plate(np.random.default_rng(2), 2, 6, 0.1)
    costs = scaled_costs(scene.problem.flat())
    assert costs.lift[0, -1].tolist() == [pytest.approx(10.0)]
    assert costs.w[0, -1] == pytest.approx(10.0)
    assert not costs.K[0, -1].any()
    assert costs.dense == len(costs.kinds) == len(scene.place)
    assert (costs.group == 0).all()
    assert costs.take(np.array([0])).one(0).cost.w.shape == costs.w[0].shape
