"""Ranges as posed problems: order-2 moments in a box, order-1 lift, and the lift on an ellipsoid of known height."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.models import MODELS
from optloc.models.primitives import WGS84_A
from optloc.problem.fix import Fix
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.solvers.certificates.relaxations import enclosed_ranges
from optloc.solvers.posing.convex_statement import ConicStatement, Locate, set_parameters, variable
from optloc.solvers.starts.position import height_sights, spread_of

# Positions are in the box of moments if their chi-square is at most this far above the chi-square of the fix. So a
# constraint may move the optimum by four standard deviations. A larger box is less tight.
_MARGIN = 16.0
# Distance from a side of the box, whose half-width is one, at which a solution is on it: above the error of Clarabel.
_EDGE = 1e-4
# Fraction of the step to the boundary of the cones that Clarabel takes. At its default, 0.99, iterates are so near the
# boundary that duals of moments, whose equalities depend on each other, are wrong by up to 2e-4.
_STEP = 0.8
# Tolerance of the gap of Clarabel for the order-1 lift. For range differences the objective may be 1e-3 of its size. At
# the tolerance of the baseline, 1e-9, duals are wrong by up to 3e-4.
_FINE = 1e-11


def pose_moments(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the moment relaxation of a flat batch of one problem, in the box of positions near its fix.

    `locate` maps the problem to its fix.
    """
    from formulations.conic import rank_ratio, tight
    from formulations.moment_sdp import moment_problem, moment_program, moments, settings_of

    about = enclosed_ranges(problem, locate(problem), _MARGIN)
    if isinstance(about, str) or about.box is None:
        why = about if isinstance(about, str) else "the rows do not bound the positions with a cost this low"
        raise InvalidProblem(why, "formulation", 'use "nls"')
    count, d = about.scaled.station.shape
    own, data = moments(count, d), moment_program(about.scaled, about.box, about.cost)
    program, box = moment_problem(count, d), about.box
    set_parameters(program, data.values)
    y = variable(program, "y")
    place, error = own.table[:, :, 0, 0], own.table[0, 0, 0]
    # (1, t, omega): the constant, the reference range, and the errors of the other ranges
    first = y[np.concatenate([[0, place[0, -1]], error[1:]])]

    def read() -> Array:
        x = box.centre + box.axes @ y.value[place[0, 1:-1]]
        return np.asarray(vectors(problem, (about.centre + about.size * x)[None, None])[0])

    centre = about.centre + about.size * box.centre
    half, middle = 0.5 * (box.high - box.low), 0.5 * (box.high + box.low)
    return ConicStatement(
        program=program,
        size=data.size,
        constant=about.loops,
        origin=about.centre,
        unit=about.size,
        parts={
            "position": centre + (about.size * box.axes) @ y[place[0, 1:-1]],
            "range": about.size * (middle + half * y[place[0, -1]]),
        },
        residual=data.white @ first,
        within=f"in the box of positions whose chi-square is at most {_MARGIN:g} above the chi-square of the fix",
        at_limit=lambda: bool((np.abs(y.value[place[0, 1:]]) >= 1.0 - _EDGE).any()),
        read=read,
        rank_ratio=lambda: rank_ratio(y.value[place]),
        settings={**settings_of(), **tight("CLARABEL", 1e-9, max_step_fraction=_STEP)},
    )


