"""The printed recursion of the paper `registration`: its steps solve the normal equations, its weights are eq. 40."""

import numpy as np
import pytest

from optloc.engine import linearise
from optloc.lab.papers.registration import MOVING, PRINTED, SPATIAL, RegistrationSetting
from optloc.lab.papers.registration_recursion import joint_step, joint_weights, step
from optloc.linear.normal import normal, step as house_step


@pytest.mark.parametrize("scenario", [PRINTED, MOVING, SPATIAL])
def test_a_step_of_the_recursion_solves_the_normal_equations(scenario):
    setting, k = RegistrationSetting(scenario, 4, 1, 1), 400
    drawn, start = setting.draw(k), setting.starts(1.0)
    arrivals = np.concatenate([np.zeros((4, k, 1)), drawn.z.reshape(4, k, 4)], axis=-1).swapaxes(1, 2)
    move, bias = step(start, arrivals, scenario.track(k).T, scenario.times(k))
    x = np.concatenate([start, np.zeros((4, 4))], axis=1)
    wanted, ok = house_step(normal(linearise(drawn, x), k), np.zeros(4))
    assert ok.all()
    for found, exact in ((move, wanted[:, :-4]), (bias, wanted[:, -4:])):
        assert np.abs(found - exact).max() < 1e-9 * np.abs(exact).max()


@pytest.mark.parametrize("sizes", [(3.0, 0.03, 1.0), (3.0, 3e-5, 5.0)])
def test_a_step_of_the_joint_recursion_solves_the_normal_equations(sizes):
    """With ratios a thousand times better than printed too, where station errors tie both kinds."""
    arrival, gain, size = sizes
    setting, k = RegistrationSetting(SPATIAL, 4, 1, 1, arrival, size, gain), 300
    drawn, start = setting.draw(k), setting.starts(1.0)
    measured = np.concatenate([rows.z.reshape(4, k, 4) for rows in drawn.rows], axis=-1)
    weight = joint_weights(start, SPATIAL.track(k), sizes)
    move, bias = joint_step(start, measured, SPATIAL.track(k), weight, weight.sum(1))
    x = np.concatenate([start, np.zeros((4, 8))], axis=1)
    wanted, ok = house_step(normal(linearise(drawn, x), k), np.zeros(4))
    assert ok.all()
    for found, exact in ((move, wanted[:, :3]), (bias, wanted[:, 3:])):
        assert np.abs(found - exact).max() < 1e-8 * np.abs(exact).max()


def test_the_weight_of_one_difference_and_one_ratio_is_the_inverse_of_eq_40():
    state, track, (arrival, gain, size) = np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 2, 3)), (2.0, 0.1, 0.5)
    track[0, 1] = [3.0, 4.0, -10.0]  # ranges of 5 m and 10 m: a ratio of 2
    both = size**2 * (2.0 + 1.0) / 5.0
    own = size**2 * (2.0**2 + 1.0) / 5.0**2 + 2.0 * gain**2
    wanted = np.linalg.inv([[2.0 * (arrival**2 + size**2), both], [both, own]])
    np.testing.assert_allclose(joint_weights(state, track, (arrival, gain, size))[0, 0], wanted, rtol=1e-12)
