"""Posed convex problems: cvxpy relations in SI units, duals, and a bound that is recomputed from a dual point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Status
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_constraints import HalfSpace, as_convex
from optloc.solvers.posing.posed import Posed, Relation
from optloc.solvers.posing.statement import ConicStatement

# Difference, relative to the gradient, up to which a relation is linear in the position alone: rounding of the probe.
_ALONE = 1e-9
# Seed of the point at which gradients set the unit of a relation; arbitrary, so that the same relation has one unit.
_SEED = 20261130


class PosedConic(Posed):
    """A convex problem of cvxpy that a formulation poses; see `optloc.pose`.

    Parameters
    ----------
    stated : Problem
        Flat batch of one problem.
    formulation : str
        Name of the formulation.
    statement : ConicStatement
        The convex problem.
    """

    def __init__(self, stated: Problem, formulation: str, statement: ConicStatement) -> None:
        super().__init__(stated, formulation)
        self.statement, self.origin, self.unit = statement, statement.origin, statement.unit
        # The program that is solved has numbers of order one; `problem` has the same constraints and the cost itself.
        self._goal, self._size, self._constant = statement.program.objective.args[0], statement.size, statement.constant
        self._restate()
        for constraint in stated.constraints:
            self._take_over(constraint)

    def _take_over(self, constraint: Any) -> None:
        """Add a constraint of the problem to the relaxation; one that is not convex stays with the refinement."""
        try:
            relation = self._table_relation(constraint, constraint.name)
        except InvalidProblem:
            return
        before = self.relations.get(constraint.name)
        if before is not None:
            relation = replace(
                before, parts=(*before.parts, *relation.parts), divisor=(*before.divisor, *relation.divisor)
            )
        self._put(relation)

    # Parts.

    def of(self, name: str) -> Any:
        """Return the expression of a named part in SI units; see `Posed.of`."""
        if name in self.statement.parts:
            return self.statement.parts[name]
        why = self.statement.missing.get(name, f"the formulation {self.formulation!r} has no {name}")
        raise InvalidProblem(why, name, f"it has {', '.join(self.statement.parts)}")

    @property
    def bias(self) -> Mapping[str, Any]:
        """Return the expressions of all unknowns except the states of targets by name, SI units."""
        states = ("position", "velocity", "acceleration", "range", "direction")
        return {name: part for name, part in self.statement.parts.items() if name not in states}

    @property
    def residual(self) -> Any:
        """Return the residuals (m,) of the rows of the formulation as an expression, standard deviations."""
        if self.statement.residual is None:
            why = self.statement.missing.get(
                "residual", f"{self.formulation!r} fits its rows exactly and has no residual"
            )
            raise InvalidProblem(why, "residual", "use the formulation 'nls'")
        return self.statement.residual

    # Changes.

    def minimise(self, expression: Any) -> None:
        """Replace the objective by a convex expression of your own; see `Posed.minimise`."""
        import cvxpy as cp

        if isinstance(expression, cp.Minimize):
            expression = expression.args[0]
        if not isinstance(expression, cp.Expression) or expression.size != 1:
            raise InvalidProblem("the objective is not a scalar expression of cvxpy", "objective", "sum its entries")
        self._check_unknowns(expression, "objective")
        if not (expression.is_convex() and expression.is_dcp()):
            raise InvalidProblem(
                "the objective is not convex by cvxpy's rules",
                "objective",
                "use the formulation 'nls' or a convex atom",
            )
        size = float(self._units(expression)[0])
        self._goal, self._size, self._constant, self.own_objective = cp.sum(expression) / size, size, 0.0, True
        self._restate()

    def _check_unknowns(self, expression: Any, where: str) -> None:
        """Raise InvalidProblem if an expression contains no variable of the program."""
        own = {one.id for one in self.statement.program.variables()}
        if not own & {one.id for one in expression.variables()}:
            raise InvalidProblem("it has no unknown of this problem", where, "use posed.position or posed.of(name)")

    def _as_planes(self, constraint: Any, name: str) -> list[Band]:
        """Return planes that a linear relation of the position alone states; empty for any other relation."""
        import cvxpy as cp

        if not isinstance(constraint, cp.constraints.Inequality | cp.constraints.Equality):
            return []
        expression, position = constraint.expr, self.statement.parts.get("position")
        if position is None or not expression.is_affine() or expression.parameters():
            return []
        self._check_unknowns(expression, "constraint")
        with self._probe(expression, position):
            slope, place = self._gradient(expression), self._gradient(position)
            names = sorted(place.keys() | slope.keys(), key=lambda one: one.id)
            full = [np.concatenate([_rows_of(part, one, size) for one in names], axis=1) for part, size in
                    ((place, position.size), (slope, expression.size))]  # fmt: skip
            normal = np.linalg.lstsq(full[0].T, full[1].T, rcond=None)[0].T
            # a column of the lift and its transpose are one number, but two entries of a gradient
            if np.abs(normal @ full[0] - full[1]).max() > _ALONE * (1.0 + np.abs(full[1]).max()):
                return []
            offset = normal @ position.value - np.ravel(expression.value, order="F")
        equal = isinstance(constraint, cp.constraints.Equality)
        length = np.linalg.norm(normal, axis=1)
        if not (length > 0.0).all():
            return []
        lower = offset / length if equal else np.full(len(offset), -np.inf)
        return [
            Band("plane", np.asarray(low), np.asarray(up), direction, name)
            for low, up, direction in zip(lower, offset / length, normal / length[:, None], strict=True)
        ]

    def _relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation of cvxpy, divided by its own unit."""
        import cvxpy as cp

        kinds = cp.constraints
        if not isinstance(constraint, kinds.Constraint):
            raise InvalidProblem(
                f"{type(constraint).__name__} is no relation of cvxpy and no constraint of optloc.constraints",
                "constraint",
                "write a relation such as posed.position[0] <= 100",
            )
        for expression in constraint.args:
            if expression.variables():
                break
        self._check_unknowns(constraint, "constraint")
        if not constraint.is_dcp():
            raise InvalidProblem(
                f"the constraint {name!r} is not convex by cvxpy's rules", "constraint", "use the formulation 'nls'"
            )
        if isinstance(constraint, kinds.SOC | kinds.PSD):
            unit = float(np.max(np.concatenate([self._units(one) for one in constraint.args])))
            return Relation(
                name, (type(constraint)(*(one / unit for one in constraint.args)),), (np.array(unit),), True
            )
        if isinstance(constraint, kinds.Inequality | kinds.Equality):
            left, equal = constraint.expr, isinstance(constraint, kinds.Equality)
        elif isinstance(constraint, kinds.NonNeg | kinds.NonPos | kinds.Zero):
            sign = -1.0 if isinstance(constraint, kinds.NonNeg) else 1.0
            left, equal = sign * constraint.args[0], isinstance(constraint, kinds.Zero)
        else:
            return Relation(name, (constraint,), (np.array(1.0),), True)
        unit = self._units(left).reshape(left.shape, order="F")
        divided = cp.multiply(1.0 / unit, left)
        return Relation(name, (divided == 0.0 if equal else divided <= 0.0,), (unit,), True)

    def _table_relation(self, constraint: Any, name: str) -> Relation:
        """Return a constraint of the table as relations of cvxpy, divided by the unit of length."""
        import cvxpy as cp

        position, parts = self.of("position"), []
        for one in as_convex(self.stated, constraint):
            if isinstance(one, HalfSpace):
                left = (one.normal @ position - one.offset) / self.unit
                parts.append(left == 0.0 if one.equal else left <= 0.0)
            else:
                away = (position[: len(one.centre)] - one.centre) / self.unit
                parts.append(cp.norm(away) <= one.radius / self.unit)
        return Relation(name, tuple(parts), tuple(np.array(self.unit) for _ in parts), free=False)

    def _restate(self) -> None:
        """Write the program that is solved, and the problem with the cost itself, anew."""
        import cvxpy as cp

        rules = [*self.statement.program.constraints, *(part for one in self.relations.values() for part in one.parts)]
        self._program = cp.Problem(cp.Minimize(self._goal), rules)
        self.problem = cp.Problem(cp.Minimize(self._size * self._goal + self._constant), rules)

    # Units: the length of the gradient in the variables of the program, which are of order one.

    def _units(self, expression: Any) -> Array:
        """Return the lengths of the gradients of the entries of an expression, in column order; one where it is zero."""
        with self._probe(expression):
            slope = self._gradient(expression)
        total = np.zeros(expression.size)
        for part in slope.values():
            total += (part**2).sum(axis=1)
        unit = np.sqrt(total)
        return np.where(np.isfinite(unit) & (unit > 0.0), unit, 1.0)

    @staticmethod
    def _gradient(expression: Any) -> dict[Any, Array]:
        """Return the derivatives (entries, variable entries) of an expression by each variable; empty where undefined."""
        out = {}
        for one, matrix in expression.grad.items():
            if matrix is not None:
                dense = matrix.toarray() if hasattr(matrix, "toarray") else np.atleast_2d(matrix)
                out[one] = np.asarray(dense, dtype=float).reshape(one.size, expression.size).T
        return out

    @contextmanager
    def _probe(self, *expressions: Any) -> Iterator[None]:
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

    def solve(
        self,
        solver: str | None = None,
        settings: Mapping[str, Any] | None = None,
        *,
        start: Any = None,
        duals: Mapping[str, float | Array] | None = None,
        warm_start: bool | None = None,
        refine: bool | None = None,
    ) -> Fix:
        """Return the judged fix of the posed problem; see `Posed.solve`."""
        from formulations.conic_solvers import SOLVERS, solve_problem

        name = (solver or "CLARABEL").upper()
        warm = (start is not None or duals is not None) if warm_start is None else warm_start
        own = {**(self.statement.settings if name == "CLARABEL" and not self.own_objective else {}), **(settings or {})}
        takes = name in SOLVERS and SOLVERS[name].takes_start
        try:
            if warm and takes:
                self._warm(start)
            report = solve_problem(self._program, name, own, warm=warm)
        except ValueError as trouble:
            raise InvalidProblem(str(trouble), "solver", "see 'optloc list solvers'") from None
        if warm and not takes:
            text = f"{name} does not use start and duals, because it is an interior-point or simplex method"
            report = replace(report, message="; ".join(filter(None, [report.message, text])))
        solved = report.outcome in ("solved", "inaccurate") and self._has_values()
        answer = self._answer(report, solved)
        if not solved:
            return self._explain_failure(answer)
        return self._conclude(self.statement.read(), answer, refine)

    def _has_values(self) -> bool:
        """Return whether all variables of the program have finite values."""
        return all(one.value is not None and np.isfinite(one.value).all() for one in self._program.variables())

    def _warm(self, start: Any) -> None:
        """Give the variables the values of an earlier answer."""
        earlier = getattr(start, "posed", start)
        if isinstance(earlier, PosedAnswer):
            for one in self._program.variables():
                value = earlier.variables.get(one.name())
                if value is not None and np.shape(value) == one.shape:
                    one.value = one.project(value)

    def _answer(self, report: Any, solved: bool) -> PosedAnswer:
        """Return the answer with the report of a back end; its numbers are NaN without a solution."""
        duals: dict[str, float | Array] = {}
        values: dict[str, float | Array] = {}
        for name, one in self.relations.items():
            pairs = list(zip(one.parts, one.divisor, strict=True))
            duals[name] = _joined(
                [self._size * _dual(part) / unit if solved else np.nan * unit for part, unit in pairs]
            )
            values[name] = _joined([_value(part) * unit if solved else np.nan * unit for part, unit in pairs])
        value = float(self._size * self._goal.value + self._constant) if solved else np.nan
        return PosedAnswer(
            self.formulation,
            duals,
            values,
            report,
            value,
            self._bound() if solved else np.nan,
            self.statement.rank_ratio() if solved else np.nan,
            refined=False,
            variables={one.name(): np.array(one.value) for one in self._program.variables()} if solved else {},
        )

    def _bound(self) -> float:
        """Return a lower bound of the objective, recomputed from a dual point of Clarabel; NaN if there is none."""
        from formulations.backend import SolverError
        from formulations.conic import Relaxation

        kept = {one.id: one.value for one in self._program.variables()}
        try:
            relaxation = Relaxation(self._program, settings=dict(self.statement.settings))
            numbers = {one.name(): np.asarray(one.value) for one in self._program.parameters()}
            low = relaxation.solve(numbers).bound
        except (ValueError, SolverError, AttributeError, KeyError):  # a problem beyond second-order and PSD cones
            low = np.nan
        finally:
            for one in self._program.variables():
                one.value = kept[one.id]
        return float(self._size * low + self._constant) if np.isfinite(low) else np.nan

    def _explain_failure(self, answer: PosedAnswer) -> Fix:
        """Return a fix without an answer and its reason, from the outcome of the back end."""
        report = answer.backend
        if report.outcome == "infeasible":
            text = f"no point meets the posed problem{self._changes()} {self.statement.within}".rstrip()
            return self._failed(Status.INFEASIBLE, text, answer)
        if report.outcome == "unbounded":
            what = "your objective" if self.own_objective else "the objective"
            return self._failed(
                Status.NUMERICAL, f"{what} has no least value under these constraints: add limits", answer
            )
        return self._failed(Status.NUMERICAL, str(report), answer)


def _rows_of(slope: Mapping[Any, Array], one: Any, size: int) -> Array:
    """Return the derivatives (size, entries) by a variable; zeros if there are none."""
    return slope[one] if one in slope else np.zeros((size, one.size))


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


def _joined(values: Sequence[Array]) -> float | Array:
    """Return a single number as float, and several numbers as one vector or in their own shape."""
    if len(values) == 1:
        one = np.asarray(values[0])
        return float(one.ravel()[0]) if one.size == 1 else one
    return np.concatenate([np.ravel(one) for one in values])
