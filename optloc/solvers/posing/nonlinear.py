"""Posed nonlinear programs: the maximum-likelihood problem of any `Problem` as expressions of CasADi.

Letters: `size` unknowns, d coordinates, m rows, q starts. X is the vector of unknowns in SI units, and y the scaled
vector, the variables of the program.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice, product
from typing import Any

import numpy as np

from formulations.nls import Local
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Status
from optloc.linear.symbolic import bounds, constrained
from optloc.linear.vectors import complete
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer, PosedSolution
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_constraints import members_of
from optloc.solvers.posing.nonlinear_program import NonlinearProgram
from optloc.solvers.posing.posed import Posed, SolveRequest, numbers_of_start
from optloc.solvers.posing.posed_problem import Relation
from optloc.solvers.scaled_program import ScaledProblem

# Most combinations of members of unions, each a program: a road of fifty pieces.
_MOST = 50
_STATES = ("position", "velocity", "acceleration")


class PosedProgram(Posed):
    """A nonlinear program of CasADi; see `optloc.pose`.

    Parameters
    ----------
    stated, formulation
        As in `Posed`.
    scaled_problem : ScaledProblem
        The program without constraints, with its own symbols; of block averages for a long run.
    """

    def __init__(self, stated: Problem, formulation: str, scaled_problem: ScaledProblem) -> None:
        self._own = scaled_problem
        self._nonlinear = NonlinearProgram(scaled_problem)
        super().__init__(stated, formulation, self._nonlinear, scaled_problem.shift, scaled_problem.length)
        self._take_over()

    # Parts.

    def of(self, name: str) -> Any:
        """Return the expression of a slot of the layout in SI units; see `Posed.of`.

        A slot that all epochs share is a column (q, 1), a slot of each epoch a matrix (epochs, q). "position" without a
        number is the position of the first unknown target.
        """
        import casadi as ca

        layout = self._own.problem.layout
        slots = (*layout.shared, *layout.local)
        numbered = [slot.name for slot in slots if slot.name.partition("[")[0] == name]
        if name == "clock" and not numbered:
            numbered = [slot.name for slot in slots if slot.name.partition("[")[0] == "emission"]
        if name == "range" and not numbered:
            raise InvalidProblem("a nonlinear program has no unknown range", "range", "write the distance of positions")
        slot, shared = layout.find(name if any(slot.name == name for slot in slots) else (numbered or [name])[0])
        if shared:
            return self._nonlinear.vector[slot.start : slot.start + slot.size]
        first, step = layout.n_shared + slot.start, layout.n_local
        rows = [self._nonlinear.vector[first + k * step : first + k * step + slot.size].T for k in range(layout.epochs)]
        return ca.vertcat(*rows)

    @property
    def bias(self) -> Mapping[str, Any]:
        """Return the expressions of all unknowns except the states of targets by name, SI units."""
        layout = self._own.problem.layout
        names = [slot.name for slot in (*layout.shared, *layout.local)]
        return {name: self.of(name) for name in names if name.partition("[")[0] not in _STATES}

    @property
    def residual(self) -> Any:
        """Return the residuals (m, 1) of the rows as an expression, standard deviations."""
        return self._nonlinear.base.white

    @property
    def bounds(self) -> dict[str, Array]:
        """Return lbx, ubx, lbg and ubg of `problem`."""
        return self._nonlinear.bounds

    @property
    def parameters(self) -> Array:
        """Return the numbers of the symbols p of `problem`."""
        return self._nonlinear.parameters

    @property
    def start(self) -> Array:
        """Return the scaled vector (size,) of the best closed-form start."""
        return self._nonlinear.start

    # Changes.

    def _as_planes(self, constraint: Any, name: str) -> tuple[list[Band], list[float]]:
        """Return planes that a linear relation of the position alone states, and the lengths of their normals."""
        import casadi as ca

        try:
            position = self.of("position")
        except InvalidProblem:
            return [], []
        if position.shape[1] != 1:
            return [], []
        slot = next(slot for slot in self._own.problem.layout.shared if slot.name.partition("[")[0] == "position")
        place = slice(slot.start, slot.start + slot.size)
        x, p = self._nonlinear.base.x, self._nonlinear.base.p
        y, others = x[place], ca.vertcat(x[: place.start], x[place.stop :], p)
        planes: list[Band] = []
        lengths: list[float] = []
        for left, equal in self._nonlinear.pairs(constraint):
            if ca.depends_on(left, others) or not ca.is_linear(left, y):
                return [], []
            slope, constant = ca.linear_coeff(left, y)
            normal = np.asarray(ca.DM(slope)).ravel() / self._own.unit[place]
            shift = float(ca.DM(constant)) - normal @ self._own.centre[place]
            length = float(np.linalg.norm(normal))
            if not length > 0.0:
                return [], []
            offset = np.asarray(-shift / length)
            lower = offset if equal else np.asarray(-np.inf)
            planes.append(Band("plane", lower, offset, normal / length, name, _target(slot.name)))
            lengths.append(length)
        return planes, lengths

    def _table_relations(self, constraint: Any, name: str) -> list[Relation]:
        """Return a constraint of the table as expressions of CasADi, in units of length; see `Posed`."""
        return [self._of_bands(bands, name) for bands in members_of(self.stated, constraint)]

    def _of_bands(self, bands: Sequence[Band], name: str) -> Relation:
        """Return a conjunction of bands as expressions of CasADi, in units of length."""
        parts: list[tuple[Any, bool]] = []
        divisor: list[Array] = []
        for band in bands:
            one = replace(self._own.problem, constraints=(band,))
            equal, more = constrained(one, self._nonlinear.vector, bounds(one), self.unit)
            unit = self.unit if _is_length(band) else 1.0
            # `constrained` states d >= 0
            parts += [(left, True) for left in equal] + [(-left, False) for left in more]
            divisor += [np.array(unit)] * (len(equal) + len(more))
        return Relation(name, tuple(parts), tuple(divisor), free=False)

    # The solution.

    def _solve(self, request: SolveRequest) -> Fix:
        """Return the judged fix; see `Posed.solve`."""
        name = (request.solver or "ipopt").lower()
        duals, own = (request.duals if request.warm else None), self._nonlinear
        with_start = request.warm and request.start is not None
        starts = self._vector_of(request.start)[None] if with_start else own.starts()
        ends: list[tuple[Local, tuple[Relation, ...]]] = []
        trouble = ""
        # one program for each member of the unions
        for members in islice(product(*self._unions.values()), _MOST):
            self._take_members(members)
            found, trouble = own.solve(starts, name, request.settings, duals)
            ends += [(one, members) for one in found]
        if not ends:
            return self._failed(Status.NUMERICAL, trouble, self._answer(own.no_solution(name, trouble), {}))
        ends.sort(key=lambda end: (not end[0].success, end[0].cost if np.isfinite(end[0].cost) else np.inf))
        best, members = ends[0]
        self._take_members(members)
        answer = self._answer(own.solution(best), {"x": best.x})
        if not best.success:
            return self._explain_failure(best, answer)
        x = np.stack([self._own.centre + self._own.unit * one.x for one, _ in ends if one.success])
        return self._conclude(self._whole(x), answer, request.refine)

    def _take_members(self, members: Sequence[Relation]) -> None:
        """State the problem with one member of each union."""
        for one in members:
            self._nonlinear.relations[one.name] = one
        if members:
            self._nonlinear.restate()

    def _answer(self, found: PosedSolution, variables: Mapping[str, Array]) -> PosedAnswer:
        """Return the answer with a solution and the values of its variables."""
        more: dict[str, Any] = {"formulation": self.formulation, "rank_ratio": np.nan, "variables": variables}
        return PosedAnswer(**found.by_name(), **more, refined=False)

    def _whole(self, x: Array) -> Array:
        """Return vectors (q, size) of the stated problem; the program of a long run has block averages only."""
        if self._own.problem.layout.size == self.stated.layout.size:
            return x
        return np.asarray(complete(self.stated, x[None, :, : self.stated.layout.n_shared])[0])

    def _vector_of(self, start: Any) -> Array:
        """Return a vector (size,) in SI units from an earlier fix, a vector or a position."""
        size, layout = self._own.program.n, self._own.problem.layout
        value = numbers_of_start(self._of_answer(start), (size, layout.n_shared, len(self.origin)))
        if len(value) == size:
            return value
        if len(value) == layout.n_shared:
            return np.asarray(complete(self._own.problem, value[None, None])[0, 0], dtype=float)
        out: Array = self._nonlinear.starts()[0].copy()
        slot = next(slot for slot in layout.shared if slot.name.partition("[")[0] == "position")
        out[slot.start : slot.start + slot.size] = value
        return out

    def _of_answer(self, start: Any) -> Any:
        """Return the vector of an earlier posed answer in SI units; any other start unchanged."""
        if isinstance(start, PosedAnswer) and "x" in start.variables:
            return self._own.centre + self._own.unit * start.variables["x"]
        return start

    def _explain_failure(self, found: Local, answer: PosedAnswer) -> Fix:
        """Return the fix after a failure and its reason, from the status of the solver."""
        status, outcome = found.status.lower(), found.report.outcome
        if outcome == "infeasible" or "restoration" in status:
            return self._failed(Status.INFEASIBLE, f"no point meets the posed problem{self._changes()}", answer)
        if outcome == "unbounded" or "diverging" in status:
            return self._unbounded(answer)
        if kinks := self._nonlinear.kinks():
            text = f"{answer.backend.backend}: {found.status}; {kinks}"
            return self._failed(Status.NUMERICAL, text, answer)
        code = Status.MAX_ITERATIONS if "iteration" in status else Status.NUMERICAL
        return self._failed(code, f"{answer.backend.backend}: {found.status}", answer)


def _is_length(band: Band) -> bool:
    """Return whether a band bounds a length, which a program divides by its unit."""
    from optloc.models.surfaces import SURFACES

    return SURFACES[band.kind].unit == "m"


def _target(slot: str) -> int:
    """Return the number of the target of a slot such as "position[1]"; 0 without a number."""
    number = slot.partition("[")[2].rstrip("]")
    return int(number) if number else 0
