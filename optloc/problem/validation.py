"""Validation of problems: malformed input raises `InvalidProblem` with a message that names the faulty part."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem, check_once
from optloc.base.frames import Frame
from optloc.base.types import Array, Bias, Motion, Prior, Rows, Stations
from optloc.base.units import LARGEST
from optloc.models import MODELS
from optloc.problem.constraint_checks import check_constraints, out_of_range
from optloc.problem.epochs import has_correlated_epochs, without_epoch_correlation
from optloc.problem.forms import form_of
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem, at_rest, check_medium


def checked(problem: Problem) -> Problem:
    """Return the problem if it is valid; raise InvalidProblem otherwise.

    Parameters
    ----------
    problem : Problem
        Any problem. NaN measurements are valid: they are simulated later, or their fix gets a status.

    Returns
    -------
    Problem
        The same problem, except that a noise block with several uncorrelated epochs is split, and stations without
        velocities get zero velocities if a row is a rate.

    Raises
    ------
    InvalidProblem
        The message names the station, row or argument, and gives advice.
    """
    if not isinstance(problem.frame, Frame):
        raise InvalidProblem(f"{problem.frame!r} is not a frame", "frame", "give an optloc.Frame")
    if problem.count == 0:
        raise InvalidProblem("there are no measurements", "measurements", "give at least one row")
    _check_stations(problem)
    for rows in problem.rows:
        _check_rows(problem, rows)
    _check_noise(problem.noise, problem.count)
    _check_times(problem)
    _check_moving(problem)
    check_medium(problem)
    check_unknowns(problem)
    _check_rates(problem)
    try:
        problem.batch_shape  # noqa: B018  (raises where leading axes disagree)
    except ValueError:
        raise InvalidProblem("leading axes disagree", "problem", "give every array the same batch axes") from None
    for prior in problem.priors:
        _check_covariance(prior.covariance[..., None, :, :], f"prior on {prior.name}", None)
    check_constraints(problem)
    return _cut_noise(at_rest(problem))


def _cut_noise(problem: Problem) -> Problem:
    """Return the problem with noise in blocks of one epoch each, which the elimination of local unknowns requires."""
    # Local unknowns are eliminated epoch by epoch. Correlation between epochs would couple them.
    if not has_correlated_epochs(problem):
        return without_epoch_correlation(problem)
    if problem.layout.n_local:
        name = problem.layout.local[0].name
        what = f"rows of different epochs are correlated, but every epoch has its own {name!r}"
        raise InvalidProblem(what, "covariance", "correlate rows of one epoch only, or share the unknown")
    return problem


def _check_stations(problem: Problem) -> None:
    """Raise if positions, names or error covariances of the stations are invalid."""
    stations: Stations = problem.stations
    bad, why = out_of_range(stations.position)
    if bad.any():
        name = stations.names[int(np.argwhere(bad.any(-1))[0][-1])]
        raise InvalidProblem(f"the position of station {name!r} is {why}", "stations", "give metres")
    if len(stations.names) != stations.count:
        what = f"{stations.count} stations have {len(stations.names)} names"
        raise InvalidProblem(what, "stations", "give one name each")
    check_once(stations.names, "station name {!r} is used twice", "stations")
    if problem.frame.kind == "ecef" and stations.dimension != 3:
        raise InvalidProblem("stations in ECEF need three coordinates", "stations", "give x, y and z")
    shape = (stations.count, stations.dimension, stations.dimension)
    for name, _, covariance in stations.errors:
        if covariance.shape[-3:] != shape:
            what = f"the covariance of the errors of {name} has shape {covariance.shape}"
            raise InvalidProblem(what, "stations", f"give {shape}")
        of = "velocity" if name == "station velocities" else "position"
        _check_covariance(covariance, f"{of} error of station", stations.names)
    if stations.span not in ("epoch", "run", "noise"):
        what = f"unknown span {stations.span!r} of station errors"
        raise InvalidProblem(what, "stations", "use 'epoch', 'run' or 'noise'")


def _check_moving(problem: Problem) -> None:
    """Raise if velocities, axes or positions per epoch do not fit the stations and epochs."""
    s, d, count = problem.stations, problem.dimension, problem.stations.count
    # `tail` is the required shape after the epoch axis. `core` counts the epoch axis and the axes of the tail.
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
        bad, why = out_of_range(array)
        if bad.any():
            label = s.names[int(np.argwhere(bad.any(tuple(range(-core + 2, 0))))[0][-1])]
            raise InvalidProblem(f"the {name} of station {label!r} is {why}", "stations", "give SI units")
    if s.axes is not None:
        # One microradian: it admits single precision and angles with seven digits, but not degrees instead of radians.
        skew = np.abs(s.axes @ np.swapaxes(s.axes, -1, -2) - np.eye(d)).max((-1, -2)) > 1e-6
        if skew.any():
            label = s.names[int(np.argwhere(skew)[0][-1])]
            raise InvalidProblem(
                f"the axes of station {label!r} are not unit vectors at right angles",
                "stations",
                "give a rotation matrix",
            )


def _check_rows(problem: Problem, rows: Rows) -> None:
    """Raise if indices, values or weights of one kind of rows are invalid, or if the kind does not fit the problem."""
    model = MODELS[rows.kind]
    if problem.dimension not in model.dimensions:
        raise InvalidProblem(
            f"{rows.kind} has no meaning in {problem.dimension} dimensions", rows.kind, "use 3-D stations"
        )
    if model.axes and problem.frame.kind == "ecef" and problem.stations.axes is None:
        advice = "give the stations axes, for instance frame.enu_axes(positions)"
        raise InvalidProblem(f"{rows.kind} rows in ECEF need the stations' own axes", rows.kind, advice)
    if model.velocity and model.stations and problem.stations.velocity is None:
        # Stations without velocities count as fixed. Stations whose positions change do not.
        position = problem.stations.position
        moved = np.argwhere((position != position[..., :1, :, :]).any(-1))
        if len(moved):
            what = f"station {problem.stations.names[int(moved[0][-1])]!r} moves, but has no velocity for {rows.kind}"
            advice = "give velocities (vx, vy, vz in a file): differences of positions are too coarse for rates"
            raise InvalidProblem(what, "stations", advice)
    if model.straight is not None and problem.medium is None:
        what = f"{rows.kind} rows need a medium"
        raise InvalidProblem(what, rows.kind, f"state a medium, or use the kind {model.straight}")
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
        # In `target`, -1 marks a row that is not yet assigned to a target.
        lowest = -1 if name == "target" else 0
        bad = np.flatnonzero((index < lowest) | (index >= limit))
        if len(bad):
            raise InvalidProblem(
                f"{rows.kind} row {bad[0]} has {name} = {index[bad[0]]}", name, f"use {lowest} to {limit - 1}"
            )
    if model.stations > 1 and np.any(rows.a == rows.b):
        row = int(np.flatnonzero(rows.a == rows.b)[0])
        raise InvalidProblem(f"{rows.kind} row {row} names one station twice", "a, b", "name two stations")
    check_values(rows)
    bad, why = out_of_range(rows.correction)
    if bad.any():
        raise InvalidProblem(f"{rows.kind} has a correction that is {why}", "correction", "give 0 where none is known")
    if not ((rows.weight >= 0.0) & (rows.weight <= 1.0)).all():
        raise InvalidProblem(f"{rows.kind} has a weight outside 0 to 1", "weight", "use 0 for absent, 1 for present")


def check_values(rows: Rows) -> None:
    """Raise if a measurement is infinite, or so large that its square overflows.

    NaN is valid: the measurement is simulated later, or only its own fix is rejected.
    """
    large = np.abs(rows.z) > LARGEST
    if large.any():
        index = tuple(np.argwhere(large)[0])
        why = "infinite" if np.isinf(rows.z[index]) else f"beyond {LARGEST:g}"
        what = f"{rows.kind} row {index[-1]} is {why}"
        raise InvalidProblem(what, "z", "remove the row or give it weight zero")


def _check_noise(noise: Noise, count: int) -> None:
    """Raise unless each row has exactly one valid covariance; `count` is the number of rows."""
    seen = np.sort(np.concatenate([block.row.ravel() for block in noise.blocks] or [np.zeros(0, dtype=int)]))
    if not np.array_equal(seen, np.arange(count)):
        raise InvalidProblem("the noise does not cover every row exactly once", "noise", "give each row one covariance")
    for block in noise.blocks:
        _check_covariance(block.covariance, "noise of row", block.row[:, 0])


def _check_covariance(covariance: Array, place: str, names: Sequence[str] | Array | None) -> None:
    """Raise if a covariance (..., g, r, r) is invalid; `place` and the group's entry of `names` enter the message."""

    def fail(bad: Any, why: str) -> None:
        if np.any(bad):
            index = int(np.argwhere(bad)[0][-1])
            label = f" {names[index]}" if names is not None and index < len(names) else ""
            raise InvalidProblem(f"the covariance in {place}{label} is {why}", "covariance", "give a true covariance")

    fail(~np.isfinite(covariance).all((-1, -2)), "not finite")
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
    fail((diagonal <= 0.0).any(-1), "not positive on its diagonal")
    # Limits of the standard deviations: residuals are divided by them and squared.
    fail((diagonal > LARGEST**2).any(-1), f"of deviations beyond {LARGEST:g}")
    fail((diagonal < LARGEST**-2).any(-1), f"of deviations below {1.0 / LARGEST:g}")
    if covariance.shape[-1] == 1:
        return
    # The check uses correlations, so that the same tolerance fits metres, radians and ratios.
    scale = np.sqrt(diagonal)
    unit = covariance / (scale[..., :, None] * scale[..., None, :])
    # The tolerance is 1e-9, so that covariances from text files pass. An eigenvalue may be negative by the sum of the
    # rounding errors.
    fail((np.abs(unit - np.swapaxes(unit, -1, -2)) > 1e-9).any((-1, -2)), "not symmetric")
    fail(np.linalg.eigvalsh(unit)[..., 0] < -1e-9 * unit.shape[-1], "not positive semidefinite")


