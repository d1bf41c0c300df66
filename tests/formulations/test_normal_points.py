"""Normal points: parabolas through blocks of rows, and their errors."""

import numpy as np

from formulations.normal_points import blocks, normal_points


def test_blocks_and_their_normal_points():
    rng = np.random.default_rng(9)
    time = rng.permutation(50.0 + np.arange(23.0))
    cut = blocks(time, 6)
    assert sorted(np.concatenate(cut)) == list(range(23))
    assert max(map(len, cut)) <= 6
    sigma = rng.uniform(0.5, 2.0, 23)
    row, z, error = normal_points(time, 3.0 - 0.7 * time + 0.02 * time**2, sigma, cut)
    np.testing.assert_allclose(z, 3.0 - 0.7 * time[row] + 0.02 * time[row] ** 2, rtol=1e-10)
    assert (error < sigma[row]).all()
    # what is said of the errors is what many draws show
    draws = [normal_points(time, sigma * rng.normal(size=23), sigma, cut)[1] for _ in range(1000)]
    np.testing.assert_allclose(np.std(draws, axis=0), error, rtol=0.1)
    # alone, in pairs, and all at one time there is no parabola
    row, z, error = normal_points([1.0, 2, 2, 5, 5, 5, 5], np.arange(7.0), np.ones(7), [[0], [1, 2], [3, 4, 5, 6]])
    np.testing.assert_allclose(z, [0.0, 1.5, 4.5])
    np.testing.assert_allclose(error, [1.0, 0.5**0.5, 0.5])
