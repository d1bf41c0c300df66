"""A nonlinear program of CasADi that users change: relations in SI units, duals, and residuals of its conditions.

Letters: `size` unknowns, d coordinates, m rows, q starts. X is the vector of unknowns in SI units, and y the scaled
vector, the variables of the program.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.nls import Local, NonlinearStatement, Program
from formulations.solver_report import SolverReport
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.posed_answer import PosedSolution
from optloc.solvers.methods import METHODS, Method
from optloc.solvers.posing.posed_problem import EXAMPLE, Relation, joined
from optloc.solvers.scaled_program import ScaledProblem

# Most iterations of IPOPT, as in the method "nlp".
_SETTINGS = {"bound_relax_factor": 0.0, "max_iter": 200}
# A start that is a solution with its multipliers: IPOPT must not push it away from its bounds, nor begin with a large
# barrier.
_FROM_SOLUTION = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_slack_bound_frac": 1e-9,
    "mu_init": 1e-9,
}
# Largest residual of the optimality conditions at which a point is a solution, although the solver reports that it
# stopped early: IPOPT cannot always meet its tolerance of 1e-10.
_STATIONARY = 1e-7
# Places around the start at which gradients set the unit of a relation: the gradient of a distance has none at its
# centre.
_SHIFTS = (0.0, 0.137, -0.211)


class NonlinearProgram:
    """A nonlinear program of CasADi with numbers of order one, to which relations are added.

    Parameters
    ----------
    scaled : ScaledProblem
        The program without constraints, with its own symbols.

    Attributes
    ----------
    problem : dict
        Expressions x, f, g and p of CasADi.
    base : formulations.nls.NonlinearStatement
        The statement without relations and with its own objective.
    vector : casadi.SX (size, 1)
        The unknowns X.
    parameters : array
        Numbers of the symbols p.
    """

    def __init__(self, scaled: ScaledProblem) -> None:
        self.scaled, self.base = scaled, scaled.program.statement
        self.goal, self.own_objective = self.base.f, False
        self.parameters = scaled.program.data(scaled.z, scaled.weight, scaled.data, scaled.prior)
        self.vector = self.base.x * scaled.unit + scaled.centre
        self.relations: dict[str, Relation] = {}
        self._starts: Array | None = None
        self.restate()

    def restate(self) -> None:
        """Rewrite the statement with the constraints and the objective."""
        import casadi as ca

        parts = [part for one in self.relations.values() for part in one.parts]
        equal, more = ([sign * left for left, is_equal in parts if is_equal is kind] for kind, sign in
                       ((True, 1.0), (False, -1.0)))  # fmt: skip
        self.statement: NonlinearStatement = replace(
            self.base,
            f=self.goal,
            equalities=ca.vertcat(ca.SX(0, 1), *equal),
            inequalities=ca.vertcat(ca.SX(0, 1), *more),
        )
        self.problem = {"x": self.base.x, "f": self.goal, "g": self.statement.g, "p": self.base.p}

    def minimise(self, expression: Any) -> None:
        """Replace the objective by a scalar expression; raise InvalidProblem for any other expression."""
        import casadi as ca

        try:
            goal = ca.SX(expression)
        except (NotImplementedError, TypeError, RuntimeError):
            raise InvalidProblem(
                "the objective is no expression of casadi.SX", "objective", "use posed.residual"
            ) from None
        if goal.numel() != 1:
            raise InvalidProblem("the objective is not a scalar expression", "objective", "sum its entries")
        self._check_unknowns(goal, "objective")
        self.goal, self.own_objective = goal, True
        self.restate()

    def _check_unknowns(self, expression: Any, where: str) -> None:
        """Raise InvalidProblem if an expression has no unknown of the program, or an unknown of another program."""
        import casadi as ca

        symbols = ca.symvar(expression)
        own = {one.element_hash() for one in ca.vertsplit(ca.vertcat(self.base.x, self.base.p))}
        if any(one.element_hash() not in own for one in symbols):
            raise InvalidProblem(
                "it has a symbol that is not of this problem", where, f"use expressions as in {EXAMPLE}"
            )
        if not ca.depends_on(expression, self.base.x):
            raise InvalidProblem("it has no unknown of this problem", where, f"use expressions as in {EXAMPLE}")

    def pairs(self, constraint: Any) -> list[tuple[Any, bool]]:
        """Return scalar expressions ``left - right`` of a relation, and whether each is an equality.

        Raises
        ------
        InvalidProblem
            If it is no relation of CasADi.
        """
        import casadi as ca

        if not isinstance(constraint, ca.SX):
            raise InvalidProblem(
                f"{type(constraint).__name__} is no relation of casadi.SX and no constraint of optloc.constraints",
                "constraint",
                f"write a relation such as {EXAMPLE}",
            )
        pairs = []
        elements: list[Any] = constraint.nonzeros()
        for one in elements:
            if one.is_constant() or one.op() not in (ca.OP_LE, ca.OP_LT, ca.OP_EQ):
                raise InvalidProblem(
                    "the expression is no relation", "constraint", "write left <= right, left >= right or left == right"
                )
            pairs.append((one.dep(0) - one.dep(1), one.op() == ca.OP_EQ))
        self._check_unknowns(ca.vertcat(*(left for left, _ in pairs)), "constraint")
        return pairs

    def relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation of CasADi, divided by its own unit."""
        pairs = self.pairs(constraint)
        units = [self._unit_of(left) for left, _ in pairs]
        parts = tuple((left / unit, equal) for (left, equal), unit in zip(pairs, units, strict=True))
        return Relation(name, parts, tuple(np.array(unit) for unit in units), free=True)

    def _unit_of(self, left: Any) -> float:
        """Return the length of the gradient of an expression in scaled unknowns, the largest near the start; or one."""
        import casadi as ca

        slope = ca.Function("slope", [self.base.x, self.base.p], [ca.gradient(left, self.base.x)])
        lengths = [np.linalg.norm(slope(self.start + shift, self.parameters).full()) for shift in _SHIFTS]
        finite = [float(one) for one in lengths if np.isfinite(one) and one > 0.0]
        return max(finite, default=1.0)

    # Starts.

    @property
    def start(self) -> Array:
        """Return the scaled vector (size,) of the best closed-form start."""
        return np.asarray((self.starts()[0] - self.scaled.centre) / self.scaled.unit)

    def starts(self) -> Array:
        """Return starting vectors (q, size) in SI units, from closed forms, or else from a search."""
        if self._starts is None:
            problem = replace(self.scaled.problem, constraints=())
            found = Method.parse("gtrs")(problem, None).x[0]
            found = found[np.isfinite(found).all(1)]
            if not len(found):
                found = Method.parse(METHODS["searched"])(problem, None).x[0]
                found = found[np.isfinite(found).all(1)]
            if not len(found):
                found = self.scaled.centre[None].copy()
            self._starts = found
        return self._starts

    # The solution.

    @property
    def bounds(self) -> dict[str, Array]:
        """Return lbx, ubx, lbg and ubg of `problem`."""
        equal, more = self.statement.equalities.shape[0], self.statement.inequalities.shape[0]
        free = np.full(self.scaled.program.n, np.inf)
        upper = np.concatenate([np.zeros(equal), np.full(more, np.inf)])
        return {"lbx": -free, "ubx": free, "lbg": np.zeros(equal + more), "ubg": upper}

    def solve(
        self, starts: Array, name: str, settings: Mapping[str, Any], duals: Mapping[str, float | Array] | None
    ) -> tuple[list[Local], str]:
        """Return the local solutions of a solver, and the last error of the solver.

        Parameters
        ----------
        starts : array (q, size)
            First iterates X.
        name : str
            Name of the solver in CasADi.
        settings : mapping
            Its settings.
        duals : mapping of str to float or array, optional
            First multipliers of relations.

        Raises
        ------
        InvalidProblem
            If the solver is unknown or refuses a setting, or if `duals` do not fit the relations.
        """
        import casadi as ca

        from formulations.backend import Choice, SolverError

        defaults = {} if name != "ipopt" else _SETTINGS if duals is None else {**_FROM_SOLUTION, **_SETTINGS}
        own = {**defaults, **settings}
        if not ca.has_nlpsol(name):  # without this question, CasADi would print all folders that it searches
            raise InvalidProblem(f"CasADi has no nonlinear solver {name!r}", "solver", "see 'optloc list solvers'")
        choice, data = None if name == "ipopt" else Choice("nonlinear", name, own), self.scaled
        try:
            program = Program.of(data.program, self.statement, choice=choice, settings=own)
        except RuntimeError:  # CasADi raises no other type
            given = ", ".join(map(str, settings)) or "of optloc"
            raise InvalidProblem(
                f"{name} does not accept the settings {given}", "settings", "check names and values"
            ) from None
        ends, failure = list[Local](), ""
        multipliers = None if duals is None else (np.zeros(program.n), self._multipliers(duals))
        for one in starts:
            y = (one - data.centre) / data.unit
            try:
                end = program.solve(y, data.z, data.weight, data.data, prior=data.prior, multipliers=multipliers)
            except SolverError as trouble:
                failure = str(trouble)
            else:
                ends.append(self._checked(end))
        return ends, failure

    def _checked(self, found: Local) -> Local:
        """Return a local solution, as a success if its point is stationary although the solver stopped early."""
        if found.success or "limit" in found.status.lower() or not np.isfinite(found.x).all():
            return found
        return replace(found, success=bool(max(self._residuals(found)) < _STATIONARY))

    def _multipliers(self, duals: Mapping[str, float | Array]) -> Array:
        """Return the multipliers (equalities, inequalities) of named duals; zeros for the other constraints."""
        first: list[float] = []
        second: list[float] = []
        unknown = [name for name in duals if name not in self.relations]
        if unknown:
            raise InvalidProblem(f"there is no constraint {unknown[0]!r}", "duals", "use fix.posed.duals")
        for name, one in self.relations.items():
            given = np.ravel(duals.get(name, np.zeros(len(one.parts))))
            if len(given) != len(one.parts):
                raise InvalidProblem(
                    f"{name!r} has {len(one.parts)} duals, not {len(given)}", "duals", "use fix.posed.duals"
                )
            for (_, equal), unit, dual in zip(one.parts, one.divisor, given, strict=True):
                (first if equal else second).append(float(dual * unit) * (1.0 if equal else -1.0))
        return np.array([*first, *second])

    def solution(self, found: Local) -> PosedSolution:
        """Return duals and values of the relations, objective and report of a local solution."""
        lefts, equal, more = iter(self._lefts(found.x)), iter(found.equalities), iter(-found.inequalities)
        duals: dict[str, float | Array] = {}
        values: dict[str, float | Array] = {}
        for name, one in self.relations.items():
            units = [float(unit) for unit in one.divisor]
            factors = [float(next(equal if is_equal else more)) for _, is_equal in one.parts]
            duals[name] = joined([factor / unit for factor, unit in zip(factors, units, strict=True)])
            values[name] = joined([next(lefts) * unit for unit in units])
        primal, dual, gap = self._residuals(found)  # all solvers lack them
        outcome = "solved" if found.success else found.report.outcome
        report = replace(found.report, primal_residual=primal, dual_residual=dual, gap=gap, outcome=outcome)
        return PosedSolution(duals, values, report, found.cost, np.nan)

    def no_solution(self, solver: str, message: str) -> PosedSolution:
        """Return a solution of NaN after a failure of a solver, with its message."""
        none = {name: joined([np.nan] * len(one.parts)) for name, one in self.relations.items()}
        return PosedSolution(none, none, SolverReport(solver, "error", message=message), np.nan, np.nan)

    def _lefts(self, y: Array) -> list[float]:
        """Return the scalar parts of all relations in order at a scaled vector, in their units."""
        import casadi as ca

        parts = ca.vertcat(ca.SX(0, 1), *(left for one in self.relations.values() for left, _ in one.parts))
        numbers = ca.Function("values", [self.base.x, self.base.p], [parts])(y, self.parameters)
        return [float(one) for one in numbers.full().ravel()]

    def _residuals(self, found: Local) -> tuple[float, float, float]:
        """Return primal residual, relative dual residual and relative complementarity of a local solution.

        The gradient is relative to its largest term. For least squares, these are the products of rows and residuals.
        """
        import casadi as ca

        x, state, white = self.base.x, self.statement, self.base.white
        terms = 2.0 * ca.fabs(ca.jacobian(white, x)).T @ ca.fabs(white) if not self.own_objective else ca.SX(0)
        parts = [ca.gradient(state.f, x), ca.jacobian(state.g, x), state.equalities, state.inequalities, terms]
        rows = ca.Function("rows", [x, self.base.p], parts)(found.x, self.parameters)
        slope, turn, equal, more, size_of_terms = (one.full() for one in rows)
        multipliers = np.concatenate([found.equalities, found.inequalities])
        pull = turn.T @ multipliers if len(multipliers) else np.zeros(len(slope))
        size = 1.0 + max(np.abs(part).max(initial=0.0) for part in (slope, pull, size_of_terms))
        primal = max(np.abs(equal).max(initial=0.0), -np.minimum(more, 0.0).min(initial=0.0))
        gap = float(np.abs(found.inequalities * more.ravel()).sum()) / (1.0 + abs(found.cost))
        return float(primal), float(np.abs(slope.ravel() + pull + found.bounds).max() / size), gap

    def kinks(self) -> str:
        """Return a sentence about an objective of the user that is not smooth; "" for a smooth one."""
        kinks = _kinks_of(self.goal) if self.own_objective else []
        if not kinks:
            return ""
        return (
            f"your objective is not smooth, because it contains {' and '.join(kinks)}: pose it in a convex "
            "formulation, or use a smooth function such as sqrt(1 + residual**2)"
        )


def _kinks_of(expression: Any) -> list[str]:
    """Return the names of functions in an expression of CasADi that have no derivative everywhere."""
    import casadi as ca

    names = {
        ca.OP_FABS: "fabs",
        ca.OP_FMIN: "fmin",
        ca.OP_FMAX: "fmax",
        ca.OP_SIGN: "sign",
        ca.OP_FLOOR: "floor",
        ca.OP_CEIL: "ceil",
        ca.OP_IF_ELSE_ZERO: "if_else",
    }
    function = ca.Function("kinks", ca.symvar(expression), [expression])
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    return [name for code, name in names.items() if code in used]
