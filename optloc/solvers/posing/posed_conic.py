"""Posed convex problems: cvxpy relations in SI units, duals, and a bound that is recomputed from a dual point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Status
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_constraints import HalfSpace, as_convex
from optloc.solvers.posing.convex_program import ConvexProgram
from optloc.solvers.posing.convex_statement import ConicStatement, Relation
from optloc.solvers.posing.posed import Posed, numbers_of_start

# Difference, relative to the gradient, up to which a relation is linear in the position alone: rounding of the probe.
_ALONE = 1e-9


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
        self._convex = ConvexProgram(statement.program, statement.size, statement.constant, statement.settings)
        self.relations = self._convex.relations
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
        self._convex.minimise(expression)
        self._convex.settings, self.own_objective = {}, True
        self._restate()

    def _restate(self) -> None:
        """Rewrite `problem` after a change."""
        self._convex.restate()
        self.problem = self._convex.problem

    def _relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation of cvxpy, divided by its own unit."""
        return self._convex.relation(constraint, name)

    def _as_planes(self, constraint: Any, name: str) -> list[Band]:
        """Return planes that a linear relation of the position alone states; empty for any other relation."""
        import cvxpy as cp

        if not isinstance(constraint, cp.constraints.Inequality | cp.constraints.Equality):
            return []
        expression, position = constraint.expr, self.statement.parts.get("position")
        if position is None or not expression.is_affine() or expression.parameters():
            return []
        self._convex.check_unknowns(expression, "constraint")
        with self._convex.probe(expression, position):
            slope, place = self._convex.gradient(expression), self._convex.gradient(position)
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
        warm = (start is not None or duals is not None) if warm_start is None else warm_start
        earlier = getattr(start, "posed", start)
        if not (start is None or isinstance(earlier, PosedAnswer)):
            layout = self.stated.layout
            numbers_of_start(start, (layout.size, layout.n_shared, self.stated.dimension))
        first = earlier.variables if isinstance(earlier, PosedAnswer) else None
        report = self._convex.solve((solver or "CLARABEL").upper(), settings, warm=warm, start=first)
        solved = self._convex.has_solution(report)
        own_duals, values, cost = self._convex.results(solved=solved)
        answer = PosedAnswer(
            self.formulation,
            own_duals,
            values,
            report,
            cost,
            self._convex.bound() if solved else np.nan,
            self.statement.rank_ratio() if solved else np.nan,
            refined=False,
            variables=self._convex.variables() if solved else {},
        )
        if solved:
            return self._conclude(self.statement.read(), answer, refine)
        return self._explain_failure(answer, refine)

    def _explain_failure(self, answer: PosedAnswer, refine: bool | None) -> Fix:
        """Return the fix after a failure and its reason, from the outcome of the back end."""
        report = answer.backend
        if report.outcome == "infeasible":
            text = f"{self.statement.nowhere}{self._changes()} {self.statement.within}".rstrip()
            if self.statement.within:  # there may be points outside these limits, and the sentence names them
                return self._failed(Status.INFEASIBLE, text, answer)
            return self._without_solution(Status.INFEASIBLE, text, answer, refine)
        if report.outcome == "unbounded":
            what = "your objective" if self.own_objective else "the objective"
            return self._failed(
                Status.NUMERICAL, f"{what} has no least value under these constraints: add limits", answer
            )
        return self._without_solution(Status.NUMERICAL, str(report), answer, refine)


def _rows_of(slope: Mapping[Any, Array], one: Any, size: int) -> Array:
    """Return the derivatives (size, entries) by a variable; zeros if `slope` does not contain it."""
    return slope[one] if one in slope else np.zeros((size, one.size))
