"""Starts for azimuths with unknown offsets: from known targets, from located targets, or from a grid of turns.

An offset of azimuths without a prior, or with a wide one, may be any part of a turn. Closed forms set offsets to their
prior means, and least squares does not correct an offset that is wrong by a right angle. Three rules find each offset:

1. If the station measures targets of known position, the offset is the circular mean of ``z - h(x)`` over these rows.
   These rows also overrule a narrow prior.
2. Else the rows of oriented stations locate the targets, and rule 1 applies to the located targets.
3. Else no target can be located. Then a grid of turns is tried for the offset with the most rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.linear.evaluate import columns, predict
from optloc.linear.vectors import vectors
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.forms import form_of
from optloc.problem.layout import state_names
from optloc.problem.noise import variances
from optloc.problem.problem import Problem
from optloc.solvers.pool import pack

# Standard deviation of a prior, radians, above which its mean is no start. Refinement recovers from errors of 80
# degrees, which is three such deviations.
_WIDE = 0.5
# Turns that are tried: one of them is within 15 degrees of the offset.
_TURNS = 12
# Offsets for which a grid of turns is tried: two oriented stations locate targets, which orient all other stations.
_GRIDS = 2


@dataclass(frozen=True, slots=True)
class Headings:
    """The offsets of azimuths that may be any part of a turn.

    Parameters
    ----------
    names : tuple of str
        Biases with such an offset.
    column : int array (n,)
        Column of each offset in the vector of unknowns; all members of these biases.
    touch : array (n, m)
        Factor with which each offset enters each row: 1, -1 or 0.
    mean : array (n,)
        Prior mean, or zero.
    known : bool array (n,)
        Whether the prior is narrow and no target of known position is measured: then the prior mean is the start.
    free : bool array (n,)
        Whether there is no prior, so that the offset is determined up to whole turns.
    """

    names: tuple[str, ...]
    column: Array
    touch: Array
    mean: Array
    known: Array
    free: Array


def headings(problem: Problem) -> Headings | None:
    """Return the offsets of azimuths that may be any part of a turn, or None without such offsets."""
    turns = np.concatenate([np.full(rows.count, MODELS[rows.kind].period is not None) for rows in problem.rows])
    marks = [i for i, motion in enumerate(problem.motions) if motion.known is not None]
    marked = np.isin(np.concatenate([rows.target for rows in problem.rows]), marks)
    parts = []
    for bias in problem.biases:
        count, tied = len(bias.members), any(prior.name == bias.name for prior in problem.priors)
        wide = np.broadcast_to(True if bias.sigma is None else bias.sigma > _WIDE, (count,))
        seen = np.bincount(bias.member, marked[bias.row], count) > 0
        form = form_of(bias)
        constant = form.enters == "adds" and not form.rate and form.steps is None and form.values_at is None
        if not constant or tied or not (wide | seen).any() or not turns[bias.row].all():
            continue
        touch = np.zeros((count, problem.count))
        touch[bias.member, bias.row] = bias.coefficient
        slot, _ = problem.layout.find(bias.name)
        mean = np.broadcast_to(bias.mean if bias.sigma is not None else 0.0, (count,))
        known, free = ~(wide | seen), np.full(count, bias.sigma is None)
        parts.append((slot.start + np.arange(count), touch, mean, known, free, bias.name))
    if not parts:
        return None
    *arrays, names = zip(*parts, strict=True)
    return Headings(names, *(np.concatenate(each) for each in arrays))


def oriented_starts(problem: Problem, found: Headings, start: Callable[[Problem], Array]) -> Array:
    """Return starting vectors (N, q, size) of a flat batch of problems with unknown offsets of azimuths.

    Parameters
    ----------
    problem : Problem
        N problems.
    found : Headings
        Their offsets.
    start : callable
        Maps problems whose offsets are about zero to starting vectors (N, q, size).
    """
    x = vectors(problem, None)[:, None]
    x[..., _states(problem)] = np.nan
    x[..., found.column] = np.where(found.known, found.mean, np.nan)
    x, grids = _orient(problem, found, x), 0
    while (lacking := _lacking(found, x)).any():
        located = _orient(problem, found, _locate(problem, found, x, start))
        if _lacking(found, located).sum() < lacking.sum():
            x = located
        elif grids < _GRIDS:
            x, grids = _turn(problem, found, x, lacking), grids + 1
        else:
            break
    out = _locate(problem, found, x, start)
    # a station that cannot be oriented keeps its prior mean: the verdict names the undetermined offset
    started = np.isfinite(np.delete(out, found.column, axis=-1)).all(-1, keepdims=True)
    open_still = started & np.isnan(out[..., found.column])
    out[..., found.column] = np.where(open_still, found.mean, out[..., found.column])
    return pack(out)


def unwind(found: Headings, x: Array) -> Array:
    """Return vectors (N, q, size) without whole turns of offsets that have no prior.

    The first vector gets offsets between plus and minus half a turn, the others offsets within half a turn of these.
    """
    column, out = found.column[found.free], np.array(x)
    out[:, :1, column] = wrap(out[:, :1, column])
    out[:, 1:, column] = out[:, :1, column] + wrap(out[:, 1:, column] - out[:, :1, column])
    return out


def _states(problem: Problem) -> Array:
    """Return the columns of the states of all targets that are not known."""
    every, count, found = np.arange(problem.epochs), len(problem.motions), [np.zeros(0, dtype=int)]
    for i, motion in enumerate(problem.motions):
        names = () if motion.known is not None else state_names(i, count, motion.order)
        found += [columns(problem.layout, name, every).ravel() for name in names]
    return np.unique(np.concatenate(found))


def _located(problem: Problem, x: Array) -> Array:
    """Return a flag for each row (N, q, m) whose target has a position in vectors (N, q, size)."""
    count, out = len(problem.motions), np.ones((*x.shape[:2], problem.count), dtype=bool)
    target, epoch = np.concatenate([rows.target for rows in problem.rows]), problem.epoch
    for i, motion in enumerate(problem.motions):
        own = np.flatnonzero(target == i)
        for name in () if motion.known is not None else state_names(i, count, motion.order):
            out[..., own] &= np.isfinite(x[..., columns(problem.layout, name, epoch[own])]).all(-1)
    return out


def _orient(problem: Problem, found: Headings, x: Array) -> Array:
    """Return vectors (N, q, size) whose offsets are circular means over the rows of targets that have a position."""
    size, q = x.shape[:2]
    part, value = problem.take(np.repeat(np.arange(size), q)), x[..., found.column]
    bare = x.copy()
    bare[..., found.column] = 0.0
    bare = np.nan_to_num(bare)
    left = (part.observed - predict(part, bare.reshape(size * q, -1))).reshape(size, q, -1)
    weight = np.broadcast_to(part.weight / variances(part.noise, part.count), (size * q, part.count))
    usable = _located(problem, x) & (weight.reshape(size, q, -1) > 0.0) & np.isfinite(left)
    left = np.where(usable, left, 0.0) - np.nan_to_num(value) @ found.touch
    # a row with two offsets determines one of them if the other is known
    single = np.isnan(value).astype(float) @ np.abs(found.touch) == 1.0
    share = np.where(usable & single, weight.reshape(size, q, -1), 0.0)
    sine, cosine = (
        (share * part_of(left)) @ sign.T for part_of, sign in ((np.sin, found.touch), (np.cos, np.abs(found.touch)))
    )
    seen = share @ np.abs(found.touch).T > 0.0
    mean = found.mean + wrap(np.arctan2(sine, cosine) - found.mean)
    out = x.copy()
    out[..., found.column] = np.where(np.isnan(value) & seen, mean, value)
    return out


def _lacking(found: Headings, x: Array) -> Array:
    """Return a flag for each offset (N, n) that has no value in any of the vectors (N, q, size)."""
    return np.asarray(np.isnan(x[..., found.column]).all(1))


def _locate(problem: Problem, found: Headings, x: Array, start: Callable[[Problem], Array]) -> Array:
    """Return starting vectors (N, q c, size) from the rows whose offsets have a value in x (N, q, size)."""
    size, q = x.shape[:2]
    value = x[..., found.column].reshape(size * q, -1)
    part = problem.take(np.repeat(np.arange(size), q))
    added = np.nan_to_num(value) @ found.touch
    missing = np.isnan(value).astype(float) @ np.abs(found.touch) > 0.0
    turned = tuple(
        replace(rows, correction=rows.correction + added[:, first : first + rows.count])
        for rows, first in zip(part.rows, part.starts, strict=True)
    )
    biases = tuple(
        replace(bias, mean=np.zeros(1), sigma=None) if bias.name in found.names else bias for bias in part.biases
    )
    weight = np.where(missing, 0.0, np.broadcast_to(part.weight, missing.shape))
    out = start(replace(part, rows=turned, biases=biases).with_rows(weight=weight))
    out[..., found.column] += value[:, None]
    return out.reshape(size, -1, out.shape[-1])


def _turn(problem: Problem, found: Headings, x: Array, lacking: Array) -> Array:
    """Return vectors (N, q turns, size) with a grid of turns for the unknown offset that has the most rows."""
    rows = np.broadcast_to(problem.weight > 0.0, (len(x), problem.count)) @ np.abs(found.touch).T
    chosen = np.argmax(np.where(lacking, rows, -1.0), axis=1)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    out = np.repeat(x[:, :, None], _TURNS, axis=2)
    item = np.flatnonzero(lacking.any(1))
    column = found.column[chosen[item]]
    out[item, :, :, column] = turns + found.mean[chosen[item], None, None]
    return out.reshape(len(x), -1, x.shape[-1])
