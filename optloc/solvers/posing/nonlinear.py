"""Posed nonlinear programs: the maximum-likelihood problem of any `Problem` as expressions of CasADi.

Letters: `size` unknowns, d coordinates, m rows, q starts. X is the vector of unknowns in SI units, and y the scaled
vector, the variables of the program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import islice, product
from typing import Any

import numpy as np

from formulations.nls import Local, NonlinearStatement, Program
from formulations.solver_report import SolverReport
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Status
from optloc.linear.symbolic import bounds, constrained
from optloc.linear.vectors import complete
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.solvers.methods import METHODS, Method
from optloc.solvers.posing.convex_constraints import members_of
from optloc.solvers.posing.convex_statement import Relation
from optloc.solvers.posing.posed import Posed, numbers_of_start, solver_name
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
# Most combinations of members of unions, each a program: a road of fifty pieces.
_MOST = 50
# Places around the start at which gradients set the unit of a relation: the gradient of a distance has none at its
# centre.
_SHIFTS = (0.0, 0.137, -0.211)
_STATES = ("position", "velocity", "acceleration")


class PosedProgram(Posed):
    """A nonlinear program of CasADi; see `optloc.pose`.

    Parameters
    ----------
    stated : Problem
        Flat batch of one problem.
    formulation : str
        Name of the formulation.
    scaled_problem : ScaledProblem
        The program without constraints, with its own symbols; of block averages for a long run.

    Attributes
    ----------
    bounds : dict
        lbx, ubx, lbg and ubg of `problem`.
    parameters : array
        Numbers of the symbols p.
    """

    def __init__(self, stated: Problem, formulation: str, scaled_problem: ScaledProblem) -> None:
        super().__init__(stated, formulation)
        self._own, self._program = scaled_problem, scaled_problem.program
        self.origin, self.unit = scaled_problem.shift, scaled_problem.length
        self._base = self._program.statement
        self._goal = self._base.f
        self.parameters = self._program.data(
            scaled_problem.z, scaled_problem.weight, scaled_problem.data, scaled_problem.prior
        )
        self._vector = self._base.x * scaled_problem.unit + scaled_problem.centre
        self._starts: Array | None = None
        self._unions: dict[str, list[Relation]] = {}
        self._restate()
        for constraint in stated.constraints:
            try:
                relation = self._table_relation(constraint, constraint.name)
            except InvalidProblem:  # a region that is no conjunction stays with the refinement
                self.dropped.append(constraint.name)
                continue
            self._put(relation)

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
            return self._vector[slot.start : slot.start + slot.size]
        first, step = layout.n_shared + slot.start, layout.n_local
        rows = [self._vector[first + k * step : first + k * step + slot.size].T for k in range(layout.epochs)]
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
        return self._base.white

    @property
    def bounds(self) -> dict[str, Array]:
        """Return lbx, ubx, lbg and ubg of `problem`."""
        equal, more = self._statement.equalities.shape[0], self._statement.inequalities.shape[0]
        free = np.full(self._program.n, np.inf)
        upper = np.concatenate([np.zeros(equal), np.full(more, np.inf)])
        return {"lbx": -free, "ubx": free, "lbg": np.zeros(equal + more), "ubg": upper}

    @property
    def start(self) -> Array:
        """Return the scaled vector (size,) of the best closed-form start."""
        return np.asarray((self._candidates()[0] - self._own.centre) / self._own.unit)

    def _candidates(self) -> Array:
        """Return starting vectors (q, size) in SI units, from closed forms, or else from a search."""
        if self._starts is None:
            problem = replace(self._own.problem, constraints=())
            found = Method.parse("gtrs")(problem, None).x[0]
            found = found[np.isfinite(found).all(1)]
            if not len(found):
                found = Method.parse(METHODS["searched"])(problem, None).x[0]
                found = found[np.isfinite(found).all(1)]
            if not len(found):
                found = self._own.centre[None].copy()
            self._starts = found
        return self._starts

    # Changes.

    def minimise(self, expression: Any) -> None:
        """Replace the objective by an expression of your own; see `Posed.minimise`."""
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
        self._goal, self.own_objective = goal, True
        self._restate()

    def _check_unknowns(self, expression: Any, where: str) -> None:
        """Raise InvalidProblem if an expression has no unknown of the program, or an unknown of another program."""
        import casadi as ca

        symbols = ca.symvar(expression)
        own = {one.element_hash() for one in ca.vertsplit(ca.vertcat(self._base.x, self._base.p))}
        if any(one.element_hash() not in own for one in symbols):
            raise InvalidProblem(
                "it has a symbol that is not of this problem", where, "use posed.position or posed.of(name)"
            )
        if not ca.depends_on(expression, self._base.x):
            raise InvalidProblem("it has no unknown of this problem", where, "use posed.position or posed.of(name)")

    def _pairs(self, constraint: Any) -> list[tuple[Any, bool]]:
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
                "write a relation such as posed.position[0] <= 100",
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

    def _as_planes(self, constraint: Any, name: str) -> tuple[list[Band], list[float]]:
        """Return planes that a linear relation of the position alone states, and the lengths of their normals."""
        import casadi as ca

        planes, lengths = [], []
        try:
            position = self.of("position")
        except InvalidProblem:
            return [], []
        if position.shape[1] != 1:
            return [], []
        layout = self._own.problem.layout
        slot = next(slot for slot in layout.shared if slot.name.partition("[")[0] == "position")
        y = self._base.x[slot.start : slot.start + slot.size]
        for left, equal in self._pairs(constraint):
            others = [self._base.x[i] for i in range(layout.size) if not slot.start <= i < slot.start + slot.size]
            if ca.depends_on(left, ca.vertcat(*others, self._base.p)) or not ca.is_linear(left, y):
                return [], []
            slope, constant = ca.linear_coeff(left, y)
            unit = self._own.unit[slot.start : slot.start + slot.size]
            normal = np.asarray(ca.DM(slope)).ravel() / unit
            shift = float(ca.DM(constant)) - normal @ self._own.centre[slot.start : slot.start + slot.size]
            length = float(np.linalg.norm(normal))
            if not length > 0.0:
                return [], []
            offset = np.asarray(-shift / length)
            lower = offset if equal else np.asarray(-np.inf)
            planes.append(Band("plane", lower, offset, normal / length, name, _target(slot.name)))
            lengths.append(length)
        return planes, lengths

    def _relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation of CasADi, divided by its own unit."""
        pairs = self._pairs(constraint)
        units = [self._unit_of(left) for left, _ in pairs]
        parts = tuple((left / unit, equal) for (left, equal), unit in zip(pairs, units, strict=True))
        return Relation(name, parts, tuple(np.array(unit) for unit in units), free=True)

    def _unit_of(self, left: Any) -> float:
        """Return the length of the gradient of an expression in scaled unknowns, the largest near the start; or one."""
        import casadi as ca

        slope = ca.Function("slope", [self._base.x, self._base.p], [ca.gradient(left, self._base.x)])
        lengths = [np.linalg.norm(slope(self.start + shift, self.parameters).full()) for shift in _SHIFTS]
        finite = [float(one) for one in lengths if np.isfinite(one) and one > 0.0]
        return max(finite, default=1.0)

    def _table_relation(self, constraint: Any, name: str) -> Relation:
        """Return a constraint of the table as expressions of CasADi, in units of length."""
        members = [self._of_bands(bands, name) for bands in members_of(self.stated, constraint)]
        if len(members) > 1:
            self._unions[name] = members
        return members[0]

    def _of_bands(self, bands: Sequence[Band], name: str) -> Relation:
        """Return a conjunction of bands as expressions of CasADi, in units of length."""
        parts: list[tuple[Any, bool]] = []
        divisor: list[Array] = []
        for band in bands:
            one = replace(self._own.problem, constraints=(band,))
            equal, more = constrained(one, self._vector, bounds(one), self.unit)
            unit = self.unit if _is_length(band) else 1.0
            # `constrained` states d >= 0
            parts += [(left, True) for left in equal] + [(-left, False) for left in more]
            divisor += [np.array(unit)] * (len(equal) + len(more))
        return Relation(name, tuple(parts), tuple(divisor), free=False)

    def _restate(self) -> None:
        """Rewrite the statement with the constraints and the objective."""
        import casadi as ca

        parts = [part for one in self.relations.values() for part in one.parts]
        equal, more = ([sign * left for left, is_equal in parts if is_equal is kind] for kind, sign in
                       ((True, 1.0), (False, -1.0)))  # fmt: skip
        self._statement: NonlinearStatement = replace(
            self._base,
            f=self._goal,
            equalities=ca.vertcat(ca.SX(0, 1), *equal),
            inequalities=ca.vertcat(ca.SX(0, 1), *more),
        )
        self.problem = {"x": self._base.x, "f": self._goal, "g": self._statement.g, "p": self._base.p}

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
        name = solver_name(solver, settings, "ipopt").lower()
        warm = (start is not None or duals is not None) if warm_start is None else warm_start
        own = {**(_SETTINGS if name == "ipopt" else {}), **(settings or {})}
        if warm and name == "ipopt" and duals is not None:
            own = {**_FROM_SOLUTION, **own}
        starts = self._candidates() if start is None or not warm else self._vector_of(start)[None]
        given = duals if warm else None
        ends: list[tuple[Local, tuple[Relation, ...]]] = []
        trouble = ""
        # one program for each member of the unions
        for members in islice(product(*self._unions.values()), _MOST):
            self._take_members(members)
            found, trouble = self._solve_from(starts, name, own, given)
            ends += [(one, members) for one in found]
        if not ends:
            return self._failed(Status.NUMERICAL, trouble, self._answer(None, name, trouble))
        ends.sort(key=lambda end: (not end[0].success, end[0].cost if np.isfinite(end[0].cost) else np.inf))
        best, members = ends[0]
        self._take_members(members)
        answer = self._answer(best, name, "")
        if not best.success:
            return self._explain_failure(best, answer)
        x = np.stack([self._own.centre + self._own.unit * one.x for one, _ in ends if one.success])
        return self._conclude(self._whole(x), answer, refine)

    def _take_members(self, members: Sequence[Relation]) -> None:
        """State the problem with one member of each union."""
        if members:
            self.relations.update({one.name: one for one in members})
            self._restate()

    def _solve_from(
        self, starts: Array, name: str, settings: Mapping[str, Any], duals: Mapping[str, float | Array] | None
    ) -> tuple[list[Local], str]:
        """Return the ends of the solver `name` from starts (q, size) in SI units, and the last error of the solver.

        `duals` are first multipliers; None for none.
        """
        import casadi as ca

        from formulations.backend import Choice, SolverError

        if not ca.has_nlpsol(name):  # without this question, CasADi would print all folders that it searches
            raise InvalidProblem(f"CasADi has no nonlinear solver {name!r}", "solver", "see 'optloc list solvers'")
        choice = None if name == "ipopt" else Choice("nonlinear", name, settings)
        try:
            program = Program.of(self._program, self._statement, choice=choice, settings=settings)
        except RuntimeError:  # CasADi raises no other type
            ours = {**_SETTINGS, **_FROM_SOLUTION}
            given = ", ".join(str(one) for one, value in settings.items() if one not in ours or value != ours[one])
            raise InvalidProblem(
                f"{name} does not accept the settings {given or 'of optloc'}", "settings", "check names and values"
            ) from None
        own, ends, failure = self._own, list[Local](), ""
        multipliers = None if duals is None else (np.zeros(program.n), self._multipliers(duals))
        for one in starts:
            y = (one - own.centre) / own.unit
            try:
                end = program.solve(y, own.z, own.weight, own.data, prior=own.prior, multipliers=multipliers)
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

    def _whole(self, x: Array) -> Array:
        """Return vectors (q, size) of the stated problem; the program of a long run has block averages only."""
        if self._own.problem.layout.size == self.stated.layout.size:
            return x
        return np.asarray(complete(self.stated, x[None, :, : self.stated.layout.n_shared])[0])

    def _vector_of(self, start: Any) -> Array:
        """Return a vector (size,) in SI units from an earlier fix, a vector or a position."""
        size, layout = self._program.n, self._own.problem.layout
        value = numbers_of_start(self._of_answer(start), (size, layout.n_shared, len(self.origin)))
        if len(value) == size:
            return value
        if len(value) == layout.n_shared:
            return np.asarray(complete(self._own.problem, value[None, None])[0, 0], dtype=float)
        out: Array = self._candidates()[0].copy()
        slot = next(slot for slot in layout.shared if slot.name.partition("[")[0] == "position")
        out[slot.start : slot.start + slot.size] = value
        return out

    def _of_answer(self, start: Any) -> Any:
        """Return the vector of an earlier posed answer in SI units; any other start unchanged."""
        if isinstance(start, PosedAnswer) and "x" in start.variables:
            return self._own.centre + self._own.unit * start.variables["x"]
        return start

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

    def _answer(self, found: Local | None, name: str, message: str) -> PosedAnswer:
        """Return the answer of a local solution, or an answer of NaN with a message."""
        duals: dict[str, float | Array] = {}
        values: dict[str, float | Array] = {}
        equal, more, i, j = *((np.zeros(0),) * 2 if found is None else (found.equalities, found.inequalities)), 0, 0
        at = None if found is None else self._evaluate(found.x)
        for label, one in self.relations.items():
            own, side = [], []
            for k, ((_, is_equal), unit) in enumerate(zip(one.parts, one.divisor, strict=True)):
                if found is None:
                    own.append(np.nan)
                elif is_equal:
                    own.append(equal[i] / float(unit))
                    i += 1
                else:
                    own.append(-more[j] / float(unit))
                    j += 1
                side.append(np.nan if at is None else at[label][k] * float(unit))
            duals[label], values[label] = _single(own), _single(side)
        report = _report(found, name, message, self._residuals)
        cost = np.nan if found is None else found.cost
        variables = {} if found is None else {"x": found.x}
        return PosedAnswer(
            self.formulation, duals, values, report, cost, np.nan, np.nan, refined=False, variables=variables
        )

    def _evaluate(self, y: Array) -> dict[str, Array]:
        """Return the values of the parts of all relations at a scaled vector, in their units."""
        import casadi as ca

        lefts = [left for one in self.relations.values() for left, _ in one.parts]
        if not lefts:
            return {}
        numbers = ca.Function("values", [self._base.x, self._base.p], [ca.vertcat(*lefts)])(y, self.parameters).full()
        cut = np.cumsum([len(one.parts) for one in self.relations.values()])[:-1]
        return dict(zip(self.relations, np.split(numbers.ravel(), cut), strict=True))

    def _residuals(self, found: Local) -> tuple[float, float, float]:
        """Return primal residual, relative dual residual and relative complementarity of a local solution.

        The gradient is relative to its largest term. For least squares, these are the products of rows and residuals.
        """
        import casadi as ca

        x, state, white = self._base.x, self._statement, self._base.white
        terms = 2.0 * ca.fabs(ca.jacobian(white, x)).T @ ca.fabs(white) if not self.own_objective else ca.SX(0)
        parts = [ca.gradient(state.f, x), ca.jacobian(state.g, x), state.equalities, state.inequalities, terms]
        rows = ca.Function("rows", [x, self._base.p], parts)(found.x, self.parameters)
        slope, turn, equal, more, size_of_terms = (one.full() for one in rows)
        multipliers = np.concatenate([found.equalities, found.inequalities])
        pull = turn.T @ multipliers if len(multipliers) else np.zeros(len(slope))
        size = 1.0 + max(np.abs(part).max(initial=0.0) for part in (slope, pull, size_of_terms))
        primal = max(np.abs(equal).max(initial=0.0), -np.minimum(more, 0.0).min(initial=0.0))
        gap = float(np.abs(found.inequalities * more.ravel()).sum()) / (1.0 + abs(found.cost))
        return float(primal), float(np.abs(slope.ravel() + pull + found.bounds).max() / size), gap

    def _kinks(self) -> str:
        """Return a sentence about an objective of the user that is not smooth; "" for a smooth one."""
        kinks = _kinks_of(self._goal) if self.own_objective else []
        if not kinks:
            return ""
        return (
            f"your objective is not smooth, because it contains {' and '.join(kinks)}: pose it in a convex "
            "formulation, or use a smooth function such as sqrt(1 + residual**2)"
        )

    def _explain_failure(self, found: Local, answer: PosedAnswer) -> Fix:
        """Return the fix after a failure and its reason, from the status of the solver."""
        status, outcome = found.status.lower(), found.report.outcome
        if outcome == "infeasible" or "restoration" in status:
            return self._failed(Status.INFEASIBLE, f"no point meets the posed problem{self._changes()}", answer)
        if outcome == "unbounded" or "diverging" in status:
            what = "your objective" if self.own_objective else "the objective"
            return self._failed(
                Status.NUMERICAL, f"{what} has no least value under these constraints: add limits", answer
            )
        if kinks := self._kinks():
            text = f"{answer.backend.backend}: {found.status}; {kinks}"
            return self._failed(Status.NUMERICAL, text, answer)
        code = Status.MAX_ITERATIONS if "iteration" in status else Status.NUMERICAL
        return self._failed(code, f"{answer.backend.backend}: {found.status}", answer)


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


def _report(
    found: Local | None, name: str, message: str, residuals: Callable[[Local], tuple[float, float, float]]
) -> SolverReport:
    """Return the solver's report of a local solution, with the residuals at its point, which all solvers lack."""
    if found is None:
        return SolverReport(name, "error", message=message)
    primal, dual, gap = residuals(found)
    outcome = "solved" if found.success else found.report.outcome
    return replace(found.report, primal_residual=primal, dual_residual=dual, gap=gap, outcome=outcome)


def _is_length(band: Band) -> bool:
    """Return whether a band bounds a length, which a program divides by its unit."""
    from optloc.models.surfaces import SURFACES

    return SURFACES[band.kind].unit == "m"


def _target(slot: str) -> int:
    """Return the number of the target of a slot such as "position[1]"; 0 without a number."""
    number = slot.partition("[")[2].rstrip("]")
    return int(number) if number else 0


def _single(values: list[float]) -> float | Array:
    """Return a single number as float, and several numbers as one vector."""
    return float(values[0]) if len(values) == 1 else np.array(values)
