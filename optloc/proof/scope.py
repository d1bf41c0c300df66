"""Scope of the proof: targets, kinds of rows, biases and constraints that it covers, and the definition of a run.

Each function `_reasons_against_...` yields sentences, one for each property of the problem that the proof does not
cover. No sentence means that the property is covered. A *node* is a scalar function of the position that rows are sums
of, such as a range. A *run* is a problem with too many nodes for dense matrices. A *factor* is an unknown number that
multiplies the nodes of a group of rows, such as an unknown speed of waves. Problem files call it a *scale*, so the
sentences for the user do, too. A factor is *free* if it has no prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from optloc.base.types import Array, Band
from optloc.kernels.jit import enabled
from optloc.linear.constraints import holds_along, is_exact
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.models.medium import Wind
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.proof.position_costs import factors_of_rows, own_epochs

# Greatest number of different ranges, angles and ratios, and of unknowns other than the position, for which a proof is
# worth its time. A box of ten thousand nodes takes a millisecond; plain Python takes a thousand times longer.
MOST_NODES, MOST_NODES_PLAIN, MOST_UNKNOWNS = 10_000, 24, 128
# Beyond these numbers of nodes, the proof for runs is used. Its time is proportional to the number of nodes, not to
# the square. SHORT is for stations that move: with 25 nodes of five epochs, the budget of dense rows did not suffice
# for one box. Without compiled code, plain Python begins proofs up to this number. MOST_DENSE is for stations that
# stay, whose batches share their rows.
SHORT, MOST_DENSE = 24, 128
# Greatest number of unknown factors of rows: each box solves a system of this size, and each factor adds three columns
# to its rows.
MOST_FACTORS = 3


def why_unsupported(problem: Problem) -> str:
    """Return the first reason why the proof does not cover a flat batch of problems, or "" if it covers them."""
    return next(_reasons(problem), "")


def _reasons(problem: Problem) -> Iterator[str]:
    """Yield all reasons why the proof does not cover a problem."""
    if len(problem.motions) != 1:
        yield _reason_against_targets(problem)
        return
    motion = problem.motions[0]
    if motion.known is not None or not problem.layout.shares("position"):
        yield "the rows do not share one position"
    if motion.order > 0:
        yield from _reasons_against_motion(problem)
    yield from _reasons_against_rows(problem)
    yield from _reasons_against_biases(problem)
    if is_scaled(problem) and not has_one_epoch_velocity(problem):
        yield from _reasons_against_scale(problem)
    yield from _reasons_against_stations(problem)
    yield from _reasons_against_constraints(problem)
    if problem.fences:
        yield f"{problem.fences[0].name!r} is an uncertain fence, whose cost the proof does not bound"
    known = {"position", "velocity", *(bias.name for bias in problem.biases)}
    known |= {name for name, _, _ in problem.stations.errors}
    # `optloc.proof.position_costs` writes priors on known names as rows. Other priors would silently be left out of
    # the cost.
    for name, _, _ in prior_parts(problem):
        if name not in known:
            yield f"the prior on {name} is not covered"


def _reason_against_targets(problem: Problem) -> str:
    """Return the reason against several targets, with the way to a proof if only one position is unknown."""
    unknown, count = sum(motion.known is None for motion in problem.motions), len(problem.motions)
    # A walk has a value at each epoch, which no mean and sigma of a file describe.
    if unknown != 1 or any(form_of(bias).steps is not None for bias in problem.biases):
        return f"there are {count} targets, but the proof covers one"
    # The rows of a known target bound the biases that both targets share. The proof has no such rows, only priors.
    return (
        "rows of a target with a known position share biases with the other target, but the proof covers the rows of "
        "one target; fix the known target alone, and state its biases with mean and sigma in the file of the other"
    )


def _reasons_against_motion(problem: Problem) -> Iterator[str]:
    """Yield the reasons against a moving target: a node at an epoch must depend on the position at that epoch."""
    motion = problem.motions[0]
    if motion.order > 1:
        yield "the target accelerates, but the proof covers fixed targets and uniform motion"
    if has_one_epoch_velocity(problem):
        yield from _reasons_against_velocity_at_epoch(problem)
        return
    if problem.epochs < 2:
        yield "the target moves, and the proof then needs several epochs"
    if problem.dimension > 2 and held_height(problem) is None:
        yield "the target moves in space, but the proof covers the plane and known heights over ground"
    if problem.dimension > 2 and any(name == "velocity" for name, _, _ in prior_parts(problem)):
        yield "the target moves over ground, and the proof then covers no prior on velocity"
    for rows in problem.rows:
        if MODELS[rows.kind].velocity:
            yield f"the target moves, and {rows.kind} rows depend on its velocity"


def has_one_epoch_velocity(problem: Problem) -> bool:
    """Return whether all rows are of one epoch and contain rates, so that the velocity of the target is an unknown."""
    motion = problem.motions[0]
    if motion.order != 1 or motion.known is not None or problem.epochs > 1:
        return False
    return any(MODELS[rows.kind].velocity for rows in problem.rows)


def _reasons_against_velocity_at_epoch(problem: Problem) -> Iterator[str]:
    """Yield the reasons against rates of one epoch: the proof needs rates that are linear in the velocity."""
    motion = problem.motions[0]
    if motion.over != "space" or motion.rise is not None:
        yield "the target moves over ground, and the proof then needs several epochs"
    if problem.times[0] != problem.origin:
        yield "the target moves, and its state is for another time than the rows"
    for rows in problem.rows:
        model = MODELS[rows.kind]
        if model.velocity and {node for _, node in model.nodes} != {"range_rate"}:
            yield f"the target moves, and {rows.kind} rows depend on its velocity"
    if problem.constraints:
        yield "the velocity at one epoch is unknown, and the proof then covers no constraints"
    if any(form_of(bias).enters == "scales" for bias in problem.biases):
        yield "the velocity at one epoch is unknown, and the proof then covers no unknown scales"
    if is_run(problem):
        yield f"the velocity at one epoch is unknown; the proof then covers {MOST_DENSE} different ranges and rates"


def held_height(problem: Problem) -> Band | None:
    """Return the exact constraint on the height of a target that moves over ground, or None without it."""
    for band in problem.constraints:
        if not isinstance(band, Band) or band.kind != "height" or not is_exact(band):
            continue
        if holds_along(problem, band) and problem.motions[band.target].over == "ground":
            return band
    return None


def _reasons_against_rows(problem: Problem) -> Iterator[str]:
    """Yield the reasons against the kinds of rows, and against the numbers of nodes and unknowns."""
    for rows in problem.rows:
        model = MODELS[rows.kind]
        if model.straight is not None:
            rays = "cross a wind" if isinstance(problem.medium, Wind) else "follow rays that bend"
            yield f"{model.straight} rows {rays}, but the proof covers straight rays"
        elif model.ranges is None and not model.nodes:
            yield f"{rows.kind} rows are neither sums of ranges or rates nor a kind with known bounds"
    most = MOST_NODES if enabled() else MOST_NODES_PLAIN
    if problem.count > most and _node_count(problem) > most:
        without = "" if enabled() else " without compiled code"
        count = _node_count(problem)
        yield f"there are {count} different ranges, rates and angles, but the proof covers {most}{without}"
    if problem.layout.size - problem.dimension > MOST_UNKNOWNS:
        yield f"there are {problem.layout.size} unknowns, but the proof covers {MOST_UNKNOWNS}"


def is_run(problem: Problem) -> bool:
    """Return whether a proof uses the method for runs (`optloc.proof.runs`): too many nodes for dense rows."""
    most = SHORT if own_epochs(problem) > 1 else MOST_DENSE
    return 2 * problem.count > most and _node_count(problem) > most


def why_too_large(problem: Problem) -> str:
    """Return the reason why a problem does not fit methods with dense rows, or an empty string if it fits.

    Unknown factors of rows and an unknown velocity are reasons, too, at any number of rows.
    """
    number = _node_count(problem)
    if is_scaled(problem):
        return "the velocity is unknown" if has_one_epoch_velocity(problem) else "a factor of the rows is unknown"
    return (
        "" if number <= MOST_DENSE else f"there are {number} different ranges, rates and angles, more than {MOST_DENSE}"
    )


def _node_count(problem: Problem) -> int:
    """Return the number of different ranges, rates, angles, ratios and heights in the rows.

    Rows share the range or rate of one station (at one epoch, if anything moves). Other nodes belong to one row.
    """
    moving, unshared = own_epochs(problem) > 1, 0
    shared: set[tuple[bool, int, int]] = set()
    for rows in problem.rows:
        model = MODELS[rows.kind]
        if model.signs is None:
            unshared += rows.count * len(model.nodes)
            continue
        when = rows.epoch if moving else np.zeros_like(rows.epoch)
        for index in (rows.a, rows.b)[: model.stations]:
            shared.update((model.ranges is None, *key) for key in zip(index.tolist(), when.tolist(), strict=True))
    return unshared + len(shared)


def _reasons_against_biases(problem: Problem) -> Iterator[str]:
    """Yield the reasons against the biases."""
    angular = np.concatenate([np.full(rows.count, MODELS[rows.kind].period is not None) for rows in problem.rows])
    for bias in problem.biases:
        if why := form_of(bias).beyond_proof:
            yield f"the {bias.form} {bias.name!r} {why}"
        elif bias.sigma is None and angular[bias.row].any():
            yield f"the bias {bias.name!r} of angles has no prior, so it may include whole turns"


def is_scaled(problem: Problem) -> bool:
    """Return whether rows have unknown factors or an unknown velocity; `optloc.proof.scaled` proves these fixes."""
    return any(form_of(bias).enters == "scales" for bias in problem.biases) or has_one_epoch_velocity(problem)


def _reasons_against_scale(problem: Problem) -> Iterator[str]:
    """Yield the reasons against unknown factors: the proof covers a few factors, each of a group of rows."""
    scales = [bias for bias in problem.biases if form_of(bias).enters == "scales"]
    name, count, factor = scales[0].name, sum(len(bias.members) for bias in scales), factors_of_rows(problem)
    if count > MOST_FACTORS:
        yield f"there are several scales ({count}), but the proof covers {MOST_FACTORS}"
    elif (factor < -1).any():
        yield "rows have several scales, or a multiple of a scale, but the proof covers one scale for each row"
    free = np.concatenate([np.full(len(bias.members), bias.sigma is None) for bias in scales])
    # The two values False are for rows with the numbers -1 and -2 instead of a factor.
    yield from _reasons_against_factors(problem, factor, [*free, False, False])
    if problem.constraints:
        yield f"the scale {name!r} is unknown, and the proof then covers no constraints"
    if problem.stations.unknown_for:
        yield f"the scale {name!r} multiplies unknown station errors, which the proof does not cover"
    if is_run(problem):
        yield f"the scale {name!r} belongs to a long run, but the proof covers {MOST_DENSE} different ranges"


def _reasons_against_factors(problem: Problem, factor: Array, free: Sequence[bool]) -> Iterator[str]:
    """Yield the reasons against kinds of rows with unknown factors.

    `factor` (m,) is the number of the factor of each row: -1 without a factor, -2 with several factors or with a
    multiple of one (`factors_of_rows`). `free` is True for each factor without a prior. It ends with two values False,
    so that -1 and -2, read as indices from the end, find no free factor.
    """
    emitting, kinds = set[int](), {rows.kind for rows in problem.rows}
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        model, factors = MODELS[rows.kind], {int(number) for number in factor[start : start + rows.count]}
        emitting |= factors if model.emission else set()
        without_prior = any(free[number] for number in factors)
        if model.ranges is None and {node for _, node in model.nodes} != {"log range"}:
            yield f"a scale is unknown; the proof then covers times, ranges and levels, but no {rows.kind} rows"
        elif model.ranges is None and without_prior and (len(kinds) > 1 or len(factors) > 1):
            yield f"the scale of {rows.kind} rows has no prior, and other rows do not have this scale"
        # Signs of ranges that sum to zero form differences, and an unknown emission time has the same effect.
        elif without_prior and sum(model.ranges or ()) != 0 and not model.emission:
            yield f"the scale of {rows.kind} rows has no prior, so that nothing bounds the position"
    if len(emitting) > 1 and any(free[number] for number in emitting):
        yield "rows with different scales share an unknown emission time, and a scale has no prior"


def _reasons_against_stations(problem: Problem) -> Iterator[str]:
    """Yield the reasons against the errors of station positions and velocities."""
    if problem.stations.velocity_covariance is not None:
        rates = [rows.kind for rows in problem.rows if MODELS[rows.kind].velocity]
        if rates:
            yield f"errors of the stations' velocities change {rates[0]} rows by amounts that depend on the position"
    if problem.stations.covariance is None:
        return
    # If station errors are isotropic, the admitted station position nearest to the surveyed one is on the line to the
    # target.
    if not problem.stations.isotropic:
        yield "the station errors differ from axis to axis"
    if problem.stations.unknown_for == "run" and _stations_move(problem):
        yield "station errors last the whole run while stations move; the proof covers one line of sight for each"
    bent = [rows.kind for rows in problem.rows if MODELS[rows.kind].ranges is None and MODELS[rows.kind].stations]
    if bent:
        yield f"station errors change {bent[0]} rows by amounts that depend on the position"


def _stations_move(problem: Problem) -> bool:
    """Return whether a station that rows of several epochs name has different positions at these epochs."""
    position = problem.stations.position
    if position.shape[-3] < 2:
        return False
    stations = np.concatenate([(rows.a, rows.b)[k] for rows in problem.rows for k in range(MODELS[rows.kind].stations)])
    when = np.concatenate([rows.epoch for rows in problem.rows for k in range(MODELS[rows.kind].stations)])
    for station in np.unique(stations):
        positions = position[..., np.unique(when[stations == station]), station, :]
        if (positions != positions[..., :1, :]).any():
            return True
    return False


def _reasons_against_constraints(problem: Problem) -> Iterator[str]:
    """Yield the reasons against the constraints."""
    equalities = [constraint for constraint in problem.constraints if is_exact(constraint)]
    if len(equalities) > 1 and any(isinstance(equality, Band) and equality.kind == "height" for equality in equalities):
        yield "a known height and another equality leave a line, which the proof does not follow"
    if len(equalities) >= problem.dimension:
        yield "the equalities leave no free direction"
    for constraint in problem.constraints:
        if is_exact(constraint) and isinstance(constraint, Band) and constraint.kind not in ("height", "plane"):
            yield f"the equality {constraint.name!r} is neither a height nor a plane"
