"""A convex program of cvxpy that users change: relations in SI units, duals, and a recomputed bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.problem.posed_answer import PosedSolution
from optloc.solvers.posing.posed_problem import EXAMPLE, Relation, joined

# Seed of the point at which gradients set the unit of a relation; arbitrary, so that the same relation has one unit.
_SEED = 20261130
# Factors of the objective for further attempts of Clarabel if it finds no solution. Far from the data the cost is 1e8
# times the objective's size, and Clarabel takes the large duals for a proof that no point exists.
_SMALLER = (1e-3, 1e-6)
# Largest violation of a rule, in its unit of order one, at which a further attempt found a point.
_MET = 1e-5
# If Clarabel stops early with a larger residual than a limit, its factorisation may have lost its digits. The settings
# are for further attempts: the first as in `formulations.conic`, the second with shorter steps and refined directions.
_AGAIN: tuple[tuple[float, dict[str, float]], ...] = (
    (1e-7, {"static_regularization_constant": 1e-7}),
    (1e-6, {"max_step_fraction": 0.8, "iterative_refinement_max_iter": 50, "iterative_refinement_stop_ratio": 1.5}),
)


class ConvexProgram:
    """A minimisation of cvxpy with numbers of order one, to which relations are added.

    Parameters
    ----------
    program : cvxpy.Problem
        The minimisation; its parameters have values.
    size, constant : float
        The cost is ``size`` times the objective, plus ``constant``.
    settings : mapping of str to float
        Settings of Clarabel for the program without changes of its objective.
    example : str
        A relation between expressions of the program, for messages.
    instead : str
        Advice about relations and objectives that are not convex.

    Attributes
    ----------
    problem : cvxpy.Problem
        The same constraints, with the cost itself as objective.
    """

    def __init__(
        self,
        program: Any,
        size: float = 1.0,
        constant: float = 0.0,
        settings: Mapping[str, float] | None = None,
        *,
        example: str = EXAMPLE,
        instead: str = "use the formulation 'nls'",
    ) -> None:
        self.base, self.size, self.constant = program, size, constant
        self.settings: dict[str, float] = dict(settings or {})
        self.goal = program.objective.args[0]
        self.relations: dict[str, Relation] = {}
        self.own_objective = False
        self._example, self._instead = example, instead
        # duals are of the goal times this factor
        self._factor = 1.0
        self.restate()

    def restate(self) -> None:
        """Rewrite the program that is solved, and the problem with the cost itself, after a change."""
        import cvxpy as cp

        rules = [*self.base.constraints, *(part for one in self.relations.values() for part in one.parts)]
        self.program = cp.Problem(cp.Minimize(self.goal), rules)
        self.problem = cp.Problem(cp.Minimize(self.size * self.goal + self.constant), rules)

    def minimise(self, expression: Any) -> None:
        """Replace the objective by a scalar convex expression; raise InvalidProblem for any other expression."""
        import cvxpy as cp

        if isinstance(expression, cp.Minimize):
            expression = expression.args[0]
        if not isinstance(expression, cp.Expression) or expression.size != 1:
            raise InvalidProblem("the objective is not a scalar expression of cvxpy", "objective", "sum its entries")
        self.check_unknowns(expression, "objective")
        if not (expression.is_convex() and expression.is_dcp()):
            raise InvalidProblem(
                "the objective is not convex by cvxpy's rules", "objective", f"{self._instead} or a convex atom"
            )
        size = float(self.units(expression)[0])
        self.goal, self.size, self.constant = cp.sum(expression) / size, size, 0.0
        self.settings, self.own_objective = {}, True
        self.restate()

    def check_unknowns(self, expression: Any, where: str) -> None:
        """Raise InvalidProblem if an expression contains no variable of the program."""
        own = {one.id for one in self.base.variables()}
        if not own & {one.id for one in expression.variables()}:
            raise InvalidProblem("it has no unknown of this problem", where, f"use expressions as in {self._example}")

    def relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation of cvxpy, divided by its own unit."""
        import cvxpy as cp

        kinds = cp.constraints
        if not isinstance(constraint, kinds.Constraint):
            raise InvalidProblem(
                f"{type(constraint).__name__} is no relation of cvxpy and no constraint of optloc.constraints",
                "constraint",
                f"write a relation such as {self._example}",
            )
        self.check_unknowns(constraint, "constraint")
        if not constraint.is_dcp():
            raise InvalidProblem(f"the constraint {name!r} is not convex by cvxpy's rules", "constraint", self._instead)
        if isinstance(constraint, kinds.SOC | kinds.PSD):
            unit = np.asarray(np.max(np.concatenate([self.units(one) for one in constraint.args])))
            return Relation(name, (type(constraint)(*(one / float(unit) for one in constraint.args)),), (unit,), True)
        if isinstance(constraint, kinds.Inequality | kinds.Equality):
            left, equal = constraint.expr, isinstance(constraint, kinds.Equality)
        elif isinstance(constraint, kinds.NonNeg | kinds.NonPos | kinds.Zero):
            sign = -1.0 if isinstance(constraint, kinds.NonNeg) else 1.0
            left, equal = sign * constraint.args[0], isinstance(constraint, kinds.Zero)
        else:
            return Relation(name, (constraint,), (np.array(1.0),), True)
        unit = self.units(left).reshape(left.shape, order="F")
        divided = cp.multiply(1.0 / unit, left)
        return Relation(name, (divided == 0.0 if equal else divided <= 0.0,), (unit,), True)

    # Units: the length of the gradient in the variables of the program, which are of order one.

    def units(self, expression: Any) -> Array:
        """Return the lengths (entries,) of the gradients of an expression, in column order; one where it is zero."""
        with self.probe(expression):
            slope = self.gradient(expression)
        total = np.zeros(expression.size)
        for part in slope.values():
            total += (part**2).sum(axis=1)
        unit = np.sqrt(total)
        return np.where(np.isfinite(unit) & (unit > 0.0), unit, 1.0)

    @staticmethod
    def gradient(expression: Any) -> dict[Any, Array]:
        """Return the derivatives (entries, q) of an expression by each variable of q entries; empty where undefined."""
        out = {}
        for one, matrix in expression.grad.items():
            if matrix is not None:
                dense = matrix.toarray() if hasattr(matrix, "toarray") else np.atleast_2d(matrix)
                out[one] = np.asarray(dense, dtype=float).reshape(one.size, expression.size).T
        return out

    @contextmanager
    def probe(self, *expressions: Any) -> Iterator[None]:
        """Give all variables of expressions arbitrary values of order one, and restore their values at the end."""
        rng, before = np.random.default_rng(_SEED), {}
        every = {one.id: one for expression in expressions for one in expression.variables()}
        try:
            for one in every.values():
                before[one.id] = one.value
                one.value = one.project(rng.uniform(0.5, 1.5, one.shape))
            yield
        finally:
            for one in every.values():
                one.value = before.get(one.id)

    # The solution.

    def solve(self, solver: str, settings: Mapping[str, Any] | None, *, warm: bool, start: Any = None) -> Any:
        """Return the report of a solve, and write values and duals onto variables and relations.

        Parameters
        ----------
        solver : str
            Name of the solver in cvxpy.
        settings : mapping, optional
            Its settings, which replace the settings of the program.
        warm : bool
            Whether to start from an earlier solution. An interior-point solver ignores it and reports this in
            the message.
        start : mapping of str to array, optional
            Values of the variables by name.

        Returns
        -------
        formulations.solver_report.SolverReport
            The report; a failed solve is reported, not raised.

        Raises
        ------
        InvalidProblem
            If the solver is unknown, does not support the cones of the problem, or refuses a setting.
        """
        from formulations.conic_solvers import SOLVERS, solve_problem

        self._factor = 1.0
        takes = solver in SOLVERS and SOLVERS[solver].takes_start
        own = {**(self.settings if solver == "CLARABEL" else {}), **(settings or {})}
        for one in self.program.variables() if warm and takes else ():
            value = (start or {}).get(one.name())
            if value is not None and np.shape(value) == one.shape:
                one.value = one.project(value)
        try:
            report = solve_problem(self.program, solver, own, warm=warm)
            if solver == "CLARABEL":
                report = self._solve_again(report, own)
            if solver == "CLARABEL" and self.relations and report.outcome in ("failed", "infeasible"):
                report = self._solve_smaller(report, own)
        except ValueError as trouble:
            raise InvalidProblem(str(trouble), "solver", "see 'optloc list solvers'") from None
        if report.status == "error" and settings and self._is_caused_by_settings(solver):
            names = ", ".join(map(str, settings))
            plural = "s" if len(settings) > 1 else ""
            raise InvalidProblem(
                f"{solver} does not accept the setting{plural} {names}", "settings", "check names and values"
            )
        if warm and not takes:
            text = f"{solver} does not use start and duals, because it is an interior-point or simplex method"
            report = replace(report, message="; ".join(filter(None, [report.message, text])))
        return report

    def _solve_again(self, report: Any, settings: Mapping[str, Any]) -> Any:
        """Return the best report of Clarabel with further settings, or `report` if its residuals are small."""
        from formulations.conic_solvers import solve_problem

        best, used, last = report, settings, settings
        for limit, more in _AGAIN:
            if best.outcome not in ("failed", "inaccurate") or best.worst <= limit:
                break
            last = {**more, **settings}
            again = solve_problem(self.program, "CLARABEL", last)
            if again.worst <= best.worst or not np.isfinite(best.worst):
                best, used = again, last
        # the variables keep the values of the last solve
        return best if used is last else solve_problem(self.program, "CLARABEL", used)

    def _is_caused_by_settings(self, solver: str) -> bool:
        """Return whether a solver that raised an error raises none without the settings of the user."""
        from formulations.conic_solvers import solve_problem

        return bool(solve_problem(self.program, solver, {}).status != "error")

    def _solve_smaller(self, report: Any, settings: Mapping[str, Any]) -> Any:
        """Return the report of an attempt with a smaller objective, which has the same solution; or else `report`.

        A report that no point exists becomes a failure if a point is found without the objective.
        """
        import cvxpy as cp

        from formulations.conic_solvers import solve_problem

        for factor in _SMALLER:
            found = solve_problem(cp.Problem(cp.Minimize(factor * self.goal), self.program.constraints), "CLARABEL",
                                  settings)  # fmt: skip
            if found.outcome in ("solved", "inaccurate") and self._is_met():
                self._factor = factor
                return found
        if report.outcome == "infeasible":
            without = solve_problem(cp.Problem(cp.Minimize(0.0), self.program.constraints), "CLARABEL", settings)
            if without.outcome in ("solved", "inaccurate") and self._is_met():
                text = "it finds no point within the constraints, but there is a point; it is far from the data"
                report = replace(report, outcome="failed", message=text)
        # no value of an attempt that failed remains
        for one in self.program.variables():
            one.value = None
        return report

    def _is_met(self) -> bool:
        """Return whether the values of the variables meet the constraints, each in its unit of order one.

        A constraint of the position alone never contradicts a relaxation. The rules of the relaxation itself are tested
        only together with other relations, since far from the data their numbers are large.
        """
        free = any(one.free for one in self.relations.values())
        rules = self.program.constraints if free else [part for one in self.relations.values() for part in one.parts]
        return all(np.max(one.violation(), initial=0.0) <= _MET for one in rules)

    def solution(
        self, solver: str | None, settings: Mapping[str, Any] | None, *, warm: bool = False, start: Any = None
    ) -> PosedSolution:
        """Return duals, values, objective and bound of a solve; arguments as of `solve`, by default with Clarabel."""
        report = self.solve((solver or "CLARABEL").upper(), settings, warm=warm, start=start)
        solved = self.has_solution(report)
        duals, values, value = self.results(solved=solved)
        return PosedSolution(duals, values, report, value, self.bound() if solved else np.nan)

    def has_solution(self, report: Any) -> bool:
        """Return whether a report is of a solution, and all variables have finite values."""
        values = [one.value for one in self.program.variables()]
        finite = all(value is not None and np.isfinite(value).all() for value in values)
        return report.outcome in ("solved", "inaccurate") and finite

    def results(self, *, solved: bool) -> tuple[dict[str, float | Array], dict[str, float | Array], float]:
        """Return duals, values of relations in SI units and the cost; NaN without a solution."""
        duals: dict[str, float | Array] = {}
        values: dict[str, float | Array] = {}
        for name, one in self.relations.items():
            pairs = list(zip(one.parts, one.divisor, strict=True))
            duals[name] = joined(
                [self.size / self._factor * _dual(part) / unit if solved else np.nan * unit for part, unit in pairs]
            )
            values[name] = joined([_value(part) * unit if solved else np.nan * unit for part, unit in pairs])
        return duals, values, float(self.size * self.goal.value + self.constant) if solved else np.nan

    def variables(self) -> dict[str, Array]:
        """Return the values of the variables by name."""
        return {one.name(): np.array(one.value) for one in self.program.variables()}

    def bound(self) -> float:
        """Return a lower bound of the objective, recomputed from a dual point of Clarabel; NaN without a bound."""
        from formulations.backend import SolverError
        from formulations.conic import Relaxation

        kept = {one.id: one.value for one in self.program.variables()}
        try:
            relaxation = Relaxation(self.program, settings=dict(self.settings))
            numbers = {one.name(): np.asarray(one.value) for one in self.program.parameters()}
            low = relaxation.solve(numbers).bound
        except (ValueError, SolverError, AttributeError, KeyError):  # a problem beyond second-order and PSD cones
            low = np.nan
        finally:
            for one in self.program.variables():
                one.value = kept[one.id]
        return float(self.size * low + self.constant) if np.isfinite(low) else np.nan


def _dual(part: Any) -> Array:
    """Return the dual value of a relation; for a cone, the multiplier of its bound."""
    dual = part.dual_value
    if isinstance(dual, list | tuple):
        dual = dual[0]
    return np.asarray(np.nan if dual is None else dual, dtype=float)


def _value(part: Any) -> Array:
    """Return left side minus right side of a relation; for a cone, the length minus its bound."""
    import cvxpy as cp

    if isinstance(part, cp.constraints.SOC):
        return np.asarray(np.linalg.norm(np.atleast_2d(part.args[1].value), axis=-1 - part.axis) - part.args[0].value)
    if hasattr(part, "expr"):
        return np.asarray(part.expr.value, dtype=float)
    return np.asarray(part.args[0].value, dtype=float)
