"""One target of several: its own rows and scans as a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.errors import InvalidProblem
from optloc.noise import Block, Noise
from optloc.problem import Problem
from optloc.types import Array, Motion, Rows

_ROW_ARRAYS = ("z", "weight", "correction")


def alone(problem: Problem, kept: Array, times: Array | None = None) -> Problem:
    """Return the run of one target: some rows of a problem, and the epochs that they belong to.

    Parameters
    ----------
    problem : Problem
        Any run; what it says of motions, and constraints of other targets, is left out.
    kept : bool array (m,)
        Rows of the target, of all kinds.
    times : array (k,), optional
        Seconds of the epochs of `problem`, in the place of its own.

    Returns
    -------
    Problem
        Of one target that is free at each epoch, to be given to `tracked`.

    Raises
    ------
    InvalidProblem
        Where no row is left.
    """
    if not kept.any():
        raise InvalidProblem("the target has no rows", "track", "name a target that was measured")
    epochs = np.unique(problem.epoch[kept])
    number = np.full(problem.epochs, -1)
    number[epochs] = np.arange(len(epochs))
    parts = np.split(kept, np.cumsum([rows.count for rows in problem.rows])[:-1])
    rows = tuple(_rows(block, own, number) for block, own in zip(problem.rows, parts, strict=True) if own.any())
    target = np.unique(np.concatenate([b.target[own] for b, own in zip(problem.rows, parts, strict=True)]))
    s = problem.stations

    def at(values: Array | None, core: int) -> Array | None:
        return values if values is None or values.shape[-core] == 1 else np.take(values, epochs, axis=-core)

    position = at(s.position, 3)
    assert position is not None
    return replace(
        problem,
        stations=replace(s, position=position, velocity=at(s.velocity, 3), axes=at(s.axes, 4)),
        rows=rows,
        noise=Noise(tuple(_blocks(problem.noise, kept))),
        times=(problem.times if times is None else times)[epochs],
        motions=(Motion(span="epoch"),),
        constraints=tuple(replace(c, target=0) for c in problem.constraints if c.target in target),
    )


def _rows(block: Rows, own: Array, number: Array) -> Rows:
    picked = {name: getattr(block, name)[..., own] for name in _ROW_ARRAYS}
    a, b = block.a[own], block.b[own]
    return replace(block, **picked, a=a, b=b, epoch=number[block.epoch[own]], target=np.zeros_like(a))


def _blocks(noise: Noise, kept: Array) -> list[Block]:
    """Return the noise of the rows that are kept: of a group that loses some, the covariance of the others."""
    place, found = np.cumsum(kept) - 1, []
    for block in noise.blocks:
        inside = kept[block.row]
        for pattern in np.unique(inside, axis=0):
            if not pattern.any():
                continue
            groups = (inside == pattern).all(1)
            one = block.covariance.shape[-3] == 1
            covariance = block.covariance if one else block.covariance[..., groups, :, :]
            found.append(Block(place[block.row[groups][:, pattern]], covariance[..., pattern, :][..., pattern]))
    return found
