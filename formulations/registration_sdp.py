r"""Biased range differences of moving stations: a semidefinite start for the target and the biases.

Windows k of a run, station i at :math:`s_i(k)` (the first is the reference), target :math:`p_k = p + v t_k` (`v = 0`
for a fixed one), biases :math:`\delta` common to all windows,

.. math:: z_i(k) = r_i(k) - r_1(k) + (E \delta)_i + n_i(k), \quad r_i = |p_k - s_i(k)|, \quad W_k n(k) \sim N(0, I),
   \quad \delta \sim N(\mu, \operatorname{diag} \sigma^2).

With the remainders :math:`f_i = z_i - (E\mu)_i - (r_i - r_1)`, everything is quadratic in :math:`y =
(1, p, v, r_1(k), f_i(k))`: the cost once the biases are eliminated, :math:`f^\top M f`, and the definitions of the
ranges,

.. math:: r_1^2 = |p_k - s_1|^2, \qquad (z_i - f_i)^2 + 2 r_1 (z_i - f_i) = |p_k - s_i|^2 - |p_k - s_1|^2 .

The lift :math:`Y = y y^\top` is relaxed to :math:`Y \succeq 0` and solved with the price :math:`\eta \,
\operatorname{mean}_k |p_k|^2`, read off the lift.

The lift is never formed. With the biases in the lift the cost is a sum over the windows, and so are the definitions: of
`Y` only the blocks of :math:`u_k = (1, p, v, \delta, r_1(k), f_i(k))` occur, which have the block of :math:`(1, p, v,
\delta)` in common. The graph of this pattern is chordal. Therefore, if all blocks are semidefinite and agree in their
common part, they are blocks of a semidefinite matrix. The best moments of the biases give :math:`f^\top M f` again. So
`K` blocks of a dozen rows are the same relaxation as the lift of all windows. The time of that lift would grow with the
sixth power of the number of windows.

Small unknowns are lifted in small units: the lift contains the remainders, not the ranges :math:`r_i`. Compared with
the squares of ranges, the remainders would be rounding for an interior-point method.

Both the price and the prior are needed. A misfit `m` of the second equality can be absorbed in the moments alone,
:math:`2 \operatorname{cov}(r_1, f) = m`, for which :math:`\operatorname{var}(r_1) \operatorname{var}(f) \ge m^2 / 4`
suffices. Without the price, :math:`\operatorname{var}(r_1)`, that is the trace, grows without bound and every target
has cost zero in the limit; with it misfits cost about :math:`\sqrt{\eta \sum M_{ff} m^2}`. Without the prior, `M` is
zero for remainders common to all windows. These misfits would cost nothing again, and the price would move the target
into the array. The relaxation is not tight (at the best price its misfit is about a twentieth of the misfit by noise):
it gives starts, not bounds.

The best price depends on the unknown distance. A price that is too high moves the target into the array; with a price
that is too low, the slack moves it far away. So the problem is solved for several prices, and the solutions are ranked
by the cost of the data at their targets.

Sources: R. Grone, C. R. Johnson, E. M. Sa and H. Wolkowicz, "Positive definite completions of partial Hermitian
matrices", Linear Algebra Appl. 58 (1984), theorem 7 (the blocks); N. Z. Shor, "Quadratic optimization problems", Sov.
J. Comput. Syst. Sci. 25 (1987) (the lift); K. W. K. Lui, W.-K. Ma, H. C. So and F. K. W. Chan, "Semi-definite
programming algorithms for sensor network node localization with uncertainties in anchor positions and/or propagation
speed", IEEE Trans. Signal Process. 57 (2009) (nuisance parameters in the lift); the remainders, the price and its
reason are this project's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio

# Two prices per decade. In random plane arrays the best price (median of twelve) depends on the distance of the target:
# 30 within one extent, 3 at two extents, 0.3 at three, 0.1 at five and 0.03 at ten.
PRICES = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01)
"""Prices eta of the squared distance from the array's centre, in units of its mean squared extent."""


