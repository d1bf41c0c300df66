"""Biases that were learnt elsewhere: taken as known, they leave the problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.arguments import numbers
from optloc.errors import InvalidProblem, nearest
from optloc.models.primitives import rotate
from optloc.problem import Problem
from optloc.types import Array, Bias


def with_known_bias(problem: Problem, name: str, values: Any) -> Problem:
    """Return the problem with one of its families of biases taken as known.

    Learn on one run, apply to another: ``with_known_bias(later, "clock", fix.take("clock"))``.

    Parameters
    ----------
    problem : Problem
        Has the family among its biases.
    name : str
        Name of the family.
    values : array (q,) or (q, 3), or mapping of str to number
        Value of each member in the order of the family, in its unit (radians for a rotation), or by the name of the
        member; members that a mapping lacks have none.

    Returns
    -------
    Problem
        Without the family: its rows are corrected, or the axes of its stations turned.

    Raises
    ------
    InvalidProblem
        Where there is no such family or member, or values do not fit.
    """
    names = [bias.name for bias in problem.biases]
    if name not in names:
        raise InvalidProblem(f"there is no bias {name!r}", "name", nearest(name, names) if names else "there are none")
    bias = problem.biases[names.index(name)]
    known = _ordered(bias, values, (3,) if bias.form == "rotation" and problem.dimension == 3 else ())
    rest = replace(problem, biases=tuple(b for b in problem.biases if b is not bias))
    return _turned(rest, bias, known) if bias.form == "rotation" else _corrected(rest, bias, known)


def _ordered(bias: Bias, values: Any, inner: tuple[int, ...]) -> Array:
    """Return values (q,) or (q, 3) in the order of the members."""
    where = f"values of {bias.name!r}"
    if isinstance(values, Mapping):
        strange = [member for member in values if member not in bias.members]
        if strange:
            raise InvalidProblem(f"{strange[0]!r} is no member", where, nearest(str(strange[0]), list(bias.members)))
        values = [values.get(member, np.zeros(inner)) for member in bias.members]
    array, shape = np.asarray(numbers(values, where)), (len(bias.members), *inner)
    if array.size != np.prod(shape):
        raise InvalidProblem(f"there are {array.size} values", where, f"give an array of shape {shape}")
    if not np.isfinite(array).all():
        raise InvalidProblem("a value is not finite", where, "take the biases of a fix that has an answer")
    return array.reshape(shape)


def _corrected(problem: Problem, bias: Bias, known: Array) -> Problem:
    """Return the problem with offsets, drifts or scales in the known corrections of its rows."""
    amount = np.zeros(problem.count)
    since = (problem.times - problem.origin)[problem.epoch[bias.row]] if bias.form == "drift" else 1.0
    np.add.at(amount, bias.row, bias.coefficient * since * known[bias.member])
    rows = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        own: Any = amount[start : start + block.count]
        if bias.form == "scale":
            own = (block.z - block.correction) * own / (1.0 + own)
        rows.append(replace(block, correction=block.correction + own))
    return replace(problem, rows=tuple(rows))


def _turned(problem: Problem, bias: Bias, known: Array) -> Problem:
    """Return the problem with the axes of its stations turned."""
    d, stations = problem.dimension, problem.stations
    turn = np.zeros((stations.count, 1 if d == 2 else 3))
    first = np.concatenate([block.a for block in problem.rows])[bias.row]
    turn[first] = bias.coefficient[:, None] * known.reshape(len(known), -1)[bias.member]
    axes = np.eye(d) + np.zeros((1, stations.count, d, d)) if stations.axes is None else stations.axes
    own = tuple(tuple(axes[..., i, c] for c in range(d)) for i in range(d))
    rows = rotate(own, tuple(turn[:, c] for c in range(turn.shape[1])))
    return replace(
        problem, stations=replace(stations, axes=np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))
    )
