"""Whole sets of rows, one or none of each channel, scored against predicted targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optloc.errors import InvalidProblem
from optloc.evaluate import predict
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem import Problem
from optloc.track.gate import check_width, innovation
from optloc.track.track import State
from optloc.types import Array

# Sets of a target and scan that are followed at once.
_SETS = 1000


@dataclass(frozen=True, slots=True)
class Clutter:
    """What is known of detections.

    Parameters
    ----------
    detection : float
        Probability that a target is seen in a channel, between 0 and 1, both excluded.
    density : float or mapping of str to float
        Mean number of false rows of a channel and scan per unit of what is measured (SI units or radians), for all
        kinds or by kind.
    width : float
        Half width of the gate of single rows, in standard deviations of the innovation.
    """

    detection: float
    density: float | Mapping[str, float]
    width: float = 5.0

    def __post_init__(self) -> None:
        if not 0.0 < self.detection < 1.0:
            what = f"a probability of detection of {self.detection}"
            raise InvalidProblem(what, "detection", "give a number between 0 and 1")
        densities = self.density.values() if isinstance(self.density, Mapping) else (self.density,)
        if not all(np.isfinite(value) and value > 0.0 for value in densities):
            advice = "give the mean number of false rows of a channel and scan for each metre or radian, above 0"
            raise InvalidProblem(f"a density of false rows of {self.density}", "density", advice)
        check_width(self.width)

    def of(self, scan: Problem) -> Array:
        """Return the density of false rows in each channel of a scan, (m,); raise InvalidProblem for unknown kinds."""
        values = []
        for block in scan.rows:
            density = self.density.get(block.kind) if isinstance(self.density, Mapping) else self.density
            if density is None:
                raise InvalidProblem(f"no density of false {block.kind} rows is given", "density", "give one")
            values.append(np.full(block.count, float(density)))
        return np.concatenate(values)


@dataclass(frozen=True, slots=True)
class Sets:
    """Sets of candidates and how well they explain each target; the first one is empty.

    Parameters
    ----------
    score : array (..., t, q)
        Twice the negative log-likelihood ratio; infinite for sets that a target cannot have.
    picks : int array (..., t, q, m)
        For each set and channel, which candidate it holds, or -1.
    """

    score: Array
    picks: Array

    def chosen(self, number: Array) -> Array:
        """Return the picks (..., t, m) of the sets of given numbers (..., t)."""
        return np.asarray(np.take_along_axis(self.picks, number[..., None, None], axis=-2)[..., 0, :])


def scored(scan: Problem, ahead: State, z: Array, clutter: Clutter) -> Sets:
    """Return the scores of all sets of candidates within their gates; see `optloc.track.associate.joint`.

    Sets grow channel by channel: the density of the rows of a set is the product of those of each row given the rows
    before it. Where there are too many, the best beginnings are followed.

    Parameters
    ----------
    scan : Problem
        One row for each channel.
    ahead : State
        Predicted targets (..., t).
    z : array (..., m, c)
        Candidates.
    clutter : Clutter
        Detection and false rows.
    """
    apart, S = offsets(scan, ahead, z)
    distance = distances(apart, S, clutter.width)
    kept = max(1, int(np.isfinite(distance).sum(-1).max(initial=0)))
    order = np.argsort(distance, axis=-1, kind="stable")[..., :kept]
    near = np.take_along_axis(np.where(np.isfinite(distance), apart, np.nan), order, axis=-1)
    gain, missed = 2.0 * np.log(clutter.detection / clutter.of(scan)), -2.0 * np.log1p(-clutter.detection)
    shape, m = near.shape[:-2], near.shape[-2]
    score, picks = np.zeros((*shape, 1)), np.zeros((*shape, 1, 0), dtype=np.int64)
    mean = np.zeros((*shape, 1, m))
    V = np.broadcast_to(S, (*shape, m, m))[..., None, :, :]
    for i in range(m):
        # Station pairs that close a loop may leave nothing of a variance but rounding.
        s = np.maximum(V[..., i, i], 1e-12 * S[..., None, i, i])
        away = near[..., None, i, :] - mean[..., i, None]
        seen = (score + np.log(2.0 * np.pi * s) - gain[i])[..., None] + away**2 / s[..., None]
        both = np.concatenate([(score + missed)[..., None], np.where(np.isnan(seen), np.inf, seen)], axis=-1)
        number = _best(both.reshape(*shape, -1))
        parent, option = np.divmod(number, kept + 1)
        score = np.take_along_axis(both.reshape(*shape, -1), number, axis=-1)
        picks, mean = (np.take_along_axis(part, parent[..., None], axis=-2) for part in (picks, mean))
        V = np.take_along_axis(V, parent[..., None, None], axis=-3)
        column = np.take_along_axis(order[..., i, :], np.maximum(option - 1, 0), axis=-1)
        picks = np.concatenate([picks, np.where(option > 0, column, -1)[..., None]], axis=-1)
        value = np.take_along_axis(near[..., i, :], np.maximum(option - 1, 0), axis=-1)
        used = (option > 0) & np.isfinite(score)
        across, s = V[..., :, i], np.take_along_axis(s, parent, axis=-1)
        share = np.where(used[..., None], across / s[..., None], 0.0)
        mean = mean + share * np.where(used, value - mean[..., i], 0.0)[..., None]
        V = V - share[..., :, None] * across[..., None, :]
    return Sets(score, picks)


def offsets(scan: Problem, ahead: State, z: Array) -> tuple[Array, Array]:
    """Return candidates less what is expected of each target (..., t, m, c), and S (..., t, m, m).

    Parameters
    ----------
    scan : Problem
        One row for each channel.
    ahead : State
        Predicted targets (..., t).
    z : array (..., m, c)
        Candidates.
    """
    expected = predict(scan, ahead.mean)
    apart = z[..., None, :, :] - expected[..., None]
    for block, start in zip(scan.rows, scan.starts, strict=True):
        if MODELS[block.kind].period is not None:
            part = slice(start, start + block.count)
            apart[..., part, :] = wrap(apart[..., part, :])
    S = innovation(scan.with_rows(z=expected), ahead.mean, ahead.cov).covariance
    return apart, S


def distances(apart: Array, S: Array, width: float) -> Array:
    """Return normalised distances (..., t, m, c), infinite outside the gate and where there is no candidate.

    Parameters
    ----------
    apart, S : array
        See `offsets`.
    width : float
        Half width of the gate in standard deviations of the innovation.
    """
    distance = np.abs(apart) / np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))[..., None]
    return np.where(distance <= width, distance, np.inf)


def _best(score: Array) -> Array:
    """Return which of the sets (..., q) are kept, (..., p): the empty one first, and no more than can be followed."""
    possible = np.flatnonzero(np.isfinite(score).any(tuple(range(score.ndim - 1))))
    if len(possible) <= _SETS:
        return np.broadcast_to(possible, (*score.shape[:-1], len(possible)))
    key = score.copy()
    key[..., 0] = -np.inf
    return np.argsort(key, axis=-1, kind="stable")[..., :_SETS]
