r"""Low-rank network: arrivals of N pulses at M stations, neither of whose places is known, as one fit of small rank.

.. math:: z_{ij} = |a_i - y_j| + o_j + b_i \quad\Longrightarrow\quad
   (z_{ij} - b_i)^2 - 2 (z_{ij} - b_i) o_j = \alpha_i + \beta_j + u_i^\top v_j

with :math:`u` any affine image of the stations, :math:`\alpha_i = |a_i|^2` and :math:`\beta_j = |y_j|^2 - o_j^2` up to
what :math:`u` and :math:`v` exchange. For given :math:`\theta_i = (\alpha_i, u_i, b_i)` each pulse is a linear least
squares problem in :math:`(\beta_j, v_j, o_j)` over its own rows, so that entries may be missing and the non-linear
problem has :math:`M (d + 1)` unknowns however many pulses there are: it is solved by variable projection (Levenberg and
Marquardt on :math:`\theta`, Kaufman's approximation of the derivative of a projector).

An error n of an arrival moves its equation by about :math:`2 |a_i - y_j| n`, so each is divided by that distance, as it
is estimated in every step. Where the distance is nearly nothing, a share of the spread stands in its place.

The values at the minimum give the network up to an affine map, which :mod:`formulations.metric_upgrade` finds.

Sources: M. Pollefeys and D. Nister, "Direct computation of sound and microphone locations from time-difference-of-
arrival data", Proc. ICASSP 2008 (the rank); G. Golub and V. Pereyra, "Separable nonlinear least squares: the variable
projection method and its applications", Inverse Problems 19 (2003); L. Kaufman, "A variable projection method for
solving separable nonlinear least squares problems", BIT 15 (1975).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from formulations.algebra import Array, Mask

# Steps that a start takes at most: before equations are divided by distances, while they are, and with the last
# distances. A random start knows no distances: of 12 x 20 networks in flat halls 60 % of the starts end at the best
# fit, 5 % where all steps divide. The last steps minimise one function.
_PLAIN, _WEIGHED, _FROZEN = 30, 55, 5
# Relative change of the costs of all starts that ends a stage, and how many such steps in a row: costs are compared
# by factors, and after five bad steps the damping is three thousand times as large.
_SETTLED, _CALM = 1e-4, 5
# Share of the spread that stands for a distance below it: a pulse beside a station must not rule the sum.
_NEAR = 0.05
# Pivots below this share of the largest are columns that say nothing: eight digits are left of the sixteen.
_DEPENDENT = 1e-8
# Marquardt's damping: at first, and its factors after a good and a bad step.
_DAMPING, _EASE, _STIFFEN = 1e-2, 0.3, 5.0
_LEAST, _MOST = 1e-12, 1e8


@dataclass(frozen=True, slots=True)
class StationFactors:
    """What is sought of the stations: S fits of M stations.

    Parameters
    ----------
    alpha : array (S, M)
        Squared distance from some point, up to an affine function of `u`.
    u : array (S, M, d)
        Affine image of the places.
    b : array (S, M)
        Offsets of clocks; zeros where they are not sought.
    """

    alpha: Array
    u: Array
    b: Array


@dataclass(frozen=True, slots=True)
class Pulses:
    """What follows for the pulses: S fits of N pulses.

    Parameters
    ----------
    beta : array (S, N)
        Squared distance less the squared offset, up to an affine function of `v`.
    v : array (S, N, d)
        Affine image of the places.
    o : array (S, N)
        Offsets of emission.
    """

    beta: Array
    v: Array
    o: Array


@dataclass(frozen=True, slots=True)
class LowRank:
    """A fit of small rank: stations, pulses and the weighted sum of squares (S,)."""

    stations: StationFactors
    pulses: Pulses
    cost: Array

    def take(self, which: Any) -> LowRank:
        """Return some of the fits."""
        s, p = self.stations, self.pulses
        return LowRank(
            StationFactors(s.alpha[which], s.u[which], s.b[which]),
            Pulses(p.beta[which], p.v[which], p.o[which]),
            self.cost[which],
        )


def random_stations(rng: np.random.Generator, count: int, m: int, d: int) -> StationFactors:
    """Return random stations in a cube, half of them flattened, from which fits begin.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of numbers.
    count, m, d : int
        Starts, stations and dimension.

    Returns
    -------
    StationFactors
        Of spread one.
    """
    u = rng.uniform(-0.5, 0.5, (count, m, d))
    u[::2, :, -1] *= 0.3  # halls and networks are wider than high
    return StationFactors(np.sum(u * u, axis=-1), u, np.zeros((count, m)))


def fit_low_rank(z: Array, weight: Array, emission: Array, start: StationFactors, *, clocks: bool = False) -> LowRank:
    """Fit stations and pulses to arrivals from each of several starts.

    Parameters
    ----------
    z : array (N, M)
        Arrivals times the speed of propagation, of order one, near zero in each pulse.
    weight : array (N, M)
        Relative inverse standard deviation of each; zero where there is none.
    emission : bool array (N,)
        Whether the time of emission of a pulse is unknown; else it is zero.
    start : StationFactors
        Where to begin, S starts.
    clocks : bool
        Whether offsets of the stations' clocks are sought.

    Returns
    -------
    LowRank
        S fits, best or not.
    """
    return _Fit(z, weight, emission, clocks).run(start)


@dataclass(frozen=True, slots=True)
class _Fit:
    """The data of a fit; methods are one step of it for all starts at once."""

    z: Array
    weight: Array
    emission: Array
    clocks: bool

    def run(self, at: StationFactors) -> LowRank:
        count = at.alpha.shape[0]
        scale = np.broadcast_to(self.weight, (count, *self.z.shape))
        damping = np.full(count, _DAMPING)
        here = self.project(at, scale)
        for limit, weighed in ((_PLAIN, False), (_WEIGHED, True), (_FROZEN, False)):
            calm = 0
            for _ in range(limit):
                before = here.cost
                if weighed:
                    scale = self.weight / (2.0 * self.distance(at, here.pulses))
                    here = self.project(at, scale)
                trial = self.moved(at, here, damping)
                there = self.project(trial, scale)
                good = there.cost < here.cost
                at, here = _chosen(good, trial, at), here.replaced(good, there)
                damping = np.clip(np.where(good, damping * _EASE, damping * _STIFFEN), _LEAST, _MOST)
                calm = calm + 1 if (np.abs(here.cost - before) <= _SETTLED * before).all() else 0
                if calm == _CALM:
                    break
        return LowRank(at, here.pulses, here.cost)

    def distance(self, at: StationFactors, pulses: Pulses) -> Array:
        """Return distances (S, N, M): the mean of what the arrival and what the fit say, kept off zero."""
        by_time = np.abs(self.z - at.b[:, None] - pulses.o[:, :, None])
        square = at.alpha[:, None] + (pulses.beta + pulses.o**2)[:, :, None] + pulses.v @ np.swapaxes(at.u, 1, 2)
        return np.maximum(0.5 * (by_time + np.sqrt(np.maximum(square, 0.0))), _NEAR)

    def project(self, at: StationFactors, scale: Array) -> _Projected:
        """Return the residuals that no choice of the pulses can take away."""
        shifted = self.z - at.b[:, None]
        u = np.broadcast_to(at.u[:, None], (*scale.shape, at.u.shape[-1]))
        ones = np.ones((*scale.shape, 1))
        # the offset comes last: its column is zero where the emission is known, and so is its vector
        last = 2.0 * (shifted * self.emission[:, None])[..., None]
        a = scale[..., None] * np.concatenate([ones, u, last], axis=-1)
        q, r = orthonormal(a)
        target = scale * (shifted**2 - at.alpha[:, None])
        part = np.einsum("snik,sni->snk", q, target)
        residual = target - np.einsum("snik,snk->sni", q, part)
        found = _back(r, part)
        d = at.u.shape[-1]
        pulses = Pulses(found[..., 0], found[..., 1 : 1 + d], found[..., 1 + d])
        return _Projected(pulses, q, residual, scale, np.sum(residual**2, axis=(1, 2)))

    def moved(self, at: StationFactors, here: _Projected, damping: Array) -> StationFactors:
        """Return stations after one damped step of Gauss and Newton."""
        count, n, m = here.scale.shape
        d = at.u.shape[-1]
        columns = [np.ones((count, n, m, 1)), np.broadcast_to(here.pulses.v[:, :, None], (count, n, m, d))]
        if self.clocks:
            columns.append(2.0 * (self.z - at.b[:, None] - here.pulses.o[:, :, None])[..., None])
        c = here.scale[..., None] * np.concatenate(columns, axis=-1)
        p = c.shape[-1]
        # sum over pulses of C'(I - QQ')C: one block for each station, less a product of what lies within Q
        inner = np.einsum("snik,snia->snkia", here.q, c).reshape(count, -1, m * p)
        normal = -np.swapaxes(inner, 1, 2) @ inner
        blocks = normal.reshape(count, m, p, m, p)
        every = np.arange(m)
        blocks[:, every, :, every, :] += np.einsum("snia,snib->isab", c, c)
        gradient = np.einsum("snia,sni->sia", c, here.residual).reshape(count, m * p, 1)
        diagonal = np.einsum("sii->si", normal)
        diagonal += damping[:, None] * (diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-300)
        step = np.linalg.solve(normal, gradient).reshape(count, m, p)
        b = at.b + step[..., -1] if self.clocks else at.b
        return StationFactors(at.alpha + step[..., 0], at.u + step[..., 1 : 1 + d], b)


@dataclass(frozen=True, slots=True)
class _Projected:
    """Pulses that fit best, the basis of what they can explain, residuals beyond it, and their squares."""

    pulses: Pulses
    q: Array
    residual: Array
    scale: Array
    cost: Array

    def replaced(self, mask: Mask, other: _Projected) -> _Projected:
        """Return this with the other's fits where the mask says so."""
        p, o = self.pulses, other.pulses
        pulses = Pulses(_where(mask, o.beta, p.beta), _where(mask, o.v, p.v), _where(mask, o.o, p.o))
        return replace(
            self,
            pulses=pulses,
            q=_where(mask, other.q, self.q),
            residual=_where(mask, other.residual, self.residual),
            cost=_where(mask, other.cost, self.cost),
        )