def _check_times(problem: Problem) -> None:
    """Raise unless the times of the epochs are finite and increase."""
    times = problem.times
    if times.ndim != 1 or out_of_range(times)[0].any():
        raise InvalidProblem("times are not a list of finite seconds", "times", "give one number per epoch")
    if (np.diff(times) <= 0.0).any():
        epoch = int(np.flatnonzero(np.diff(times) <= 0.0)[0]) + 1
        raise InvalidProblem(f"epoch {epoch} is not later than epoch {epoch - 1}", "times", "sort the epochs")
    if any(rows.epoch.max(initial=0) >= len(times) for rows in problem.rows):
        raise InvalidProblem(f"there are only {len(times)} times", "times", "give one for each epoch")


def _check_rates(problem: Problem) -> None:
    """Raise for range rates between fixed points: all of them are zero, wherever the target is."""
    still = problem.stations.velocity is None and all(motion.order == 0 for motion in problem.motions)
    kind = next((rows.kind for rows in problem.rows if MODELS[rows.kind].velocity), None)
    if still and kind is not None:
        what = f"{kind} of a fixed target needs stations that move, and no station has a velocity"
        advice = "give velocities (vx, vy, vz in a file), or state the motion of the target"
        raise InvalidProblem(what, "stations", advice)


# Checks of unknowns: malformed motions, biases and priors raise an error that names them.


