"""What the proof covers: one static position, rows made of ranges, angles, ratios and heights."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from optloc.base.types import Band
from optloc.compute.jit import enabled
from optloc.linear.constraints import is_exact
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.problem.problem import Problem

# Different ranges, angles and ratios, and unknowns beside the position, of a problem whose proof is worth the time. It
# goes with the square of the nodes, and plain Python takes a thousand times longer.
MOST_NODES, MOST_NODES_PLAIN, MOST_UNKNOWNS = 128, 24, 128


def unsupported(problem: Problem) -> str:
    """Return why a problem is beyond the proof, in a sentence that names what, or nothing where it is within.

    Parameters
    ----------
    problem : Problem
        Flat batch of problems.
    """
    return next(_reasons(problem), "")


def _reasons(problem: Problem) -> Iterator[str]:
    if len(problem.motions) != 1:
        yield f"there are {len(problem.motions)} targets, and the proof is for one"
        return
    motion = problem.motions[0]
    if motion.known is not None or not any(slot.name == "position" for slot in problem.layout.shared):
        yield "no position is common to all rows"
    if motion.order > 0:
        yield "the target moves, and the proof is for one that stays"
    yield from _of_rows(problem)
    yield from _of_biases(problem)
    yield from _of_stations(problem)
    yield from _of_constraints(problem)
    known = {"position", "stations", *(bias.name for bias in problem.biases)}
    # What `optloc.proof.pose` does not write as rows would be left out of the cost without a word.
    for name, _, _ in prior_parts(problem):
        if name not in known:
            yield f"the prior on {name} is not covered"


def _of_rows(problem: Problem) -> Iterator[str]:
    for rows in problem.rows:
        model = MODELS[rows.kind]
        if model.velocity:
            yield f"{rows.kind} rows depend on velocities, which the proof does not bound"
        elif model.ranges is None and not model.nodes:
            yield f"{rows.kind} rows are neither sums of ranges nor a kind whose bounds are known"
    most = MOST_NODES if enabled() else MOST_NODES_PLAIN
    if problem.count > most and _nodes(problem) > most:
        without = "" if enabled() else " without machine code"
        yield f"there are {_nodes(problem)} different ranges and angles, and the proof takes {most}{without}"
    if problem.layout.size - problem.dimension > MOST_UNKNOWNS:
        yield f"there are {problem.layout.size} unknowns, and the proof takes {MOST_UNKNOWNS}"


def _nodes(problem: Problem) -> int:
    """Return how many different ranges, angles, ratios and heights the rows are made of."""
    moving, own = problem.stations.position.shape[-3] > 1, 0
    found: set[tuple[int, int]] = set()
    for rows in problem.rows:
        model = MODELS[rows.kind]
        if model.ranges is None:
            own += rows.count * len(model.nodes)
            continue
        when = rows.epoch if moving else np.zeros_like(rows.epoch)
        for index in (rows.a, rows.b)[: model.stations]:
            found.update(zip(index.tolist(), when.tolist(), strict=True))
    return own + len(found)


def _of_biases(problem: Problem) -> Iterator[str]:
    angular = np.concatenate([np.full(rows.count, MODELS[rows.kind].period is not None) for rows in problem.rows])
    for bias in problem.biases:
        if bias.form not in ("offset", "drift"):
            yield f"the {bias.form} {bias.name!r} multiplies what it touches, and the proof takes what is added"
        elif bias.sigma is None and angular[bias.row].any():
            yield f"the bias {bias.name!r} of angles has no prior, and may be whole turns"


def _of_stations(problem: Problem) -> Iterator[str]:
    covariance = problem.stations.covariance
    if covariance is None:
        return
    # A sphere is what makes the nearest place to the surveyed one lie on the line to the target.
    same = np.eye(problem.dimension) * covariance[..., :1, :1]
    if not np.allclose(covariance, same, rtol=1e-9, atol=0.0):
        yield "the station errors differ from axis to axis"
    bent = [rows.kind for rows in problem.rows if MODELS[rows.kind].ranges is None and MODELS[rows.kind].stations]
    if bent:
        yield f"station errors enter {bent[0]} rows in a way that depends on the place"


def _of_constraints(problem: Problem) -> Iterator[str]:
    for constraint in problem.constraints:
        if is_exact(constraint) and isinstance(constraint, Band) and constraint.kind not in ("height", "plane"):
            yield f"the equality {constraint.name!r} is neither a height nor a plane"
