"""Access to parts of cvxpy that its documentation does not promise: reductions, stored maps, solver tables.

This is the only file of the project with such attributes and import paths, so a new version of cvxpy can break nothing
else. The tests of this file run with the oldest and with the newest supported version.

Calls that build, fill or read cvxpy problems hold `LOCK`.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from formulations.algebra import Array, Index
from formulations.backend import hold_in_forks

# cvxpy counts its variables in a global that is read and written in two steps, and stores the values of parameters in
# the problem. Two threads could give two variables the same number, or solve each other's data.
LOCK = threading.RLock()
"""Lock of all calls of cvxpy that change a problem or count variables."""
hold_in_forks(LOCK)

# Names of the cones in this package by their class in cvxpy; versions from 1.8 store the triangle of a matrix ("Svec").
_CONES = {
    "Zero": "linear",
    "NonNeg": "linear",
    "SOC": "second-order",
    "PSD": "semidefinite",
    "SvecPSD": "semidefinite",
    "ExpCone": "exponential",
    "PowCone3D": "power",
    "PowConeND": "power",
}


def clear_values(problem: Any) -> None:
    """Remove the result of the previous solve from a problem, because a failed solve does not overwrite it.

    Parameters
    ----------
    problem : cvxpy.Problem
        The problem; values of its parameters stay.
    """
    for variable in problem.variables():
        variable.save_value(None)
    for constraint in problem.constraints:
        for dual in constraint.dual_variables:
            dual.save_value(None)
    problem._value = problem._status = problem._solution = None  # noqa: SLF001  (no public way)


# One solve through cvxpy, in three steps, so that the solver's own solution object is seen between them.


@dataclass(frozen=True, slots=True)
class Compiled:
    """A problem in the form of one solver.

    Parameters
    ----------
    solver : str
        Name of the solver.
    data : dict
        Arguments of the solver.
    chain, inverse : object
        Reductions of cvxpy, and their data for the way back.
    """

    solver: str
    data: dict[str, Any]
    chain: Any
    inverse: list[Any]


def compiled(problem: Any, solver: str, settings: Mapping[str, Any]) -> Compiled:
    """Return a problem in the form of a solver, with the present values of its parameters.

    Parameters
    ----------
    problem : cvxpy.Problem
        The problem.
    solver : str
        Name of the solver.
    settings : Mapping[str, Any]
        Settings of the solver; a few change the form.

    Returns
    -------
    Compiled
        The data of the solver.

    Raises
    ------
    cvxpy.error.SolverError
        If the solver is not installed or does not solve such problems.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a problem that is not DPP is compiled again at each solve, which is allowed
        data, chain, inverse = problem.get_problem_data(solver, solver_opts=dict(settings))
    return Compiled(solver, data, chain, inverse)


def run(problem: Any, form: Compiled, settings: Mapping[str, Any], *, warm: bool) -> Any:
    """Return the solution object of the solver.

    Parameters
    ----------
    problem : cvxpy.Problem
        The problem, which stores the previous solution for a warm start.
    form : Compiled
        Its data.
    settings : Mapping[str, Any]
        Settings of the solver.
    warm : bool
        Whether to start at the previous solution of this problem by this solver, if there is one.

    Returns
    -------
    object
        The solution, whose type depends on the solver.
    """
    return form.chain.solve_via_data(problem, form.data, warm_start=warm, verbose=False, solver_opts=dict(settings))


def write_back(problem: Any, form: Compiled, raw: Any) -> str:
    """Write a solution onto the variables and constraints of a problem, as ``problem.solve`` does.

    Parameters
    ----------
    problem : cvxpy.Problem
        The problem, whose values were cleared.
    form : Compiled
        Its data.
    raw : object
        Solution object of the solver.

    Returns
    -------
    str
        Status in cvxpy's words. Nothing is written if the solver failed.
    """
    import cvxpy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the status reports an inaccurate solution
        try:
            problem.unpack_results(raw, form.chain, form.inverse)
        except cvxpy.error.SolverError:
            return str(cvxpy.settings.SOLVER_ERROR)
    return str(problem.status)


def cvxopt_matrices(form: Compiled) -> dict[str, Any]:
    """Return the arguments of CVXOPT's ``conelp`` by name: c, G, h, dims, A, b.

    Parameters
    ----------
    form : Compiled
        A problem in the form of CVXOPT.

    Returns
    -------
    dict
        Matrices of CVXOPT.
    """
    from cvxpy.reductions.solvers.conic_solvers.cvxopt_conif import CVXOPT, dims_to_solver_dict

    dims = dims_to_solver_dict(form.data["dims"])
    own = CVXOPT._prepare_cvxopt_matrices(form.data)  # noqa: SLF001  (no public way)
    return {"c": own["c"], "G": own["G"], "h": own["h"], "dims": dims, "A": own["A"], "b": own["b"]}


