"""The one file with undocumented parts of cvxpy: what it returns, and that no other file uses such parts."""

import ast
from pathlib import Path

import clarabel
import cvxpy as cp
import numpy as np
import pytest

from formulations import cvxpy_access
from formulations.cvxpy_access import clear_values, compiled, cone_program, cones_of, cones_of_solvers, run, write_back

ROOT = Path(__file__).resolve().parents[2]
ACCESS = "formulations/cvxpy_access.py"
# Names that belong to the inside of cvxpy, wherever they stand.
INSIDE = {
    "get_problem_data", "solve_via_data", "unpack_results", "unpack", "save_value", "save_dual_value", "param_prob",
    "reduced_A", "reduced_P", "reduced_mat", "problem_data_index", "param_id_to_col", "total_param_size",
    "dims_to_solver_cones", "dims_to_solver_dict", "SOLVER_MAP_CONIC", "SOLVER_MAP_QP", "SUPPORTED_CONSTRAINTS",
    "invert", "reductions", "_solver_cache", "_solver_stats", "_cache", "extra_stats",
}  # fmt: skip


def uses_of_the_inside(source):
    """Return lines and names of undocumented parts of cvxpy in a source text; `_cache` counts with cvxpy only."""
    found = []
    # most files do not name cvxpy, and to parse them takes seconds
    for node in ast.walk(ast.parse(source)) if "cvxpy" in source else ():
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cvxpy."):
            found.append((node.lineno, node.module))
        if isinstance(node, ast.Import):
            found += [(node.lineno, name.name) for name in node.names if name.name.startswith("cvxpy.")]
        if isinstance(node, ast.Attribute) and node.attr in INSIDE:
            found.append((node.lineno, node.attr))
        if isinstance(node, ast.Constant) and node.value == "param_prob":
            found.append((node.lineno, node.value))
    return found


def test_no_other_file_uses_the_inside_of_cvxpy():
    files = [path for folder in ("formulations", "optloc", "docs") for path in (ROOT / folder).rglob("*.py")]
    found = {
        str(path.relative_to(ROOT)): uses for path in files if (uses := uses_of_the_inside(path.read_text("utf-8")))
    }
    assert set(found) == {ACCESS}


@pytest.mark.parametrize(
    "line", ["from cvxpy.reductions.solution import Solution", "import cvxpy.settings", "cvxpy; p.get_problem_data(1)"]
)
def test_a_use_of_the_inside_is_seen(line):
    assert uses_of_the_inside(line)


def parametric():
    """A problem with each kind of cone, a quadratic objective, and variables that cvxpy changes."""
    a, b = cp.Parameter(3, name="a"), cp.Parameter((2, 3), name="b")
    x, y = cp.Variable(3, name="x"), cp.Variable(2, nonneg=True, name="y")
    lift = cp.Variable((2, 2), PSD=True, name="lift")
    rules = [b @ x == y, cp.norm(x - a) <= y[0] + 1, lift[0, 1] == x[0], x <= 2, cp.trace(lift) <= 3]
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x - a) + cp.sum(y) + lift[1, 1]), rules)
    a.value, b.value = np.array([0.5, -0.3, 0.8]), np.array([[1.0, 0.2, 0.3], [-0.4, 1.0, 0.5]])
    return problem


def filled(program, problem):
    """Clarabel's P, q, d, A, b from the affine maps at the values of the parameters."""
    import scipy.sparse as sp

    vector = np.zeros(program.length + 1)
    vector[-1] = 1.0
    for parameter in problem.parameters():
        start, shape = program.slots[parameter.name()]
        assert shape == parameter.shape
        vector[start : start + parameter.size] = parameter.value.ravel(order="F")
    linear = program.linear @ vector
    both = program.constraints
    matrix = sp.csc_array((both.matrix @ vector, both.rows, both.starts), shape=both.shape)
    quadratic = program.quadratic
    P = sp.csc_array((quadratic.matrix @ vector, quadratic.rows, quadratic.starts), shape=quadratic.shape)
    return P, linear[:-1], float(linear[-1]), -matrix[:, :-1], matrix[:, [-1]].toarray().ravel()