@dataclass(frozen=True, slots=True)
class RegistrationStart:
    """One solution of the relaxation.

    Parameters
    ----------
    target : Array, shape (1, d) or (2, d)
        Position; for a moving target position at time zero and velocity.
    bias : Array, shape (b,)
        The biases that fit best at this target.
    cost : float
        Cost of the windows at target and bias, ``sum |W (z - h - E bias)|^2 + sum ((bias - mean) / sigma)^2``.
    price : float
        The price of this solution.
    misfit : float
        The same cost in the relaxation; far below the cost of noise.
    slack : float
        Mean over the windows of the lifted ``|p_k|^2`` less its value at the target, length squared.
    rank_ratio : float
        Second over first eigenvalue in its own units, of the block in which it is largest; near zero if tight.
    answer : ConicAnswer
        The solver's report.
    """

    target: Array
    bias: Array
    cost: float
    price: float
    misfit: float
    slack: float
    rank_ratio: float
    answer: ConicAnswer


def registration(
    station: ArrayLike,
    z: ArrayLike,
    whiten: ArrayLike,
    sigma: ArrayLike,
    *,
    design: ArrayLike | None = None,
    mean: ArrayLike = 0.0,
    time: ArrayLike | None = None,
    prices: tuple[float, ...] = PRICES,
    backend: str = "CLARABEL",
) -> tuple[RegistrationStart, ...]:
    """Return the solutions of the relaxation for several prices.

    Parameters
    ----------
    station : array_like, shape (K, S, d)
        Positions in each window, the reference first; d is 2 or 3, any unit of length.
    z : array_like, shape (K, S - 1)
        Averaged range differences ``r_i - r_1`` plus bias, same unit.
    whiten : array_like, shape (K, S - 1, S - 1) or (S - 1, S - 1)
        Whitening matrices W of the averaged rows, ``W'W`` their inverse covariance.
    sigma : array_like, shape (b,)
        Prior standard deviations of the biases, positive and finite.
    design : array_like, shape (S - 1, b), optional
        E; by default one bias for each row.
    mean : array_like, shape (b,) or ()
        Prior means.
    time : array_like, shape (K,), optional
        Times of the windows, for a uniformly moving target; without times the target is fixed.
    prices : tuple of float
        Prices eta, in units of the inverse mean squared distance of the stations from their mean over all windows.
    backend : str
        Conic solver.

    Returns
    -------
    tuple of RegistrationStart
        One start for each solved price, lowest cost first; refine them. For a moving target refine all of them: it has
        several minima, and the order hardly predicts the minimum that a start leads to. Empty if the data are not
        finite, if a moving target has only one time, or if the solver gave no solution.

    Raises
    ------
    ValueError
        If a prior standard deviation is not positive and finite: without a prior there is no start.

    Notes
    -----
    See the text of the module. The data are shifted and scaled, so the result does not depend on origin or unit. Built
    once per shape and back end in each process.
    """
    run = RegistrationWindows.of(station, z, whiten, sigma, design, mean, time)
    if not run.finite:
        return ()
    K, S, d = run.station.shape
    relaxation, data = _relaxation(K, S, d, run.power.shape[1] - 1, len(run.prior), backend), run.parameters()
    weight = run.weight
    found = []
    for price in prices:
        answer = relaxation.solve({**data, "price": price * weight}, bound=False)
        if all(np.isfinite(value).all() for value in answer.values.values()):
            found.append(_read_off(run, weight, price, answer))
    return tuple(sorted(found, key=lambda one: one.cost))


