"""Sparse rows over nodes, against the dense matrices that they stand for."""

import numpy as np
import pytest

from optloc.proof.nodes.node import HIGH, LOW, NODE_WIDTH, PHI
from optloc.proof.runs.rows import (
    RunRows,
    greatest_length,
    is_balanced,
    is_convex_by,
    multiply,
    multiply_transposed,
    norm_of,
    project_out_unknowns,
    relative_rounding_of,
    residual_at,
    rounding_of_residual,
    share_within,
    workspace_of,
)

pytestmark = pytest.mark.usefixtures("plainly")

# each row is a difference of two nodes, and one offset is in the first three rows
S = np.array([[1.0, -1.0, 0, 0], [1.0, 0, -1.0, 0], [1.0, 0, 0, -1.0], [0, 2.0, -2.0, 0]])
W, SPAN = np.array([3.0, -1.0, 2.0, 5.0]), np.array([1.0, 1.0, 1.0, 0.0]) / np.sqrt(3.0)


def rows():
    row, column = np.nonzero(S)
    start = np.concatenate([[0], np.cumsum(np.bincount(row))])
    return RunRows(start, column, S[row, column], W, SPAN[None], np.linalg.norm(S, axis=0))


def test_products_are_those_of_the_dense_matrix():
    made, values, out = rows(), np.array([1.0, -2.0, 0.5, 4.0]), np.empty(4)
    multiply(made, values, out)
    np.testing.assert_allclose(out, S @ values)
    multiply_transposed(made, values, out)
    np.testing.assert_allclose(out, S.T @ values)


def test_what_others_can_change_is_taken_off():
    values = np.array([5.0, 2.0, -1.0, 7.0])
    project_out_unknowns(rows(), values)
    np.testing.assert_allclose(values, [3.0, 0.0, -3.0, 7.0], atol=1e-12)


def test_the_cost_is_that_of_the_best_offset():
    made, nodes = rows(), np.zeros((4, NODE_WIDTH))
    nodes[:, PHI] = [10.0, 4.0, -3.0, 1.0]
    sheet = workspace_of(made)
    e = S @ nodes[:, PHI] - W
    best = np.append(e[:3] - e[:3].mean(), e[3])
    assert residual_at(made, nodes, sheet) == pytest.approx((best**2).sum())
    np.testing.assert_allclose(sheet.force, S.T @ best, atol=1e-12)


def test_the_greatest_length_is_reached_at_a_corner_of_one_row():
    made, out = rows(), np.empty(4)
    reach = np.array([1.0, 2.0, 0.5, 0.0])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 4), axis=-1).reshape(-1, 4) * reach
    assert np.linalg.norm(corners @ S.T, axis=1).max() <= greatest_length(made, reach, out)
    assert greatest_length(made, np.eye(4)[3], out) == pytest.approx(1.0)


def test_differences_are_balanced_and_a_change_of_one_node_is_not():
    assert is_balanced(rows(), np.ones(4), np.empty(4))
    assert not is_balanced(rows(), np.eye(4)[1], np.empty(4))


def test_rounding_grows_with_nodes_and_their_enclosures():
    made, nodes = rows(), np.zeros((4, NODE_WIDTH))
    assert rounding_of_residual(made, 2.0, nodes) == pytest.approx(2.0 * relative_rounding_of(made))
    nodes[1, PHI], nodes[1, LOW], nodes[1, HIGH] = -3.0, -1.0, 2.0
    assert rounding_of_residual(made, 0.0, nodes) == pytest.approx(relative_rounding_of(made) * np.sqrt(5.0) * 6.0)
    assert share_within(made) == pytest.approx(0.8)


def test_a_hessian_is_convex_only_with_room_for_its_change():
    half, sums = np.array([1.0, 1.0, 0.0]), np.zeros(25)
    sums[0], sums[3] = 2.0, 3.0
    assert is_convex_by(half, sums, 0.5, 0.0)
    assert not is_convex_by(half, sums, 2.5, 0.0)
    assert not is_convex_by(half, sums, 0.5, 1.6)
    assert not is_convex_by(half, sums, np.inf, 0.0)


def test_the_norm_counts_both_halves_of_a_hessian():
    curves, full = np.zeros((1, 16)), np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    curves[0, :6] = full[np.triu_indices(3)]
    assert norm_of(curves, 0) == pytest.approx(np.linalg.norm(full))
