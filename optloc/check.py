"""What cannot be a problem: malformed input is refused with a sentence that names the culprit."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from optloc.check_constraints import check_constraints
from optloc.check_unknowns import check_unknowns
from optloc.epochs import tied, untied
from optloc.errors import InvalidProblem
from optloc.frames import Frame
from optloc.models import MODELS
from optloc.noise import Noise
from optloc.problem import Problem
from optloc.types import Array, Rows, Stations


def checked(problem: Problem) -> Problem:
    """Return the problem if it is well formed.

    Parameters
    ----------
    problem : Problem
        Any problem. NaN measurements pass: they are simulated later, or become a status of their own fix.

    Returns
    -------
    Problem
        The same; a noise block that holds several uncorrelated epochs is cut.

    Raises
    ------
    InvalidProblem
        Naming the station, row or argument and what to do.
    """
    if not isinstance(problem.frame, Frame):
        raise InvalidProblem(f"{problem.frame!r} is not a frame", "frame", "give an optloc.Frame, such as optloc.ECEF")
    if problem.count == 0:
        raise InvalidProblem("there are no measurements", "measurements", "give at least one row")
    _check_stations(problem)
    for rows in problem.rows:
        _check_rows(problem, rows)
    _check_noise(problem.noise, problem.count)
    _check_times(problem)
    _check_moving(problem)
    check_unknowns(problem)
    try:
        problem.batch_shape  # noqa: B018  (raises where leading axes disagree)
    except ValueError:
        raise InvalidProblem("leading axes disagree", "problem", "give every array the same batch axes") from None
    for prior in problem.priors:
        _check_covariance(prior.covariance[..., None, :, :], f"prior on {prior.name}", None)
    check_constraints(problem)
    return _arrowed(problem)


def _arrowed(problem: Problem) -> Problem:
    """Return the problem with noise in blocks of one epoch each, as the elimination of local unknowns needs it."""
    if not tied(problem):
        return untied(problem)
    if problem.layout.n_local:
        name = problem.layout.local[0].name
        what = f"rows of different epochs are correlated, but every epoch has its own {name!r}"
        raise InvalidProblem(what, "covariance", "correlate rows of one epoch only, or share the unknown")
    return problem


def _check_stations(problem: Problem) -> None:
    stations: Stations = problem.stations
    bad = ~np.isfinite(stations.position).all(-1)
    if bad.any():
        name = stations.names[int(np.argwhere(bad)[0][-1])]
        raise InvalidProblem(f"the position of station {name!r} is not finite", "stations", "give metres")
    if len(stations.names) != stations.count:
        raise InvalidProblem(
            f"{stations.count} stations have {len(stations.names)} names", "stations", "give one name each"
        )
    twice = [name for name, n in Counter(stations.names).items() if n > 1]
    if twice:
        raise InvalidProblem(f"station name {twice[0]!r} is used twice", "stations", "rename one of them")
    if problem.frame.kind == "ecef" and stations.dimension != 3:
        raise InvalidProblem("stations in ECEF need three coordinates", "stations", "give x, y and z")
    if stations.covariance is not None:
        shape = (stations.count, stations.dimension, stations.dimension)
        if stations.covariance.shape[-3:] != shape:
            raise InvalidProblem(
                f"the covariance of their errors has shape {stations.covariance.shape}", "stations", f"give {shape}"
            )
        _check_covariance(stations.covariance, "position error of station", stations.names)
    if stations.span not in ("epoch", "run", "noise"):
        what = f"unknown span {stations.span!r} of position errors"
        raise InvalidProblem(what, "stations", "use 'epoch', 'run' or 'noise'")


def _check_moving(problem: Problem) -> None:
    """Refuse velocities, axes and moving positions that do not fit the stations and epochs."""
    s, d, count = problem.stations, problem.dimension, problem.stations.count
    for name, array, tail in (
        ("position", s.position, (count, d)),
        ("velocity", s.velocity, (count, d)),
        ("axes", s.axes, (count, d, d)),
    ):
        if array is None:
            continue
        core = len(tail) + 1
        if array.ndim < core or array.shape[-core + 1 :] != tail:
            raise InvalidProblem(f"station {name} has shape {array.shape}", "stations", "match the positions")
        if array.shape[-core] not in (1, problem.epochs):
            counts = f"{array.shape[-core]} epochs of station {name} for {problem.epochs} epochs of measurements"
            raise InvalidProblem(counts, "stations", "give one, or one for each epoch")
        bad = ~np.isfinite(array).all(tuple(range(-core + 2, 0)))
        if bad.any():
            label = s.names[int(np.argwhere(bad)[0][-1])]
            raise InvalidProblem(f"the {name} of station {label!r} is not finite", "stations", "give SI units")
    if s.axes is not None:
        skew = np.abs(s.axes @ np.swapaxes(s.axes, -1, -2) - np.eye(d)).max((-1, -2)) > 1e-6
        if skew.any():
            label = s.names[int(np.argwhere(skew)[0][-1])]
            raise InvalidProblem(
                f"the axes of station {label!r} are not unit vectors at right angles",
                "stations",
                "give a rotation matrix",
            )


def _check_rows(problem: Problem, rows: Rows) -> None:
    model = MODELS[rows.kind]
    if problem.dimension not in model.dimensions:
        raise InvalidProblem(
            f"{rows.kind} has no meaning in {problem.dimension} dimensions", rows.kind, "use 3-D stations"
        )
    if model.axes and problem.frame.kind == "ecef" and problem.stations.axes is None:
        advice = "give the stations axes, for instance frame.enu_axes(positions)"
        raise InvalidProblem(f"{rows.kind} rows in ECEF need the stations' own axes", rows.kind, advice)
    if model.ecef and not problem.frame.geodetic:
        raise InvalidProblem(f"{rows.kind} needs a geodetic frame", "frame", "use frame ecef or enu with an origin")
    if model.ecef and problem.dimension != 3:
        raise InvalidProblem(f"{rows.kind} needs three dimensions", "frame", "use 3-D stations")
    for name, index, limit in (
        ("a", rows.a if model.stations > 0 else None, problem.stations.count),
        ("b", rows.b if model.stations > 1 else None, problem.stations.count),
        ("epoch", rows.epoch, problem.epochs),
        ("target", rows.target, len(problem.motions)),
    ):
        if index is None:
            continue
        lowest = -1 if name == "target" else 0
        bad = np.flatnonzero((index < lowest) | (index >= limit))
        if len(bad):
            raise InvalidProblem(
                f"{rows.kind} row {bad[0]} has {name} = {index[bad[0]]}", name, f"use {lowest} to {limit - 1}"
            )
    if model.stations > 1 and np.any(rows.a == rows.b):
        row = int(np.flatnonzero(rows.a == rows.b)[0])
        raise InvalidProblem(f"{rows.kind} row {row} names one station twice", "a, b", "name two stations")
    infinite = np.argwhere(np.isinf(rows.z))
    if len(infinite):
        row = infinite[0][-1]
        raise InvalidProblem(f"{rows.kind} row {row} is infinite", "z", "remove the row or give it weight zero")
    if not np.isfinite(rows.correction).all():
        raise InvalidProblem(
            f"{rows.kind} has a correction that is not finite", "correction", "give 0 where none is known"
        )
    if not ((rows.weight >= 0.0) & (rows.weight <= 1.0)).all():
        raise InvalidProblem(f"{rows.kind} has a weight outside 0 to 1", "weight", "use 0 for absent, 1 for present")


def _check_noise(noise: Noise, count: int) -> None:
    seen = np.sort(np.concatenate([block.row.ravel() for block in noise.blocks] or [np.zeros(0, dtype=int)]))
    if not np.array_equal(seen, np.arange(count)):
        raise InvalidProblem("the noise does not cover every row exactly once", "noise", "give each row one covariance")
    for block in noise.blocks:
        _check_covariance(block.covariance, "noise of row", tuple(str(row) for row in block.row[:, 0]))


def _check_covariance(covariance: Array, what: str, names: tuple[str, ...] | None) -> None:
    def fail(bad: Any, why: str) -> None:
        if np.any(bad):
            place = int(np.argwhere(bad)[0][-1])
            label = f" {names[place]}" if names and place < len(names) else ""
            raise InvalidProblem(f"the covariance in {what}{label} is {why}", "covariance", "give a true covariance")

    fail(~np.isfinite(covariance).all((-1, -2)), "not finite")
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
    fail((diagonal <= 0.0).any(-1), "not positive on its diagonal")
    if covariance.shape[-1] == 1:
        return
    scale = np.sqrt(diagonal)
    unit = covariance / (scale[..., :, None] * scale[..., None, :])
    fail((np.abs(unit - np.swapaxes(unit, -1, -2)) > 1e-9).any((-1, -2)), "not symmetric")
    fail(np.linalg.eigvalsh(unit)[..., 0] < -1e-9 * unit.shape[-1], "not positive semidefinite")


def _check_times(problem: Problem) -> None:
    times = problem.times
    if times.ndim != 1 or not np.isfinite(times).all():
        raise InvalidProblem("times are not a list of finite seconds", "times", "give one number per epoch")
    if (np.diff(times) <= 0.0).any():
        place = int(np.flatnonzero(np.diff(times) <= 0.0)[0]) + 1
        raise InvalidProblem(f"epoch {place} is not later than the one before", "times", "sort the epochs")
    if any(rows.epoch.max(initial=0) >= len(times) for rows in problem.rows):
        raise InvalidProblem(f"there are only {len(times)} times", "times", "give one for each epoch")
