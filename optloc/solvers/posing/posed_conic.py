"""Posed convex problems: cvxpy relations in SI units, duals, and a bound that is recomputed from a dual point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Constraint, Status
from optloc.linear.constraints import is_exact
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_constraints import HalfSpace, as_convex
from optloc.solvers.posing.convex_program import ConvexProgram
from optloc.solvers.posing.convex_statement import ConicStatement
from optloc.solvers.posing.posed import Posed, SolveRequest, numbers_of_start, with_reason
from optloc.solvers.posing.posed_problem import Relation

# Difference, relative to the gradient, up to which a relation is linear in the position alone: rounding of the probe.
_ALONE = 1e-9
# Difference of value and bound, relative to the value, from which an objective of the user counts as unbounded.
# Clarabel reports solutions of unbounded problems at 1e8 m, whose bounds are 1e8 times lower; bounds of other solutions
# agree to 1e-6.
_SLACK = 1e-2


class PosedConic(Posed):
    """A convex problem of cvxpy that a formulation poses; see `optloc.pose`.

    Parameters
    ----------
    stated, formulation
        As in `Posed`.
    statement : ConicStatement
        The convex problem.
    """

    def __init__(self, stated: Problem, formulation: str, statement: ConicStatement) -> None:
        self.statement = statement
        self._convex = ConvexProgram(statement.program, statement.size, statement.constant, statement.settings)
        super().__init__(stated, formulation, self._convex, statement.origin, statement.unit)
        self.dropped += [fence.name for fence in stated.fences]
        self._take_over()

    def _keeps(self, constraint: Constraint) -> bool:
        """Return whether the formulation itself keeps a constraint of the problem: an exact height."""
        return self.statement.at_height and getattr(constraint, "kind", "") == "height" and is_exact(constraint)

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

    def _as_planes(self, constraint: Any, name: str) -> tuple[list[Band], list[float]]:
        """Return planes that a linear relation of the position alone states, and the lengths of their normals."""
        import cvxpy as cp

        if not isinstance(constraint, cp.constraints.Inequality | cp.constraints.Equality):
            return [], []
        expression, position = constraint.expr, self.statement.parts.get("position")
        if position is None or not expression.is_affine() or expression.parameters():
            return [], []
        self._convex.check_unknowns(expression, "constraint")
        with self._convex.probe(expression, position):
            slope, place = self._convex.gradient(expression), self._convex.gradient(position)
            names = sorted(place.keys() | slope.keys(), key=lambda one: one.id)
            full = [np.concatenate([_rows_of(part, one, size) for one in names], axis=1) for part, size in
                    ((place, position.size), (slope, expression.size))]  # fmt: skip
            normal = np.linalg.lstsq(full[0].T, full[1].T, rcond=None)[0].T
            # a column of the lift and its transpose are one number, but two entries of a gradient
            if np.abs(normal @ full[0] - full[1]).max() > _ALONE * (1.0 + np.abs(full[1]).max()):
                return [], []
            offset = normal @ position.value - np.ravel(expression.value, order="F")
        equal = isinstance(constraint, cp.constraints.Equality)
        length = np.linalg.norm(normal, axis=1)
        if not (length > 0.0).all():
            return [], []
        lower = offset / length if equal else np.full(len(offset), -np.inf)
        planes = [
            Band("plane", np.asarray(low), np.asarray(up), direction, name)
            for low, up, direction in zip(lower, offset / length, normal / length[:, None], strict=True)
        ]
        return planes, length.tolist()

    def _table_relations(self, constraint: Any, name: str) -> list[Relation]:
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
        return [Relation(name, tuple(parts), tuple(np.array(self.unit) for _ in parts), free=False)]

    # The solution.

    def _solve(self, request: SolveRequest) -> Fix:
        """Return the judged fix; see `Posed.solve`."""
        unknown = [name for name in request.duals or {} if name not in self.relations]
        if unknown:
            raise InvalidProblem(f"there is no constraint {unknown[0]!r}", "duals", "use fix.posed.duals")
        earlier = getattr(request.start, "posed", request.start)
        if not (request.start is None or isinstance(earlier, PosedAnswer)):
            layout = self.stated.layout
            numbers_of_start(request.start, (layout.size, layout.n_shared, self.stated.dimension))
        first = earlier.variables if isinstance(earlier, PosedAnswer) else None
        found = self._convex.solution(request.solver, request.settings, warm=request.warm, start=first)
        solved = self._convex.has_solution(found.backend)
        answer = PosedAnswer(
            **found.by_name(),
            formulation=self.formulation,
            rank_ratio=self.statement.rank_ratio() if solved else np.nan,
            refined=False,
            variables=self._convex.variables() if solved else {},
        )
        if solved and self.own_objective and answer.bound < answer.value - _SLACK * (1.0 + abs(answer.value)):
            text = (
                f"your objective may have no least value: {answer.value:.3g} is above the bound {answer.bound:.3g}; "
                "add limits"
            )
            return self._failed(Status.NUMERICAL, text, answer)
        if solved:
            fix = self._conclude(self.statement.read(), answer, request.refine)
            if not (self.own_objective and self.statement.at_limit()):
                return fix
            text = f"the optimum of your objective is on the edge of the search, {self.statement.within}"
            return replace(fix, reason=with_reason(fix.reason, text))
        return self._explain_failure(answer, request.refine)

    def _explain_failure(self, answer: PosedAnswer, refine: bool | None) -> Fix:
        """Return the fix after a failure and its reason, from the outcome of the back end."""
        report = answer.backend
        if report.outcome == "infeasible":
            text = f"{self.statement.nowhere}{self._changes()} {self.statement.within}".rstrip()
            if self.statement.within:  # there may be points outside these limits, and the sentence names them
                return self._failed(Status.INFEASIBLE, text, answer)
            return self._without_solution(Status.INFEASIBLE, text, answer, refine)
        if report.outcome == "unbounded":
            return self._unbounded(answer)
        return self._without_solution(Status.NUMERICAL, str(report), answer, refine)


def _rows_of(slope: Mapping[Any, Array], one: Any, size: int) -> Array:
    """Return the derivatives (size, entries) by a variable; zeros if `slope` does not contain it."""
    return slope[one] if one in slope else np.zeros((size, one.size))
