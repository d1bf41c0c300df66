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


def test_roots_are_those_of_eigenvalues():
    rng = np.random.default_rng(1)
    work, out = np.zeros((2, DEGREE + 2)), np.zeros(DEGREE)
    for trial in range(200):
        roots = rng.uniform(-2.0, 2.0, 4)
        pair = rng.uniform(-1.0, 1.0) + 1j * rng.uniform(0.1, 1.0)
        if trial % 2:
            roots = np.array([*roots[:2], pair, np.conj(pair)])
        c = np.poly(roots).real[::-1] * rng.uniform(0.1, 10.0)
        real = np.sort(roots[np.abs(roots.imag) == 0.0].real)
        real = real[np.abs(real) < 1.5]
        count = real_roots(c, -1.5, 1.5, work, out)
        assert count == len(real)
        apart = np.diff(real).min(initial=1.0)
        np.testing.assert_allclose(out[:count], real, atol=1e-13 / apart**2)


def test_roots_of_lower_degree():
    work, out = np.zeros((2, DEGREE + 2)), np.zeros(DEGREE)
    assert real_roots(np.array([-6.0, 3.0, 0.0, 0.0, 0.0]), -9.0, 9.0, work, out) == 1
    assert out[0] == pytest.approx(2.0)
    assert real_roots(np.array([1.0, 0.0, 1.0, 0.0, 0.0]), -9.0, 9.0, work, out) == 0
