"""Runs and Doppler shifts as posed problems: position, course, biases and rates lifted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from formulations.squared_range_conic import in_deviations
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.vectors import vectors
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_statement import ConicStatement, Locate, set_parameters, variable
from optloc.solvers.starts.doppler import limited_rows
from optloc.solvers.starts.registration import place_states, run_of, run_starts, steady_blocks
from optloc.solvers.starts.registration_windows import has_windows, windows_of

_REACH = 10.0  # greatest distance of a source without a known height, as in `formulations.doppler_sdp.doppler`
# Settings of Clarabel for the duals of runs. The method needs a start only, and keeps the default of 1e-8. With steps
# of 0.99 iterates are so near the boundary of the cones that the value has six digits.
_FINE = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-9, "max_step_fraction": 0.8}


def pose_registration(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the relaxation of a flat batch of one run, on its windows, with the price whose start fits best.

    The parameter "price" multiplies the mean squared distance from the array's centre, which is part of the objective.
    `locate` is not used.
    """
    from formulations.registration_sdp import (
        RegistrationWindows,
        largest_rank_ratio,
        registration,
        registration_problem,
    )

    steady = steady_blocks(problem)
    run = run_of(steady)
    given = next(windows_of(steady, run)) if run is not None and has_windows(steady, run) else None
    answers = () if given is None else registration(**given)
    if run is None or given is None or not answers:
        raise InvalidProblem(
            "this formulation needs two blocks of range differences of moving stations from one reference",
            "formulation",
            'use "nls"',
        )
    data = RegistrationWindows.of(
        *(given[name] for name in ("station", "z", "whiten", "sigma", "design", "mean", "time"))
    )
    (K, S, d), order, b = data.station.shape, data.power.shape[1] - 1, len(data.prior)
    change = _less_biases(data)
    program = registration_problem(K, S, d, order, b, change)
    set_parameters(program, {**data.parameters(), "price": answers[0].price * data.weight})
    every = {one.name(): one for one in program.variables()}
    shared, n = every["shared"], d * (order + 1)
    place, speed = _course(data, shared[0, 1 : 1 + n], d, order)
    parts = {"position": run.origin + run.length * place}
    if order:
        parts["velocity"] = run.length / run.duration * speed
    delta = run.length * data.bias(shared[0, 1 + n :])
    parts |= _by_slot(steady.layout, run.column, delta)

    def read() -> Array:
        target = shared.value[0, 1 : 1 + n]
        state, bias = data.place(target), data.bias(data.cost(target)[1])
        starts = place_states(steady, run, state[None, None], bias[None, None])
        return np.asarray(run_starts(problem, begin=lambda blocks: starts)[0])

    return ConicStatement(
        program=program,
        origin=run.origin + run.length * data.origin,
        unit=run.length * data.scale,
        parts=parts,
        residual=_window_residuals(data, every, change[-1, -1]),
        read=read,
        rank_ratio=lambda: largest_rank_ratio({name: one.value for name, one in every.items()}, K),
        settings=_FINE,
    )


def _less_biases(data: Any) -> Array:
    """Return the matrix (S, b + S) from biases, first range and remainders less their biases to range and remainders.

    The new remainders are in deviations of the noise. With the old remainders the cost would be a small difference of
    large numbers.
    """
    rows, b = data.design.shape
    fine = 1.0 / np.sqrt(np.einsum("kii->ki", data.gram).mean())
    change = np.zeros((1 + rows, b + 1 + rows))
    change[0, b], change[1:, :b], change[1:, b + 1 :] = 1.0, data.design, fine * np.eye(rows)
    return change


def _course(data: Any, target: Any, d: int, order: int) -> tuple[Any, Any]:
    """Return position at time zero and velocity of a scaled target (n,), as `RegistrationWindows.place` does."""
    place, speed = data.scale * target[:d], None
    if order:
        speed = data.scale / data.clock[1] * target[d:]
        place = place - data.clock[0] * speed
    return data.origin + place, speed


def _window_residuals(data: Any, every: Mapping[str, Any], fine: float) -> Any:
    """Return the whitened remainders of all windows less their biases, (K (S - 1),); `fine` is the unit of these."""
    import cvxpy as cp

    parts = []
    for k, gram in enumerate(data.gram):
        root = np.linalg.cholesky(gram).T
        parts.append(fine * root @ every[f"across {k}"][0, 1:])
    return cp.hstack(parts)


def _by_slot(layout: Layout, column: Array, values: Any) -> dict[str, Any]:
    """Return expressions of the shared unknowns whose columns are all in `column` (q,), from expressions (q,)."""
    places = {int(c): i for i, c in enumerate(column)}
    out = {}
    for slot in layout.shared:
        mine = range(slot.start, slot.start + slot.size)
        if all(c in places for c in mine):
            out[slot.name] = values[[places[c] for c in mine]]
    return out


def pose_doppler(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the last pass of the relaxation of a flat batch of one source at rest; `locate` is not used."""
    from formulations.conic import rank_ratio
    from formulations.doppler_sdp import DopplerScene, doppler_problem, settings_of

    rows = limited_rows(problem)
    if rows is None:
        raise InvalidProblem("no row measures a range rate", "formulation", 'use "nls"')
    surface, frame = rows.surface, problem.frame
    given = rows.given
    scene = DopplerScene.of(
        given["place"],
        given["speed"],
        given["z"],
        given["whiten"],
        given["ranges"],
        given["rates"],
        given["design"],
        surface,
    )
    far, size, answer = scene.last_pass(reach=_REACH)
    if not np.isfinite(answer.primal):
        raise InvalidProblem("the first pass of the relaxation has no solution", "formulation", 'use "nls"')
    change, gram, size = _whitened((scene.whiten @ (scene.rows / far[:, None])), size)
    program = doppler_problem(scene.shape, change)
    set_parameters(program, {**scene.parameters(far, _REACH)[0], "gram": gram})
    own, d = variable(program, "lift"), problem.dimension
    lift = change @ own @ change.T
    position, origin = scene.origin + scene.length * lift[0, 1 : 1 + d], scene.origin
    if surface is not None:
        turn = frame.rotation_to_ecef()
        position = turn.T @ (position - frame.origin_ecef())
        origin = np.asarray(frame.from_ecef(origin))

    def read() -> Array:
        points = scene.points(lift.value)
        points = points if surface is None else frame.from_ecef(points)
        return np.asarray(vectors(problem, points[None])[0])

    return ConicStatement(
        program=program,
        size=size,
        origin=origin,
        unit=scene.length,
        parts={"position": position, **_by_slot(problem.layout, rows.column, scene.unknown(lift))},
        residual=(scene.whiten @ (scene.rows / far[:, None])) @ lift[0],
        at_height=surface is not None,
        read=read,
        rank_ratio=lambda: rank_ratio(lift.value),
        settings=settings_of(),
    )


def _whitened(form: Array, size: float) -> tuple[Array, Array, float]:
    """Return a change of unknowns after which residuals are standard deviations, their products, and the unit of these.

    `form` (m, n) are the whitened rows in y, whose first entry is 1. Without the change, a cost of a few standard
    deviations would be below the rounding error of the squared ranges. `size` is the unit of these squares.
    """
    n = form.shape[1]
    change = np.eye(n)
    inner = in_deviations(form[:, 1:], -form[:, 0])
    change[1:, 1:], change[1:, 0] = inner[:, :-1], inner[:, -1]
    white = form @ change
    gram = white.T @ white
    own = float(np.abs(gram).max()) or size
    return change, gram / own, own
