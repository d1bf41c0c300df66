r"""Doppler shifts of a source at rest, its ranges and the products with unknown rates lifted: **a start, never tight**.

A node is a station at one epoch: place :math:`s_i`, velocity :math:`v_i`. Range and range rate of a source at `x` are

.. math:: r_i = |x - s_i|, \qquad r_i\, q_i = -(x - s_i) \cdot v_i,

and the rows are :math:`z_m = q_a - q_b + A_m \cdot b + n_m` (without :math:`q_b` if one station measures the Doppler
shift) or :math:`z_l = R_l \cdot r + A_l \cdot b + n_l` with unknowns `b`, an offset of the emitter's frequency for
instance. A row of rates times :math:`r_a` has no quotient:

.. math:: \varepsilon_m = r_a n_m = z_m r_a + (x - s_a) \cdot v_a + q_b r_a - A_m \cdot b\, r_a .

With the unknown rates :math:`\beta = (b, q_b)` and the products :math:`w_{ji} = \beta_j r_i` that occur, all rows are
linear in :math:`y = (1, x, \beta, r, w)`. Rows of rates are divided by ranges :math:`\rho_a`, which the previous pass
gives. The weighted cost,

.. math:: \min_x \; |W \,\mathrm{diag}(1/\rho)\, L\, y|^2,

is linear in :math:`Y = y y^\top`. It is relaxed to :math:`Y \succeq 0` with rules that hold for
every source (the last two only within their bounds):

- ties: :math:`Y_{r_i r_i} = |x - s_i|^2`, :math:`Y_{\beta_j r_i} = w_{ji}`, and
  :math:`Y_{q_b r_b} = -(x - s_b) \cdot v_b` of a rate's own range;
- products taken in two orders: :math:`w_{ji} r_n = w_{jn} r_i` and :math:`w_{ji} \beta_l = w_{li} \beta_j`, where the
  product of a rate with its own range is the linear form above;
- Cauchy and Schwarz, :math:`r_i r_n \ge |(x - s_i) \cdot (x - s_n)|` (the triangle inequality),
  :math:`q_b^2 \le |v_b|^2`, and :math:`|x - s_i| \le r_i`;
- where the height is known, :math:`(x - c)^\top E (x - c) = 1`, else :math:`|x| \le` `reach`; squared both are linear
  in `Y`, and the ellipsoid is a surface of constant height only nearly (`formulations.range_height.ellipsoid`);
- to keep `Y` bounded: `b` differs from its fit without the source by at most ten speeds of the fastest node.

Limits: the value is a lower bound of that weighted cost for the last :math:`\rho`, not of the likelihood's
(both agree at a point whose ranges are :math:`\rho`). It is not tight: the first row of `Y` gives a position, and
the rest the region around it in which the relaxation does not decide. A frequency offset leaves two places, one on each
side of a satellite's track, of which `Y` is the mean. Then the first moment is between them, and the points

.. math:: \bar x, \quad \bar x \pm \sqrt{\lambda_k}\, e_k, \qquad Y_{xx} - \bar x \bar x^\top = \sum_k \lambda_k e_k
   e_k^\top

contain both (a mean of two points has one eigenvalue, and they are at plus and minus its root). They are starts for a
local method and prove no uniqueness; they are worst for differences of rates of a single pair.

The size is limited: :mod:`formulations.normal_points` averages rows that are adjacent in time.

Sources: B. Song, W. Wen, Q. Zhang, B. Xu and L.-T. Hsu, "Certifiably optimal Doppler positioning using opportunistic
LEO satellites", arXiv:2509.17198 (2025) (place, ranges, clock drift and its products with the ranges lifted, and
weights from the ranges of the previous pass: the programme for one station a row, without the products in two orders
and the inequalities); G. Wang, Y. Li and N. Ansari, "A semidefinite relaxation method for source localization using
TDOA and FDOA measurements", IEEE Trans. Veh. Technol. 62 (2013), p. 853 (range and rate of the reference as unknowns
that are lifted with the source); H. D. Sherali and W. P. Adams, "A reformulation-linearization technique", Kluwer 1999
(products in two orders).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from formulations.algebra import Array, Index, Mask
from formulations.conic import ConicAnswer, Relaxation, keep, rank_ratio, tight
from formulations.range_height import Ellipsoid

SIZE = 24
"""Length of y beyond which rows should be joined. The time of the programme grows with its fourth power, and starts
from 36 led to the best minimum in 47 of 48 runs of a pair or of satellites, from 24 in 48."""

_PASSES = 2  # the second pass has the ranges of the first; a third pass changed no start of 40
_LIMIT = 10.0  # limit of unknowns that are not rates, in speeds of the fastest node: far above their values after a fit
_NEAREST = 1e-3  # least range in a weight, in units of length: at a station the weight would be infinite


@dataclass(frozen=True, slots=True)
class Shape:
    """The structure of the programme.

    Parameters
    ----------
    dimension, nodes, unknowns : int
        Dimension of space, number of nodes, number of linear unknowns b.
    second : tuple of int
        Nodes whose range rate is an unknown: the nodes subtracted in a row.
    product : tuple of (int, int)
        Unknown j of beta and node i of each product w.
    surface : bool
        Whether the source is on an ellipsoid; else it is within a reach.
    """

    dimension: int
    nodes: int
    unknowns: int
    second: tuple[int, ...]
    product: tuple[tuple[int, int], ...]
    surface: bool

    @property
    def places(self) -> tuple[int, int, int, int]:
        """Return four indices of y: the first of beta, the first of r, the first of w, and its length."""
        beta = 1 + self.dimension
        r = beta + self.unknowns + len(self.second)
        return beta, r, r + self.nodes, r + self.nodes + len(self.product)

    @property
    def rate_of(self) -> dict[int, int]:
        """Return the node of each range rate in beta, by the number of the unknown."""
        return {self.unknowns + i: node for i, node in enumerate(self.second)}

    def swaps(self) -> Index:
        """Return the products that may be taken in two orders.

        Returns
        -------
        int array, shape (q, 4)
            ``f, u, g, v``: f times entry u of y equals g times entry v. Both f and g are entries of y, products w; but
            a negative f means the range times the range rate of node ``-1 - f``.
        """
        beta, r, w, _ = self.places
        form = {(j, node): -1 - node for j, node in self.rate_of.items()}
        form |= {pair: w + k for k, pair in enumerate(self.product)}
        found = []
        for (one, f), (other, g) in combinations(form.items(), 2):
            if one[0] == other[0]:
                found.append((f, r + other[1], g, r + one[1]))
            elif one[1] == other[1]:
                found.append((f, beta + other[0], g, beta + one[0]))
        # a rate has one node, and a node one rate: at most one of two forms is negative, and it is the first in `form`
        return np.array(found, dtype=np.int64).reshape(-1, 4)


@dataclass(frozen=True, slots=True)
class DopplerScene:
    """The scaled rows, see the text of the module.

    Parameters
    ----------
    shape : Shape
        Structure of the products.
    place, speed : Array, shape (M, d)
        Nodes.
    rows : Array, shape (m, n)
        L: every row as a form in y.
    pivot : int array, shape (m,)
        Node whose range multiplies the error of a row; -1 for none.
    whiten : Array, shape (m, m)
        W.
    surface : Ellipsoid or None
        The ellipsoid in these units.
    origin : Array, shape (d,)
        Origin of the scaled coordinates.
    length, rate : float
        Units of length and speed.
    unit, mean : Array, shape (p,)
        Units and offsets of b.
    """

    shape: Shape
    place: Array
    speed: Array
    rows: Array
    pivot: Array
    whiten: Array
    surface: Ellipsoid | None
    origin: Array
    length: float
    rate: float
    unit: Array
    mean: Array

    @classmethod
    def of(
        cls,
        place: Array,
        speed: Array,
        z: Array,
        whiten: Array,
        ranges: Array,
        rates: Array,
        design: Array,
        surface: Ellipsoid | None,
    ) -> DopplerScene:
        """Return the scaled rows with the structure of the lift; arguments as in `doppler`."""
        origin = place.mean(axis=0) if surface is None else surface.centre
        # the mean radius of an ellipsoid, else the distance of the farthest node
        length = (
            float(np.sqrt(((place - origin) ** 2).sum(axis=1).max()))
            if surface is None
            else float(np.trace(surface.shape) / len(origin)) ** -0.5
        )
        length = length or 1.0
        rate = float(np.sqrt((speed**2).sum(axis=1).max())) or 1.0
        of_rate = np.asarray(rates.any(axis=1))
        size = np.where(of_rate, rate, length)
        first, second, sign = _nodes_of_rows(rates, speed)
        scaled = design / size[:, None]
        unit = 1.0 / np.maximum(np.abs(scaled).max(axis=0, initial=0.0), np.finfo(float).tiny)
        scaled = scaled * unit
        # after a fit by the unknowns b alone, the remainders are numbers of order one
        left = z / size
        mean = np.linalg.lstsq(scaled, left, rcond=None)[0] if scaled.size else np.zeros(design.shape[1])
        left = left - scaled @ mean
        shape = _shape(place.shape, first, second, scaled, of_rate, surface is not None)
        place, speed = (place - origin) / length, speed / rate
        left, scaled = np.where(of_rate, sign, 1.0) * left, np.where(of_rate, sign, 1.0)[:, None] * scaled
        rows = _forms(shape, place, speed, left, ranges, first, second, scaled)
        whiten = whiten * (size * np.where(of_rate, sign, 1.0))
        own = None if surface is None else Ellipsoid(surface.shape * length**2, np.zeros(len(origin)))
        return cls(shape, place, speed, rows, first, whiten, own, origin, length, rate, unit, unit * mean)

    def parameters(self, far: Array, reach: float) -> tuple[dict[str, Array], float]:
        """Return the parameters of the programme by name, and the unit of its cost.

        `far` (m,) are the ranges of the previous pass, which divide the rows; `reach` is the greatest distance of the
        source.
        """
        form = self.whiten @ (self.rows / far[:, None])
        gram = form.T @ form
        size = float(np.abs(gram).max()) or 1.0
        speed, place, shape = self.speed, self.place, self.shape
        swap = shape.swaps()
        slow = np.sqrt((speed**2).sum(axis=1))
        own = (place * speed).sum(axis=1)
        values = {
            "gram": gram / size,
            "station": place,
            "square": (place**2).sum(axis=1),
        }
        limit = np.concatenate([np.full(shape.unknowns, _LIMIT), slow[list(shape.second)]])
        if len(limit):
            values["limit"] = limit**2
        if shape.second:
            values |= {"rate": speed[list(shape.second)], "level": own[list(shape.second)]}
        # swaps with the product of a range and its own rate, a linear form in x
        mixed = -1 - swap[swap[:, 0] < 0, 0]
        if len(mixed):
            values |= {"turned rate": speed[mixed], "turned level": own[mixed]}
        if shape.nodes > 1:
            u, v = np.triu_indices(shape.nodes, 1)
            values |= {"middle": place[u] + place[v], "inner": (place[u] * place[v]).sum(axis=1)}
        values |= {"reach": np.array(reach**2)} if self.surface is None else {"form": self.surface.shape}
        return values, size

    def last_pass(self, *, reach: float = 10.0, backend: str = "CLARABEL") -> tuple[Array, float, ConicAnswer]:
        """Return the weights of the last pass and its solution.

        Parameters
        ----------
        reach, backend
            As in `doppler`.

        Returns
        -------
        far : Array, shape (m,)
            Ranges that divide the rows, scaled.
        size : float
            Unit of the cost.
        answer : ConicAnswer
            The solution; of the first pass if that failed.
        """
        relaxation, far = _relaxation(self.shape, backend), np.ones(len(self.pivot))
        for _ in range(_PASSES):
            given, size = self.parameters(far, reach)
            answer = relaxation.solve(given, reach=self.longest(reach))
            # value and bound of a pass belong to the ranges that divided its rows
            weighted, lift = far, answer.values["lift"]
            if not np.isfinite(lift).all():
                break
            apart = np.sqrt(((lift[0, 1 : 1 + self.shape.dimension] - self.place) ** 2).sum(axis=1))
            far = np.where(self.pivot < 0, 1.0, np.maximum(apart[self.pivot], _NEAREST))
        return weighted, size, answer

    def points(self, lift: Array) -> Array:
        """Return points (1 + 2 d, d) in the units of the caller: the first moment of a lift, then points around it."""
        d = self.shape.dimension
        point = lift[0, 1 : 1 + d]
        spread, axes = np.linalg.eigh(lift[1 : 1 + d, 1 : 1 + d] - np.outer(point, point))
        step = (np.sqrt(np.maximum(spread, 0.0)) * axes).T[::-1]
        points = point + np.concatenate([np.zeros((1, d)), np.stack([step, -step], axis=1).reshape(-1, d)])
        if self.surface is not None:
            # a mean of positions on a surface is below it: it is moved to the surface along the line to the centre
            points = points / np.sqrt(np.einsum("ij,jk,ik->i", points, self.surface.shape, points))[:, None]
        return np.asarray(self.origin + self.length * points)

    def unknown(self, lift: Any) -> Any:
        """Return b (p,) in the units of the caller, from a lift, an array or an expression."""
        beta = self.shape.places[0]
        return self.mean + np.diag(self.unit) @ lift[0, beta : beta + self.shape.unknowns]

    def longest(self, reach: float) -> float:
        """Return the greatest length of Y for any source within the reach; the bound from the dual needs it."""
        far = reach if self.surface is None else float(np.linalg.eigvalsh(self.surface.shape)[0]) ** -0.5
        r = far + np.sqrt((self.place**2).sum(axis=1))
        slow = np.sqrt((self.speed**2).sum(axis=1))
        beta = np.concatenate([np.full(self.shape.unknowns, _LIMIT), slow[list(self.shape.second)]])
        w = np.array([beta[j] * r[i] for j, i in self.shape.product])
        return float(1.0 + far**2 + (r**2).sum() + (beta**2).sum() + (w**2).sum())


@dataclass(frozen=True, slots=True)
class DopplerStart:
    """A start from the relaxation.

    Parameters
    ----------
    point : Array, shape (1 + 2 d, d)
        Point of the first row of Y, then the points around it, the farthest first; NaN if the solver gave none.
    unknown : Array, shape (p,)
        Values of b.
    far : Array, shape (m,)
        Divisors of rows in the weighted cost: ranges for rows of rates, one for other rows.
    value, bound : float
        Optimum, and a lower bound of the weighted cost within the reach, recomputed from the dual.
    rank_ratio : float
        Second over first eigenvalue of the lift.
    answer : ConicAnswer
        The solver's report.
    """

    point: Array
    unknown: Array
    far: Array
    value: float
    bound: float
    rank_ratio: float
    answer: ConicAnswer | None


def doppler(
    place: ArrayLike,
    speed: ArrayLike,
    z: ArrayLike,
    whiten: ArrayLike,
    *,
    ranges: ArrayLike,
    rates: ArrayLike,
    design: ArrayLike | None = None,
    surface: Ellipsoid | None = None,
    reach: float = 10.0,
    backend: str = "CLARABEL",
) -> DopplerStart:
    """Return a start for a source at rest from Doppler shifts and, optionally, range differences.

    Parameters
    ----------
    place, speed : array_like, shape (M, d)
        Positions and velocities of the nodes; a node is a station at one epoch.
    z : array_like, shape (m,)
        Measured values: range rates and differences of range rates, ranges and their differences or sums.
    whiten : array_like, shape (m, m)
        W, the whitening matrix of their errors.
    ranges, rates : array_like, shape (m, M)
        Coefficients of the nodes' ranges and range rates in each row. A row of rates has one node with plus or minus
        one, or two nodes of opposite signs, and no ranges.
    design : array_like, shape (m, p), optional
        A: coefficients of the linear unknowns in the rows.
    surface : Ellipsoid, optional
        Surface on which the source is.
    reach : float
        Without a surface: greatest distance from the nodes' centre, in units of the distance of the farthest node.
    backend : str
        Conic solver; only ``"CLARABEL"`` gives bounds.

    Returns
    -------
    DopplerStart
        Points and bound; the text of the module explains their limits. NaN if the data or the solution are NaN.

    Raises
    ------
    ValueError
        If a row of rates has another form.

    Notes
    -----
    Song et al. (2025); Wang, Li and Ansari (2013). Built once for each shape in each process.
    """
    S, V, values, W, R, Q = (np.asarray(part, dtype=np.float64) for part in (place, speed, z, whiten, ranges, rates))
    A = np.zeros((len(values), 0)) if design is None else np.asarray(design, dtype=np.float64)
    if not all(np.isfinite(part).all() for part in (S, V, values, W, A)):
        return _no_start(S.shape[1], A.shape, None)
    scene = DopplerScene.of(S, V, values, W, R, Q, A, surface)
    far, size, answer = scene.last_pass(reach=reach, backend=backend)
    if not np.isfinite(answer.values["lift"]).all():
        return _no_start(S.shape[1], A.shape, answer)
    return _read_off(scene, far, size, answer)


def _read_off(scene: DopplerScene, far: Array, size: float, answer: ConicAnswer) -> DopplerStart:
    """Return the start in the units of the caller from a solution of the relaxation.

    `far` (m,) are the ranges that divided the rows, scaled; `size` is the unit of the cost.
    """
    lift = answer.values["lift"]
    return DopplerStart(
        scene.points(lift),
        scene.unknown(lift),
        np.where(scene.pivot < 0, 1.0, scene.length * far),
        answer.primal * size,
        max(answer.bound * size, 0.0),  # a sum of squares is not negative
        rank_ratio(lift),
        answer,
    )


def _no_start(dimension: int, design: tuple[int, ...], answer: ConicAnswer | None) -> DopplerStart:
    """Return a start of NaN, for `design` of the shape (rows, unknowns)."""
    rows, unknowns = design
    point, none = np.full((1 + 2 * dimension, dimension), np.nan), np.full(unknowns, np.nan)
    return DopplerStart(point, none, np.full(rows, np.nan), np.nan, -np.inf, np.nan, answer)


def _nodes_of_rows(rates: Array, speed: Array) -> tuple[Array, Array, Array]:
    """Return three arrays (m,): the node whose range multiplies a row, the node whose rate is an unknown, and the sign.

    `rates` (m, M) are the coefficients of range rates in the rows, `speed` (M, d) the velocities of the nodes. A node
    is -1 if there is none. The sign is the coefficient of the first node.
    """
    if (np.abs(rates).sum(axis=1) > 2.0).any() or (np.abs(rates.sum(axis=1)) > 1.0).any():
        raise ValueError("a row of rates must be one rate, or the difference of two")
    # a rate that is always zero needs no unknown; a rate that many rows share should be only one unknown
    moving = (speed != 0.0).any(axis=1)
    often = np.where(moving, 1.0 + np.abs(rates).sum(axis=0), 0.0)
    held = np.where(rates != 0.0, often, np.inf)
    first = np.where(rates.any(axis=1), held.argmin(axis=1), -1)
    rest = np.where(np.arange(rates.shape[1]) == first[:, None], 0.0, np.abs(rates) * often)
    second = np.where(rest.any(axis=1), rest.argmax(axis=1), -1)
    # if only one station moves, its range multiplies the row; the rate of the station at rest needs no unknown
    still = (first >= 0) & (second >= 0) & ~moving[first]
    first, second = np.where(still, second, first), np.where(still, -1, second)
    return first, second, np.where(first < 0, 1.0, rates[np.arange(len(rates)), first])


def _shape(nodes: tuple[int, ...], first: Array, second: Array, design: Array, rate: Mask, surface: bool) -> Shape:
    """Return the structure of the programme.

    `nodes` is the shape (M, d) of the nodes. `first` and `second` are the results of `_nodes_of_rows`. `design` (m, p)
    are the coefficients of b. `rate` marks rows of rates, `surface` is True for a source on an ellipsoid.
    """
    known = design.shape[1]
    others = tuple(int(node) for node in np.unique(second[second >= 0]))
    of = {node: known + i for i, node in enumerate(others)}
    product: dict[tuple[int, int], None] = {}  # a dictionary keeps the order, and contains each pair once
    for a, b, row in zip(first[rate], second[rate], design[rate], strict=True):
        product |= {(int(j), int(a)): None for j in np.flatnonzero(row)}
        product |= {(of[int(b)], int(a)): None} if b >= 0 else {}
    return Shape(nodes[1], nodes[0], known, others, tuple(product), surface)


def _forms(
    shape: Shape, place: Array, speed: Array, z: Array, ranges: Array, first: Array, second: Array, design: Array
) -> Array:
    """Return the rows (m, length of y) as linear forms in y: measured values z minus predicted values.

    `first` and `second` (m,) are the results of `_nodes_of_rows`, `design` (m, p) the coefficients of b. The form of a
    row of rates is multiplied by the range of its node `first`.
    """
    beta, r, w, size = shape.places
    at = {pair: w + k for k, pair in enumerate(shape.product)}
    of = {node: j for j, node in shape.rate_of.items()}
    rows = np.zeros((len(z), size))
    for m, (a, b) in enumerate(zip(first, second, strict=True)):
        if a < 0:
            rows[m, 0], rows[m, beta : beta + shape.unknowns], rows[m, r:w] = z[m], -design[m], -ranges[m]
            continue
        rows[m, 0], rows[m, 1:beta], rows[m, r + a] = -place[a] @ speed[a], speed[a], z[m]
        for j in np.flatnonzero(design[m]):
            rows[m, at[int(j), int(a)]] = -design[m, j]
        if b >= 0:
            rows[m, at[of[int(b)], int(a)]] = 1.0
    return rows


def lifted_size(dimension: int, ranges: Array, rates: Array, design: Array) -> int:
    """Return the length of y for rows whose nodes all move.

    Parameters
    ----------
    dimension : int
        Dimension of space.
    ranges, rates : Array, shape (m, M)
        Coefficients of ranges and range rates in the rows.
    design : Array, shape (m, p)
        Coefficients of the linear unknowns.

    Returns
    -------
    int
        The length; beyond `SIZE` the programme takes seconds.
    """
    first, second, _ = _nodes_of_rows(rates, np.ones((rates.shape[1], 1)))
    rate = np.asarray(rates.any(axis=1))
    return _shape((rates.shape[1], dimension), first, second, design, rate, False).places[-1]


def doppler_problem(shape: Shape, change: Array | None = None) -> Any:
    """Build the relaxation as a cvxpy problem.

    Parameters
    ----------
    shape : Shape
        Structure of the lift.
    change : Array, shape (n, n), optional
        Other unknowns u, whose first is 1, with ``y = change u``; by default u is y.

    Returns
    -------
    cvxpy.Problem
        Variable ``lift`` of shape (n, n) of u; parameters of `DopplerScene.parameters`, with ``gram`` in u.

    Notes
    -----
    Song et al. (2025), with the further rules in the text of the module.
    """
    import cvxpy as cp

    d, count = shape.dimension, shape.nodes
    beta, r, w, size = shape.places
    own = cp.Variable((size, size), symmetric=True, name="lift")
    lift = own if change is None else change @ own @ change.T
    gram = cp.Parameter((size, size), name="gram")
    station, square = cp.Parameter((count, d), name="station"), cp.Parameter(count, name="square")
    x, inside, far = lift[0, 1:beta], lift[1:beta, 1:beta], lift[0, r:w]
    rules = [
        own >> 0,
        own[0, 0] == 1,
        cp.diag(lift)[r:w] == cp.trace(inside) - 2 * station @ x + square,
        far >= 0,
        *(cp.norm(x - station[i]) <= far[i] for i in range(count)),
    ]
    if shape.surface:
        form = cp.Parameter((d, d), name="form")
        rules.append(cp.sum(cp.multiply(form, inside)) == 1)
    else:
        rules.append(cp.trace(inside) <= cp.Parameter(name="reach"))
    if count > 1:
        u, v = np.triu_indices(count, 1)
        middle, inner = cp.Parameter((len(u), d), name="middle"), cp.Parameter(len(u), name="inner")
        dot = cp.trace(inside) - middle @ x + inner
        rules += [lift[r + u, r + v] >= dot, lift[r + u, r + v] >= -dot]
    if r > beta:
        rules.append(cp.diag(lift)[beta:r] <= cp.Parameter(r - beta, name="limit"))
    return cp.Problem(cp.Minimize(cp.sum(cp.multiply(gram, own))), [*rules, *_products(shape, lift)])


def _products(shape: Shape, lift: Any) -> list[Any]:
    """Return the constraints of the products: their definitions, and their symmetry in the order of factors."""
    import cvxpy as cp

    d, (beta, r, w, _) = shape.dimension, shape.places
    rules = []
    if shape.product:
        j, i = np.array(shape.product).T
        rules.append(lift[beta + j, r + i] == lift[0, w:])
    if shape.second:
        own, node = beta + shape.unknowns + np.arange(len(shape.second)), np.array(shape.second)
        rate, level = cp.Parameter((len(node), d), name="rate"), cp.Parameter(len(node), name="level")
        rules.append(lift[own, r + node] == level - rate @ lift[0, 1:beta])
    swap = shape.swaps()
    plain, mixed = swap[swap[:, 0] >= 0], swap[swap[:, 0] < 0]
    if len(plain):
        rules.append(lift[plain[:, 0], plain[:, 1]] == lift[plain[:, 2], plain[:, 3]])
    if len(mixed):
        rate, level = cp.Parameter((len(mixed), d), name="turned rate"), cp.Parameter(len(mixed), name="turned level")
        along = cp.sum(cp.multiply(rate, lift[mixed[:, 1]][:, 1:beta]), axis=1)
        rules.append(cp.multiply(level, lift[0, mixed[:, 1]]) - along == lift[mixed[:, 2], mixed[:, 3]])
    return rules


@keep
def _relaxation(shape: Shape, backend: str) -> Relaxation:
    """Return the relaxation, built once for each structure and back end."""
    return Relaxation(doppler_problem(shape), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the relaxation: a decade below Clarabel's default, for errors of 1e-5 of the rates."""
    return tight(backend, 1e-9)