@dataclass(frozen=True, slots=True)
class RegistrationWindows:
    """Data of K windows, relative to the stations' mean, in units of the stations' extent.

    Parameters
    ----------
    station : Array, shape (K, S, d)
        Positions, the reference first.
    z : Array, shape (K, S - 1)
        Range differences minus the prior means of the biases.
    gram : Array, shape (K, S - 1, S - 1)
        Inverse covariance of the rows, in the fine unit.
    design : Array, shape (S - 1, b)
        Coefficients of the biases in the rows.
    prior : Array, shape (b,)
        Inverse prior variances of the biases, in the fine unit.
    mean : Array, shape (b,)
        Prior means in the units of the caller.
    power : Array, shape (K, 1) or (K, 2)
        Powers of time that multiply the target's unknowns; time is relative to its middle, in half spans.
    unit : float
        The fine unit, for biases and remainders, in units of the extent.
    origin : Array, shape (d,)
        Mean of the stations, in the units of the caller.
    scale : float
        Extent of the stations, in the units of the caller.
    clock : tuple of two float
        Middle and half span of the times.
    """

    station: Array
    z: Array
    gram: Array
    design: Array
    prior: Array
    mean: Array
    power: Array
    unit: float
    origin: Array
    scale: float
    clock: tuple[float, float]

    @classmethod
    def of(
        cls,
        station: ArrayLike,
        z: ArrayLike,
        whiten: ArrayLike,
        sigma: ArrayLike,
        design: ArrayLike | None,
        mean: ArrayLike,
        time: ArrayLike | None,
    ) -> RegistrationWindows:
        """Return the shifted and scaled data; arguments as in `formulations.registration_sdp.registration`."""
        s, rows, W, spread = (np.asarray(a, dtype=np.float64) for a in (station, z, whiten, sigma))
        if not (np.isfinite(spread) & (spread > 0)).all():
            raise ValueError("every bias needs a prior standard deviation that is positive and finite")
        K, C = rows.shape
        E = np.eye(C) if design is None else np.asarray(design, dtype=np.float64)
        mu = np.broadcast_to(np.asarray(mean, dtype=np.float64), spread.shape)
        gram = np.broadcast_to(np.swapaxes(W, -1, -2) @ W, (K, C, C))
        origin = s.mean(axis=(0, 1))
        scale = float(np.sqrt(((s - origin) ** 2).sum(axis=-1).mean()))
        # a small unit for biases and noise, which are small compared with the size of the array
        noise = 1.0 / np.einsum("kii->ki", gram).mean()
        fine = float(np.sqrt(((E * spread) ** 2).sum(axis=1).mean() + noise))
        clock, power = (0.0, 1.0), np.ones((K, 1))
        if time is not None:
            t = np.asarray(time, dtype=np.float64)
            clock = float(t.mean()), float(np.ptp(t)) / 2 or np.nan
            power = np.stack([np.ones(K), (t - clock[0]) / clock[1]], axis=1)
        place, seen, prior = (s - origin) / scale, (rows - E @ mu) / scale, (fine / spread) ** 2
        return cls(place, seen, gram * fine**2, E, prior, mu, power, fine / scale, origin, scale, clock)

    @property
    def finite(self) -> bool:
        """Return whether all numbers are finite and, for a moving target, the times differ."""
        return all(np.isfinite(part).all() for part in (self.station, self.z, self.gram, self.power))

    def cost(self, target: Array) -> tuple[float, Array]:
        """Return the cost at a scaled target (n,), and the best shifts (b,) of the biases from their means."""
        away = np.linalg.norm((self.power @ target.reshape(-1, len(self.origin)))[:, None] - self.station, axis=-1)
        left = (self.z - away[:, 1:] + away[:, :1]) / self.unit
        shift = np.linalg.solve(self.total, self.design.T @ np.einsum("kij,kj->i", self.gram, left))
        rest = left - self.design @ shift
        return float(np.einsum("ki,kij,kj", rest, self.gram, rest) + self.prior @ shift**2), shift

    def place(self, target: Array) -> Array:
        """Return the target (1 or 2, d) in the units of the caller: position at time zero, and velocity if it moves."""
        found = self.scale * target.reshape(-1, len(self.origin))
        if len(found) == 2:  # back from time relative to its middle, in half spans
            found[1] /= self.clock[1]
            found[0] -= self.clock[0] * found[1]
        found[0] += self.origin
        return np.asarray(found)

    @property
    def weight(self) -> Array:
        """Return the form (n, n) of the mean of |p_k|^2 over the windows, which the price multiplies."""
        mean = self.power.T @ self.power / len(self.station)
        return np.asarray(np.kron(mean, np.eye(len(self.origin))), dtype=np.float64)

    def bias(self, shift: Any) -> Any:
        """Return the biases (b,) in the units of the caller from scaled shifts, an array or an expression."""
        return self.mean + self.unit * self.scale * shift

    def parameters(self) -> dict[str, Array]:
        """Return the parameters of `registration_problem` by name, except the price."""
        return _parameters(self)

    @property
    def total(self) -> Array:
        """Return the information of the biases (b, b) in the fine unit, including the prior."""
        return np.asarray(self.design.T @ self.gram.sum(axis=0) @ self.design + np.diag(self.prior))


