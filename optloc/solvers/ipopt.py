"""The stage "nlp": the maximum-likelihood problem as a nonlinear program for IPOPT, one problem at a time.

It checks the refinement by an independent solver. In a program, lengths are relative to the centre of the stations and
in units of their spread; y is the scaled vector, p the data of the program, z the measurements.
"""

from __future__ import annotations

import os
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from formulations.backend import Choice, SolverError, choice_for
from formulations.nls import Program
from optloc.base.cache import Cache
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Status
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import Face, conjunction, face_of, faces, is_conjunctive, on_face, restore, tangent_at
from optloc.linear.fences import fence_numbers, symbolic_cost
from optloc.linear.normal import decrement, prior_parts, step, with_station_noise
from optloc.linear.symbolic import bounds, constrained, parameters, residual
from optloc.linear.vectors import complete
from optloc.linear.walks import chain_at, state_columns, walks
from optloc.problem.fix import Stage
from optloc.problem.noise import whiten
from optloc.problem.problem import Problem
from optloc.solvers.inequalities import bound_pool, by_least_squares, without_broken
from optloc.solvers.pool import Pool, begin, offer
from optloc.solvers.stages import lsr
from optloc.solvers.starts.block_averages import average_blocks
from optloc.solvers.starts.position import is_registration_run, spread_of
from optloc.solvers.starts.registration import BLOCKS, group_alike
from optloc.solvers.verdict.judge import judge, surviving_candidates
from optloc.solvers.verdict.minima import settle

# "1": the C compiler of the system compiles programs; this takes seconds, for many fixes of one large structure
_COMPILE = "OPTLOC_COMPILE_NLP"


def nlp(problem: Problem, pool: Pool | None) -> Pool:
    """Return the minima that IPOPT reaches from all candidates of the pool before.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems.
    pool : Pool
        Starts.

    Returns
    -------
    Pool
        Settled. For a long run IPOPT solves block averages, and least squares refines the answers on all epochs.
    """
    if pool is None:
        raise InvalidProblem("nlp needs a start", "method", "give start= or a method such as 'gtrs+nlp'")
    began = perf_counter()
    # a program with thousands of rows is slow to build and to solve; the least squares after it use all epochs
    # with fewer than two epochs per block, nothing would be averaged
    if is_registration_run(problem) and problem.epochs >= 2 * BLOCKS:
        return lsr(problem, offer(problem, _of_blocks(problem, pool.x), pool, "nlp", began))
    # IPOPT gets one covariance, so station errors of an epoch become noise
    problem = with_station_noise(problem)
    x, shape = pool.x.copy(), pool.x.shape[:2]
    cost, code = np.full(shape, np.inf), np.full(shape, int(Status.NUMERICAL), dtype=np.int8)
    item, slot = pool.occupied
    # one by one: a program belongs to a structure and takes the numbers of each problem
    for i in np.unique(item):
        one = problem.take(np.array([i]))
        solver = _ScaledProblem(one)
        for j in slot[item == i]:
            x[i, j], cost[i, j], code[i, j] = solver.from_start(pool.x[i, j])
    face = np.zeros(shape, dtype=int)
    if len(item):
        part, points = problem.take(item), x[item, slot]
        face[item, slot] = face_of(part, points) if problem.constraints else 0
        code[item, slot] = _stationary(part, points, code[item, slot], face[item, slot])
    cost[code == Status.NUMERICAL] = np.inf  # for instance a start on a station
    weights = np.broadcast_to(problem.weight, (len(pool), problem.count))
    found = Pool(x, cost, code, face, weights, pool.dof, pool.stages, missing=pool.missing)
    # a program cannot contain a union; so each of its faces is an equality of one more program
    united = any(not is_conjunctive(constraint) for constraint in problem.constraints)
    found = bound_pool(problem, found, _on_face) if united else without_broken(problem, found)
    settled = settle(problem, found, Stage("nlp", f"{len(item)} programs", perf_counter() - began))
    return replace(settled, refined=False)  # not refined, so that a following "lsr" runs


# Most starts of programs on one face of the constraints: those of least cost after projection onto it.
_STARTS = 6


def _on_face(problem: Problem, start: Array, item: Array, face: Face) -> tuple[Array, Array, Array]:
    """Return x (M, size), cost (M,) and status (M,) of the minima on a face that IPOPT reaches from starts (M, size).

    `item` (M,) is the problem of each start. Faces at epochs along a course are left to least squares.
    """
    if any(level.epoch is not None for level in face):
        return by_least_squares(problem, start, item, face)
    part = problem.take(item)
    with np.errstate(all="ignore"):
        x = restore(part, face, start)
        cost = equations_at(part, np.where(np.isfinite(x), x, start)).cost
    ends, least, code = start.copy(), np.full(len(start), np.inf), np.full(len(start), int(Status.NUMERICAL))
    for i in np.unique(item):
        solver = _ScaledProblem(on_face(problem.take(np.array([i])), face))
        own = np.flatnonzero(item == i)
        for k in own[np.argsort(cost[own], kind="stable")][:_STARTS]:
            ends[k], least[k], code[k] = solver.from_start(x[k] if np.isfinite(x[k]).all() else start[k])
    number = faces(problem).index(face)
    code = _stationary(part, ends, code, np.full(len(ends), number))
    return ends, np.where(code == Status.NUMERICAL, np.inf, least), code


