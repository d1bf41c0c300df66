"""A posed problem: what convex and nonlinear formulations have in common, from named parts to the judged fix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import AnyOf, Array, Band, Constraint, Fence, Polygon, Status
from optloc.linear.constraints import is_conjunctive
from optloc.problem.constraint_checks import check_constraints
from optloc.problem.fix import Fix
from optloc.problem.posed_answer import PosedAnswer
from optloc.problem.problem import Problem
from optloc.solvers.methods import Method
from optloc.solvers.pool import begin, in_parts, noting_place, pack
from optloc.solvers.posing.posed_problem import EXAMPLE, PosedProblem, Relation, StatedProgram
from optloc.solvers.solution import with_sources
from optloc.solvers.verdict.judge import failed_fixes, hide_open_epochs, verdict

_REFINEMENT = Method(("lsr", "certify"))
# With constraints, least squares from the posed solution alone may miss the minimum on their faces, or the minimum
# without them that shows a contradiction. So the solution competes with the starts of `optloc.solve`.
_CONSTRAINED = "auto"


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """The arguments of `Posed.solve`; `warm` is its argument `warm_start` or the default of this argument."""

    solver: str | None
    settings: Mapping[str, Any]
    start: Any
    duals: Mapping[str, float | Array] | None
    warm: bool
    refine: bool | None


class Posed(PosedProblem, ABC):
    """An optimisation problem that a formulation poses, to read, to change and to solve.

    Parameters
    ----------
    stated : Problem
        Flat batch of one problem.
    formulation : str
        Name of the formulation.
    program : StatedProgram
        Its optimisation problem, without the constraints of `stated`.
    origin, unit
        Scaled coordinates are ``(x - origin) / unit``, metres.
    """

    def __init__(self, stated: Problem, formulation: str, program: StatedProgram, origin: Array, unit: float) -> None:
        super().__init__(program)
        self.stated, self.formulation, self.origin, self.unit = stated, formulation, origin, unit
        # the alternatives of each union, one of which is among the relations
        self._unions: dict[str, list[Relation]] = {}
        # names of constraints and fences of the problem that the posed problem lacks; only the refinement obeys them
        self.dropped: list[str] = []

    # Parts in SI units.

    @abstractmethod
    def of(self, name: str) -> Any:
        """Return the expression of a named part, such as "position" or "clock", in SI units.

        Raises
        ------
        InvalidProblem
            If the formulation has no such unknown.
        """

    @property
    def position(self) -> Any:
        """Return the position (d,) of the first unknown target as an expression, metres."""
        return self.of("position")

    @property
    def velocity(self) -> Any:
        """Return the velocity (d,) of the first unknown target as an expression, metres per second."""
        return self.of("velocity")

    @property
    def clock(self) -> Any:
        """Return the clock offsets as an expression, SI units."""
        return self.of("clock")

    @property
    def range(self) -> Any:
        """Return the range to the reference station as an expression, metres."""
        return self.of("range")

    @property
    @abstractmethod
    def bias(self) -> Mapping[str, Any]:
        """Return the expressions of all unknowns except the states of targets by name, SI units."""

    @property
    @abstractmethod
    def residual(self) -> Any:
        """Return the residuals (m,) of the rows of the formulation as an expression, standard deviations."""

    def scaled(self, value: Any) -> Any:
        """Return a position (..., d) in scaled units, or a length as a multiple of the unit.

        Parameters
        ----------
        value : array, float or expression
            Metres. A value whose last axis has d entries is a position; every other value is a length.
        """
        return (value - self.origin) / self.unit if self._is_position(value) else value / self.unit

    def si(self, value: Any) -> Any:
        """Return a scaled position (..., d) or a scaled length in metres: the inverse of `scaled`."""
        return self.origin + self.unit * value if self._is_position(value) else self.unit * value

    def _is_position(self, value: Any) -> bool:
        """Return whether a value has the shape of a position: d entries in its last axis, or in a column of CasADi."""
        shape = tuple(getattr(value, "shape", np.shape(value)))
        shape = shape[:1] if len(shape) == 2 and shape[1] == 1 else shape
        return bool(shape) and shape[-1] == len(self.origin)

    # Changes.

    def add(self, constraint: Any, *, name: str | None = None) -> None:
        """Add a constraint in SI units, divided by its own unit.

        Parameters
        ----------
        constraint : relation, or constraint of `optloc.constraints`
            A relation of cvxpy or CasADi between expressions of this object, such as ``posed.position[0] <= 100``. A
            constraint of the table, and a linear relation of the position alone, hold for the fix too. Any other
            relation holds in the posed problem only.
        name : str, optional
            Name for `duals` and messages; for the table the names of its constraints by default.

        Raises
        ------
        InvalidProblem
            If it is no relation, has no unknown of this problem, is not convex, or has a name in use.
        """
        members = _table_members(constraint)
        if members is not None:
            self._add_table(members, name)
            return
        if isinstance(constraint, Fence) or (
            isinstance(constraint, tuple | list) and any(isinstance(one, Fence) for one in constraint)
        ):
            raise InvalidProblem(
                "a fence is a term of the cost and no constraint",
                "constraint",
                "give it to optloc.assemble, and pose that problem by 'nls'",
            )
        if isinstance(constraint, bool | np.bool_):
            raise InvalidProblem(
                "the relation has no unknown of this problem", "constraint", f"use expressions as in {EXAMPLE}"
            )
        free = self._new_name(name)
        planes, lengths = self._as_planes(constraint, free)
        if planes:
            self._add_table(planes, free)
            stored = self.relations[free]
            if len(stored.divisor) == len(lengths):  # duals and values are of the relation as it is written
                units = tuple(d * size for d, size in zip(stored.divisor, lengths, strict=True))
                self._program.relations[free] = replace(stored, divisor=units)
        else:
            self._put(self._program.relation(constraint, free))

    def _add_table(self, members: Sequence[Any], name: str | None) -> None:
        """Add constraints of the table to the `Problem` and to the posed problem; all get `name` if it is given."""
        named = [(one.name if name is None else name, one) for one in members]
        for label in dict.fromkeys(label for label, _ in named):
            self._new_name(label)
        for label, one in named:
            if not is_conjunctive(one) and sum(label == other for other, _ in named) > 1:
                raise InvalidProblem(f"{label!r} names a union and another constraint", "name", "add them one by one")
        kept = tuple(one if one.name == label else replace(one, name=label) for label, one in named)
        stated = replace(self.stated, constraints=(*self.stated.constraints, *kept))
        check_constraints(stated)
        found: dict[str, list[Relation]] = {}
        for label, one in named:
            found[label] = _together(found.get(label), self._table_relations(one, label))
        self.stated = stated
        for alternatives in found.values():
            self._put_one_of(alternatives)

    def _take_over(self) -> None:
        """Add the constraints of the problem; a constraint that the back end cannot state stays with the refinement."""
        for one in self.stated.constraints:
            before = self.relations.get(one.name)
            alone = before is not None and (one.name in self._unions or not is_conjunctive(one))
            label = self._counted(one.name, 2) if alone else one.name
            try:
                alternatives = self._table_relations(one, label)
            except InvalidProblem:
                if not self._keeps(one):
                    self.dropped.append(one.name)
                continue
            self._put_one_of(alternatives if before is None or alone else _together([before], alternatives))

    def _keeps(self, constraint: Constraint) -> bool:
        """Return whether the formulation itself keeps a constraint of the problem that its back end cannot state."""
        return False

    def _put_one_of(self, alternatives: Sequence[Relation]) -> None:
        """State the problem with the first of the alternatives of a constraint, and keep the others for the solve."""
        if len(alternatives) > 1:
            self._unions[alternatives[0].name] = list(alternatives)
        self._put(alternatives[0])

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
        """Return the judged fix of the posed problem; ``fix.posed`` has duals, values, bound and report.

        Parameters
        ----------
        solver : str, optional
            Name of the back end: by default "CLARABEL", or "ipopt" for a nonlinear program.
        settings : mapping, optional
            Settings of the back end by its names.
        start : Fix, array (size,) or (d,), optional
            First iterate: an earlier fix, a vector in the order of ``problem.layout``, or a position. Interior-point
            solvers of convex problems ignore it, and the message of the report says so.
        duals : mapping, optional
            Multipliers of an earlier answer, ``fix.posed.duals``.
        warm_start : bool, optional
            Whether the solver starts from `start` and `duals`; by default if one of them is given.
        refine : bool, optional
            Whether least squares refines and judges the solution. By default it does unless a constraint holds in the
            posed problem only, or the objective is your own.

        Returns
        -------
        Fix
            A solution that is not refined has the status `unrefined` and no covariance. A failed solve is a status.
            With constraints that hold for the fix too, the solution and the starts of `optloc.solve` compete in the
            refinement. If the back end finds no solution then, the reason says so, and the starts alone are refined.
        """
        warm = (start is not None or duals is not None) if warm_start is None else warm_start
        if not (solver is None or isinstance(solver, str)):
            raise InvalidProblem(f"{solver!r} is not the name of a solver", "solver", "see 'optloc list solvers'")
        if not (settings is None or isinstance(settings, Mapping)):
            raise InvalidProblem(
                f"{settings!r} is no dictionary", "settings", "give a dictionary, such as {'max_iter': 50}"
            )
        return self._solve(SolveRequest(solver, settings or {}, start, duals, warm, refine))

    @abstractmethod
    def _solve(self, request: SolveRequest) -> Fix:
        """Return the judged fix; see `solve`."""

    @abstractmethod
    def _as_planes(self, constraint: Any, name: str) -> tuple[list[Band], list[float]]:
        """Return planes that a linear relation of the position alone states, and the lengths of their normals.

        Both are empty for any other relation.
        """

    @abstractmethod
    def _table_relations(self, constraint: Any, name: str) -> list[Relation]:
        """Return a constraint of the table in the back end's language: alternatives, one of which holds.

        Raises
        ------
        InvalidProblem
            If the back end cannot state it.
        """

    # The fix.

    @property
    def free(self) -> list[str]:
        """Return the names of the constraints that hold in the posed problem only."""
        return [one.name for one in self.relations.values() if one.free]

    def _conclude(self, starts: Array, answer: PosedAnswer, refine: bool | None) -> Fix:
        """Return the fix from solutions `starts` (q, size), the best first."""
        wanted = not (self.free or self.own_objective) if refine is None else refine
        if not np.isfinite(starts[0]).all() and not (wanted and np.isfinite(starts).all(1).any()):
            return self._failed(Status.NUMERICAL, "the solution of the posed problem gives no position", answer)
        if not wanted:
            fix = _of_pool(self.stated, starts[:1], None)
            lost = f", without {_constraints(self.dropped)}" if self.dropped else ""
            reason = f"the optimum of the posed problem{self._changes()}{lost}, not refined"
            return _marked(fix, Status.UNREFINED, reason, replace(answer, refined=False))
        fix = _of_pool(self.stated, pack(starts[None])[0], self._refinement)
        answer = replace(answer, refined=True)
        if not (self.free or self.own_objective):
            return replace(fix, posed=answer)
        without = [f"the {_constraints(self.free)}"] if self.free else []
        without += ["your objective"] if self.own_objective else []
        reason = f"refined without {' and '.join(without)}"
        if not bool(fix.answered):
            return replace(fix, reason=with_reason(fix.reason, reason), posed=answer)
        first = Status.UNPROVEN if int(fix.code) in (Status.OK, Status.CURVED) else Status(int(fix.code))
        return _marked(fix, first, f"{reason}; {fix.reason[()]}".rstrip("; "), answer)

    @property
    def _refinement(self) -> Method:
        """Return the method that refines and judges solutions."""
        return Method.parse(_CONSTRAINED) if self.stated.constraints else _REFINEMENT

    def _without_solution(self, code: Status, reason: str, answer: PosedAnswer, refine: bool | None) -> Fix:
        """Return the fix after a back end found no solution, although it may exist.

        If all changes are constraints of the problem too, `optloc.solve` answers, and the reason names the failure.
        """
        if self.stated.constraints and refine is not False and not (self.free or self.own_objective):
            fix = _of_pool(self.stated, np.full((1, self.stated.layout.size), np.nan), self._refinement)
            # a contradiction or a run to infinity is an answer of `optloc.solve` too
            if int(fix.code) not in (Status.NUMERICAL, int(code)):
                failed = code == Status.NUMERICAL
                why = f"the posed problem has no solution by {answer.backend}" if failed else reason
                text = f"{why}; the starts are of the method 'auto'"
                return replace(fix, reason=with_reason(fix.reason, text), posed=replace(answer, refined=False))
        return self._failed(code, reason, answer)

    def _changes(self) -> str:
        """Return the changes of the posed problem as the end of a sentence."""
        what = [_constraints(self.relations)] if self.relations else []
        what += ["your objective"] if self.own_objective else []
        return f" with {' and '.join(what)}" if what else ""

    def _unbounded(self, answer: PosedAnswer) -> Fix:
        """Return the fix of an objective without a least value."""
        what = "your objective" if self.own_objective else "the objective"
        return self._failed(Status.NUMERICAL, f"{what} has no least value under these constraints: add limits", answer)

    def _failed(self, code: Status, reason: str, answer: PosedAnswer) -> Fix:
        """Return a fix without an answer."""
        fix = replace(with_sources(self.stated, failed_fixes(self.stated, reason)).reshape(()), marks=None)
        return _marked(fix, code, reason, replace(answer, refined=False))


def numbers_of_start(start: Any, sizes: Sequence[int]) -> Array:
    """Return a start as a vector; raise InvalidProblem if it is no vector of numbers, or has a wrong length.

    Parameters
    ----------
    start : Fix or array
        An earlier fix, or numbers.
    sizes : sequence of int
        Valid lengths; the length of a whole vector is first.
    """
    advice = "give a fix, a vector or a position"
    try:
        value = np.asarray(start.x if isinstance(start, Fix) else start, dtype=float).ravel()
    except (TypeError, ValueError):
        raise InvalidProblem("start is no vector of numbers", "start", advice) from None
    if len(value) not in sizes:
        raise InvalidProblem(f"start has {len(value)} numbers, not {sizes[0]}", "start", advice)
    return value


def _table_members(constraint: Any) -> list[Constraint] | None:
    """Return constraints of the table as a list; None for anything else."""
    kinds = Band | Polygon | AnyOf
    if isinstance(constraint, kinds):
        return [constraint]
    if isinstance(constraint, tuple | list) and constraint and all(isinstance(one, kinds) for one in constraint):
        return list(constraint)
    return None


def _together(before: Sequence[Relation] | None, more: list[Relation]) -> list[Relation]:
    """Return the alternatives `more` of a constraint, after a constraint of the same name, as one constraint.

    Both constraints have one alternative each if there is a constraint before.
    """
    if before is None:
        return more
    (first,), (second,) = before, more
    return [replace(first, parts=(*first.parts, *second.parts), divisor=(*first.divisor, *second.divisor))]


def _constraints(names: Collection[str]) -> str:
    """Return the word "constraint" or "constraints", and the names in quotation marks, joined by "and"."""
    quoted = " and ".join(f'"{name}"' for name in names)
    return f"constraint{'s' if len(names) > 1 else ''} {quoted}"


def with_reason(reason: Any, more: str) -> Array:
    """Return the reason of a fix, extended by a sentence, as an array without axes."""
    out = np.empty((), dtype=object)
    out[()] = f"{reason[()]}; {more}" if reason[()] else more
    return out


def _marked(fix: Fix, code: Status, reason: str, answer: PosedAnswer) -> Fix:
    """Return a single fix with another status, reason and posed answer; only an answer with a covariance keeps it."""
    text = np.empty((), dtype=object)
    text[()] = reason
    marks = np.asarray((0 if fix.marks is None else int(fix.marks)) | code.mark)
    return replace(fix, code=np.asarray(int(code), dtype=np.int8), marks=marks, reason=text, posed=answer)


def _of_pool(problem: Problem, starts: Array, method: Method | None) -> Fix:
    """Return the fix that a method reaches from starts (q, size) of a flat batch of one problem; None: the starts."""

    def work(some: Problem, part: slice) -> Fix:
        pool = begin(some, starts[None])
        with noting_place("the verdict"):
            return hide_open_epochs(verdict(some, pool if method is None else method(some, pool)))

    with np.errstate(all="ignore"):  # an overflow gets a status, so a warning would repeat it
        return with_sources(problem, in_parts(problem, work, 1, failed_fixes)).reshape(())