def registration_problem(
    windows: int, stations: int, dimension: int, order: int, biases: int, change: Array | None = None
) -> Any:
    """Build the relaxation as a cvxpy problem.

    Parameters
    ----------
    windows, stations, dimension : int
        K, S and d.
    order : int
        Zero for a fixed target, one for a uniformly moving one.
    biases : int
        b.
    change : Array, shape (S, b + S), optional
        Matrix for other unknowns w of each window: ``(r_1, f) = change (delta, w)``. By default w is (r_1, f).

    Returns
    -------
    cvxpy.Problem
        Variables ``shared`` of size 1 + n + b, n = d (order + 1), the lift of (1, p, v, delta), and for each window k
        ``across k`` (1 + n + b, S) and ``own k`` (S, S), the lifts of its products with w, and of w.
        Parameters ``gram k`` and ``tie k``, the inverse covariance G of the rows and G E, ``bias`` (b, b), the sum of
        E'G E and the prior, ``price`` (n, n), ``moment`` (K, order + 1, order + 1) flattened to (K, ...), whose entries
        weigh the inner products of p and v in ``|p_k|^2``; of ``r_1^2 = |p_k|^2 + near'(1, p, v)`` the rows ``near``
        (K, n + 1); of ``unit f^2 - 2 r_1 f + level'(1, p, v) + ahead r_1 - turn f = 0`` the rows ``level`` (K (S - 1),
        n + 1), ``ahead`` and ``turn`` (K (S - 1),), and the scalar ``unit``.

    Notes
    -----
    Shor (1987); Grone et al. (1984).
    """
    import cvxpy as cp

    n, rows = dimension * (order + 1), stations - 1
    first, size = 1 + n, 1 + n + biases
    shared = cp.Variable((size, size), symmetric=True, name="shared")
    price, bias = cp.Parameter((n, n), name="price"), cp.Parameter((biases, biases), name="bias")
    moment = cp.Parameter((windows, (order + 1) ** 2), name="moment")
    near, level = cp.Parameter((windows, n + 1), name="near"), cp.Parameter((windows * rows, n + 1), name="level")
    ahead, turn = cp.Parameter(windows * rows, name="ahead"), cp.Parameter(windows * rows, name="turn")
    unit = cp.Parameter(name="unit")
    parts = [slice(1 + i * dimension, 1 + (i + 1) * dimension) for i in range(order + 1)]
    head, inner = shared[0, :first], cp.hstack([cp.trace(shared[a, b]) for a in parts for b in parts])
    cost = cp.sum(cp.multiply(price, shared[1:first, 1:first])) + cp.sum(cp.multiply(bias, shared[first:, first:]))
    rules = [shared[0, 0] == 1]
    for k in range(windows):
        across = cp.Variable((size, stations), name=f"across {k}")
        own = cp.Variable((stations, stations), symmetric=True, name=f"own {k}")
        gram, tie = cp.Parameter((rows, rows), name=f"gram {k}"), cp.Parameter((rows, biases), name=f"tie {k}")
        part = slice(k * rows, (k + 1) * rows)
        block = cp.bmat([[shared, across], [across.T, own]])
        if change is not None:
            across = block[:size, first:] @ change.T
            own = change @ block[first:, first:] @ change.T
        rules += [
            block >> 0,
            own[0, 0] == moment[k] @ inner + near[k] @ head,
            unit * cp.diag(own)[1:] - 2 * own[0, 1:] + level[part] @ head + ahead[part] * across[0, 0]
            == cp.multiply(turn[part], across[0, 1:]),
        ]
        cost += cp.sum(cp.multiply(gram, own[1:, 1:])) - 2 * cp.sum(cp.multiply(tie, across[first:, 1:].T))
    return cp.Problem(cp.Minimize(cost), rules)


