"""Parameters and variables of a program by name."""

import cvxpy as cp
import numpy as np

from optloc.solvers.posing.convex_statement import set_parameters, variable


def test_parameters_get_values_and_variables_are_found_by_name():
    a, b, x = cp.Parameter(2, name="a"), cp.Parameter(name="b"), cp.Variable(2, name="x")
    program = cp.Problem(cp.Minimize(a @ x + b), [x >= 0])
    set_parameters(program, {"a": np.ones(2), "other": np.zeros(1)})
    assert a.value.tolist() == [1.0, 1.0]
    assert b.value is None
    assert variable(program, "x") is x
