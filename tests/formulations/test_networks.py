"""Fits of low rank and their upgrade: exact without noise, with entries missing, from either side."""

import numpy as np
import pytest
from often import few

from formulations.low_rank_network import LowRank, Pulses, StationFactors, fit_low_rank, orthonormal, random_stations
from formulations.metric_upgrade import unknowns, upgrade


def network(seed, m, n, d=3):
    rng = np.random.default_rng(seed)
    # wider than high, as halls are: in a cube few starts end at the best fit
    box = np.array([1.0, 1.0, 0.3])[3 - d :]
    stations, pulses = rng.random((m, d)) * box, rng.random((n, d)) * box
    o = rng.normal(0.0, 0.2, n)
    return stations, pulses, o, np.linalg.norm(pulses[:, None] - stations, axis=-1) + o[:, None]


def test_squared_arrivals_have_the_rank_of_space():
    *_, o, z = network(0, 10, 15)
    table = z**2 - 2.0 * z * o[:, None]
    centred = table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()
    s = np.linalg.svd(centred)[1]
    assert s[3] < 1e-13 * s[0] < s[2]


@pytest.mark.parametrize(("m", "n", "d"), few([(7, 12, 2), (12, 20, 3), (8, 30, 3)], 2, 3))
def test_a_fit_without_noise_is_upgraded_to_the_network(m, n, d):
    stations, _, _, z = network(1, m, n, d)
    given = np.random.default_rng(4).random(z.shape) < (0.9 if m > 8 else 1.1)
    fit = fit_low_rank(
        z - np.median(z, axis=1)[:, None],
        given.astype(float),
        np.ones(n, dtype=bool),
        random_stations(np.random.default_rng(2), 60, m, d),
    )
    best = fit.take(np.array([fit.cost.argmin()]))
    assert best.cost[0] < 1e-20
    i, k = np.tril_indices(m, -1)
    truth = np.linalg.norm(stations[i] - stations[k], axis=1)
    found = [np.abs(np.linalg.norm(a[i] - a[k], axis=1) - truth).max() for a in upgrade(best)[0]]
    assert min(found) < 1e-6


def test_both_sides_upgrade_to_the_same_network():
    stations, pulses, o, _ = network(3, 12, 12)
    rng = np.random.default_rng(5)
    turn, move = rng.standard_normal((3, 3)), rng.standard_normal(3)
    # any affine image: u = turn (a - move) with what alpha, beta and v must then be
    u = (stations - move) @ turn
    v = -2.0 * np.linalg.solve(turn, (pulses - move).T).T
    alpha = ((stations - move) ** 2).sum(axis=1)
    beta = ((pulses - move) ** 2).sum(axis=1) - o**2
    fit = LowRank(
        StationFactors(alpha[None], u[None], np.zeros((1, 12))), Pulses(beta[None], v[None], o[None]), np.zeros(1)
    )
    found, places, _ = upgrade(fit)
    i, k = np.tril_indices(12, -1)
    truth = np.linalg.norm(stations[i] - stations[k], axis=1)
    exact = [a for a in found if np.abs(np.linalg.norm(a[i] - a[k], axis=1) - truth).max() < 1e-9]
    assert len(exact) >= 2  # one from each side at least
    apart = np.linalg.norm(places[0][:, None] - found[0], axis=-1)
    assert apart == pytest.approx(np.linalg.norm(pulses[:, None] - stations, axis=-1), abs=1e-9)


def test_a_column_that_says_nothing_has_no_vector():
    a = np.random.default_rng(6).standard_normal((4, 7, 3))
    a[1, :, 2] = a[1, :, 0] - 2.0 * a[1, :, 1]
    q, r = orthonormal(a)
    assert q[1, :, 2] == pytest.approx(0.0)
    assert np.isinf(r[1, 2, 2])
    assert q[[0, 2, 3]] @ r[[0, 2, 3]] == pytest.approx(a[[0, 2, 3]])
    assert (unknowns(2), unknowns(3)) == (6, 10)
