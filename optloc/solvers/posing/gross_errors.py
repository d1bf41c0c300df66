"""A few gross errors as a posed problem: the last program of the stage "sparse"."""

from __future__ import annotations

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.problem.arrival_times import as_arrivals
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_statement import ConicStatement, Locate, set_parameters, variable
from optloc.solvers.starts.position import spread_of
from optloc.solvers.starts.sparse_rows import derivatives, deviations, lift_positions


def pose_sparse(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the program with gross errors of a flat batch of one problem of one position.

    The rows are linear at the point of the squared rows. `locate` gives this point if these rows do not determine it.
    The objective is chi-square plus twice the penalty.
    """
    from formulations.sparse_errors import settings_of, sparse_problem, sparse_program

    if not one_position(problem):
        raise InvalidProblem("gross errors are posed for one target at one position", "formulation", 'use "nls"')
    alone = problem_at_rest(problem)
    arrived = as_arrivals(alone)
    alone = alone if arrived is None else arrived.problem
    position, failed = lift_positions(alone, lambda part: locate(part).position)
    if failed[0]:
        raise InvalidProblem("the solver found no point at which the rows are linear", "formulation", 'use "nls"')
    x = vectors(alone, position[:, None])[:, 0]
    residual, jacobian = derivatives(alone, x)
    sigma = deviations(alone)
    white, right = jacobian[0] / sigma[0][:, None], residual[0] / sigma[0]
    used = np.asarray((white != 0.0).any(0))
    data = None if not used.any() else sparse_program(white[:, used], right)
    if data is None:
        raise InvalidProblem("the rows leave a direction of the position undetermined", "formulation", 'use "nls"')
    program = sparse_problem(*data.structure)
    set_parameters(program, data.values)
    z, error = variable(program, "y"), variable(program, "error")
    slot, _ = alone.layout.find("position")
    pick = np.zeros((slot.size, len(used)))
    pick[np.arange(slot.size), slot.start + np.arange(slot.size)] = 1.0
    pick = pick[:, used]
    start = x[0, slot.start : slot.start + slot.size] + pick @ data.centre
    centre, spread = spread_of(problem)

    def read() -> Array:
        return np.asarray(vectors(problem, (start + pick @ data.back @ z.value)[None, None])[0])

    return ConicStatement(
        program=program,
        size=2.0 * data.scale**2,
        origin=centre[0],
        unit=float(spread[0]),
        parts={"position": start + (pick @ data.back) @ z, "error": data.scale * error},
        residual=data.scale * (data.values["rows"] @ z - data.values["right"] - error),
        read=read,
        rank_ratio=lambda: np.nan,
        settings=settings_of(),
    )
