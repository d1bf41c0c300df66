"""Prepared problems: everything that does not depend on the measurements is computed once, for many fixes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.errors import NUMERICAL, InvalidProblem
from optloc.base.short_form import HasShortForm
from optloc.base.types import Array
from optloc.engine.plan import Plan, plan_of
from optloc.problem.epochs import separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.methods import Method, shortcut
from optloc.solvers.planned import settle_by_plan
from optloc.solvers.single import PreparedFix, is_few, prepare_fix
from optloc.solvers.solution import solve, solve_in_stages
from optloc.solvers.verdict.judge import verdict


@dataclass(frozen=True, slots=True, repr=False)
class Prepared(HasShortForm):
    """A problem that is prepared to fix new measurements; see `prepare`.

    Parameters
    ----------
    problem : Problem
        The problem; its measurements do not matter.
    method : str
        As of `optloc.solve`.
    plan : Plan, optional
        The plan that fixes measurements; None if the stages of the method have to run.
    shape : tuple of int
        Batch axes of the problem without its measurements.
    count : int
        Number of rows.
    short : PreparedFix, optional
        Fixes a few sets of measurements on the short path; None if the path is not available.
    """

    problem: Problem
    method: str
    plan: Plan | None
    shape: tuple[int, ...]
    count: int
    short: PreparedFix | None

    def __call__(self, z: ArrayLike) -> Fix:
        """Return the fix of measurements, as `solve` does."""
        return self.solve(z)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the call that prepares the same problem in another process; workspaces are not copied."""
        return prepare, (self.problem, self.method)

    def solve(self, z: ArrayLike) -> Fix:
        """Return the fix of new measurements.

        Parameters
        ----------
        z : array (..., m)
            Measurements of all rows in the order of the problem, SI units and radians. A fix with a missing measurement
            (NaN) has the status "rejected".

        Returns
        -------
        Fix
            With the leading axes of z and of the problem.

        Raises
        ------
        InvalidProblem
            If z does not fit the rows of the problem.
        """
        values = np.asarray(z, dtype=float)
        shape = self._batch(values)
        if self.short is not None and is_few(shape):
            with suppress(*NUMERICAL):  # the stages report the item that fails
                fix = self.short(np.broadcast_to(values, (*shape, values.shape[-1])) if self.shape else values)
                if fix is not None:
                    return fix
        # without machine code at hand the stages of the method run
        if self.plan is None or not self.plan.at_hand(prod(shape)):
            wide = np.broadcast_to(values, (*shape, values.shape[-1]))
            return solve_in_stages(self.problem.with_rows(z=wide), Method.parse(self.method))
        flat = self._flat(values, shape)
        try:
            pool = settle_by_plan(self.plan, self.plan.load(flat), flat.z, flat.take)
            fix = verdict(flat, pool)
        except NUMERICAL:
            # one item fails, and the stages report which
            return solve(flat, self.method).reshape(shape)
        return fix if len(shape) == 1 else fix.reshape(shape)

    def _flat(self, z: Array, shape: tuple[int, ...]) -> Problem:
        """Return a flat batch of problems with measurements z (..., m); the answer has the batch axes `shape`."""
        # A problem without batch axes takes the axes of its measurements, so only the measurements are reshaped.
        if not self.shape:
            return self.problem.with_rows(z=np.broadcast_to(z, (*shape, z.shape[-1])).reshape(-1, z.shape[-1]))
        return self.problem.with_rows(z=np.broadcast_to(z, (*shape, z.shape[-1]))).flat()

    def _batch(self, z: Array) -> tuple[int, ...]:
        """Return the batch axes of the answer for measurements z; raise InvalidProblem if z does not fit the rows."""
        count = self.count
        if z.shape == (count,):
            return self.shape
        if z.ndim == 0 or z.shape[-1] != count:
            raise InvalidProblem(
                f"z has shape {z.shape}, and the problem has {count} rows",
                "z",
                f"give {count} values along its last axis",
            )
        try:
            return np.broadcast_shapes(z.shape[:-1], self.shape)
        except ValueError:
            raise InvalidProblem(
                f"z has batch axes {z.shape[:-1]}, and the problem has {self.shape}", "z", "give axes that broadcast"
            ) from None


def prepare(problem: Problem, method: str = "gtrs+lsr") -> Prepared:
    """Return a prepared problem that fixes new measurements of the same rows many times.

    All work that does not depend on the measurements is done once. With "gtrs+lsr" and "auto" a fix of one target at
    rest then takes some hundred microseconds, for rows of every kind. Every other problem and method works too, as fast
    as `optloc.solve`.

    Parameters
    ----------
    problem : Problem
        Batch axes (...); its measurements do not matter.
    method : str
        As of `optloc.solve`.

    Returns
    -------
    Prepared
        Call it with measurements (..., m).

    Raises
    ------
    InvalidProblem
        For an unknown method, or if nothing is unknown.
    """
    parsed = Method.parse(method)
    if problem.layout.size == 0:
        raise InvalidProblem("nothing is unknown: the motion of every target is known", "motions", "give a bias")
    # the prepared problem must not depend on measurements, so they are zero
    bare = problem.with_rows(z=np.zeros(problem.count))
    plan = short = None
    with suppress(*NUMERICAL):  # the stages report the item that fails
        plan = plan_of(bare) if shortcut(parsed) and not separable(bare) else None
        short = prepare_fix(bare, parsed)
    return Prepared(bare, method, plan, bare.batch_shape, bare.count, short)
