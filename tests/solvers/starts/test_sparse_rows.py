"""Rows at a point: residuals, derivatives and deviations."""

import numpy as np
import pytest
from solvers.posing.scenes import ranged

from optloc.solvers.starts.sparse_rows import derivatives, deviations, lift_positions, linearise_sparse


def test_derivatives_and_a_step_with_gross_errors():
    problem = ranged(2).flat()
    position, failed = lift_positions(problem, lambda part: np.zeros((1, 2)))
    assert not failed.any()
    residual, slope = derivatives(problem, position)
    step = np.array([[0.5, -0.25]])
    moved, _ = derivatives(problem, position + step)
    assert residual - moved == pytest.approx((slope @ step[0]), abs=1e-3)
    assert deviations(problem).shape == residual.shape
    x, wrong, failed = linearise_sparse(problem, position)
    assert np.abs(x - position).max() < 100.0
    assert not wrong.any()
    assert not failed.any()
