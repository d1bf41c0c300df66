"""Starts for azimuths with unknown offsets: from known targets, from located targets, or from a grid of turns.

An offset of azimuths without a prior, or with a wide one, may be any part of a turn. Closed forms set offsets to their
prior means, and least squares does not correct an offset that is wrong by a right angle. Three rules find each offset:

1. If the station measures targets of known position, the offset is the circular mean of ``z - h(x)`` over these rows.
   These rows also overrule a narrow prior. Here z is the measurement and h(x) the prediction.
2. Else the rows of oriented stations locate the targets, and rule 1 applies to the located targets.
3. Else no target can be located. Then a grid of turns is tried for the offset with the most rows.

In a vector, NaN means that an offset or a position is not found yet. Letters: N problems, q vectors of a problem, m
rows, n offsets, `size` numbers of a vector. Angles are in radians.
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
        Names of the biases with offsets of this kind.
    column : int array (n,)
        Column of each offset in the vector of unknowns; all members of these biases.
    touch : array (n, m)
        Factor with which each offset enters each row: 1, -1 or 0.
    mean : array (n,)
        Prior mean, or zero, radians.
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
    is_azimuth = np.concatenate([np.full(rows.count, MODELS[rows.kind].period is not None) for rows in problem.rows])
    known_targets = [i for i, motion in enumerate(problem.motions) if motion.known is not None]
    to_known_target = np.isin(np.concatenate([rows.target for rows in problem.rows]), known_targets)
    parts = []
    for bias in problem.biases:
        count, correlated = len(bias.members), any(prior.name == bias.name for prior in problem.priors)
        is_wide = np.broadcast_to(True if bias.sigma is None else bias.sigma > _WIDE, (count,))
        has_known_target = np.bincount(bias.member, to_known_target[bias.row], count) > 0
        form = form_of(bias)
        constant = form.enters == "adds" and not form.rate and form.steps is None and form.values_at is None
        if not constant or correlated or not (is_wide | has_known_target).any() or not is_azimuth[bias.row].all():
            continue
        factor = np.zeros((count, problem.count))
        factor[bias.member, bias.row] = bias.coefficient
        slot, _ = problem.layout.find(bias.name)
        mean = np.broadcast_to(bias.mean if bias.sigma is not None else 0.0, (count,))
        known, free = ~(is_wide | has_known_target), np.full(count, bias.sigma is None)
        parts.append((slot.start + np.arange(count), factor, mean, known, free, bias.name))
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
    while (lacking := _is_missing(found, x)).any():
        located = _orient(problem, found, _locate(problem, found, x, start))
        if _is_missing(found, located).sum() < lacking.sum():
            x = located
        elif grids < _GRIDS:
            x, grids = _with_turns(problem, found, x, lacking), grids + 1
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
    """Return the columns, in a vector of unknowns, of the states of all targets that are not known."""
    epochs, count, found = np.arange(problem.epochs), len(problem.motions), [np.zeros(0, dtype=int)]
    for i, motion in enumerate(problem.motions):
        names = () if motion.known is not None else state_names(i, count, motion.order)
        found += [columns(problem.layout, name, epochs).ravel() for name in names]
    return np.unique(np.concatenate(found))


def _located(problem: Problem, x: Array) -> Array:
    """Return flags (N, q, m) of rows whose target has a known position, or a position in vectors x (N, q, size)."""
    count, out = len(problem.motions), np.ones((*x.shape[:2], problem.count), dtype=bool)
    target, epoch = np.concatenate([rows.target for rows in problem.rows]), problem.epoch
    for i, motion in enumerate(problem.motions):
        rows_of_target = np.flatnonzero(target == i)
        for name in () if motion.known is not None else state_names(i, count, motion.order):
            out[..., rows_of_target] &= np.isfinite(x[..., columns(problem.layout, name, epoch[rows_of_target])]).all(
                -1
            )
    return out


def _orient(problem: Problem, found: Headings, x: Array) -> Array:
    """Return vectors (N, q, size) with circular means as offsets, over the rows of targets that have a position.

    Offsets with a value, and offsets without such rows, do not change.
    """
    size, q = x.shape[:2]
    part, value = problem.take(np.repeat(np.arange(size), q)), x[..., found.column]
    bare = x.copy()
    bare[..., found.column] = 0.0
    bare = np.nan_to_num(bare)
    residual = (part.observed - predict(part, bare.reshape(size * q, -1))).reshape(size, q, -1)
    weight = np.broadcast_to(part.weight / variances(part.noise, part.count), (size * q, part.count))
    usable = _located(problem, x) & (weight.reshape(size, q, -1) > 0.0) & np.isfinite(residual)
    residual = np.where(usable, residual, 0.0) - np.nan_to_num(value) @ found.touch
    # a row with two offsets determines one of them if the other is known
    one_unknown = np.isnan(value).astype(float) @ np.abs(found.touch) == 1.0
    share = np.where(usable & one_unknown, weight.reshape(size, q, -1), 0.0)
    # the sense of a row changes the sign of the sine only
    sine, cosine = (
        (share * part_of(residual)) @ sign.T for part_of, sign in ((np.sin, found.touch), (np.cos, np.abs(found.touch)))
    )
    has_rows = share @ np.abs(found.touch).T > 0.0
    mean = found.mean + wrap(np.arctan2(sine, cosine) - found.mean)
    out = x.copy()
    out[..., found.column] = np.where(np.isnan(value) & has_rows, mean, value)
    return out


def _is_missing(found: Headings, x: Array) -> Array:
    """Return flags (N, n) of offsets that have no value in any of the vectors x (N, q, size)."""
    return np.asarray(np.isnan(x[..., found.column]).all(1))


def _locate(problem: Problem, found: Headings, x: Array, start: Callable[[Problem], Array]) -> Array:
    """Return starting vectors (N, q c, size) from the rows whose offsets have a value in x (N, q, size).

    `start` maps problems with offsets about zero to c starting vectors each.
    """
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


def _with_turns(problem: Problem, found: Headings, x: Array, lacking: Array) -> Array:
    """Return vectors (N, q turns, size) with a grid of turns for the unknown offset that has the most rows.

    `lacking` (N, n) flags the unknown offsets. A problem without such an offset keeps its vectors, repeated.
    """
    rows = np.broadcast_to(problem.weight > 0.0, (len(x), problem.count)) @ np.abs(found.touch).T
    chosen = np.argmax(np.where(lacking, rows, -1.0), axis=1)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    out = np.repeat(x[:, :, None], _TURNS, axis=2)
    item = np.flatnonzero(lacking.any(1))
    column = found.column[chosen[item]]
    out[item, :, :, column] = turns + found.mean[chosen[item], None, None]
    return out.reshape(len(x), -1, x.shape[-1])
