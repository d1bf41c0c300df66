"""A few windows of a run for the semidefinite start of registration.

Letters: N runs, K windows, C starts of a run, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from optloc.base.types import Array
from optloc.problem.problem import Problem
from optloc.solvers.starts.registration import RegistrationRun, place_states, run_of

# Blocks in the relaxation: the time of a semidefinite program grows steeply with their number.
_WINDOWS = 6
# The relaxation needs a prior. Biases without a prior get a deviation of this share of the largest range difference. A
# wide prior leaves the lifted biases free, and a narrow one shifts the start; only a start depends on it.
_LOOSE = 1e-2


def relax_run(problem: Problem) -> Array | None:
    """Return starting vectors (N, C, size) of runs from the semidefinite relaxation, or None if it does not apply.

    It uses a few blocks over the whole run in which every station has a row.

    Parameters
    ----------
    problem : Problem
        Flat batch of N runs of a few dozen epochs, fixed targets or constant velocity.
    """
    from formulations.registration_sdp import registration

    run, order = run_of(problem), problem.motions[0].order
    if run is None or not has_windows(problem, run):
        return None
    found = [
        [] if given is None else [(one.target, one.bias) for one in registration(**given)]
        for given in windows_of(problem, run)
    ]
    width = max(1, *(len(pairs) for pairs in found))
    shape = (len(found), width, order + 1, problem.dimension)
    state, delta = np.full(shape, np.nan), np.zeros((len(found), width, len(run.column)))
    for i, pairs in enumerate(found):
        for j, (target, bias_of) in enumerate(pairs):
            state[i, j], delta[i, j] = target, bias_of
    return place_states(problem, run, state, delta)


def has_windows(problem: Problem, run: RegistrationRun) -> bool:
    """Return whether the relaxation applies: at most constant velocity, and differences to the reference only."""
    return problem.motions[0].order <= 1 and not (run.course.sign < 0).any()


def windows_of(problem: Problem, run: RegistrationRun) -> Iterator[dict[str, Any] | None]:
    """Yield the arguments of `formulations.registration_sdp.registration` for each run; None without two windows.

    Parameters
    ----------
    problem : Problem
        N runs; see `has_windows`.
    run : RegistrationRun
        Their range offsets.
    """
    course = run.course
    size = len(course.offset)
    station, bias = (np.broadcast_to(a, (size, *a.shape[1:])) for a in (course.station, course.bias))
    whiten = np.broadcast_to(course.whiten, (size, *course.offset.shape[1:], course.offset.shape[2]))
    # the offsets are scaled, and so is the loose prior
    loose = _LOOSE * np.abs(course.offset).max() if course.offset.size else 1.0
    sigma = np.where(np.isfinite(course.sigma), course.sigma, loose)
    for i in range(size):
        # blocks in which every station has a row, spread evenly over the run
        whole = np.flatnonzero((whiten[i] != 0.0).any(-1).all(-1))
        k = whole[np.unique(np.linspace(0, len(whole) - 1, _WINDOWS).round().astype(int))] if len(whole) else whole
        if len(k) < 2:
            yield None
            continue
        yield {
            "station": station[i, k],
            "z": course.offset[i, k],
            "whiten": whiten[i, k],
            "sigma": sigma,
            "design": bias[i, k[0]],
            "mean": course.mean,
            "time": course.time[k] if problem.motions[0].order else None,
        }
