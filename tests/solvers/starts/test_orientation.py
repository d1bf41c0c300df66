"""Azimuths from an unknown direction: marks, located targets or a grid of turns give the start, whatever the turn."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE
from often import few
from scipy.optimize import least_squares

import optloc
from optloc import Status, assemble, measured
from optloc.base.types import Motion
from optloc.problem.bias import with_bias
from optloc.solvers.starts.orientation import Headings, headings, unwind

# Rounds of a theodolite at three control points: directions from the first mark of each, degrees clockwise.
CONTROL = np.array([[865.40, 4527.15], [2432.55, 2047.25], [2865.22, 27.15]])
ROUNDS = [(0, 2, 0.0), (0, 0, -50.113889), (1, 1, 0.0), (1, 0, 101.513056), (1, 3, 200.201111), (2, 2, 0.0)]
ROUNDS += [(2, 0, 59.283611)]
SIGMA = np.radians(0.0014)


def wrap(angle):
    return np.arctan2(np.sin(angle), np.cos(angle))


def network(stations, marks, rows, noise, **prior):
    """Return a problem of azimuths: target 0 is unknown, target k is mark k - 1."""
    a, target, z = rows
    motions = (Motion(), *(Motion(known=mark[None, None]) for mark in marks))
    bare = assemble(stations, measured("azimuth", z, a=a, target=target, sigma=noise), motions=motions)
    return with_bias(bare, "orientation", kind="azimuth", **prior)


@pytest.mark.parametrize("turn", [0.0, 5.0, 80.0, 100.0, 140.0, 179.9, 180.0, 250.0])
def test_rounds_of_a_theodolite_find_their_point_at_any_turn_of_the_circle(turn):
    a, target, degrees = (np.array(part) for part in zip(*ROUNDS, strict=True))
    z = wrap(-np.radians(degrees + turn))
    fix = optloc.solve(network(CONTROL, CONTROL, (a, target, z), SIGMA))
    assert np.allclose(fix.x[:2], [6860.7154, 3727.5056], atol=1e-3)
    assert fix.status == Status.UNPROVEN
    assert fix.dof == 2
    assert np.isclose(fix.cost, 2.5206, atol=1e-3)


def test_marks_overrule_a_prior_that_is_wrong_by_a_quarter_turn():
    a, target, degrees = (np.array(part) for part in zip(*ROUNDS, strict=True))
    fix = optloc.solve(network(CONTROL, CONTROL, (a, target, wrap(-np.radians(degrees))), SIGMA, sigma=0.09))
    assert fix.status == Status.MISFIT
    assert np.allclose(fix.x[:2], [6860.7, 3727.5], atol=1.0)


def drawn(rng):
    """Return stations, marks, rows and noise of a random network in which each station sees a mark."""
    n, m, sigma = rng.integers(3, 7), rng.integers(2, 7), 10.0 ** rng.uniform(-4.0, -2.0)
    stations, marks = rng.uniform(0.0, 1e4, (n, 2)), rng.uniform(0.0, 1e4, (m, 2))
    rows = [(s, k) for s in range(n) for k in [0, *(1 + rng.permutation(m)[: rng.integers(1, m + 1)])]]
    a, target = np.array(rows).T
    place = np.concatenate([rng.uniform(-1e3, 11e3, (1, 2)), marks])
    away = place[target] - stations[a]
    turn = rng.uniform(-np.pi, np.pi, n)
    z = wrap(np.arctan2(away[:, 1], away[:, 0]) + turn[a] + sigma * rng.standard_normal(len(a)))
    return stations, marks, (a, target, z), sigma


def least(stations, marks, rows, sigma):
    """Return the least cost and its place from a grid of starts, with formulas of this test."""
    a, target, z = rows

    def error(place):
        away = np.concatenate([place[None], marks])[target] - stations[a]
        return z - np.arctan2(away[:, 1], away[:, 0])

    def residual(x):
        return wrap(error(x[:2]) - x[2:][a]) / sigma

    starts = []
    for place in np.stack(np.meshgrid(*2 * [np.linspace(-3e3, 13e3, 9)]), axis=-1).reshape(-1, 2):
        e = error(place)
        starts.append(np.r_[place, [np.angle(np.exp(1j * e[a == s]).sum()) for s in range(len(stations))]])
    starts.sort(key=lambda x: (residual(x) ** 2).sum())
    scale = np.r_[1e3, 1e3, np.ones(len(stations))]
    found = [least_squares(residual, x, x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-12) for x in starts[:12]]
    best = min(found, key=lambda one: one.cost)
    return 2.0 * best.cost, best.x[:2]


@pytest.mark.parametrize("seed", few(range(500), 12))
def test_random_networks_with_marks_have_the_best_place_of_a_multi_start(seed):
    case = drawn(np.random.default_rng((7, seed)))
    fix, (cost, place) = optloc.solve(network(*case)), least(*case)
    assert fix.cost <= cost * (1.0 + 1e-6) + 1e-6
    assert np.allclose(fix.x[:2], place, rtol=1e-4, atol=1.0)


def test_a_station_without_marks_is_oriented_by_located_targets():
    rng = np.random.default_rng(3)
    stations, place = rng.uniform(0.0, 1e4, (4, 2)), rng.uniform(0.0, 1e4, (5, 2))
    a, target = (part.ravel() for part in np.mgrid[:4, :5])
    away, turn = place[target] - stations[a], np.array([0.0, 0.0, 2.9, -1.9])
    z = wrap(np.arctan2(away[:, 1], away[:, 0]) + turn[a] + 1e-4 * rng.standard_normal(20))
    bare = assemble(stations, measured("azimuth", z, a=a, target=target, sigma=1e-4), motions=(Motion(),) * 5)
    fix = optloc.solve(with_bias(bare, "turn", kind="azimuth", members=bare.stations.names[2:]))
    assert np.abs(fix.x[:10].reshape(5, 2) - place).max() < 20.0
    assert np.allclose(fix.bias["turn"], turn[2:], atol=1e-3)


@pytest.mark.parametrize("turn", [-2.8, -1.3, 0.4, 2.0, 3.1])
def test_one_offset_of_all_stations_is_found_from_a_grid_of_turns(turn):
    rng = np.random.default_rng(5)
    stations, place = rng.uniform(0.0, 1e4, (5, 2)), np.array([4e3, 7e3])
    away = place - stations
    z = wrap(np.arctan2(away[:, 1], away[:, 0]) + turn + 1e-4 * rng.standard_normal(5))
    bare = assemble(stations, measured("azimuth", z, a=np.arange(5), sigma=1e-4))
    fix = optloc.solve(with_bias(bare, "turn", kind="azimuth", per="kind"))
    assert np.linalg.norm(fix.position - place) < 20.0
    assert abs(fix.bias["turn"][0] - turn) < 1e-3


def test_offsets_without_a_narrow_prior_are_headings():
    bare = assemble(SQUARE, measured("azimuth", np.zeros(5), a=np.arange(5), sigma=0.01))
    turned = with_bias(bare, "north", form="offset", per="station")
    found = headings(turned.flat())
    assert found.names == ("north",)
    assert found.free.all()
    np.testing.assert_array_equal(found.touch, np.eye(5))
    assert headings(bare.flat()) is None
    assert headings(with_bias(bare, "north", form="offset", per="station", sigma=0.01).flat()) is None


def test_whole_turns_are_taken_off_offsets_without_a_prior():
    free = np.array([True, False])
    found = Headings(("north",), np.array([2, 3]), np.zeros((2, 1)), np.zeros(2), ~free, free)
    x = np.array([[[*PLACE, 7.0, 7.0], [*PLACE, 3.6, 7.0]]])
    out = unwind(found, x)[0]
    assert out[0, 2] == pytest.approx(7.0 - 2.0 * np.pi)
    assert abs(out[1, 2] - out[0, 2]) <= np.pi
    np.testing.assert_array_equal(out[:, 3], 7.0)
