"""What all posed problems share: names that are given or counted, and numbers of one or several relations."""

import cvxpy as cp
import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.solvers.posing.convex_program import ConvexProgram
from optloc.solvers.posing.posed_problem import PosedProblem, joined


def test_constraints_are_named_or_counted_and_objectives_replaced():
    x = cp.Variable(2, name="x")
    posed = PosedProblem(ConvexProgram(cp.Problem(cp.Minimize(cp.sum_squares(x))), example="x[0] <= 1"))
    posed.add(x[0] <= 1.0)
    posed.add(x[1] <= 1.0, name="constraint 2")
    posed.add(x[0] >= -1.0)
    assert list(posed.relations) == ["constraint 1", "constraint 2", "constraint 3"]
    assert len(posed.problem.constraints) == 3
    with pytest.raises(InvalidProblem, match="already a constraint 'constraint 2'"):
        posed.add(x[0] <= 9.0, name="constraint 2")
    with pytest.raises(InvalidProblem, match="no text"):
        posed.add(x[0] <= 9.0, name=3)
    with pytest.raises(InvalidProblem, match=r"x\[0\] <= 1"):
        posed.add("fence")
    assert not posed.own_objective
    posed.minimise(cp.norm1(x))
    assert posed.own_objective


def test_numbers_of_no_relation_one_and_several():
    assert joined([np.array(1.0)]) == 1.0
    assert joined([np.array(1.0), np.array([2.0, 3.0])]).tolist() == [1.0, 2.0, 3.0]
    assert joined([]).shape == (0,)