def check_unknowns(problem: Problem) -> None:
    """Raise if a motion, bias or prior is invalid; the stations, rows and times must be valid."""
    for number, motion in enumerate(problem.motions):
        _check_motion(problem, motion, number)
    for bias in problem.biases:
        _check_bias(problem, bias, f"bias {bias.name!r}")
    layout = problem.layout
    # Names identify the parts of the vector, and `layout.find` returns only the first of equal names.
    names = Counter(slot.name for slot in (*layout.shared, *layout.local))
    twice = [name for name, count in names.items() if count > 1]
    if twice:
        raise InvalidProblem(f"the name {twice[0]!r} is used twice", "biases", "give every unknown a different name")
    for prior in problem.priors:
        _check_prior(problem, prior)


def _check_motion(problem: Problem, motion: Motion, number: int) -> None:
    """Raise if the motion of target `number` is invalid."""
    where = f"motions[{number}]"
    if motion.order not in (0, 1, 2):
        raise InvalidProblem(f"the motion has order {motion.order}", where, "use order 0, 1 or 2")
    if motion.span not in ("run", "epoch"):
        raise InvalidProblem(f"unknown span {motion.span!r}", where, "use 'run' or 'epoch'")
    if motion.reference is not None and out_of_range(motion.reference)[0]:
        raise InvalidProblem(f"the reference time is {motion.reference}", where, "give finite seconds")
    _check_course_over(problem, motion, where)
    if motion.known is None:
        return
    shape = motion.known.shape
    if len(shape) < 3 or shape[-1] != problem.dimension:
        wanted = f"give (epochs or 1, order + 1, {problem.dimension})"
        raise InvalidProblem(f"the known states have shape {shape}", where, wanted)
    if shape[-3] not in (1, problem.epochs):
        counts = f"{problem.epochs} epoch{'s' if problem.epochs > 1 else ''}"
        raise InvalidProblem(
            f"known states are for {shape[-3]} epochs, not {counts}", where, "give one, or one for each"
        )
    bad, why = out_of_range(motion.known)
    if bad.any():
        raise InvalidProblem(f"a known state is {why}", where, "give metres and metres per second")
    if shape[-3] > 1 and shape[-2] == 1:
        for rows in problem.rows:
            if MODELS[rows.kind].velocity and (rows.target == number).any():
                raise InvalidProblem(f"{rows.kind} needs the velocity of this known target", where, "give it as well")