def _of_blocks(problem: Problem, x: Array) -> Array:
    """Return the answers (N, q, size) for the block averages of runs, started from candidates x (N, q, size).

    A run of many epochs is averaged to `BLOCKS` epochs, since a program with thousands of rows is slow. NaN in empty
    slots.
    """
    n, out = problem.layout.n_shared, np.full(x.shape, np.nan)
    for items in group_alike(problem):
        blocks = average_blocks(problem.take(items), BLOCKS)
        pool = nlp(blocks, begin(blocks, complete(blocks, x[items, :, :n])))
        found = surviving_candidates(pool, judge(blocks, pool))
        width = min(found.shape[1], x.shape[1])
        out[items, :width] = complete(problem.take(items), found[:, :width, :n])
    return out


def _stationary(problem: Problem, x: Array, code: Array, face: Array) -> Array:
    """Return status codes (M,) of points x (M, size): `ok` if the next Gauss-Newton step is shorter than 1e-5 sigma.

    `code` (M,) has the codes from the reports of IPOPT, which stay otherwise. `face` (M,) is the index of the face of
    each point.
    """
    sides, out = faces(problem) if problem.constraints else [()], np.array(code)
    for number in np.unique(face):
        items = np.flatnonzero(face == number)
        part, here = problem.take(items), x[items]
        with np.errstate(all="ignore"):
            along = tangent_at(part, sides[number], here) if sides[number] else None
            equations = equations_at(part, here, whiten(part.noise, part.weight))
            move, solvable = step(equations, np.zeros(len(here)), along)
            small = solvable & (np.abs(decrement(equations, move, problem.layout.n_shared)) < _STATIONARY)
        out[items[small]] = Status.OK
    return out


class _ScaledProblem:
    """One problem, scaled to order one, with the compiled program of its structure."""

    def __init__(self, problem: Problem) -> None:
        """Scale the problem, and find the program of its structure."""
        self.problem = problem
        shift, size = (value[0] for value in spread_of(problem))
        layout = problem.layout
        unit = np.concatenate(
            [_slot_units(layout.shared, size), np.tile(_slot_units(layout.local, size), layout.epochs)]
        )
        # Positions are relative to the centre of the stations, and lengths and speeds are in spreads of the stations.
        centre = np.zeros(layout.size)
        for found in (layout.shared, layout.local):
            for place in found:
                if place.name.partition("[")[0] == "position":
                    base = place.start + (0 if found is layout.shared else layout.n_shared)
                    step = layout.n_local or 1
                    for k in range(1 if found is layout.shared else layout.epochs):
                        centre[base + k * step : base + k * step + place.size] = shift
        self.unit, self.centre = unit, centre
        rows = parameters(problem)
        self.data = np.concatenate([unit, centre, rows, [size], bounds(problem), fence_numbers(problem)])
        self.program = _program(problem, len(self.data), len(rows))
        self.weight = _whitening(problem)
        # absent rows have weight zero, but zero times NaN is NaN
        self.z = np.where(problem.weight[0] > 0.0, problem.observed[0], 0.0)
        self.prior = _prior(problem, unit, centre)

    def from_start(self, start: Array) -> tuple[Array, float, int]:
        """Return vector (size,), cost and status of the minimum that IPOPT reaches from a start (size,)."""
        begin = (start - self.centre) / self.unit
        try:
            found = self.program.solve(begin, self.z, self.weight, self.data, prior=self.prior)
        except SolverError:  # only this candidate failed; `recording` has the message
            return start, np.inf, int(Status.NUMERICAL)
        code = (
            Status.OK if found.success else Status.MAX_ITERATIONS if "Iteration" in found.status else Status.NUMERICAL
        )
        return found.x * self.unit + self.centre, found.cost, int(code)


# Programs take up to a second to build, and some megabytes each: the cache limits the memory of studies of many
# layouts.
_PROGRAMS = Cache[Program](64)
# Most iterations of IPOPT: far more than a start near a minimum takes; a start that runs to infinity never ends.
_ITERATIONS = 200
# Squared length of the next Gauss-Newton step, in sigma, at a minimum: IPOPT reports some of these ends as unfinished.
_STATIONARY = 1e-10


def _program(problem: Problem, data: int, rows: int) -> Program:
    """Return the program of the structure of a problem, from a cache.

    `data` is the number of parameters of the program, of which `rows` belong to the measurements.
    """
    choice, compiled = choice_for("nonlinear"), os.environ.get(_COMPILE, "") == "1"
    s = problem.stations
    shapes = tuple(None if a is None else a.shape[-3:] for a in (s.position, s.velocity, s.axes))
    limits = tuple(
        (bool(np.all(b.lower == b.upper)), bool(np.isfinite(b.lower).all()), bool(np.isfinite(b.upper).all()))
        for b in conjunction(problem)
    )
    # everything that shapes the program, but none of its input numbers
    key = (problem.structure, data, shapes, limits, None if choice is None else choice.key, compiled)
    return _PROGRAMS.find(key, lambda: _build(problem, data, rows, choice, compiled))


