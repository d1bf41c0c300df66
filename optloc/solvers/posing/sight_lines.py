"""Bearings as posed problems: unit directions in a semidefinite relaxation, and the largest ball inside cones."""

from __future__ import annotations

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_statement import ConicStatement, Locate, set_parameters, variable
from optloc.solvers.starts.angles import Bearings, bearings, complete_bearings, cones_of, sights

_NO_POSITION = (
    "the unknowns of this relaxation are unit vectors, and the position is not an expression of them; limit "
    "posed.of('direction'), or use the formulation 'nls'"
)
_NO_ANGLES = "angles are not convex in the position"
# Settings of Clarabel for directions. At the tolerance of the method, 1e-9, and with steps of 0.99 to the boundary of
# the cone, the value is up to 5e-6 above the optimum.
_FINE = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "max_step_fraction": 0.8}


def _seen(problem: Problem, formulation: str) -> Bearings:
    """Return the angles of a flat batch of one problem; raise InvalidProblem without azimuths of one position."""
    seen = bearings(problem_at_rest(problem.straightened())) if one_position(problem) else None
    if seen is None:
        kinds = " and ".join(dict.fromkeys(block.kind for block in problem.rows))
        raise InvalidProblem(
            f"{formulation!r} needs azimuths of one position, and the rows here are {kinds}", "formulation", 'use "nls"'
        )
    return seen


def pose_directions(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the chordal relaxation of a flat batch of one problem in space; `locate` is not used."""
    import cvxpy as cp

    from formulations.conic import rank_ratio
    from formulations.direction_sdp import chordal_program, direction_problem, settings_of

    seen = _seen(problem, "direction_sdp")
    complete = complete_bearings(seen)
    if not complete:
        raise InvalidProblem(
            "'direction_sdp' needs an azimuth and an elevation of two stations or more in space",
            "formulation",
            'use "nls"',
        )
    data = chordal_program(**sights(seen, *complete[0]))
    count = len(data.station)
    program = direction_problem(count)
    set_parameters(program, data.values)
    lift = variable(program, "lift")
    w = lift[0, 1:]
    matrix, base = data.change
    tangent = np.sqrt(data.weight[:, 1:]) * data.unit
    across = [tangent[:, k] @ np.diag(np.ones(count)) for k in range(2)]
    residual = cp.hstack([cp.multiply(across[k], w[1 + k :: 3]) for k in range(2)])

    def read() -> Array:
        point = data.read(lift.value)[0]
        return np.asarray(vectors(problem, seen.metres(point[None, None]))[0])

    return ConicStatement(
        program=program,
        constant=data.constant,
        origin=seen.centre[0],
        unit=float(seen.scale[0]),
        parts={"direction": cp.reshape(base + matrix @ w, (count, 3), order="C")},
        residual=residual,
        missing={"position": _NO_POSITION},
        read=read,
        rank_ratio=lambda: rank_ratio(data.lift_of_directions(lift.value)),
        settings={**settings_of(), **_FINE},
    )


def pose_minimax(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the last cone program of the smallest maximal angle of a flat batch of one problem; `locate` is not used.

    It maximises the radius of a ball inside cones whose half-angles are the smallest maximal angle. The objective is
    minus the radius, metres. The unit of length is the width of the widest cone at the fix.
    """
    from formulations.minimax_cone import ball_data, ball_problem, minimax, settings_of

    seen = _seen(problem, "minimax_cone")
    cones = cones_of(seen, 0)
    found = None if cones is None else minimax(*cones)
    if found is None or cones is None or not np.isfinite(found.level):
        raise InvalidProblem("no position is in front of two bearings or more", "formulation", 'use "nls"')
    ahead, station, scale = cones
    # In this unit the cones are about one wide at the fix, and the ball is inside them. In sizes of the array both are
    # so small that duals have three digits only.
    wide = max(found.level, 1.0) * np.max(scale * np.linalg.norm(found.point - station, axis=1))
    size, centre = min(float(wide), 1.0), found.point
    program = ball_problem(*ahead.shape)
    set_parameters(program, ball_data(ahead, (station - centre) / size, scale, found.level))
    point, unit = variable(program, "point"), float(seen.scale[0]) * size
    origin = seen.centre[0] + float(seen.scale[0]) * centre

    def read() -> Array:
        return np.asarray(vectors(problem, (origin + unit * point.value)[None, None])[0])

    return ConicStatement(
        program=program,
        size=unit,
        origin=origin,
        unit=unit,
        parts={"position": origin + unit * point, "radius": unit * variable(program, "radius")},
        missing={"residual": _NO_ANGLES},
        read=read,
        rank_ratio=lambda: np.nan,
        settings=settings_of(),
    )