def _check_course_over(problem: Problem, motion: Motion, where: str) -> None:
    """Raise if a course over ground, or a known change of height (`rise`), does not fit the problem."""
    if motion.over not in ("space", "ground"):
        raise InvalidProblem(f"a course over {motion.over!r}", where, "use 'space' or 'ground'")
    moving = [m for m in problem.motions if m.known is None and m.order > 0]
    if motion.over == "ground":
        if not problem.frame.geodetic or problem.dimension != 3:
            advice = "use frame ecef or enu with 3-D stations"
            raise InvalidProblem("a course over ground needs a geodetic frame", where, advice)
        if motion.span != "run" or motion.known is not None:
            raise InvalidProblem("only a state of the run has a course over ground", where, "leave out over='ground'")
        if any(m.over != "ground" for m in moving):
            advice = "give over='ground' to all targets that move"
            raise InvalidProblem("some targets move over ground and some in space", where, advice)
    if motion.rise is None:
        return
    if motion.known is not None or (motion.span == "run" and (motion.over != "ground" or not motion.order)):
        advice = "give it with over='ground' and order 1 or 2, or to a free target"
        raise InvalidProblem("a known shape of its height does not fit this motion", where, advice)
    if motion.rise.shape[-2:] != (problem.epochs, 2):
        what = f"a rise of shape {motion.rise.shape} for {problem.epochs} epochs"
        raise InvalidProblem(what, where, "give height and rate at each epoch, see optloc.constraints.reported")
    bad, why = out_of_range(motion.rise)
    if bad.any():
        raise InvalidProblem(f"a rise is {why}", where, "give metres and metres per second")