def _build(problem: Problem, data: int, rows: int, choice: Choice | None, compiled: bool) -> Program:
    """Return a new program for a structure: `choice` is the solver, and `compiled` requests a C compiler.

    `data` and `rows` are as in `_program`.
    """
    n = problem.layout.size
    # The numbers p of a problem are n units, n centres, the numbers of the rows, the spread of the stations, the bounds
    # of the constraints, and the numbers of the fences.

    def scaled_residual(y: Any, p: Any, z: Any) -> list[Any]:
        return residual(problem, y * p[:n] + p[n : 2 * n], p[2 * n :], z)

    def limits_at(y: Any, p: Any) -> tuple[list[Any], list[Any]]:
        last = 2 * n + rows
        return constrained(problem, y * p[:n] + p[n : 2 * n], p[last + 1 :], p[last])

    def fence_cost(y: Any, p: Any) -> Any:
        return symbolic_cost(problem, y * p[:n] + p[n : 2 * n], p[data - len(fence_numbers(problem)) :])

    equal, more = ((lambda y, p, i=i: limits_at(y, p)[i]) if problem.constraints else None for i in (0, 1))
    return Program(
        n,
        problem.count,
        data,
        residual=scaled_residual,
        penalty=fence_cost if problem.fences else None,
        equalities=equal,
        inequalities=more,
        diagonal=_independent(problem),
        settings={"bound_relax_factor": 0.0, "max_iter": _ITERATIONS},  # by default IPOPT relaxes constraints by 1e-8
        choice=choice,
        compiled=compiled,
    )


def _slot_units(slots: Any, size: float) -> Array:
    """Return the units of all entries of slots, one array: `size` for lengths and their rates, else 1.

    `size` is the spread of the stations, metres.
    """
    # a unit that begins with m is metres, or metres per something
    units = [np.full(slot.size, size if slot.unit.startswith("m") else 1.0) for slot in slots]
    return np.concatenate([*units, np.zeros(0)])


def _independent(problem: Problem) -> bool:
    """Return whether all rows have independent errors, so that a diagonal of weights replaces the whitening matrix."""
    return all(block.row.shape[1] == 1 for block in problem.noise.blocks)


def _whitening(problem: Problem) -> Array:
    """Return the whitening matrix (m, m) of m rows, or the weights (m,) alone if errors are independent."""
    rows = problem.count
    matrix = np.zeros(rows if _independent(problem) else (rows, rows))
    for whitener in whiten(problem.noise, problem.weight):
        full = np.broadcast_to(whitener.matrix, (1, *whitener.row.shape, whitener.row.shape[1]))[0]
        if matrix.ndim == 1:
            matrix[whitener.row[:, 0]] = full[:, 0, 0]
            continue
        for members, block in zip(whitener.row, full, strict=True):
            matrix[np.ix_(members, members)] = block
    return matrix


def _add_walks(problem: Problem, mean: Array, information: Array) -> None:
    """Add the walks of biases to prior means (size,) and information (size, size): steps of a walk are zero on average.

    Both arrays are written.
    """
    layout = problem.layout
    chain = chain_at(problem, np.zeros((1, layout.size)))
    starts = layout.n_shared + layout.n_local * np.arange(layout.epochs)
    columns_of_epoch = starts[:, None] + np.arange(layout.n_local)
    information[columns_of_epoch[:, :, None], columns_of_epoch[:, None, :]] += chain.block
    information[columns_of_epoch[:-1, :, None], columns_of_epoch[1:, None, :]] += chain.link
    information[columns_of_epoch[1:, :, None], columns_of_epoch[:-1, None, :]] += chain.link.mT
    for bias in walks(problem):
        # a walk that stays at its prior mean costs nothing
        if bias.sigma is not None:
            place = starts[:, None] + state_columns(layout, bias)[:, 0]
            mean[place] = np.ravel(bias.mean)


def _prior(problem: Problem, unit: Array, centre: Array) -> tuple[Array, Array]:
    """Return the prior mean (size,) and the prior information (size, size) in scaled units.

    `unit` and `centre` (size,) are the unit and the origin of each scaled unknown.
    """
    layout = problem.layout
    mean, information = np.zeros(layout.size), np.zeros((layout.size, layout.size))
    for name, value, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        for k in range(1 if shared else layout.epochs):
            start = slot.start + (0 if shared else layout.n_shared + k * layout.n_local)
            part = slice(start, start + slot.size)
            mean[part] = value.reshape(-1, value.shape[-1])[0]
            information[part, part] = precision.reshape(-1, slot.size, slot.size)[0]
    if walks(problem):
        _add_walks(problem, mean, information)
    return (mean - centre) / unit, information * unit[:, None] * unit[None, :]
