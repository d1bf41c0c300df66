"""From a batch of problems to what is proven about them: ``f(x) = |K phi(x) - w|^2`` over the position alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.noise import variances, whiten
from optloc.plan import columns, plans
from optloc.priors import prior_parts
from optloc.problem import Problem
from optloc.proof.alone import with_alone
from optloc.proof.columns import Columns, columns_of, linear_nodes
from optloc.proof.eliminate import compressed, roots, whitened, without
from optloc.proof.scope import ANGLES
from optloc.types import Array
from optloc.weigh import weighed


@dataclass(frozen=True, slots=True)
class Posed:
    """The maximum-likelihood costs of a flat batch of N problems over the position; B is N, or 1 where all share.

    Every other unknown has the value that is best for the position.

    Parameters
    ----------
    kinds : int array (J,)
        Codes of the nodes.
    data : array (B, J, width)
        Numbers of the nodes.
    K : array (B, q, J)
        Whitened rows over the nodes.
    w : array (N, q)
        Whitened measurements.
    level : array (N,)
        Cost from which on angles may be off by a turn that the rows do not see; infinite without biases of angles.
    """

    kinds: Array
    data: Array
    K: Array
    w: Array
    level: Array


def posed(problem: Problem) -> Posed:
    """Return the costs of a flat batch of problems over the position.

    Unknown emission times and offsets without a prior are projected out; offsets, drifts and isotropic station errors
    with Gaussian priors enlarge the covariance. Both are exact: these unknowns enter the rows linearly, a station
    error because the nearest place to its surveyed one from which the range is another lies on the line to the target.

    Parameters
    ----------
    problem : Problem
        N problems within the scope of the proof, see `optloc.proof.scope.unsupported`.
    """
    problem = weighed(problem)
    others = _Others.of(problem)
    known = problem.observed - (others.touch @ others.mean[..., None])[..., 0]
    usable = (problem.weight > 0.0) & np.isfinite(known)
    known = np.where(usable, known, 0.0)
    made = columns_of(problem, known)
    others = others.with_stations(problem, made)
    angles = _kind_of_rows(problem)
    value = np.where(angles == "azimuth", 0.0, known)
    K, w = _projected(problem, made, others, value)
    K, w = _with_position_prior(problem, made, K, w)
    K, w = compressed(K, w)
    size, level = problem.batch_shape[0], _turned(problem, others, angles, known)
    w, level = np.broadcast_to(w, (size, w.shape[-1])), np.broadcast_to(level, (size,))
    kinds = np.array(made.kinds)
    return Posed(kinds, with_alone(kinds, made.numbers, K, w), K, w, level)


@dataclass(frozen=True, slots=True)
class _Others:
    """Unknowns beside the position: how rows contain them (m, n), their precision (B, n, n) and mean (B, n)."""

    touch: Array
    precision: Array
    mean: Array

    @classmethod
    def of(cls, problem: Problem) -> _Others:
        size = problem.layout.size
        touch = np.zeros((problem.count, size))
        for plan, start in zip(plans(problem), problem.starts, strict=True):
            np.add.at(touch, (start + plan.adds.row, plan.adds.column), plan.adds.coefficient)
        parts = [part for part in prior_parts(problem) if part[0] != "position"]
        wide = max(
            (len(array) for _, m, p in parts for array, core in ((m, 1), (p, 2)) if array.ndim > core), default=1
        )
        precision, mean = np.zeros((wide, size, size)), np.zeros((wide, size))
        for name, centre, information in parts:
            shared = problem.layout.find(name)[1]
            for epoch in range(1 if shared else problem.epochs):
                own = columns(problem.layout, name, np.array([epoch]))[0]
                precision[:, own[:, None], own] += information if shared else information[..., 0, :, :]
                mean[:, own] = centre
        return cls(touch, precision, mean)

    def with_stations(self, problem: Problem, made: Columns) -> _Others:
        """Return the unknowns with station errors along the line to the target as their first coordinates."""
        if problem.stations.covariance is None:
            return self
        touch, d = self.touch.copy(), problem.dimension
        epoch = problem.epoch
        for row, node, coefficient in zip(made.row, made.column, made.coefficient, strict=True):
            own = columns(problem.layout, "stations", epoch[row : row + 1])[0]
            touch[row, own[made.station[node] * d]] += coefficient
        return _Others(touch, self.precision, self.mean)


def _kind_of_rows(problem: Problem) -> Array:
    return np.concatenate([np.full(rows.count, rows.kind, dtype=object) for rows in problem.rows])


def _projected(problem: Problem, made: Columns, others: _Others, value: Array) -> tuple[Array, Array]:
    """Return whitened rows (B, q, J) over the nodes and measurements (N, q), free of the other unknowns."""
    noise, J = whiten(problem.noise, problem.weight), len(made.kinds)
    used = others.touch.any(0) | others.precision.any((0, 1))
    touch, precision = others.touch[:, used], others.precision[:, used][:, :, used]
    geometry = whitened(noise, np.concatenate([made.design, touch], axis=1))
    geometry = geometry if geometry.ndim == 3 else geometry[None]
    shared = len(geometry) == len(precision) == 1
    # Measurements of all problems are the columns of one matrix where everything else is shared.
    seen = whitened(noise, value.T if shared else value[..., None])
    seen = seen if seen.ndim == 3 else seen[None]
    if used.any():
        size = max(len(geometry), len(precision))
        tail = np.zeros((size, touch.shape[1], J + touch.shape[1]))
        tail[..., J:] = roots(precision)
        geometry = np.concatenate([np.broadcast_to(geometry, (size, *geometry.shape[1:])), tail], axis=1)
        none = np.zeros((len(seen), touch.shape[1], seen.shape[-1]))
        seen = np.concatenate([seen, none], axis=1)
        unknowns = geometry[..., J:]
        geometry, seen = without(unknowns, geometry[..., :J]), without(unknowns, seen)
    return geometry[..., :J], np.ascontiguousarray(seen[0].T) if shared else seen[..., 0]


def _with_position_prior(problem: Problem, made: Columns, K: Array, w: Array) -> tuple[Array, Array]:
    """Return the rows with those of a Gaussian prior on the position; its nodes are added."""
    for name, mean, precision in prior_parts(problem):
        if name == "position":
            whole = precision if precision.ndim == 3 else precision[None]
            nodes = linear_nodes(made, roots(whole), mean if mean.ndim == 2 else mean[None])
            own = np.zeros((len(K), len(nodes), len(made.kinds)))
            own[:, np.arange(len(nodes)), nodes] = 1.0
            wider = np.zeros((*K.shape[:2], len(nodes)))
            K = np.concatenate([np.concatenate([K, wider], axis=2), own], axis=1)
            w = np.concatenate([w, np.zeros((len(w), len(nodes)))], axis=1)
    return K, w


def _turned(problem: Problem, others: _Others, kind: Array, known: Array) -> Array:
    """Return the cost (N,) from which on the sum of an angle and its bias may be off by a turn.

    Residuals are wrapped with their bias, nodes without it; a row can differ only where noise and bias together are
    half a turn, and then its own chi-square is at least that squared over their variance.
    """
    level = np.full(len(known), np.inf)
    rows = np.flatnonzero(np.isin(kind, ANGLES))
    if not len(rows):
        return level
    variance = variances(problem.noise, problem.count)[..., rows]
    touch = others.touch[rows]
    biased = touch.any(1)
    if biased.any():
        covariance = np.linalg.pinv(others.precision, hermitian=True)
        variance = variance + np.einsum("rn,bnm,rm->br", touch, covariance, touch)
    size = np.abs(known[:, rows])
    steep = kind[rows] == "elevation"
    apart = np.where(steep, 1.5 * np.pi - size, np.pi)
    able = biased | (steep & (size >= 0.5 * np.pi))
    return np.asarray(np.where(able, apart * np.abs(apart) / variance, np.inf).min(1))


def taken(pose: Posed, items: Array) -> Posed:
    """Return the posed costs of some of the problems."""

    def own(array: Array) -> Array:
        return array if len(array) == 1 else array[items]

    return Posed(pose.kinds, own(pose.data), own(pose.K), pose.w[items], pose.level[items])
