"""Systems of tied epochs, against the whole matrix."""

import numpy as np
import pytest

from optloc.linear import chain

RNG = np.random.default_rng(20261123)


def tied_system(k, size, batch=2):
    """Return a regular chain as blocks and as the whole matrix."""
    whole = np.zeros((batch, k * size, k * size))
    for j in range(k):
        wide = slice(j * size, min(j + 2, k) * size)
        rows = RNG.standard_normal((batch, 5, wide.stop - wide.start))
        whole[:, wide, wide] += rows.mT @ rows
    whole += np.eye(k * size)
    cut = whole.reshape(batch, k, size, k, size).swapaxes(2, 3)
    return cut[:, np.arange(k), np.arange(k)], cut[:, np.arange(k - 1), np.arange(1, k)], whole


@pytest.mark.parametrize("k", [1, 2, 3, 4, 5, 8, 13])
def test_a_chain_is_solved_as_the_whole_matrix_is(k):
    block, link, whole = tied_system(k, 3)
    right = RNG.standard_normal((2, k, 3, 2))
    solved, ok = chain.solve(block, link, right)
    assert ok.all()
    np.testing.assert_allclose(solved.reshape(2, 3 * k, 2), np.linalg.solve(whole, right.reshape(2, 3 * k, 2)))
    inner, ok = chain.inverse_blocks(block, link)
    inverse = np.linalg.inv(whole).reshape(2, k, 3, k, 3).swapaxes(2, 3)
    np.testing.assert_allclose(inner, inverse[:, np.arange(k), np.arange(k)], atol=1e-12)


def test_a_chain_that_leaves_something_open_says_so_and_a_block_takes_least_norm():
    # a walk whose steps alone are known may begin anywhere
    k = 9
    block, link = np.full((k, 1, 1), 2.0), np.full((k - 1, 1, 1), -1.0)
    block[[0, -1]] = 1.0
    assert not chain.solve(block, link, np.ones((k, 1, 1)))[1]
    # an unknown of one epoch that no row sees stays where it is, and the walk beside it is as without it
    both = np.zeros((k, 2, 2))
    both[:, :1, :1] = block + 0.5
    both[[0, 1, 2, 5], 1, 1] = 3.0
    ties, right = np.zeros((k - 1, 2, 2)), np.ones((k, 2, 1))
    ties[:, :1, :1] = link
    right[both[:, 1, 1] == 0.0, 1] = 0.0
    solved, ok = chain.solve(both, ties, right)
    assert ok
    np.testing.assert_allclose(solved[:, :1], chain.solve(block + 0.5, link, right[:, :1])[0])
    np.testing.assert_allclose(solved[:, 1, 0], right[:, 1, 0] / 3.0)
