r"""Metric upgrade: the affine image of a network becomes the network, from the side of the stations or of the pulses.

A fit of small rank (:mod:`formulations.low_rank_network`) gives :math:`\alpha_i + \beta_j + o_j^2 + u_i^\top v_j =
|a_i - y_j|^2`. With :math:`u` centred and white, :math:`a_i = T^\top u_i`, :math:`y_j = -T^{-1} (v_j + h)/2` and
:math:`H = T T^\top`, :math:`K = H^{-1}`,

.. math::
   \alpha_i = u_i^\top H u_i + u_i^\top h + c, \qquad
   \beta_j + o_j^2 = \tfrac14 v_j^\top K v_j + \tfrac12 v_j^\top K h + c'

are each linear: in (H, h, c) for enough stations, in (K, K h, c') for enough pulses, and exact without noise. Noise can
make H or K indefinite along the thinnest axis. Eigenvalues below a share of the largest are then raised to this share;
several shares are tried.

Sources: the rank condition is that of M. Pollefeys and D. Nister, "Direct computation of sound and microphone locations
from time-difference-of-arrival data", Proc. ICASSP 2008; the upgrade from stations is in M. Crocco, A. Del Bue and V.
Murino, "A bilinear approach to the position self-calibration of multiple sensors", IEEE Trans. Signal Process. 60
(2012), section IV.
"""

from __future__ import annotations

import numpy as np

from formulations.algebra import Array
from formulations.low_rank_network import LowRank

# Floors of eigenvalues as a share of the largest: for a nearly flat network, one like a hall, and one like a cube.
_FLOORS = (1e-3, 5e-2, 0.3)
# Singular values below this share of the largest are undetermined directions.
_OPEN = 1e-9


def unknowns(d: int) -> int:
    """Return the number of stations, or pulses, that a side needs: the entries of H, h and c in d dimensions."""
    return d * (d + 1) // 2 + d + 1


def upgrade(fit: LowRank) -> tuple[Array, Array, Array]:
    """Return candidate positions of stations and pulses for each of several fits, in the unit of the fit.

    Parameters
    ----------
    fit : LowRank
        S fits of M stations and N pulses.

    Returns
    -------
    stations : array (C, M, d)
        Candidate positions, from each side with enough points and for each floor; centred.
    pulses : array (C, N, d)
        Candidate positions of the pulses.
    which : int array (C,)
        Number of the fit of each candidate.
    """
    found: list[tuple[Array, Array, int]] = []
    for s in range(len(fit.cost)):
        u, v, alpha, square = _whitened_fit(fit, s)
        for H, h in _candidates_of_sides(u, v, alpha, square):
            T = np.linalg.cholesky(H)
            found.append((u @ T, -0.5 * np.linalg.solve(T, (v + h).T).T, s))
    d = fit.stations.u.shape[-1]
    m, n = fit.stations.alpha.shape[1], fit.pulses.beta.shape[1]
    kept = [one for one in found if np.isfinite(one[0]).all() and np.isfinite(one[1]).all()]
    return (
        np.array([one[0] for one in kept]).reshape(-1, m, d),
        np.array([one[1] for one in kept]).reshape(-1, n, d),
        np.array([one[2] for one in kept], dtype=np.int64),
    )


def _whitened_fit(fit: LowRank, s: int) -> tuple[Array, Array, Array, Array]:
    """Return the data of fit number s with centred and white stations u (M, d).

    The results are u, the pulses v (N, d) for these stations, alpha (M,), and beta + o^2 (N,).
    """
    u, v = fit.stations.u[s], fit.pulses.v[s]
    middle = u.mean(axis=0)
    centred = u - middle
    width, axes = np.linalg.eigh(centred.T @ centred / len(u))
    root = axes * np.sqrt(np.maximum(width, _OPEN**2 * width[-1]))
    beta = fit.pulses.beta[s] + v @ middle
    return np.linalg.solve(root, centred.T).T, v @ root, fit.stations.alpha[s], beta + fit.pulses.o[s] ** 2


def _candidates_of_sides(u: Array, v: Array, alpha: Array, square: Array) -> list[tuple[Array, Array]]:
    """Return the candidates (H, h), with H (d, d) and h (d,), from each side with enough points.

    `alpha` (M,) and `square` (N,) are the values of the two quadrics, for the stations u and the pulses v.
    """
    d, out = u.shape[1], []
    if len(u) >= unknowns(d):
        H, h = _quadric(u, alpha)
        out += [(positive, h) for positive in _with_floors(H)]
    if len(v) >= unknowns(d):
        # 4 K and 2 K h of a quadric in v; pulses may be far away, so they have another unit of length
        length = np.sqrt(np.mean(v * v))
        K, Kh = _quadric(v / length, square)
        K, Kh = 4.0 * K / length**2, 2.0 * Kh / length
        for positive in _with_floors(K):
            inverse = np.asarray(np.linalg.inv(positive), dtype=float)
            out.append((0.5 * (inverse + inverse.T), inverse @ Kh))
    return out


def _quadric(x: Array, value: Array) -> tuple[Array, Array]:
    """Return Q (d, d) and q (d,) of the fit ``x'Qx + x'q + constant`` to values (n,) at points x (n, d)."""
    d = x.shape[1]
    i, k = np.triu_indices(d)
    columns = np.concatenate([x[:, i] * x[:, k] * np.where(i == k, 1.0, 2.0), x, np.ones((len(x), 1))], axis=1)
    found = np.linalg.lstsq(columns, value, rcond=_OPEN)[0]
    Q = np.zeros((d, d))
    Q[i, k] = Q[k, i] = found[: len(i)]
    return Q, found[len(i) : len(i) + d]


def _with_floors(Q: Array) -> list[Array]:
    """Return matrices with eigenvalues raised to each floor of `_FLOORS`.

    The list has one matrix if no eigenvalue is below a floor, and none if Q is zero or not finite.
    """
    width, axes = np.linalg.eigh(Q)
    largest = np.abs(width).max()
    if not np.isfinite(largest) or largest <= 0.0:
        return []
    floors = _FLOORS[:1] if width[0] >= _FLOORS[-1] * largest else _FLOORS
    return [(axes * np.maximum(width, f * largest)) @ axes.T for f in floors]