def test_the_affine_maps_give_the_solution_and_the_duals_of_cvxpy():
    import scipy.sparse as sp

    problem = parametric()
    program = cone_program(problem)
    P, q, d, A, b = filled(program, problem)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    found = clarabel.DefaultSolver(sp.triu(P).tocsc(), q, A.tocsc(), b, program.cones, settings).solve()
    problem.solve(solver=cp.CLARABEL)
    assert found.obj_val + d == pytest.approx(problem.value, abs=1e-7)
    x = np.array(found.x)
    for name, matrix, shape in program.recovery:
        value = next(v for v in problem.variables() if v.name() == name).value
        np.testing.assert_allclose((matrix @ x).reshape(shape, order="F"), value, atol=1e-5)
    duals = program.duals(np.array(found.z))
    for own, constraint in zip(duals, problem.constraints, strict=True):
        np.testing.assert_allclose(own, cvxpy_access._flat(constraint.dual_value), atol=1e-5)


def test_the_maps_are_affine_in_the_parameters():
    problem = parametric()
    program, rng = cone_program(problem), np.random.default_rng(0)
    ends = []
    for _ in range(2):
        for parameter in problem.parameters():
            parameter.value = rng.normal(size=parameter.shape)
        ends.append(({p.name(): p.value for p in problem.parameters()}, filled(program, problem)))
    for parameter in problem.parameters():
        parameter.value = 0.5 * (ends[0][0][parameter.name()] + ends[1][0][parameter.name()])
    middle = filled(program, problem)
    for i in (1, 2, 4):
        np.testing.assert_allclose(middle[i], 0.5 * (ends[0][1][i] + ends[1][1][i]), atol=1e-12)
    np.testing.assert_allclose(middle[3].toarray(), 0.5 * (ends[0][1][3] + ends[1][1][3]).toarray(), atol=1e-12)


def test_a_solve_in_three_steps_writes_what_a_solve_of_cvxpy_writes():
    problem, other = parametric(), parametric()
    form = compiled(problem, "CLARABEL", {})
    assert write_back(problem, form, run(problem, form, {}, warm=False)) == "optimal"
    other.solve(solver=cp.CLARABEL)
    assert problem.value == pytest.approx(other.value, abs=1e-9)
    for own, theirs in zip(problem.constraints, other.constraints, strict=True):
        np.testing.assert_allclose(cvxpy_access._flat(own.dual_value), cvxpy_access._flat(theirs.dual_value), atol=1e-9)
    clear_values(problem)
    assert all(v.value is None for v in problem.variables())
    assert problem.value is None
    assert problem.status is None
    assert all(d.value is None for c in problem.constraints for d in c.dual_variables)


def test_an_infeasible_problem_has_its_status_and_no_values():
    x = cp.Variable(2, name="x")
    problem = cp.Problem(cp.Minimize(cp.sum(x)), [x >= 1, x <= 0])
    form = compiled(problem, "CLARABEL", {})
    assert write_back(problem, form, run(problem, form, {}, warm=False)) == "infeasible"
    assert x.value is None


def test_problems_without_constraint_or_with_odd_parameters_are_refused():
    x, p, q = cp.Variable(2, name="x"), cp.Parameter(2, name="p", value=[1, 1]), cp.Parameter(2, name="p", value=[1, 2])
    with pytest.raises(ValueError, match="no constraint"):
        cone_program(cp.Problem(cp.Minimize(cp.sum_squares(x))))
    with pytest.raises(ValueError, match="unique names"):
        cone_program(cp.Problem(cp.Minimize(p @ x + q @ x), [cp.norm(x) <= 1]))


def test_cones_have_one_name_in_all_versions():
    cones = cones_of_solvers()
    assert cones["CLARABEL"] >= {"linear", "second-order", "semidefinite", "exponential", "power"}
    assert cones["SCS"] >= {"linear", "second-order", "semidefinite", "exponential"}
    assert cones["CVXOPT"] >= {"linear", "second-order", "semidefinite"}
    assert cones["OSQP"] == {"linear"}
    assert cones_of(parametric()) == {"linear", "second-order", "semidefinite"}
    x = cp.Variable(2)
    assert cones_of(cp.Problem(cp.Minimize(cp.sum_squares(x)), [x >= 1])) == {"linear"}
    assert cones_of(cp.Problem(cp.Minimize(cp.sum(cp.exp(x))), [x >= 1])) == {"linear", "exponential"}


def test_solvers_of_quadratic_objectives():
    quadratic = {name: cvxpy_access.solves_quadratic_objectives(name) for name in ("OSQP", "CLARABEL", "SCIPY", "GLPK")}
    assert quadratic == {"OSQP": True, "CLARABEL": True, "SCIPY": False, "GLPK": False}
    assert cvxpy_access.known_solvers() >= {"MOSEK", "CLARABEL"}