def _check_bias(problem: Problem, bias: Bias, where: str) -> None:
    """Raise if the entries, the prior or the form of a bias are invalid."""
    form = form_of(bias)
    sizes = [len(bias.row), len(bias.member), len(bias.coefficient)]
    if len(set(sizes)) > 1:
        raise InvalidProblem(
            f"row, member and coefficient have {sizes} entries", where, "give one entry of each for every affected row"
        )
    for name, index, limit in (("row", bias.row, problem.count), ("member", bias.member, len(bias.members))):
        bad = (index < 0) | (index >= limit)
        if bad.any():
            raise InvalidProblem(f"there is no {name} {index[bad][0]}", where, f"use 0 to {limit - 1}")
    bad, why = out_of_range(bias.coefficient)
    if bad.any():
        raise InvalidProblem(f"a coefficient is {why}", where, "give numbers such as 1 and -1")
    if form.enters == "turns":
        _check_rotation(problem, bias, where)
    if form.enters == "moves":
        _check_course(problem, bias, where)
    if form.check is not None:
        form.check(bias, problem.times, where)
    if bias.sigma is None:
        return
    wanted = problem.layout.find(bias.name)[0].size
    for name, values, sizes in (("sigma", bias.sigma, [wanted]), ("mean", bias.mean, [1, wanted])):
        if np.size(values) not in sizes:
            raise InvalidProblem(
                f"{name} has {np.size(values)} entries, not {wanted}", where, "give one for each unknown"
            )
    sigma = np.asarray(bias.sigma)
    if not ((sigma >= 1.0 / LARGEST) & (sigma <= LARGEST)).all() or out_of_range(bias.mean)[0].any():
        raise InvalidProblem("sigma is not positive or mean is not finite", where, "give true numbers, or no sigma")


def _check_rotation(problem: Problem, bias: Bias, where: str) -> None:
    """Raise if a rotation affects rows that are not measured in the axes of a station."""
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        inside = (bias.row >= start) & (bias.row < start + rows.count)
        if inside.any() and not MODELS[rows.kind].axes:
            advice = "let it touch rows that are measured in the station's axes"
            raise InvalidProblem(
                f"a rotation does not change {rows.kind} row {bias.row[inside][0] - start}", where, advice
            )


def _check_course(problem: Problem, bias: Bias, where: str) -> None:
    """Raise if a bias of the form "time" is invalid. It moves a station along its track by velocity times time.

    The coefficient of an entry is 1 for the first station of its row (`a`), and -1 for the second (`b`).
    """
    velocity = problem.stations.velocity
    if velocity is None:
        raise InvalidProblem("a time along a course needs velocities of the stations", where, "give vx, vy and vz")
    # Axes before the last three (epoch, station, coordinate) are batch axes.
    if np.prod(velocity.shape[:-3]) * np.prod(problem.stations.position.shape[:-3]) > 1:
        raise InvalidProblem("the stations differ from problem to problem", where, "solve them one by one")
    if not np.isin(bias.coefficient, (1.0, -1.0)).all():
        advice = "give 1 if it moves the first station of the row, and -1 if it moves the second"
        raise InvalidProblem("a coefficient is neither 1 nor -1", where, advice)
    ends = (np.concatenate([getattr(rows, name) for rows in problem.rows])[bias.row] for name in ("a", "b"))
    station = np.where(bias.coefficient > 0.0, *ends)
    # Two equal pairs (row, station) name a station twice in one row. The station number -1 is a missing station.
    if len(np.unique(np.stack([bias.row, station]), axis=1).T) < len(bias.row) or (station < 0).any():
        what = "a row does not have this station, or has it twice"
        raise InvalidProblem(what, where, "let each row name a station once")
    epoch = problem.epoch[bias.row] if velocity.shape[-3] > 1 else np.zeros_like(bias.row)
    moves = velocity.reshape(-1, *velocity.shape[-2:])[epoch, station].any(-1)
    still = np.setdiff1d(np.arange(len(bias.members)), bias.member[moves])
    if len(still):
        what = f"{bias.members[still[0]]} does not move, so it has no time along its course"
        raise InvalidProblem(what, f"{where}, members", "name the stations that move")


def _check_prior(problem: Problem, prior: Prior) -> None:
    """Raise if a prior does not fit the size of its unknown, or if its mean is out of range."""
    where = f"prior on {prior.name}"
    slot, _ = problem.layout.find(prior.name)
    if prior.mean.shape[-1:] != (slot.size,) or prior.covariance.shape[-2:] != (slot.size, slot.size):
        raise InvalidProblem(
            f"mean {prior.mean.shape} and covariance {prior.covariance.shape} do not fit",
            where,
            f"give {slot.size} entries",
        )
    bad, why = out_of_range(prior.mean)
    if bad.any():
        raise InvalidProblem(f"the mean is {why}", where, "give SI units, or no prior")
