r"""Low-rank network: arrivals of N pulses at M stations, all at unknown positions, as one fit of small rank.

.. math:: z_{ij} = |a_i - y_j| + o_j + b_i \quad\Longrightarrow\quad
   (z_{ij} - b_i)^2 - 2 (z_{ij} - b_i) o_j = \alpha_i + \beta_j + u_i^\top v_j

with :math:`u` any affine image of the stations, :math:`\alpha_i = |a_i|^2` and :math:`\beta_j = |y_j|^2 - o_j^2` up to
an exchange between :math:`u` and :math:`v`. For given :math:`\theta_i = (\alpha_i, u_i, b_i)` each pulse is a linear
least-squares problem in :math:`(\beta_j, v_j, o_j)` over its own rows, so that entries may be missing. The nonlinear
problem has :math:`M (d + 1)` unknowns for any number of pulses. It is solved by variable projection (Levenberg and
Marquardt on :math:`\theta`, Kaufman's approximation of the derivative of a projector).

An error n of an arrival changes its equation by about :math:`2 |a_i - y_j| n`. So each equation is divided by this
distance, as estimated in every step. A share of the spread replaces distances near zero.

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

# Greatest numbers of steps: before equations are divided by distances, while they are divided, and with fixed
# distances. Distances at a random start are wrong. For 12 x 20 networks in flat halls, 60 % of the starts end at the
# best fit, but only 5 % if all steps divide. The last steps minimise one fixed function.
_PLAIN, _WEIGHED, _FROZEN = 30, 55, 5
# Relative change of the costs of all starts that ends a stage, and the number of successive steps with this change.
# Costs are compared by factors, and after five bad steps the damping is three thousand times as large.
_SETTLED, _CALM = 1e-4, 5
# Least distance as a share of the spread: a pulse near a station must not dominate the sum.
_NEAR = 0.05
# Pivots below this share of the largest are columns without information: eight of sixteen digits are left.
_DEPENDENT = 1e-8
# Marquardt's damping: initial value, and factors after a good and a bad step.
_DAMPING, _EASE, _STIFFEN = 1e-2, 0.3, 5.0
_LEAST, _MOST = 1e-12, 1e8


@dataclass(frozen=True, slots=True)
class StationFactors:
    """The unknowns of the stations: S fits of M stations.

    Parameters
    ----------
    alpha : array (S, M)
        Squared distance from a fixed point, up to an affine function of `u`.
    u : array (S, M, d)
        Affine image of the positions.
    b : array (S, M)
        Offsets of clocks; zeros if they are not unknowns.
    """

    alpha: Array
    u: Array
    b: Array


@dataclass(frozen=True, slots=True)
class Pulses:
    """The unknowns of the pulses, which follow from the stations: S fits of N pulses.

    Parameters
    ----------
    beta : array (S, N)
        Squared distance less the squared offset, up to an affine function of `v`.
    v : array (S, N, d)
        Affine image of the positions.
    o : array (S, N)
        Offsets of emission.
    """

    beta: Array
    v: Array
    o: Array


@dataclass(frozen=True, slots=True)
class LowRank:
    """Fits of small rank: stations and pulses of S fits, and `cost` (S,), the weighted sums of squares."""

    stations: StationFactors
    pulses: Pulses
    cost: Array

    def take(self, which: Any) -> LowRank:
        """Return the selected fits; `which` is an index, a mask or a slice."""
        s, p = self.stations, self.pulses
        return LowRank(
            StationFactors(s.alpha[which], s.u[which], s.b[which]),
            Pulses(p.beta[which], p.v[which], p.o[which]),
            self.cost[which],
        )


def random_stations(rng: np.random.Generator, count: int, m: int, d: int) -> StationFactors:
    """Return random stations in a cube as starts of fits; every second start is flattened.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    count, m, d : int
        Numbers of starts, of stations, and of dimensions.

    Returns
    -------
    StationFactors
        Stations with a spread of one.
    """
    u = rng.uniform(-0.5, 0.5, (count, m, d))
    u[::2, :, -1] *= 0.3  # halls and networks are wider than they are high
    return StationFactors(np.sum(u * u, axis=-1), u, np.zeros((count, m)))


def fit_low_rank(z: Array, weight: Array, emission: Array, start: StationFactors, *, clocks: bool = False) -> LowRank:
    """Return fits of stations and pulses to arrivals from each of several starts.

    Parameters
    ----------
    z : array (N, M)
        Arrivals times the speed of propagation, of order one, near zero in each pulse.
    weight : array (N, M)
        Relative inverse standard deviation of each arrival; zero if it is missing.
    emission : bool array (N,)
        Whether the time of emission of a pulse is unknown; else it is zero.
    start : StationFactors
        S starts.
    clocks : bool
        Whether offsets of the stations' clocks are unknowns.

    Returns
    -------
    LowRank
        S fits, in the order of the starts.
    """
    return _NetworkFit(z, weight, emission, clocks).run(start)


@dataclass(frozen=True, slots=True)
class _NetworkFit:
    """The data of a fit; each method is a part of one step for all S starts at once.

    The fields are arguments of `fit_low_rank`: `z` and `weight` (N, M), `emission` (N,), `clocks`.
    """

    z: Array
    weight: Array
    emission: Array
    clocks: bool

    def run(self, at: StationFactors) -> LowRank:
        """Return the fits from S starts `at`.

        The stages are plain steps, steps that divide by distances, and steps with fixed distances.
        """
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
                at, here = _choose_stations(good, trial, at), here.replaced(good, there)
                damping = np.clip(np.where(good, damping * _EASE, damping * _STIFFEN), _LEAST, _MOST)
                calm = calm + 1 if (np.abs(here.cost - before) <= _SETTLED * before).all() else 0
                if calm == _CALM:
                    break
        return LowRank(at, here.pulses, here.cost)

    def distance(self, at: StationFactors, pulses: Pulses) -> Array:
        """Return distances (S, N, M), which divide the equations.

        A distance is the mean of two estimates, from the arrival time and from the fit. Short distances are raised to a
        minimum.
        """
        by_time = np.abs(self.z - at.b[:, None] - pulses.o[:, :, None])
        square = at.alpha[:, None] + (pulses.beta + pulses.o**2)[:, :, None] + pulses.v @ np.swapaxes(at.u, 1, 2)
        return np.maximum(0.5 * (by_time + np.sqrt(np.maximum(square, 0.0))), _NEAR)

    def project(self, at: StationFactors, scale: Array) -> _Projected:
        """Return the residuals that remain for the best pulses, at stations `at`.

        `scale` (S, N, M) multiplies the equations.
        """
        shifted = self.z - at.b[:, None]
        u = np.broadcast_to(at.u[:, None], (*scale.shape, at.u.shape[-1]))
        ones = np.ones((*scale.shape, 1))
        # the offset is the last column; it is zero if the emission time is known, and so is its basis vector
        last = 2.0 * (shifted * self.emission[:, None])[..., None]
        a = scale[..., None] * np.concatenate([ones, u, last], axis=-1)
        q, r = orthonormal(a)
        target = scale * (shifted**2 - at.alpha[:, None])
        part = np.einsum("snik,sni->snk", q, target)
        residual = target - np.einsum("snik,snk->sni", q, part)
        found = _back_substitute(r, part)
        d = at.u.shape[-1]
        pulses = Pulses(found[..., 0], found[..., 1 : 1 + d], found[..., 1 + d])
        return _Projected(pulses, q, residual, scale, np.sum(residual**2, axis=(1, 2)))

    def moved(self, at: StationFactors, here: _Projected, damping: Array) -> StationFactors:
        """Return stations after one damped step of Gauss and Newton from `at`, whose projection is `here`.

        `damping` (S,) is Marquardt's factor of each start.
        """
        count, n, m = here.scale.shape
        d = at.u.shape[-1]
        columns = [np.ones((count, n, m, 1)), np.broadcast_to(here.pulses.v[:, :, None], (count, n, m, d))]
        if self.clocks:
            columns.append(2.0 * (self.z - at.b[:, None] - here.pulses.o[:, :, None])[..., None])
        c = here.scale[..., None] * np.concatenate(columns, axis=-1)
        p = c.shape[-1]
        # Sum over pulses of C'(I - QQ')C, with the derivatives C by the unknowns of the stations: one block for each
        # station, less the product of the parts in the span of Q.
        inner = np.einsum("snik,snia->snkia", here.q, c).reshape(count, -1, m * p)
        normal = -np.swapaxes(inner, 1, 2) @ inner
        blocks = normal.reshape(count, m, p, m, p)
        every = np.arange(m)
        blocks[:, every, :, every, :] += np.einsum("snia,snib->isab", c, c)
        gradient = np.einsum("snia,sni->sia", c, here.residual).reshape(count, m * p, 1)
        diagonal = np.einsum("sii->si", normal)
        # Marquardt's damping, with a floor for unknowns without information, whose diagonal is zero
        diagonal += damping[:, None] * (diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-300)
        step = np.linalg.solve(normal, gradient).reshape(count, m, p)
        b = at.b + step[..., -1] if self.clocks else at.b
        return StationFactors(at.alpha + step[..., 0], at.u + step[..., 1 : 1 + d], b)


@dataclass(frozen=True, slots=True)
class _Projected:
    """The result of a projection: the pulses that fit best, and the residuals.

    `q` (S, N, M, d + 2) is an orthonormal basis of the columns of the pulses. `residual` (S, N, M) are the scaled
    residuals, `cost` (S,) the sums of their squares. `scale` (S, N, M) multiplied the equations.
    """

    pulses: Pulses
    q: Array
    residual: Array
    scale: Array
    cost: Array

    def replaced(self, mask: Mask, other: _Projected) -> _Projected:
        """Return this projection with the fits of `other` where the mask is True."""
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
    """Return items of `one` where the mask (S,) is True, else items of `other`."""
    return np.where(mask.reshape(-1, *[1] * (one.ndim - 1)), one, other)


def _choose_stations(mask: Mask, one: StationFactors, other: StationFactors) -> StationFactors:
    """Return stations of `one` where the mask (S,) is True, else of `other`."""
    return StationFactors(
        _where(mask, one.alpha, other.alpha), _where(mask, one.u, other.u), _where(mask, one.b, other.b)
    )


def orthonormal(a: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of columns and their coordinates, by the Gram-Schmidt method, each column twice.

    Parameters
    ----------
    a : array (..., m, k)
        Columns; a column that depends on earlier columns gets a zero vector.

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


def _back_substitute(r: Array, part: Array) -> Array:
    """Return the solution of the upper triangular system ``r x = part``; zero where its pivot is infinite."""
    out = np.zeros_like(part)
    for i in range(part.shape[-1] - 1, -1, -1):
        known = part[..., i] - np.einsum("...k,...k->...", r[..., i, i + 1 :], out[..., i + 1 :])
        out[..., i] = known / r[..., i, i]
    return out
