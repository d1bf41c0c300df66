"""The likelihood of a network: derivatives, minima, residuals by hand, and estimates side by side."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
from sites.calibration.scenes import hall

from optloc.kernels.jit import plain
from optloc.sites.calibration import network_of
from optloc.sites.calibration.likelihood import likelihood, rows_of, together


def nearby(truth):
    rng = np.random.default_rng(1)
    return type(truth)(*(v + 0.3 * rng.standard_normal(v.shape) for v in (getattr(truth, n) for n in truth.__slots__)))


def test_derivatives_are_those_of_automatic_differentiation():
    truth, z = hall(5, 5, 6, 0.1, clocks=True)
    near = nearby(truth)
    net = network_of(z, 0.1, synchronised=False, distances=[(0, 2, 7.0, 0.2)], place=truth.stations[0], place_sigma=0.5)
    lik = likelihood(net)
    a, b, y, o = (casadi.SX.sym(n, *s) for n, s in (("a", (5, 3)), ("b", (5, 1)), ("y", (6, 3)), ("o", (6, 1))))
    rows = [(z[j, i] - casadi.norm_2(a[i, :] - y[j, :]) - o[j] - b[i]) / 0.1 for j in range(6) for i in range(5)]
    rows.append((7.0 - casadi.norm_2(a[0, :] - a[2, :])) / 0.2)
    rows.append(casadi.vec(net.place - a) / 0.5)
    cost = casadi.sumsqr(casadi.vertcat(*rows))
    unknowns = casadi.vertcat(casadi.vec(a.T), b, casadi.vec(y.T), o)
    both = casadi.Function("f", [a, b, y, o], [cost, casadi.gradient(cost, unknowns)])
    value, gradient = both(near.stations[0], near.clocks[0], near.pulses[0], near.emission[0])
    assert lik.cost(near)[0] == pytest.approx(float(value))
    by_station, by_pulse, known = lik.jacobian(near)
    residual, line = lik.residual(near)[0], near.stations[0, 0] - near.stations[0, 2]
    extra = [(7.0 - np.linalg.norm(line)) / 0.2, *((net.place - near.stations[0]) / 0.5).ravel()]
    stations = -2.0 * (np.einsum("nrp,nr->p", by_station, residual) + known.T @ extra)
    pulses = -2.0 * np.einsum("nrq,nr->nq", by_pulse, residual)
    ours = np.concatenate([stations, pulses[:, :3].ravel(), pulses[:, 3]])
    assert ours == pytest.approx(np.asarray(gradient).ravel(), rel=1e-9, abs=1e-7)


def test_machine_code_finds_the_minima_of_numpy():
    truth, z = hall(5, 7, 12, 0.1, clocks=True)
    z[2, 3] = np.nan
    distances = [(0, 2, float(np.linalg.norm(truth.stations[0, 0] - truth.stations[0, 2])), 0.2)]
    lik = likelihood(
        network_of(z, 0.1, synchronised=False, distances=distances, place=truth.stations[0], place_sigma=0.5)
    )
    with plain():
        one, first = lik.refine(truth)
    two, second = lik.refine(truth)
    assert first == pytest.approx(second, abs=1e-5)
    assert one.stations == pytest.approx(two.stations, abs=1e-3)


def test_residuals_are_arrivals_less_range_emission_and_clock_over_the_noise():
    truth, z = hall(1, 4, 3, 0.0, clocks=True)
    z[1, 2] = np.nan
    lik = likelihood(network_of(z + 0.5, 0.25, synchronised=False))
    residual = lik.residual(truth)[0]
    assert residual[1, 2] == 0.0
    residual[1, 2] = 2.0
    assert residual == pytest.approx(2.0)
    assert lik.cost(truth) == pytest.approx([11 * 4.0])


def test_rows_of_each_kind_stand_together_and_absent_ones_are_left_out():
    _, z = hall(1, 4, 3, 0.0)
    z[0, 1] = z[2, 3] = np.nan
    pulse, slot = rows_of(network_of(z, 0.1))
    order = np.lexsort((slot, pulse))
    np.testing.assert_array_equal(np.stack([pulse, slot], axis=1)[order], np.argwhere(np.isfinite(z)))


def test_known_coordinates_count_and_exact_ones_do_not_move():
    truth, z = hall(2, 5, 8, 0.0)
    sigma = np.full((5, 3), np.inf)
    sigma[0], sigma[1] = 0.0, 2.0
    lik = likelihood(network_of(z, 0.1, place=truth.stations[0], place_sigma=sigma))
    assert (~lik.free[:3]).all()
    assert lik.free[3:].all()
    moved = replace(truth, stations=truth.stations + np.array([0.0, 1.0, 0.0, 0.0, 0.0])[None, :, None])
    alone = lik.cost(moved)[0] - (lik.residual(moved) ** 2).sum()
    assert alone == pytest.approx(3 * 0.5**2)  # one metre of two, in each coordinate
    assert lik.refine(nearby(truth))[0].stations[0, 0] == pytest.approx(truth.stations[0, 0], abs=1e-12)


def test_estimates_side_by_side_are_taken_and_mixed():
    one, two = hall(1, 4, 3, 0.0)[0], hall(2, 4, 3, 0.0)[0]
    both = together(one, two)
    assert both.count == 2
    np.testing.assert_array_equal(both.take(np.array([1])).pulses, two.pulses)
    mixed = both.where(np.array([True, False]), together(two, one))
    np.testing.assert_array_equal(mixed.stations, together(one, one).stations)
