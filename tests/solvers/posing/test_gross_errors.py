"""The posed program with gross errors finds the row that is wrong."""

import numpy as np
import pytest
from solvers.posing.scenes import pair_of_targets, ranged

from optloc import InvalidProblem, pose, solve
from optloc.solvers.posing.gross_errors import pose_sparse


def test_the_wrong_row_has_an_error():
    problem = ranged(3, count=10)
    z = problem.observed.copy()
    z[..., 4] += 2e3
    posed = pose(problem.with_rows(z=z), "sparse_errors")
    fix = posed.solve(refine=False)
    error = posed.of("error").value
    assert np.abs(error).argmax() == 4
    assert np.abs(np.delete(error, 4)).max() < 0.02 * abs(error[4])
    assert np.linalg.norm(fix.position - solve(problem).position) < 300.0


def test_several_targets_are_refused():
    with pytest.raises(InvalidProblem, match="one target"):
        pose_sparse(pair_of_targets(1).flat(), solve)