def pose_heights(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the lift on the ellipsoid for the widest three stations of a flat batch of one problem.

    The objective is a squared distance, m^2: the rows fit exactly, and it selects one of the points. `locate` is not
    used.
    """
    from formulations.conic import rank_ratio
    from formulations.range_height_conic import height_program, lifted_problem, settings_of

    given = height_sights(problem_at_rest(problem.straightened())) if one_position(problem) else None
    data = None if given is None else height_program(**given)
    if given is None or data is None:
        raise InvalidProblem(
            "this formulation needs three ranges with a common unknown, and a known height", "formulation", 'use "nls"'
        )
    program = lifted_problem()
    set_parameters(program, data.values)
    lift, frame = variable(program, "lift"), problem.frame
    turn = frame.rotation_to_ecef()
    # the position in the frame of the problem is linear in the first column of the lift
    places = turn.T @ (WGS84_A * data.places)
    shift = -turn.T @ frame.origin_ecef()

    def read() -> Array:
        x = frame.from_ecef(WGS84_A * (data.places @ lift.value[:, 0]))
        return np.asarray(vectors(problem, x[None, None])[0])

    return ConicStatement(
        program=program,
        size=data.size * WGS84_A**2,
        origin=np.asarray(frame.from_ecef(WGS84_A * given["near"])),
        unit=WGS84_A,
        parts={"position": shift + places @ lift[:, 0]},
        at_height=True,
        nowhere="no point of the known height fits the ranges exactly",
        read=read,
        rank_ratio=lambda: rank_ratio(lift.value),
        settings=settings_of(),
    )


def pose_lifted(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the order-1 lift of a flat batch of one problem whose rows are sums of ranges.

    `locate` maps the problem to its fix, near which the lift has its unknowns if the rows determine all ranges.
    """
    from formulations.conic import rank_ratio
    from formulations.lifted import lifted_data, lifted_problem, settings_of

    models = [MODELS[rows.kind] for rows in problem.rows]
    if not one_position(problem) or any(model.ranges is None or model.emission for model in models):
        raise InvalidProblem(
            "this formulation needs ranges or their differences of one position", "formulation", 'use "nls"'
        )
    centre, spread = spread_of(problem)
    origin, unit = centre[0], float(spread[0])
    alone = problem_at_rest(problem)
    rows, right = range_rows(alone, unit)
    place = np.broadcast_to(alone.stations.position, (1, *alone.stations.position.shape[-3:]))[0, 0]
    station = (place - origin) / unit
    values, _, _ = lifted_data(rows, right, station)
    count, d = station.shape
    change = _deviations_of_lift(rows, right, station, lambda: _scaled_fix(locate(problem), origin, unit))
    table = rows @ change[1 + d :]
    table[:, 0] -= right
    table = np.delete(table, np.s_[1 : 1 + d], axis=1)
    size = float(np.abs(table).max()) or 1.0
    program = lifted_problem(count, d, change)
    set_parameters(program, {**values, "gram": table.T @ table / size**2})
    lift = change @ variable(program, "lift") @ change.T

    def read() -> Array:
        return np.asarray(vectors(problem, (origin + unit * lift.value[0, 1 : 1 + d])[None, None])[0])

    return ConicStatement(
        program=program,
        size=size**2,
        origin=origin,
        unit=unit,
        parts={"position": origin + unit * lift[0, 1 : 1 + d], "range": unit * lift[0, 1 + d :]},
        residual=rows @ lift[0, 1 + d :] - right,
        read=read,
        rank_ratio=lambda: rank_ratio(lift.value),
        settings={**settings_of(), "tol_gap_abs": _FINE, "tol_gap_rel": _FINE, "max_step_fraction": _STEP},
    )


def _deviations_of_lift(
    rows: Array, right: Array, station: Array, fix: Callable[[], tuple[Array, Array] | None]
) -> Array:
    """Return the matrix from the unknowns of the lift to (1, x, r), in standard deviations where these are known.

    Otherwise a small cost would be below the rounding error of the squared ranges. `rows` and `right` are whitened.
    `station` (s, d) is in the unit of `rows`. `fix` returns position and square root of its covariance.

    If the rows determine all ranges, the lift is near the fix, and position and ranges are differences from it. For
    range differences the point of the lift is far from the fix, and the position keeps its unit.
    """
    from formulations.squared_range_conic import in_deviations

    count, d = station.shape
    change, inner = np.eye(1 + d + count), in_deviations(rows, right)
    change[1 + d :, 1 + d :], change[1 + d :, 0] = inner[:, :-1], inner[:, -1]
    near = fix() if np.linalg.matrix_rank(rows) == count else None
    if near is not None:
        x, root = near
        change[1 : 1 + d, 0], change[1 : 1 + d, 1 : 1 + d] = x, root
        change[1 + d :, 0] = np.linalg.norm(x - station, axis=1)
    return change


def _scaled_fix(fix: Fix, origin: Array, unit: float) -> tuple[Array, Array] | None:
    """Return position (d,) and triangular root (d, d) of its covariance in a unit; None without a covariance."""
    d = len(origin)
    x, cov = np.reshape(fix.position, (-1, d))[0], np.reshape(fix.cov, (-1, *fix.cov.shape[-2:]))[0, :d, :d]
    if not (np.isfinite(x).all() and np.isfinite(cov).all()):
        return None
    try:
        return (x - origin) / unit, np.linalg.cholesky(cov) / unit
    except np.linalg.LinAlgError:  # a constraint fixes a direction
        return None


def range_rows(one: Problem, scale: float) -> tuple[Array, Array]:
    """Return whitened rows K (m, s) and values z (m,) of one problem whose rows are sums of ranges.

    Parameters
    ----------
    one : Problem
        Flat batch of one problem.
    scale : float
        Unit of length, metres: K r = z for ranges r (s,) from the stations in this unit.
    """
    K, start = np.zeros((one.count, one.stations.count)), 0
    for rows in one.rows:
        ends = MODELS[rows.kind].ranges
        assert ends is not None
        for index, sign in zip((rows.a, rows.b), ends, strict=True):
            if sign:
                K[start + np.arange(rows.count), index] += sign
        start += rows.count
    # Values are in units of the scale, like the stations: whitening gives numbers of order one.
    stacked = np.concatenate([K, one.observed[0][:, None] / scale], axis=1)
    white = np.concatenate([w.apply(stacked[None])[0] for w in whiten(one.noise, one.weight)])
    return white[:, :-1] * scale, white[:, -1] * scale
