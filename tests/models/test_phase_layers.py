"""Layers with a speed of P and of S waves: rays of both, fixes of simulated earthquakes, and wrong tables."""

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem
from optloc.models import MODELS
from optloc.models.layers import Layers, first_arrival
from optloc.models.phase_layers import S_TOA, PhaseLayers
from optloc.problem.build import assemble, measured

CRUST = PhaseLayers((0.0, 4e3, 12e3), (5000.0, 6000.0, 6800.0), "constant", 3000.0, None, (2700.0, 3500.0, 3900.0))
NET = np.array([[0.0, 0, 0], [20e3, 2e3, 300], [1e3, 22e3, 800], [21e3, 19e3, 100], [9e3, -12e3, 500], [-14e3, 8e3, 9]])
FOCUS = np.array([8e3, 7e3, -5e3])


def times(layers):
    """Return the travel times from the focus to the network, seconds."""
    across = np.hypot(*(NET - FOCUS)[:, :2].T)
    return first_arrival(layers, across, np.full(len(NET), CRUST.surface - FOCUS[2]), CRUST.surface - NET[:, 2]).time


def quake(p, s, noise=0.0, seed=0):
    """Return a problem with P picks at stations `p`, S picks at stations `s`, and one origin time, 2 s."""
    rng, unit, rows = np.random.default_rng(seed), CRUST.unit_speed, []
    for kind, layers, stations in (("toa", CRUST, p), (S_TOA, CRUST.shear, s)):
        if len(stations):
            z = (times(layers)[stations] + 2.0 + noise * rng.standard_normal(len(stations))) * unit
            rows.append(measured(kind, z, a=stations, sigma=0.02 * unit))
    return assemble(NET, *rows, medium=CRUST)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("p", "s"),
    [
        pytest.param(range(6), range(4), marks=SLOW, id="both"),
        pytest.param(range(4), range(3, 6), marks=SLOW, id="S of other stations"),
        pytest.param([], range(6), id="S alone"),
        pytest.param(range(6), [], id="P alone"),
    ],
)
def test_exact_picks_give_the_focus(p, s):
    fix = optloc.solve(quake(list(p), list(s)))
    assert np.abs(fix.position - FOCUS).max() < 1.0
    assert float(fix.cost) < 1e-3


@pytest.mark.slow
def test_errors_are_of_the_size_of_their_deviations():
    score = []
    for seed in range(6):
        fix = optloc.solve(quake(list(range(6)), list(range(6)), 0.02, seed))
        score.append((fix.position - FOCUS) @ np.linalg.solve(fix.covariance(), fix.position - FOCUS))
    # the mean of six chi-square values with three degrees of freedom
    assert 0.8 < np.mean(score) < 7.0


def test_one_ratio_for_all_layers_is_a_bias():
    one = Layers(CRUST.depth, CRUST.speed, "constant", CRUST.surface)
    ratio = float(np.mean(np.array(CRUST.speed) / CRUST.s_speed))
    assert np.abs(times(CRUST.shear) - ratio * times(one)).max() > 0.05


def test_the_kind_of_s_waves_is_not_listed():
    assert S_TOA not in [*MODELS]
    assert MODELS["ray_" + S_TOA].straight == S_TOA


@pytest.mark.parametrize(
    ("slow", "told"),
    [((2700.0, 3500.0), "3 speeds of P and 2 of S"), ((2700.0, 6500.0, 3900.0), "not faster than S waves of 6500")],
)
def test_wrong_speeds_are_named(slow, told):
    with pytest.raises(InvalidProblem, match=told):
        PhaseLayers(CRUST.depth, CRUST.speed, "constant", 0.0, None, slow)
