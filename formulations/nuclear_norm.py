r"""Nuclear norm of a network, the convex start: **a baseline of studies, never a default**.

The arrivals of N pulses at M stations are :math:`z_{ij} = |a_i - y_j| + o_j`. Squared and centred over both, they are
affine in the times of emission o, and of rank d at the true times:

.. math:: G(o) = Q_M^\top (Z \circ Z - 2 Z \, \mathrm{diag}\, o) \, Q_N = -2 \, Q_M^\top A Y^\top Q_N,

with `Z` (M, N) and orthonormal :math:`Q_M`, :math:`Q_N` whose columns are orthogonal to ones. Rank is replaced by the
sum of the singular values, its convex envelope on matrices of bounded norm, and no distance is negative:

.. math:: \min_o \; \|G(o)\|_* - \langle W, G(o) \rangle \quad\text{subject to}\quad o_j \le \min_i z_{ij}.

*First pass*, :math:`W = 0`: the nuclear norm. It is **not tight**: distances that are too small make all of `G` small.
So the least nuclear norm is between the true times and the times at the nearest stations. Without the bounds on `o` the
solution is beyond them.

*Further passes*, :math:`W = U_d V_d^\top` of the pass before: the truncated nuclear norm, the sum of the singular
values beyond the first d, decreased by linearising its concave part. Without noise it is zero at the true times. If the
passes end there, they are exact. They are a local method from one start.

Times of emission make the network affine by one singular value decomposition, and :mod:`formulations.metric_upgrade`
gives the positions. Stations without a common clock are not supported: their term :math:`b \, o^\top` is not affine.

Sources: M. Fazel, "Matrix rank minimization with applications", PhD thesis, Stanford University, 2002 (the nuclear norm
for rank); F. Jiang, Y. Kuang and K. Astrom, "Time delay estimation for TDOA self-calibration using truncated nuclear
norm regularization", Proc. ICASSP 2013 (the truncated norm for times of emission, without the bounds).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep
from formulations.low_rank_network import LowRank, Pulses, StationFactors
from formulations.unit_scale import power_of_two

# Change of the times of emission, in units of the spread, below which passes have converged: far below any noise.
_SETTLED = 1e-7


@dataclass(frozen=True, slots=True)
class NuclearNorm:
    """The result of the passes.

    Parameters
    ----------
    offset : array (N,)
        Times of emission.
    value : float
        Nuclear norm of G at these times.
    bound : float
        Lower bound of the nuclear norm over all times that the constraints allow, from the dual of the first pass.
    beyond : float
        Share of the singular values beyond the first d in the nuclear norm: zero for a network without noise.
    passes : int
        Number of passes.
    answer : ConicAnswer
        The solver's report on the last pass.
    """

    offset: Array
    value: float
    bound: float
    beyond: float
    passes: int
    answer: ConicAnswer


def nuclear_problem(stations: int, pulses: int) -> Any:
    """Build one pass as a cvxpy problem: a baseline, never a default.

    Parameters
    ----------
    stations, pulses : int
        M and N.

    Returns
    -------
    cvxpy.Problem
        Variable ``offset`` (N,); parameters ``squares`` (M - 1, N - 1), the part of G without offsets, ``factor``
        (M - 1, N), ``slope`` (N,), the derivative of the linearised part by the offsets, and ``most`` (N,).

    Notes
    -----
    Fazel (2002); Jiang, Kuang and Astrom (2013).
    """
    import cvxpy as cp

    offset = cp.Variable(pulses, name="offset")
    squares = cp.Parameter((stations - 1, pulses - 1), name="squares")
    factor = cp.Parameter((stations - 1, pulses), name="factor")
    slope, most = cp.Parameter(pulses, name="slope"), cp.Parameter(pulses, name="most")
    G = squares - 2 * factor @ cp.diag(offset) @ _centring_columns(pulses)
    return cp.Problem(cp.Minimize(cp.normNuc(G) - slope @ offset), [offset <= most])


@keep
def _relaxation(stations: int, pulses: int, backend: str) -> Relaxation:
    """Return the relaxation for numbers of stations and pulses, built once for each size and back end."""
    return Relaxation(nuclear_problem(stations, pulses), backend=backend)


def _centring_columns(n: int) -> Array:
    """Return a matrix (n, n - 1) of orthonormal columns that are orthogonal to ones (Helmert's)."""
    row, k = np.arange(n)[:, None], np.arange(1, n)
    return np.asarray(np.where(row < k, 1.0, np.where(row == k, -k, 0.0)) / np.sqrt(k * (k + 1)))


def nuclear_offsets(z: ArrayLike, d: int, *, passes: int = 20, backend: str = "CLARABEL") -> NuclearNorm:
    """Return times of emission of least nuclear norm, truncated from the second pass on: a baseline, never a default.

    Parameters
    ----------
    z : array_like, shape (N, M)
        All arrivals times the speed of propagation, near zero in each pulse; none is missing.
    d : int
        Dimension of space, 2 or 3.
    passes : int
        Greatest number of passes; 1 is the nuclear norm itself. Without noise, 12 x 20 networks converge after 4
        passes, 6 x 20 after 15 or more.
    backend : str
        Conic solver.

    Returns
    -------
    NuclearNorm
        Times of emission, value and bound.

    Notes
    -----
    Fazel (2002); Jiang, Kuang and Astrom (2013). Built once per size and back end in each process.
    """
    data, unit = nuclear_data(z)
    n, m = np.shape(z)
    squares, factor, right = data["squares"], data["factor"], _centring_columns(n)
    relaxation = _relaxation(m, n, backend)
    slope, before, bound = np.zeros(n), np.full(n, np.inf), -np.inf
    for made in range(1, passes + 1):
        answer = relaxation.solve({**data, "slope": slope}, bound=made == 1)
        offset = answer.values["offset"]
        bound = answer.bound * unit**2 if made == 1 else bound
        G = squares - 2.0 * (factor * offset) @ right
        if not np.isfinite(G).all():
            return NuclearNorm(unit * offset, np.nan, bound, np.nan, made, answer)
        s = np.linalg.svd(G, compute_uv=False)
        if np.abs(offset - before).max() < _SETTLED:
            break
        slope, before = truncated_slope(data, offset, d), offset
    return NuclearNorm(unit * offset, float(s.sum()) * unit**2, bound, float(s[d:].sum() / s.sum()), made, answer)


def nuclear_data(z: ArrayLike) -> tuple[dict[str, Array], float]:
    """Return the parameters of the first pass for arrivals (N, M), by name, and the unit of length."""
    given = np.asarray(z, dtype=np.float64)
    unit = power_of_two(float(np.sqrt((given * given).mean())))
    Z = given.T / unit
    left, right = _centring_columns(len(Z)), _centring_columns(Z.shape[1])
    squares, factor = left.T @ (Z * Z) @ right, left.T @ Z
    return {"squares": squares, "factor": factor, "slope": np.zeros(Z.shape[1]), "most": Z.min(axis=0)}, unit


def truncated_slope(data: Mapping[str, Array], offset: Array, d: int) -> Array:
    """Return the derivative (N,) of the d largest singular values by scaled times of emission `offset` (N,)."""
    right = _centring_columns(len(offset))
    u, _, v = np.linalg.svd(data["squares"] - 2.0 * (data["factor"] * offset) @ right, full_matrices=False)
    # d/do of <W, G(o)>
    return np.asarray(-2.0 * np.einsum("pj,pq,jq->j", data["factor"], u[:, :d] @ v[:d], right), dtype=np.float64)


def affine_network(z: ArrayLike, offset: ArrayLike, d: int) -> LowRank:
    """Return the network for given times of emission, up to an affine map, as one fit of rank d.

    Parameters
    ----------
    z : array_like, shape (N, M)
        Arrivals.
    offset : array_like, shape (N,)
        Times of emission.
    d : int
        Dimension of space.

    Returns
    -------
    LowRank
        One fit, for `formulations.metric_upgrade.upgrade`; its cost is the sum of squares beyond rank d.
    """
    Z, o = np.asarray(z, dtype=np.float64).T, np.asarray(offset, dtype=np.float64)
    X = Z * Z - 2.0 * Z * o
    middle, alpha, beta = X.mean(), X.mean(axis=1), X.mean(axis=0)
    u, s, v = np.linalg.svd(X - alpha[:, None] - beta + middle, full_matrices=False)
    stations = StationFactors((alpha - middle)[None], (u[:, :d] * s[:d])[None], np.zeros((1, len(Z))))
    return LowRank(stations, Pulses(beta[None], v[:d].T[None], o[None]), np.array([np.sum(s[d:] ** 2)]))
