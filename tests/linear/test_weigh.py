"""Station errors of each epoch: weighed through the noise or eliminated, it is the same information."""

from dataclasses import replace

import numpy as np
import pytest
from runs import drawn, estimated, run, truth

import optloc
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.normal import linearise, marginal, with_station_noise
from optloc.problem.noise import dense


def oblong(problem):
    """Return the run with errors that differ from station to station and along the axes."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(problem.stations.count, 3, 3))
    return replace(problem, stations=replace(problem.stations, covariance=4.0 * root @ np.swapaxes(root, -1, -2)))


CASES = {
    "isotropic": run(6),
    "oblong": oblong(run(6)),
    "gains": run(6, gain=3e-4),
    "oblong gains, moving": oblong(run(6, gain=3e-4, order=1)),
}


@pytest.mark.parametrize("name", CASES)
def test_weighed_and_eliminated_information_is_equal(name):
    problem = drawn(CASES[name], 1, 2)
    x = truth(problem) + np.zeros((2, 1))
    whole = equations_at(problem, x)
    named = estimated(problem)
    inner = np.concatenate([x, np.zeros((2, named.layout.size - x.shape[1]))], axis=1)
    information, vector, ok = marginal(equations_at(named, inner))
    assert ok.all()
    scale = np.sqrt(np.diagonal(whole.shared, axis1=-2, axis2=-1))
    both = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(information / both, whole.shared / both, atol=1e-10)
    np.testing.assert_allclose(vector / scale, whole.shared_vector / scale, rtol=1e-9, atol=1e-8)


def test_estimates_agree_within_a_hundredth_of_sigma():
    problem = drawn(run(60, station=5.0, prior=200.0), 2, 5)
    x = np.broadcast_to(truth(problem), (5, problem.layout.size))
    weighed_ = refine(problem, x)
    named = estimated(problem)
    start = np.concatenate([x, np.zeros((5, named.layout.size - x.shape[1]))], axis=1)
    eliminated = refine(named, start)
    sigma = np.sqrt(np.diagonal(optloc.crlb(problem, truth(problem)), axis1=-2, axis2=-1))
    assert (np.abs(weighed_.x - eliminated.x[:, : x.shape[1]]) < 0.01 * sigma).all()


def test_the_bound_is_that_of_the_full_fisher_matrix():
    """All station positions of all epochs are kept as unknowns of one dense matrix, written from the definitions."""
    problem = oblong(run(12, gain=0.03))
    named, x = estimated(problem), truth(problem)
    inner = np.concatenate([x, np.zeros(named.layout.size - len(x))])
    linear = linearise(named, inner)
    n, each = named.layout.n_shared, named.layout.n_local
    full = np.zeros((named.count, named.layout.size))
    full[:, :n] = linear.shared
    for row, epoch in enumerate(named.epoch):
        full[row, n + epoch * each : n + (epoch + 1) * each] = linear.local[row]
    noise = dense(named.noise, np.arange(named.count))
    fisher = full.T @ np.linalg.solve(noise, full)
    for epoch in range(named.epochs):
        for s, covariance in enumerate(named.stations.covariance):
            at = n + epoch * each + 3 * s
            fisher[at : at + 3, at : at + 3] += np.linalg.inv(covariance)
    scale = 1.0 / np.sqrt(np.diag(fisher))
    bound = (np.linalg.inv(fisher * scale * scale[:, None]) * scale * scale[:, None])[:n, :n]
    ours = optloc.crlb(problem, x)
    size = np.sqrt(np.diag(bound))
    np.testing.assert_allclose(ours / size / size[:, None], bound / size / size[:, None], atol=1e-8)
    assert len(fisher) == 191


def test_isotropic_errors_are_arrival_errors():
    problem = run(3, sigma=3.0, station=4.0)
    covariance = dense(with_station_noise(problem).noise, np.arange(4))
    np.testing.assert_allclose(covariance, 25.0 * (np.eye(4) + 1.0), rtol=1e-12)
    assert with_station_noise(problem).stations.covariance is None


def test_stations_say_whether_errors_are_noise_or_unknowns():
    place, equal = np.zeros((1, 2, 3)), np.broadcast_to(np.eye(3) * 4.0, (2, 3, 3))
    for span, unknown in (("epoch", "epoch"), ("run", "run"), ("noise", None)):
        exact = optloc.Stations(place, ("A", "B"), span=span)
        assert (exact.unknown_for, exact.weighed, exact.isotropic) == (None, False, True)
        assert exact.with_noise() is exact
        for name in ("covariance", "velocity_covariance"):
            stations = replace(exact, **{name: equal})
            assert (stations.unknown_for, stations.weighed, stations.isotropic) == (unknown, span == "noise", True)
            assert stations.with_noise().span == ("run" if span == "run" else "noise")
    assert replace(exact, covariance=equal * (1.0 + 1e-12 * np.eye(3)[0])).isotropic
    assert not replace(exact, covariance=equal * (1.0 + 1e-6 * np.eye(3)[0])).isotropic


def test_errors_of_a_run_of_one_epoch_have_the_covariance_of_their_information():
    rng = np.random.default_rng(3)
    place, variance = rng.uniform(-1e3, 1e3, (6, 2)), np.linspace(4.0, 9.0, 6)
    z = np.linalg.norm(place - [300.0, -200.0], axis=1) + 3.0 * rng.standard_normal(6)
    stations = optloc.Stations(place[None], tuple("ABCDEF"), covariance=np.eye(2) * variance[:, None, None], span="run")
    fix = optloc.solve(optloc.assemble(stations, optloc.measured("range", z, a=np.arange(6), sigma=3.0)))
    assert fix.status == optloc.Status.OK
    line = fix.x[:2] - place - fix.x[2:].reshape(6, 2)
    unit = line / np.linalg.norm(line, axis=1)[:, None]
    J = np.hstack([unit, -(np.eye(6)[:, :, None] * unit[:, None]).reshape(6, 12)])
    information = J.T @ J / 9.0 + np.diag([0.0, 0.0, *np.repeat(1.0 / variance, 2)])
    np.testing.assert_allclose(fix.cov, np.linalg.inv(information), rtol=1e-6, atol=1e-9)


def test_what_has_no_such_errors_stays():
    problem = run(3, station=0)
    assert with_station_noise(problem) is problem


def test_simulated_station_errors_have_the_weighed_covariance():
    problem = oblong(run(1, gain=3e-4, biased=False))
    x = truth(problem)
    drawn_ = optloc.simulate(problem, x, 5, trials=20_000)
    sample = np.cov(drawn_.z.T)
    expected = dense(with_station_noise(problem, x).noise, np.arange(problem.count))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(sample / scale / scale[:, None], expected / scale / scale[:, None], atol=0.04)
