"""Covariance blocks of measurements read from a file: independent rows, arrivals, a matrix for each epoch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.chunk import Chunk
from optloc.files.schema import ProblemFile
from optloc.files.sigmas import ESTIMATE
from optloc.files.words import join
from optloc.models import MODELS
from optloc.noise import Block, Noise, arrivals, group, together
from optloc.problem import Problem
from optloc.quality.levels import NoiseLevels, with_estimated_noise
from optloc.types import Array


def noise_of(
    chunks: Sequence[Chunk], numbers: Sequence[Array], epochs: Sequence[Array], targets: Sequence[Array]
) -> Noise:
    """Return the noise of chunks.

    Parameters
    ----------
    chunks : sequence of Chunk
        Rows with their own noise.
    numbers, epochs, targets : sequence of int array (m,)
        Global row number, epoch and target of each row of each chunk.
    """
    blocks: list[Block] = []
    for chunk, number, epoch, target in zip(chunks, numbers, epochs, targets, strict=True):
        if chunk.sigma is not None:
            blocks.append(Block(number[:, None], chunk.sigma[:, None, None] ** 2))
        elif chunk.arrival is not None:
            members = together(epoch * (target.max(initial=0) + 1) + target)
            blocks += [Block(number[m], _arrivals(chunk, m)) for m in members]
        elif chunk.covariance is not None:
            blocks.append(_repeated(chunk, number, epoch, chunk.covariance))
        else:
            advice = "give sigma, arrival_sigma or covariance, or rows with a column sigma"
            raise InvalidProblem("the measurements have no noise", chunk.table.source, advice)
    return group([Block(b.row, b.covariance) for b in blocks])


def _arrivals(chunk: Chunk, members: Array) -> Array:
    """Return the covariance (g, r, r) of groups of rows (g, r) that combine independent arrivals."""
    signs = MODELS[chunk.kind].ranges
    assert signs is not None
    assert chunk.arrival is not None
    ends = [(index[members], sign) for index, sign in zip((chunk.a, chunk.b), signs, strict=True)]
    covariance = arrivals(ends, chunk.arrival**2)
    row, column = np.nonzero(np.diagonal(covariance, axis1=-2, axis2=-1) <= 0.0)
    if len(row):
        place = join(chunk.table.source, f"row {chunk.row[members[row[0], column[0]]] + 1}")
        raise InvalidProblem("no station of this row has an arrival_sigma", place, "name its stations there")
    return covariance


def _repeated(chunk: Chunk, number: Array, epoch: Array, matrix: Array) -> Block:
    return per_epoch(number, epoch, chunk.slope, matrix, join(chunk.table.source, "covariance"), int(chunk.row[0]))


def per_epoch(number: Array, epoch: Array, slope: Array, matrix: Array, where: str, first: int = 0) -> Block:
    """Return the block of a matrix (r, r) that holds for the r rows of every epoch, in the order of the file.

    Parameters
    ----------
    number, epoch : int array (m,)
        Global row number and epoch of each row.
    slope : array (m,)
        SI units in one unit of the file.
    matrix : array (r, r)
        In the file's units.
    where : str
        Place to name.
    first : int
        Row that the first stands in.
    """
    groups = together(epoch)
    wrong = [g for g in groups if g.shape[1] != len(matrix)]
    if wrong:
        row = int(wrong[0][0, 0])
        what = f"the epoch of row {row + first + 1} has {wrong[0].shape[1]} rows, but the covariance {len(matrix)}"
        raise InvalidProblem(what, where, "give every epoch all rows, absent ones with weight 0")
    members = groups[0]
    sizes = slope[members]
    if not np.isfinite(sizes).all():
        raise InvalidProblem("a covariance in dB needs the measured values", where, "state it in unit '1'")
    return Block(number[members], matrix * sizes[:, :, None] * sizes[:, None, :])


def with_noise(file: ProblemFile, problem: Problem, source: str) -> tuple[Problem, NoiseLevels | None]:
    """Return the problem with its noise found from the data, where the file leaves it to them."""
    if all(section.sigma != ESTIMATE for section in file.measurements):
        return problem, None
    place = join(source, "key 'sigma'")
    if any(section.sigma != ESTIMATE for section in file.measurements):
        what = "the noise of some measurements is stated and that of others is to be estimated"
        raise InvalidProblem(what, place, f'state all, or give sigma = "{ESTIMATE}" to all')
    if not np.isfinite(problem.z[problem.weight > 0.0]).all():
        raise InvalidProblem("without measured values there is no noise to estimate", place, "state a sigma")
    try:
        return with_estimated_noise(problem)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, place, error.advice) from None
