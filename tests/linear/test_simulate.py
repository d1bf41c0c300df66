"""Simulated measurements."""

import numpy as np
from cases import CASES, plain_predict, wrapped

from optloc import Stations, assemble, measured
from optloc.linear.simulate import draw, samples, simulate

COVARIANCE = np.array([[4.0, 1.5, 0.0], [1.5, 9.0, -2.0], [0.0, -2.0, 1.0]])


def test_samples_have_the_covariance_that_they_are_drawn_from():
    found = samples(COVARIANCE, (20_000,), np.random.default_rng(2))
    np.testing.assert_allclose(np.cov(found.T), COVARIANCE, atol=0.25)
    assert abs(found.mean(0)).max() < 0.08


def test_noise_is_drawn_for_every_row_of_every_block():
    problem = CASES["tdoa~groa-2d"].problem
    found = draw(problem.noise, problem.count, (4, 7), np.random.default_rng(3))
    assert found.shape == (4, 7, problem.count)
    assert (found != 0.0).all()


def test_a_seed_decides_and_trials_are_the_first_axis():
    case = CASES["tdoa+azimuth-2d"]
    truth = np.stack([case.truth, case.truth + 100.0])
    problem = case.problem.with_rows(z=np.zeros(case.problem.count))
    one, two, other = (simulate(problem, truth, seed, 3).z for seed in (4, 4, 5))
    assert one.shape == (3, 2, case.problem.count)
    assert (one == two).all()
    assert (one != other).all()


def test_measurements_of_little_noise_are_those_of_the_model_and_their_corrections():
    case = CASES["azimuth-2d"]
    count = case.problem.count
    rows = measured("azimuth", a=np.arange(count), sigma=1e-12, correction=0.25)
    found = simulate(assemble(case.problem.stations, rows), case.truth, 1)
    residual = found.z - plain_predict(case.problem, case.truth) - 0.25
    np.testing.assert_allclose(wrapped(case.problem, residual), 0.0, atol=1e-10)


def test_errors_of_stations_that_are_noise_spread_the_ranges_along_the_line_of_sight():
    error = np.diag([9.0, 1e-6])
    stations = Stations(np.zeros((1, 1, 2)), ("A",), covariance=error[None], span="noise")
    rows = measured("range", a=[0, 0], epoch=[0, 1], sigma=1e-3)
    found = simulate(assemble(stations, rows), np.array([100.0, 0.0]), 6, 4000).z
    np.testing.assert_allclose(found.std(0), 3.0, rtol=0.05)
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.05  # drawn anew at each epoch
