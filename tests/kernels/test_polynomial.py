"""Real roots against those of companion matrices."""

import numpy as np
import pytest

from optloc.kernels.jit import plain
from optloc.kernels.polynomial import DEGREE, real_roots


def roots(c, low, high):
    out = np.zeros(DEGREE)
    with plain():
        count = real_roots(np.array(c, dtype=float), low, high, np.zeros((2, DEGREE + 2)), out)
    return out[:count]


@pytest.mark.parametrize("places", [[-2.0, 0.5, 1.0, 3.0], [0.1, 0.2, 0.3, 40.0], [-1e4, -1.0, 1.0, 1e4]])
def test_the_roots_of_a_product_are_its_zeros_in_order(places):
    c = np.polynomial.polynomial.polyfromroots(places)
    np.testing.assert_allclose(roots(c, -1e5, 1e5), places, rtol=1e-10)
    inside = [t for t in places if -1.5 < t < 2.0]
    np.testing.assert_allclose(roots(c, -1.5, 2.0), inside, rtol=1e-10)


def test_random_polynomials_have_the_real_roots_of_their_companion_matrices():
    rng = np.random.default_rng(1)
    for c in rng.standard_normal((50, DEGREE + 1)):
        expected = np.polynomial.polynomial.polyroots(c)
        real = np.sort(expected.real[np.abs(expected.imag) < 1e-9])
        real = real[np.abs(real) < 5.0]
        np.testing.assert_allclose(roots(c, -5.0, 5.0), real, rtol=1e-7, atol=1e-9)


def test_polynomials_of_lower_degree_and_without_real_roots():
    np.testing.assert_allclose(roots([-6.0, 2.0, 0.0, 0.0, 0.0], -9.0, 9.0), [3.0])
    assert len(roots([1.0, 0.0, 1.0, 0.0, 0.0], -9.0, 9.0)) == 0
