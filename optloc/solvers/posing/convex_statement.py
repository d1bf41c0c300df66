"""One problem as a formulation states it: a cvxpy problem, expressions in SI units, and functions that read it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

Locate = Callable[[Problem], Fix]
"""Maps a problem to its fix by the method "auto", for formulations that are posed around a fix."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConicStatement:
    """A convex formulation of one problem.

    Parameters
    ----------
    program : cvxpy.Problem
        A minimisation whose numbers are of order one. Its parameters have values.
    size, constant : float
        ``size`` times the objective of `program`, plus ``constant``, is the cost in its own unit, usually chi-square.
    origin : array (d,)
        Origin of the scaled coordinates, metres.
    unit : float
        Unit of length of the scaled coordinates, metres.
    parts : mapping of str to expression
        Expressions in SI units, such as "position" (d,), "velocity" (d,) or "clock" (q,).
    residual : expression, optional
        Residuals (m,) of the rows of the formulation, standard deviations.
    missing : mapping of str to str
        The reason why the formulation lacks a part that users may expect.
    read : callable
        Returns starting vectors (q, size) from the values of the variables, the point of the relaxation first.
    rank_ratio : callable
        Returns the distance of the solution from a point; near zero means exact.
    within : str
        Limits of the unknowns that the formulation adds, as the end of a sentence; "" without any.
    at_limit : callable
        Returns whether the solution is on these limits.
    at_height : bool
        Whether the formulation itself keeps the exact height of the problem.
    nowhere : str
        The sentence for a program without any point, before changes.
    settings : mapping of str to float
        Settings of Clarabel.
    """

    program: Any
    read: Callable[[], Array]
    rank_ratio: Callable[[], float]
    origin: Array
    unit: float
    size: float = 1.0
    constant: float = 0.0
    parts: Mapping[str, Any] = field(default_factory=dict)
    residual: Any = None
    missing: Mapping[str, str] = field(default_factory=dict)
    within: str = ""
    at_limit: Callable[[], bool] = lambda: False
    at_height: bool = False
    nowhere: str = "no point meets the posed problem"
    settings: Mapping[str, float] = field(default_factory=dict)


def set_parameters(program: Any, values: Mapping[str, Array]) -> None:
    """Give the parameters of a cvxpy problem their values by name; a missing name keeps its value."""
    for parameter in program.parameters():
        if parameter.name() in values:
            parameter.value = values[parameter.name()]


def variable(program: Any, name: str) -> Any:
    """Return the variable of a cvxpy problem with this name."""
    return next(one for one in program.variables() if one.name() == name)