def _where(mask: Mask, one: Array, other: Array) -> Array:
    return np.where(mask.reshape(-1, *[1] * (one.ndim - 1)), one, other)


def _chosen(mask: Mask, one: StationFactors, other: StationFactors) -> StationFactors:
    return StationFactors(
        _where(mask, one.alpha, other.alpha), _where(mask, one.u, other.u), _where(mask, one.b, other.b)
    )


def orthonormal(a: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of columns and their coordinates, by Gram and Schmidt, each column twice.

    Parameters
    ----------
    a : array (..., m, k)
        Columns; the last of those that depend on the ones before get a zero vector.

    Returns
    -------
    q : array (..., m, k)
        Orthonormal columns, or zeros.
    r : array (..., k, k)
        Upper triangle with ``a = q r``; pivots of zero vectors are infinite, so that solving by it gives zero.
    """
    k = a.shape[-1]
    q, r = np.zeros_like(a), np.zeros((*a.shape[:-2], k, k))
    largest = np.sqrt(np.sum(a * a, axis=-2).max(axis=-1))
    for i in range(k):
        column = a[..., i]
        for _ in range(2 if i else 0):
            within = np.einsum("...mk,...m->...k", q[..., :i], column)
            column = column - np.einsum("...mk,...k->...m", q[..., :i], within)
            r[..., :i, i] += within
        length = np.sqrt(np.sum(column * column, axis=-1))
        known = length > _DEPENDENT * largest
        r[..., i, i] = np.where(known, length, np.inf)
        q[..., i] = column / r[..., i, i][..., None]
    return q, r


def _back(r: Array, part: Array) -> Array:
    """Solve an upper triangle; zero where its pivot is infinite."""
    out = np.zeros_like(part)
    for i in range(part.shape[-1] - 1, -1, -1):
        known = part[..., i] - np.einsum("...k,...k->...", r[..., i, i + 1 :], out[..., i + 1 :])
        out[..., i] = known / r[..., i, i]
    return out
