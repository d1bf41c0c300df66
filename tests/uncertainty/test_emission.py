"""Emission times: their standard deviations cover, and agree with the full covariance."""

import numpy as np

import optloc
from optloc.linear.evaluate import differentiate
from optloc.problem.build import assemble, measured
from optloc.uncertainty.emission import emissions

PLACES = np.array([[0.0, 0.0], [500.0, 0.0], [0.0, 500.0], [500.0, 500.0], [250.0, 700.0]])


def shots(count, sigma=0.5):
    """Return a batch of problems of arrival times from one place, emitted at 1000 m."""
    z = np.linalg.norm(PLACES - [310.0, 260.0], axis=1) + 1000.0
    z = z + sigma * np.random.default_rng(5).standard_normal((count, 5))
    return assemble(PLACES, measured("toa", z, a=np.arange(5), sigma=sigma))


def test_the_standard_deviation_is_of_the_full_covariance():
    problem = shots(3).flat()
    fix = optloc.solve(problem)
    time, sigma = emissions(problem, fix)
    _, jacobian = differentiate(problem, fix.x)
    full = np.linalg.inv(np.swapaxes(jacobian, -1, -2) @ jacobian / 0.25)
    assert np.allclose(sigma[:, 0], np.sqrt(full[:, 2, 2]), rtol=1e-9)
    assert np.allclose(time[:, 0], fix.x[:, 2])


def test_the_intervals_cover():
    problem = shots(400).flat()
    time, sigma = emissions(problem, optloc.solve(problem))
    inside = np.abs(time - 1000.0) < 1.96 * sigma
    # 95 % of 400, plus or minus four standard deviations of a share
    assert 0.906 < inside.mean() < 0.994


def test_fixes_without_an_answer_or_an_emission_are_nan():
    ranges = assemble(PLACES, measured("range", np.full(5, 300.0), a=np.arange(5), sigma=1.0))
    time, sigma = emissions(ranges, optloc.solve(ranges))
    assert np.isnan(time).all()
    assert np.isnan(sigma).all()
    few = assemble(PLACES, measured("toa", np.array([1.0, 2.0]), a=[0, 1], sigma=1.0))
    assert np.isnan(emissions(few, optloc.solve(few))[0]).all()
