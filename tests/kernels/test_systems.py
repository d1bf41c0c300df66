"""Small positive definite systems in plain Python, against numpy."""

import numpy as np
import pytest

from optloc.kernels import systems
from optloc.kernels.jit import plain
from optloc.kernels.systems import LANES

N = 4


@pytest.fixture(autouse=True)
def in_python():
    """Run kernels as plain Python: nothing is compiled."""
    with plain():
        yield


def definite(count, n=N, seed=0):
    rows = np.random.default_rng(seed).standard_normal((count, n + 3, n))
    return rows.mT @ rows


def side_by_side(parts):
    """Return matrices or vectors (..., n) of all lanes with the lane as the last axis."""
    return np.ascontiguousarray(np.moveaxis(parts, 0, -1))


def test_scaled_systems_are_solved_and_a_singular_lane_is_flagged():
    matrix, right, scale = (
        definite(3),
        np.random.default_rng(1).standard_normal((3, N)),
        np.array([1.0, 1e6, 1e-4, 1.0]),
    )
    matrix *= scale[:, None] * scale
    matrix[1, 2] = matrix[1, :, 2] = 0.0
    m = np.concatenate([matrix.reshape(3, -1), right, np.zeros((3, N)), np.ones((3, 1))], axis=1).T.copy()
    systems.factor(m, 0, N, 5 * N, 6 * N, 1e-12, 3)
    assert m[6 * N].tolist() == [1.0, 0.0, 1.0]
    systems.forward(m, 0, N, 5 * N, 4 * N, 3)
    systems.backward(m, 0, N, 5 * N, 4 * N, 3)
    for lane in (0, 2):
        np.testing.assert_allclose(m[4 * N : 5 * N, lane], np.linalg.solve(matrix[lane], right[lane]), rtol=1e-7)


def test_plain_factors_solve():
    A, right = definite(LANES), np.random.default_rng(2).standard_normal((LANES, N))
    lower, inverse, found = np.zeros((N, N, LANES)), np.zeros((N, LANES)), side_by_side(right)
    systems.factor_plain(side_by_side(A), side_by_side(np.diagonal(A, axis1=1, axis2=2)), lower, inverse)
    systems.solve_plain(lower, inverse, found)
    np.testing.assert_allclose(found.T, np.linalg.solve(A, right[..., None])[..., 0], rtol=1e-8)


def test_eliminated_unknowns_leave_the_schur_complement_and_the_least_cost():
    A, right, keep = definite(LANES), np.random.default_rng(3).standard_normal((LANES, N)), 2
    left, vector, cost = side_by_side(A), side_by_side(right), np.full(LANES, 10.0)
    systems.eliminate_last(left, vector, cost, np.zeros((N, LANES)), keep)
    inner = np.linalg.inv(A[:, keep:, keep:])
    share = A[:, :keep, keep:] @ inner
    schur = A[:, :keep, :keep] - share @ A[:, keep:, :keep]
    np.testing.assert_allclose(np.tril(left[:keep, :keep].transpose(2, 0, 1)), np.tril(schur), rtol=1e-9)
    rest = right[:, :keep] - (share @ right[:, keep:, None])[..., 0]
    np.testing.assert_allclose(vector[:keep].T, rest, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(cost, 10.0 - np.einsum("li,lij,lj->l", right[:, keep:], inner, right[:, keep:]))


def test_positive_is_what_all_eigenvalues_are():
    rng = np.random.default_rng(4)
    for matrix in rng.standard_normal((40, 3, 3)):
        a = matrix + matrix.T + 2.5 * np.eye(3)
        six = a[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        assert systems.positive(*six) == (np.linalg.eigvalsh(a)[0] > 0.0)
    assert systems.positive_along(1.0, 0.0, 0.0, 2.0, 0.0, -5.0, True, False)
    assert not systems.positive_along(1.0, 0.0, 0.0, 2.0, 0.0, -5.0, True, True)


@pytest.mark.parametrize("function", [systems.principal, systems.roughly_principal])
def test_principal_axes_of_a_matrix_make_it_diagonal(function):
    (a,) = definite(1, 3, 5)
    found, vectors = a.copy(), np.zeros((3, 3))
    function(found, vectors)
    np.testing.assert_allclose(vectors @ found @ vectors.T, a, rtol=1e-9)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-12)
    size = np.sqrt(np.diag(found))
    assert np.abs(found / np.outer(size, size) - np.eye(3)).max() <= (1e-12 if function is systems.principal else 1e-2)


def test_principal_axes_of_many_matrices_have_their_eigenvalues():
    a = definite(LANES, 3, 6)
    found, axes = side_by_side(a), np.zeros((3, 3, LANES))
    systems.principal_axes(found, axes, np.zeros(LANES))
    values, axes = np.diagonal(found.transpose(2, 0, 1), axis1=1, axis2=2), axes.transpose(2, 0, 1)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(a), rtol=1e-9)
    np.testing.assert_allclose(axes * values[:, None] @ axes.mT, a, rtol=1e-7, atol=1e-9)


def test_an_inverse_is_that_of_numpy_and_a_singular_matrix_has_none():
    (a,) = definite(1, 3, 7)
    out = np.zeros((3, 3))
    assert systems.inverse(*a[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], out)
    np.testing.assert_allclose(out, np.linalg.inv(a), rtol=1e-9)
    assert not systems.inverse(1.0, 2.0, 3.0, 4.0, 6.0, 9.0, out)  # rank one


def test_cholesky_solves_and_inverts_a_leading_block():
    (a,), right = definite(1, 5, 8), np.arange(1.0, 6.0)
    lower, found = a.copy(), right.copy()
    assert systems.cholesky(lower, 5, 1e-12)
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(a), rtol=1e-9)
    systems.solve_factored(lower, found)
    np.testing.assert_allclose(found, np.linalg.solve(a, right), rtol=1e-8)
    inverted = a.copy()
    assert systems.invert(inverted, 3, 1e-12)
    np.testing.assert_allclose(inverted[:3, :3], np.linalg.inv(a[:3, :3]), rtol=1e-9)
    assert (inverted[3:, 3:] == a[3:, 3:]).all()
    assert not systems.cholesky(np.ones((2, 2)), 2, 1e-12)
