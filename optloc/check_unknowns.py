"""What cannot be unknown: malformed motions, biases and priors are refused with a sentence that names them."""

from __future__ import annotations

from collections import Counter

import numpy as np

from optloc.errors import InvalidProblem
from optloc.models import MODELS
from optloc.problem import Problem
from optloc.types import Bias, Motion, Prior

_FORMS = ("offset", "scale", "drift", "rotation")


def check_unknowns(problem: Problem) -> None:
    """Refuse motions, biases and priors that cannot be what is meant.

    Parameters
    ----------
    problem : Problem
        Its stations, rows and times are in order.

    Raises
    ------
    InvalidProblem
        Naming the motion, bias or prior.
    """
    for number, motion in enumerate(problem.motions):
        _check_motion(problem, motion, number)
    for bias in problem.biases:
        _check_bias(problem, bias, f"bias {bias.name!r}")
    layout = problem.layout
    names = Counter(slot.name for slot in (*layout.shared, *layout.local))
    twice = [name for name, count in names.items() if count > 1]
    if twice:
        raise InvalidProblem(f"the name {twice[0]!r} is taken twice", "biases", "give every unknown its own name")
    for prior in problem.priors:
        _check_prior(problem, prior)


def _check_motion(problem: Problem, motion: Motion, number: int) -> None:
    where = f"motions[{number}]"
    if motion.order not in (0, 1, 2):
        raise InvalidProblem(f"a motion of order {motion.order}", where, "use order 0, 1 or 2")
    if motion.span not in ("run", "epoch"):
        raise InvalidProblem(f"unknown span {motion.span!r}", where, "use 'run' or 'epoch'")
    if motion.reference is not None and not np.isfinite(motion.reference):
        raise InvalidProblem(f"the reference time is {motion.reference}", where, "give finite seconds")
    if motion.known is None:
        return
    shape = motion.known.shape
    if len(shape) < 3 or shape[-1] != problem.dimension:
        raise InvalidProblem(
            f"known states of shape {shape}", where, f"give (epochs or 1, order + 1, {problem.dimension})"
        )
    if shape[-3] not in (1, problem.epochs):
        counts = f"{problem.epochs} epoch{'s' if problem.epochs > 1 else ''}"
        raise InvalidProblem(f"known states for {shape[-3]} epochs, not {counts}", where, "give one, or one an epoch")
    if not np.isfinite(motion.known).all():
        raise InvalidProblem("a known state is not finite", where, "give metres and metres per second")
    if shape[-3] > 1 and shape[-2] == 1:
        for rows in problem.rows:
            if MODELS[rows.kind].velocity and (rows.target == number).any():
                raise InvalidProblem(f"{rows.kind} needs the velocity of this known target", where, "give it as well")


def _check_bias(problem: Problem, bias: Bias, where: str) -> None:
    if bias.form not in _FORMS:
        raise InvalidProblem(f"unknown form {bias.form!r}", where, f"use {', '.join(_FORMS)}")
    sizes = [len(bias.row), len(bias.member), len(bias.coefficient)]
    if len(set(sizes)) > 1:
        raise InvalidProblem(
            f"row, member and coefficient have {sizes} entries", where, "give one each for every touch"
        )
    for name, index, limit in (("row", bias.row, problem.count), ("member", bias.member, len(bias.members))):
        bad = (index < 0) | (index >= limit)
        if bad.any():
            raise InvalidProblem(f"there is no {name} {index[bad][0]}", where, f"use 0 to {limit - 1}")
    if not np.isfinite(bias.coefficient).all():
        raise InvalidProblem("a coefficient is not finite", where, "give numbers such as 1 and -1")
    if bias.form == "rotation":
        _check_turned(problem, bias, where)
    turns = (1 if problem.dimension == 2 else 3) if bias.form == "rotation" else 1
    if bias.sigma is None:
        return
    wanted = len(bias.members) * turns
    for name, values, sizes in (("sigma", bias.sigma, [wanted]), ("mean", bias.mean, [1, wanted])):
        if np.size(values) not in sizes:
            raise InvalidProblem(
                f"{name} has {np.size(values)} entries, not {wanted}", where, "give one for each unknown"
            )
    if not ((np.asarray(bias.sigma) > 0.0) & np.isfinite(bias.sigma)).all() or not np.isfinite(bias.mean).all():
        raise InvalidProblem("sigma is not positive or mean is not finite", where, "give true numbers, or no sigma")


def _check_turned(problem: Problem, bias: Bias, where: str) -> None:
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        inside = (bias.row >= start) & (bias.row < start + rows.count)
        if inside.any() and not MODELS[rows.kind].axes:
            advice = "let it touch rows that are measured in the station's axes"
            raise InvalidProblem(
                f"a rotation does not change {rows.kind} row {bias.row[inside][0] - start}", where, advice
            )


def _check_prior(problem: Problem, prior: Prior) -> None:
    where = f"prior on {prior.name}"
    slot, _ = problem.layout.find(prior.name)
    if prior.mean.shape[-1:] != (slot.size,) or prior.covariance.shape[-2:] != (slot.size, slot.size):
        raise InvalidProblem(
            f"mean {prior.mean.shape} and covariance {prior.covariance.shape} do not fit",
            where,
            f"give {slot.size} entries",
        )
    if not np.isfinite(prior.mean).all():
        raise InvalidProblem("the mean is not finite", where, "give SI units, or no prior")
