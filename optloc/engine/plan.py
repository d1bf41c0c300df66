"""Plans: the structure of a problem as arrays for the compiled engine.

A plan is made once and cached; measurements and station positions are arguments of a run. A plan serves one target at
rest, with rows of every kind and with other unknowns. The problems of a batch may differ in measurements, and in
positions and velocities of stations.

Letters: N problems, m rows, s station positions with rows, d coordinates. A *narrow block* of machine code computes one
problem at a time, a *wide block* many.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.frames import Frame
from optloc.base.threads import map_on_threads
from optloc.base.types import Array, Band
from optloc.engine.admission import admission_of, levels_of
from optloc.engine.draw import draw_ranges, draw_tapes
from optloc.engine.fixes import fix_one_by_ranges, fix_one_by_tapes, fix_ranges, fix_tapes
from optloc.engine.memory import (
    GRADIENT,
    KAPPA_FAR,
    Answer,
    EngineModel,
)
from optloc.engine.tapes import TapeRows
from optloc.kernels.jit import enabled, is_in_use, may_use_code
from optloc.linear.constraints import exact, face_names, is_exact
from optloc.linear.normal import depends_on_place
from optloc.linear.redundancy import degrees_of_freedom
from optloc.linear.walks import walks
from optloc.models import MODELS
from optloc.problem.layout import Layout
from optloc.problem.problem import Problem

# Greatest number of rows, and of epochs with emission times, for which dense maps are fast: their cost grows with the
# square.
MOST = 64
# Greatest number of unknowns for which systems are solved in lanes.
_UNKNOWNS = 40

TOLERANCE, LIMIT = 1e-7, 100
"""Tolerance and greatest number of steps of the refinement of the method "lsr"."""


@dataclass(frozen=True, slots=True)
class Plan:
    """All data that fixes of one structure need, except measurements and stations.

    Parameters
    ----------
    layout : Layout
        Layout of the unknowns; the position is the first.
    frame : Frame
        Frame of the positions.
    weight : array (m,)
        Weights of the rows.
    dof : int
        Degrees of freedom.
    node : int array (2, s)
        Epoch and station number of each station position that has rows; the epoch is 0 if stations do not move.
    model : EngineModel
        Maps from measurements to a start.
    rows : callable
        Returns the rows for the evaluator, from one problem without batch axes or from a flat batch.
    ranged : bool
        Whether all rows are sums of ranges, and emission times are the only other unknowns.
    size, shared : int
        Number of all unknowns, and of the unknowns that all epochs share.
    widths : tuple of int
        Arguments of `blank_answer` after the number of problems.
    held : tuple of str
        Names of the exact constraints.
    """

    layout: Layout
    frame: Frame
    weight: Array
    dof: int
    node: Array
    model: EngineModel
    rows: Callable[[Problem], Any]
    ranged: bool
    size: int
    shared: int
    widths: tuple[int, ...]
    held: tuple[str, ...]

    def load(self, problem: Problem) -> Load:
        """Return the data of problems of this structure: of one problem without batch axes, or of a flat batch."""
        model, admission = self.model, self.model.admission
        if admission.level.shape[1]:
            model = model._replace(admission=admission._replace(level=levels_of(problem)))
        return Load(model, self.rows(problem), self._places(problem))

    def _places(self, problem: Problem) -> Array:
        """Return the positions (N or 1, s, d) of the stations with rows, metres; 1 if all problems share them."""
        position = problem.stations.position
        flat = position.reshape(-1, *position.shape[-3:])
        # Usually all stations have rows, and their positions need no copy.
        if flat.shape[1] == 1 and np.array_equal(self.node[1], np.arange(flat.shape[2])):
            return flat[:, 0]
        return flat[:, self.node[0], self.node[1]]

    def kernel(self, count: int, *, often: bool = False) -> Callable[..., int]:
        """Return the machine code for `count` problems: narrow blocks for few problems, else wide blocks.

        Few problems use wide blocks too if only wide blocks are loaded. `often` is True if such calls are frequent, so
        that the best machine code is worth loading.
        """
        few, many, most = _BY_RANGES if self.ranged else _BY_TAPES
        narrow = count <= most and (is_in_use(few) or ((often or not is_in_use(many)) and may_use_code(few, count)))
        return few if narrow else many

    def at_hand(self, count: int) -> bool:
        """Return whether `count` problems can run: their machine code exists or may be compiled now."""
        return may_use_code(self.kernel(count, often=True), count)

    def run(self, load: Load, z: Array, threads: int | None = None, start: Array | None = None) -> tuple[Answer, int]:
        """Return the answers to N problems, and the greatest number of steps.

        Parameters
        ----------
        load : Load
            Data of the problems.
        z : array (N, m)
            Measurements, SI units or radians.
        threads : int, optional
            Greatest number of threads; default `optloc.base.threads.thread_count`.
        start : array (N, size), optional
            Starts of the refinements; by default the engine finds starts.
        """
        kernel, count = self.kernel(len(z)), len(z)
        answer, given = (
            blank_answer(count, *self.widths),
            start is not None,
        )
        if start is not None:
            answer = answer._replace(x=np.array(start))

        def work(first: int) -> int:
            """Compute the problems from `first` on, and return their greatest number of steps."""
            part = slice(first, min(first + _CHUNK, count))
            loaded, written = load.take(part), Answer(*(array[part] for array in answer))
            return int(
                kernel(
                    loaded.model,
                    loaded.rows,
                    _contiguous(z[part]),
                    _contiguous(loaded.place),
                    TOLERANCE,
                    LIMIT,
                    given,
                    written,
                )
            )

        return answer, max(map_on_threads(work, range(0, count, _CHUNK), threads), default=0)


class Load(NamedTuple):
    """Data of N problems of one structure, except measurements.

    Parameters
    ----------
    model : EngineModel
        Maps to a start, with the levels of constraints.
    rows : named tuple
        Rows of the evaluator.
    place : array (N or 1, s, d)
        Positions of the stations with rows, metres.
    """

    model: EngineModel
    rows: Any
    place: Array

    def take(self, part: slice | Array) -> Load:
        """Return the data of the problems that `part` selects; data that all problems share stay as they are."""
        model, rows, place = self
        level = model.admission.level
        if len(level) > 1:
            model = model._replace(admission=model.admission._replace(level=level[part]))
        if isinstance(rows, TapeRows):
            c = rows.numbers
            own = {name: getattr(c, name) for name in ("source", "white", "prior", "sigma")}
            cut = {name: array[part] for name, array in own.items() if len(array) > 1}
            rows = rows._replace(numbers=c._replace(**cut)) if cut else rows
        return Load(model, rows, place[part] if len(place) > 1 else place)


# Number of problems that a thread computes at a time: some milliseconds, much more than the cost of handing them out.
# From 1 000 to 16 000 no difference was measured.
_CHUNK = 4096
# Machine code for narrow blocks and for wide blocks, and the greatest number of problems for which narrow blocks are
# faster: one problem of ranges takes a fifth of the time of a wide block. Narrow blocks have one lane. Four lanes would
# fix eight problems in half of the time, but would need more code.
_BY_RANGES = (fix_one_by_ranges, fix_ranges, 5)
_BY_TAPES = (fix_one_by_tapes, fix_tapes, 4)


def blank_answer(count: int, d: int, size: int, shared: int, sides: int) -> Answer:
    """Return arrays for the answers to `count` problems; the kernels write their values later.

    Parameters
    ----------
    count : int
        Number N of problems.
    d : int
        Number of coordinates of a position.
    size : int
        Number of all unknowns of a problem.
    shared : int
        Number of unknowns that all epochs share; only these have a covariance.
    sides : int
        Number of constrained quantities.
    """
    return Answer(
        np.empty((count, size)),
        np.empty((count, shared, shared)),
        np.empty((count, size)),
        np.empty((count, KAPPA_FAR + 1)),
        np.empty((count, sides, GRADIENT + d)),
    )


def _contiguous(values: Array) -> Array:
    """Return values as the array type that machine code takes: float, C order, writable."""
    return np.require(values, dtype=float, requirements=["C", "W"])


# Structures that have a plan.

# A plan of 64 rows takes 100 kB, a plan of six rows 2 kB.
_KEPT = Cache["Plan | None"](256)


def plan_of(problem: Problem) -> Plan | None:
    """Return the cached plan of problems, or None if their structure has no plan or machine code is disabled.

    Parameters
    ----------
    problem : Problem
        Batch of problems; its measurements are not used.
    """
    if not (is_planned(problem) and enabled()):
        return None
    return _KEPT.find(key_of(problem), lambda: _make_plan(problem))


def key_of(problem: Problem) -> tuple[Hashable, ...]:
    """Return a cache key of everything that determines the plan of a problem."""
    # These numbers are not part of the structure, but determine the plan. The key contains their bytes.
    numbers = [array for r in problem.rows for array in (r.weight, r.correction)]
    numbers += [block.covariance for block in problem.noise.blocks]
    numbers += [covariance for _, _, covariance in problem.stations.errors]
    if problem.biases or problem.priors:
        numbers += [array for bias in problem.biases for array in (bias.mean, bias.sigma) if array is not None]
        numbers += [array for prior in problem.priors for array in (prior.mean, prior.covariance)]
    if problem.stations.axes is not None:
        numbers.append(problem.stations.axes)
    numbers += [band.coefficients for band in problem.constraints if isinstance(band, Band)]
    held = tuple((is_exact(constraint), constraint.name) for constraint in problem.constraints)
    return (problem.structure, *(array.tobytes() for array in numbers), held)


def is_planned(problem: Problem) -> bool:
    """Return whether a plan exists for the structure and for the data that a batch shares, and saves time."""
    stations, motion = problem.stations, problem.motions[0]
    # arrays that must be the same for the whole batch, with the number of their axes if there is no batch axis
    shared = [(array, 1) for r in problem.rows for array in (r.weight, r.correction)]
    shared += [(block.covariance, 3) for block in problem.noise.blocks]
    shared += [(covariance, 3) for _, _, covariance in stations.errors]
    if problem.biases or problem.priors:
        shared += [(array, 1) for bias in problem.biases for array in (bias.mean, bias.sigma) if array is not None]
        shared += [(prior.mean, 1) for prior in problem.priors] + [(prior.covariance, 2) for prior in problem.priors]
    if stations.axes is not None:
        shared.append((stations.axes, 4))
    return (
        len(problem.motions) == 1
        and not problem.fences
        and (motion.order, motion.span) == (0, "run")
        and motion.known is None
        and all(bool((r.target == 0).all()) for r in problem.rows)
        and 0 < problem.count <= MOST
        and problem.epochs <= MOST
        and all(array.ndim == core for array, core in shared)
        and (_is_ranged(problem) or _is_taped(problem))
        and not depends_on_place(problem)
    )


def _is_ranged(problem: Problem) -> bool:
    """Return whether all rows are sums of ranges to fixed stations, and the only other unknowns are emission times."""
    stations = problem.stations
    # Isotropic station errors of one epoch are noise of ranges. Errors that last for the run are unknowns with a
    # covariance.
    alone = stations.unknown_for == "epoch" and problem.epochs == 1
    return (
        not (problem.biases or problem.priors)
        and (not stations.unknown_for or (alone and stations.isotropic and stations.velocity_covariance is None))
        and stations.position.shape[-3] == 1
        and all(MODELS[rows.kind].ranges is not None for rows in problem.rows)
    )


def _is_taped(problem: Problem) -> bool:
    """Return whether the rows can have tapes, and the unknowns are few enough for lanes.

    A medium, walks, or unknowns of several epochs exclude tapes.
    """
    layout = problem.layout
    several = layout.n_local > 0 and problem.epochs > 1
    return problem.medium is None and not several and layout.size <= _UNKNOWNS and not walks(problem)


# How a plan is made.


def _make_plan(problem: Problem) -> Plan | None:
    """Return the plan of problems, or None if a plan is impossible.

    Reasons are negative degrees of freedom, a position that is not first among the unknowns, constraints or rows
    without tapes, or rows without a start.
    """
    one = _without_measurements(problem)
    dof = int(degrees_of_freedom(one.flat())[0])
    if dof < 0 or problem.layout.find("position")[0].start:
        return None
    admission = admission_of(one)
    if admission is None:
        return None
    drawn = draw_ranges(one, admission) if _is_ranged(problem) else None
    if drawn is None and _is_taped(problem):
        drawn = draw_tapes(one, admission, dof)
    if drawn is None:
        return None
    layout = problem.layout
    held, size, shared = face_names(one, exact(one)), layout.size, layout.n_shared
    widths = (one.dimension, size, shared, len(one.constraints))
    ranged = drawn.ranged
    return Plan(
        layout, problem.frame, one.weight, dof, drawn.node, drawn.model, drawn.rows, ranged, size, shared, widths, held
    )


def _without_measurements(problem: Problem) -> Problem:
    """Return one problem of a batch with zero measurements and without levels of constraints, as a plan needs it."""
    stations = problem.stations
    place = stations.position.reshape(-1, *stations.position.shape[-3:])[0]
    rates = stations.velocity
    rates = None if rates is None else rates.reshape(-1, *rates.shape[-3:])[0]
    # Levels are arguments of a run. A band that is exact only in some problems of a batch counts as not exact.
    bands = tuple(
        replace(band, lower=np.array(0.0), upper=np.array(0.0 if is_exact(band) else 1.0))
        if isinstance(band, Band)
        else band
        for band in problem.constraints
    )
    bare = problem.with_rows(z=np.zeros(problem.count))
    return replace(bare, stations=replace(stations, position=place, velocity=rates), constraints=bands)
