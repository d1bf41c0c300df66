"""The part that all posed problems share: named constraints and an objective in the language of the back end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.short_form import HasShortForm
from optloc.base.types import Array

# The relation that messages show to users, unless a problem has other unknowns.
EXAMPLE = "posed.position[0] <= 100"


@dataclass(frozen=True, slots=True)
class Relation:
    """A named constraint of a posed problem, one entry for each scalar relation ``left - right <= 0`` or ``== 0``.

    Parameters
    ----------
    name : str
        Name for duals and messages.
    parts : tuple
        Relations in the language of the back end, normalised.
    divisor : tuple of array
        For each part, the numbers in SI units by which it is divided.
    free : bool
        Whether it holds in the posed problem only; else it is a constraint of the `Problem` too.
    """

    name: str
    parts: tuple[Any, ...]
    divisor: tuple[Array, ...]
    free: bool


class StatedProgram(Protocol):
    """A program in the language of its back end, to which relations are added.

    Attributes
    ----------
    problem
        The optimisation problem itself.
    relations : dict of str to Relation
        The added constraints by name.
    own_objective : bool
        Whether the objective is an expression of the user.
    """

    problem: Any
    relations: dict[str, Relation]
    own_objective: bool

    def relation(self, constraint: Any, name: str) -> Relation:
        """Return a relation, divided by its own unit; raise InvalidProblem for anything else."""

    def minimise(self, expression: Any) -> None:
        """Replace the objective; raise InvalidProblem for an expression that is no objective."""

    def restate(self) -> None:
        """Rewrite `problem` after a change of the relations."""


class PosedProblem(HasShortForm):
    """An optimisation problem to read and to change.

    Parameters
    ----------
    program : StatedProgram
        The problem in the language of its back end.
    """

    def __init__(self, program: StatedProgram) -> None:
        self._program = program

    @property
    def problem(self) -> Any:
        """Return the optimisation problem itself.

        It is a ``cvxpy.Problem`` whose parameters have values, or for a nonlinear program a dictionary of
        ``casadi.SX`` with the keys x, f, g and p.
        """
        return self._program.problem

    @property
    def relations(self) -> Mapping[str, Relation]:
        """Return the constraints by name."""
        return self._program.relations

    @property
    def own_objective(self) -> bool:
        """Return whether the objective is an expression of your own."""
        return self._program.own_objective

    def add(self, constraint: Any, *, name: str | None = None) -> None:
        """Add a constraint, divided by its own unit.

        Parameters
        ----------
        constraint : relation
            A relation of cvxpy or CasADi between expressions of this object.
        name : str, optional
            Name for `duals` and messages.

        Raises
        ------
        InvalidProblem
            If it is no relation, has no unknown of this problem, is not convex, or has a name in use.
        """
        self._put(self._program.relation(constraint, self._new_name(name)))

    def minimise(self, expression: Any) -> None:
        """Replace the objective by an expression of your own, in your unit.

        Parameters
        ----------
        expression : expression
            A scalar expression of cvxpy or CasADi.

        Raises
        ------
        InvalidProblem
            If it is not a scalar, has no unknown of this problem, or is not convex in a convex formulation.
        """
        self._program.minimise(expression)

    def _new_name(self, name: str | None) -> str:
        """Return a name for a constraint, by default a counted one; raise InvalidProblem if it is in use."""
        if name is None:
            return self._counted("constraint", 1)
        if not isinstance(name, str):
            raise InvalidProblem(f"the name {name!r} is no text", "name", "give a text such as 'fence'")
        if name in self.relations:
            raise InvalidProblem(f"there is already a constraint {name!r}", "name", "give each constraint its own name")
        return name

    def _counted(self, stem: str, first: int) -> str:
        """Return the first of "stem 1", "stem 2" and so on, from the number `first`, that is not in use."""
        numbers = range(first, first + 1 + len(self.relations))
        return next(text for i in numbers if (text := f"{stem} {i}") not in self.relations)

    def _put(self, relation: Relation) -> None:
        """Store a relation and state the problem with it."""
        self._program.relations[relation.name] = relation
        self._program.restate()


def joined(values: Sequence[Array | float]) -> float | Array:
    """Return a single number as float, and several numbers as one vector or in their own shape."""
    if len(values) == 1:
        one = np.asarray(values[0])
        return float(one.ravel()[0]) if one.size == 1 else one
    return np.concatenate([np.zeros(0), *(np.ravel(one) for one in values)])
