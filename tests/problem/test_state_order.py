"""Orders of the components of a state."""

import numpy as np
import pytest

from optloc.problem import InvalidProblem
from optloc.problem.state_order import components, in_order


def test_components_are_positions_then_velocities_then_accelerations():
    assert components(2, 6) == ["x", "y", "vx", "vy", "ax", "ay"]
    assert components(3, 3) == ["x", "y", "z"]


def test_another_order_moves_means_and_covariances_alike():
    mean = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    root = np.random.default_rng(1).normal(size=(4, 4))
    cov = np.broadcast_to(root @ root.T, (2, 4, 4))
    moved, spread = in_order("x vx y vy", 2, mean, cov)
    assert moved.tolist() == [[1.0, 3.0, 2.0, 4.0], [5.0, 7.0, 6.0, 8.0]]
    turn = np.eye(4)[[0, 2, 1, 3]]
    np.testing.assert_array_equal(spread[0], turn @ cov[0] @ turn.T)
    back, _ = in_order(["x", "vx", "y", "vy"], 2, moved, spread)
    np.testing.assert_array_equal(back, mean)


def test_components_may_be_left_out():
    moved, spread = in_order("vy,x", 2, np.arange(4.0), np.diag(np.arange(4.0)))
    assert moved.tolist() == [3.0, 0.0]
    assert spread.tolist() == [[3.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("order", ["x vz", "x x", "", "x ax"])
def test_an_order_that_is_none_is_refused(order):
    with pytest.raises(InvalidProblem, match="name some of x y vx vy, each once"):
        in_order(order, 2, np.zeros(4), np.eye(4))