@keep
def _relaxation(windows: int, stations: int, dimension: int, order: int, biases: int, backend: str) -> Relaxation:
    """Return the relaxation, built once for each shape and back end."""
    return Relaxation(registration_problem(windows, stations, dimension, order, biases), backend=backend)


def _parameters(run: RegistrationWindows) -> dict[str, Array]:
    """Return the parameters of `registration_problem` by name, except the price.

    The second kind of equalities is divided by the unit of the remainders.
    """
    K, S, _ = run.station.shape
    power, first, other = run.power, run.station[:, 0], run.station[:, 1:]
    size = (run.station**2).sum(axis=-1)
    # |p_k - s_i|^2 - |p_k - s_1|^2 is linear in the target: stations times powers of time
    lever = np.einsum("ko,kid->kiod", power, other - first[:, None]).reshape(K, S - 1, -1)
    level = np.concatenate([(run.z**2 - size[:, 1:] + size[:, :1])[..., None], 2 * lever], axis=-1)
    slope = np.einsum("ko,kd->kod", power, first).reshape(K, -1)
    tie = run.gram @ run.design
    blocks = {f"gram {k}": run.gram[k] for k in range(K)} | {f"tie {k}": tie[k] for k in range(K)}
    return blocks | {
        "bias": run.total,
        "moment": np.einsum("ka,kb->kab", power, power).reshape(K, -1),
        "near": np.concatenate([size[:, :1], -2 * slope], axis=1),
        "level": level.reshape(K * (S - 1), -1) / run.unit,
        "ahead": 2 * run.z.ravel() / run.unit,
        "turn": 2 * run.z.ravel(),
        "unit": np.array(run.unit),
    }


def _read_off(run: RegistrationWindows, weight: Array, price: float, answer: ConicAnswer) -> RegistrationStart:
    """Return the start in the units of the caller from a solution of the relaxation.

    `weight` (n, n) is the form of the mean of |p_k|^2 over the windows, which `price` multiplies.
    """
    shared, inside = answer.values["shared"], slice(1, 1 + len(weight))
    target = shared[0, inside]
    cost, shift = run.cost(target)
    # |p|^2 in the lift exceeds the square of p in the lift by the slack
    square = float((weight * shared[inside, inside]).sum())
    return RegistrationStart(
        run.place(target),
        run.bias(shift),
        cost,
        price,
        answer.primal - price * square,
        run.scale**2 * (square - float(target @ weight @ target)),
        largest_rank_ratio(answer.values, len(run.station)),
        answer,
    )


def largest_rank_ratio(values: Mapping[str, Array], windows: int) -> float:
    """Return the second over the first eigenvalue of the block in which it is largest.

    Parameters
    ----------
    values : mapping of str to Array
        Variables of `registration_problem` by name.
    windows : int
        K.
    """
    return max(rank_ratio(_block(values, k)) for k in range(windows))


def _block(values: Mapping[str, Array], window: int) -> Array:
    """Return the block of a window from a solution of the relaxation: the lift of (1, p, v, delta, r_1, f)."""
    across = values[f"across {window}"]
    return np.block([[values["shared"], across], [across.T, values[f"own {window}"]]])