def cvxopt_solution(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result of CVXOPT's ``conelp`` in the form that cvxpy reads.

    Parameters
    ----------
    found : Mapping[str, Any]
        The result.

    Returns
    -------
    dict
        Status in cvxpy's words; value, primal and dual point if there is one.
    """
    from cvxpy.reductions.solvers.conic_solvers.cvxopt_conif import CVXOPT

    out: dict[str, Any] = {"status": CVXOPT.STATUS_MAP[found["status"]]}
    if found["status"] == "optimal":
        parts = {"primal": "x", "eq_dual": "y", "ineq_dual": "z"}
        out |= {name: np.array(found[key]).ravel() for name, key in parts.items()}
        out["value"] = found["primal objective"]
    return out


# Cones and objectives that the solvers of cvxpy support.


def cones_of_solvers() -> dict[str, frozenset[str]]:
    """Return the cones that each solver of cvxpy supports, installed or not, by the name of the solver.

    Returns
    -------
    dict
        Sets of "linear", "second-order", "semidefinite", "exponential", "power". A solver of quadratic programs has
        "linear" only.
    """
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC, SOLVER_MAP_QP

    found = dict.fromkeys(SOLVER_MAP_QP, frozenset({"linear"}))
    for name, solver in SOLVER_MAP_CONIC.items():
        cones = {_CONES[cone.__name__] for cone in solver.SUPPORTED_CONSTRAINTS if cone.__name__ in _CONES}
        found[name] = frozenset(cones) | found.get(name, frozenset())
    return found


def solves_quadratic_objectives(solver: str) -> bool:
    """Return whether a solver of cvxpy takes a quadratic objective without a cone.

    Parameters
    ----------
    solver : str
        Name of the solver.

    Returns
    -------
    bool
        True for solvers of quadratic programs, and for conic solvers with a quadratic objective.
    """
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC, SOLVER_MAP_QP

    return solver in SOLVER_MAP_QP or bool(solver in SOLVER_MAP_CONIC and SOLVER_MAP_CONIC[solver].supports_quad_obj())


def cones_of(problem: Any) -> frozenset[str]:
    """Return the cones that a problem needs if its objective may be quadratic.

    Parameters
    ----------
    problem : cvxpy.Problem
        A convex problem.

    Returns
    -------
    frozenset of str
        A set of "linear", "second-order", "semidefinite", "exponential", "power".
    """
    import cvxpy

    dims = compiled(problem, cvxpy.CLARABEL, {}).data["dims"]
    sizes = {
        "linear": 1,
        "second-order": len(dims.soc),
        "semidefinite": len(dims.psd),
        "exponential": int(dims.exp),
        "power": len(dims.p3d) + len(getattr(dims, "pnd", ())),
    }
    return frozenset(name for name, size in sizes.items() if size)


def known_solvers() -> frozenset[str]:
    """Return the names of all solvers that cvxpy knows, installed or not."""
    import cvxpy

    return frozenset(map(str, cvxpy.settings.SOLVERS))


# The affine maps from parameters to Clarabel's data.


@dataclass(frozen=True, slots=True)
class AffineMap:
    """The stored entries of a sparse matrix as an affine function of the parameter vector.

    Parameters
    ----------
    matrix : scipy.sparse matrix
        The map from the parameter vector, with a one at its end, to the entries.
    rows, starts : Index
        Row of each entry, and start of each column (compressed columns).
    shape : tuple of int
        Rows and columns of the matrix.
    """

    matrix: Any
    rows: Index
    starts: Index
    shape: tuple[int, int]


@dataclass(frozen=True, slots=True)
class ConeProgram:
    """A problem that is DPP in Clarabel's form, as affine functions of its parameters.

    Parameters
    ----------
    size : int
        Number of unknowns n.
    slots : dict
        For each parameter name, its first entry in the parameter vector, and its shape.
    length : int
        Length of the parameter vector without the constant 1 at its end.
    linear : scipy.sparse matrix
        Map from the parameter vector to q, followed by d.
    constraints : AffineMap
        Map to [A, b] in cvxpy's signs, with n + 1 columns.
    quadratic : AffineMap, optional
        Map to P; None if the objective is linear.
    dims : object
        Sizes of the cones: ``zero``, ``nonneg``, ``soc``, ``psd``.
    cones : list
        Cones of Clarabel.
    recovery : list of tuple
        For each variable, its name, the matrix that maps the solver's x (n,) to it, and its shape.
    form : Compiled
        The reductions, for dual values.
    problem : cvxpy.Problem
        The problem.
    """

    size: int
    slots: dict[str, tuple[int, tuple[int, ...]]]
    length: int
    linear: Any
    constraints: AffineMap
    quadratic: AffineMap | None
    dims: Any
    cones: list[Any]
    recovery: list[tuple[str, Array, tuple[int, ...]]]
    form: Compiled
    problem: Any

    def duals(self, z: Array) -> tuple[Array, ...]:
        """Return the dual values of the constraints from a dual point of Clarabel.

        Parameters
        ----------
        z : Array, shape (m,)
            Dual point.

        Returns
        -------
        tuple of Array
            The dual value of each constraint in the order of ``problem.constraints``, in cvxpy's signs. A second-order
            cone has its parts in one vector.
        """
        raw = SimpleNamespace(
            status="Solved", x=np.zeros(self.size), z=z, obj_val=0.0, obj_val_dual=0.0, solve_time=0.0, iterations=0
        )
        with LOCK:
            found = self.form.chain.invert(raw, self.form.inverse).dual_vars
        return tuple(_flat(found.get(constraint.id)) for constraint in self.problem.constraints)


def _flat(value: Any) -> Array:
    """Return a dual value as one array; the parts of a cone are joined to a vector. None gives an empty array."""
    if value is None:
        return np.zeros(0)
    if isinstance(value, list | tuple):
        return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in value])
    dense = value.toarray() if hasattr(value, "toarray") else value
    return np.array(dense, dtype=np.float64)


def dual_values(problem: Any) -> tuple[Array, ...]:
    """Return the dual values that a problem stores, in the order of its constraints.

    Parameters
    ----------
    problem : cvxpy.Problem
        A problem after a solve.

    Returns
    -------
    tuple of Array
        The dual values in cvxpy's signs; an empty array for a constraint without dual values.
    """
    return tuple(_flat(constraint.dual_value) for constraint in problem.constraints)


def cone_program(problem: Any) -> ConeProgram:
    """Return a problem in Clarabel's form, as affine functions of its parameters.

    Parameters
    ----------
    problem : cvxpy.Problem
        A minimisation that follows cvxpy's rules for parameters (DPP), with at least one constraint.

    Returns
    -------
    ConeProgram
        The maps.

    Raises
    ------
    ValueError
        If the problem has no constraint, or if a parameter has no unique name or an attribute.
    """
    import cvxpy
    from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones

    form = compiled(problem, cvxpy.CLARABEL, {})
    program, dims = form.data["param_prob"], form.data["dims"]
    columns = program.param_id_to_col
    slots = {p.name(): (int(columns[p.id]), p.shape) for p in problem.parameters() if p.id in columns}
    if len(slots) != len(problem.parameters()):
        raise ValueError("parameters need unique names and no symmetric, diagonal or semidefinite attribute")
    n = int(program.x.size)
    return ConeProgram(
        size=n,
        slots=slots,
        length=int(program.total_param_size),
        linear=program.q,
        constraints=_affine(program.reduced_A),
        quadratic=None if program.P is None else _affine(program.reduced_P),
        dims=dims,
        cones=dims_to_solver_cones(dims),
        recovery=_recovery(problem, form, program.x.id, n),
        form=form,
        problem=problem,
    )


def _affine(reduced: Any) -> AffineMap:
    """Return the map from the parameter vector to the stored entries of a matrix, with their pattern."""
    reduced.cache()
    if reduced.problem_data_index is None:
        raise ValueError("the problem has no constraint")
    return AffineMap(reduced.reduced_mat, *reduced.problem_data_index)


def _recovery(problem: Any, form: Compiled, name: int, n: int) -> list[tuple[str, Array, tuple[int, ...]]]:
    """Return, for each variable, its name, the matrix that maps the solver's x (n,) to it, and its shape.

    cvxpy's reductions are undone on unit vectors. `name` is the id of x.
    """
    from cvxpy.reductions.solution import Solution

    columns: dict[int, list[Array]] = {variable.id: [] for variable in problem.variables()}
    for unit in np.eye(n):
        solution = Solution("optimal", 0.0, {name: unit}, None, {})
        for reduction, data in zip(reversed(form.chain.reductions[:-1]), reversed(form.inverse[:-1]), strict=True):
            solution = reduction.invert(solution, data)
        for variable in problem.variables():
            value = solution.primal_vars[variable.id]
            dense = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
            columns[variable.id].append(dense.ravel(order="F"))
    return [(v.name(), np.stack(columns[v.id], axis=1), v.shape) for v in problem.variables()]
