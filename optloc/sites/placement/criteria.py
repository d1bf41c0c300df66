"""Criteria of a relaxed choice of sites, with gradient and Hessian, as machine code.

Site i has a weight 0 <= w_i <= 1 and whitened rows g_pi at place p. The information at place p is M_p =
M0_p + sum_i w_i g_pi g_pi'. The covariance of the position, Cov_p, is the leading block of its inverse.
All criteria are maxima of

    L(w; lambda, W) = sum_q lambda_q tr(W_q Cov_q(w)),   lambda >= 0, sum 1,  W_q >= 0

over the multipliers lambda of places and failures, and over the weights W of directions. L is convex in
w; its gradient is -lambda_q c_i' W_q c_i with c_i = C M^-1 g_i, where C selects the position. (For the
determinant, W = Cov^-1 and the value is log det Cov.) `formulations.placement` contains the same
functions in NumPy.

Letters: P places, n sites with r rows each, m unknowns, d of them coordinates of the position. A scenario
(S of them) is no loss, or the loss of one site. An item q (Q of them) is one function under the maximum:
a place in a scenario if the criterion is the worst place, otherwise a scenario.
"""

from __future__ import annotations

import numpy as np

from optloc.engine import compiled
from optloc.problem import Array

TRACE, VOLUME, AXIS = 0, 1, 2
"""Criteria: tr Cov, log det Cov, and the largest eigenvalue of Cov."""

# Width of the smoothed largest eigenvalue, as a share of the eigenvalue: the bound loses less than this share.
_SMOOTH = 5e-3


@compiled
def invert(matrix: Array, inverse: Array, lower: Array) -> float:
    """Write the inverse of a matrix (m, m); return its log determinant, NaN if the matrix is not positive definite.

    `lower` (m, m) is scratch for the Cholesky factor; it can be the matrix. Criteria need the inverse and the
    log determinant.
    """
    m = matrix.shape[0]
    logdet = 0.0
    for j in range(m):
        for i in range(j, m):
            s = matrix[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            if i == j:
                if not s > 0.0:
                    return np.nan
                lower[j, j] = np.sqrt(s)
                logdet += np.log(s)
            else:
                lower[i, j] = s / lower[j, j]
    for c in range(m):
        for i in range(m):
            s = 1.0 if i == c else 0.0
            for k in range(i):
                s -= lower[i, k] * inverse[k, c]
            inverse[i, c] = s / lower[i, i]
        for i in range(m - 1, -1, -1):
            s = inverse[i, c]
            for k in range(i + 1, m):
                s -= lower[k, i] * inverse[k, c]
            inverse[i, c] = s / lower[i, i]
    return logdet


@compiled
def eigen(matrix: Array, values: Array, vectors: Array) -> None:
    """Write eigenvalues (d,) and eigenvectors (columns) of a small symmetric matrix (d, d), by Jacobi rotations.

    The eigenvalues are not sorted.
    """
    d = matrix.shape[0]
    a = matrix.copy()
    for i in range(d):
        for j in range(d):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = 0.0
        for i in range(d):
            for j in range(i):
                off += a[i, j] * a[i, j]
        trace = 0.0
        for i in range(d):
            trace += abs(a[i, i])
        if off <= 1e-30 * trace * trace:
            break
        for p in range(d):
            for q in range(p + 1, d):
                if a[p, q] == 0.0:
                    continue
                theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                t = t if theta >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(d):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(d):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(d):
                    x, y = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * x - s * y, s * x + c * y
    for i in range(d):
        values[i] = a[i, i]


@compiled
def measure(kind: int, cov: Array, weight: Array, basis: Array, shares: Array) -> tuple[float, float, float]:
    """Write the weight W (d, d) of a covariance; return criterion, smoothed criterion and tangent value tr(W Cov).

    `kind` is TRACE, VOLUME or AXIS, and `cov` is the covariance of the position (d, d), m^2. For TRACE and
    VOLUME, the three numbers are equal. For AXIS, the largest eigenvalue e is smoothed to tau log sum exp(e /
    tau). Its weight W has the directions `basis` (d, d, columns) in the `shares` (d,). tr(W Cov) is at most
    e; the difference is negligible if the other eigenvalues are far from e. `basis` and `shares` are outputs
    for AXIS only.
    """
    d = cov.shape[0]
    value = 0.0
    if kind != AXIS:
        if kind == VOLUME:
            value = invert(cov, weight, basis)
            return value, value, value
        for i in range(d):
            value += cov[i, i]
            for j in range(d):
                weight[i, j] = 1.0 if i == j else 0.0
        return value, value, value
    values = np.empty(d)
    eigen(cov, values, basis)
    for i in range(d):
        value = max(value, values[i])
    total, tangent = 0.0, 0.0
    for i in range(d):
        shares[i] = np.exp((values[i] - value) / (_SMOOTH * value))
        total += shares[i]
    for i in range(d):
        shares[i] /= total
        tangent += shares[i] * values[i]
        for j in range(d):
            weight[i, j] = 0.0
    for i in range(d):
        for j in range(d):
            for k in range(d):
                weight[i, j] += shares[k] * basis[i, k] * basis[j, k]
    return value, value * (1.0 + _SMOOTH * np.log(total)), tangent


@compiled
def gather(rows: Array, base: Array, w: Array, off: int, scale: float, out: Array, matrix: Array) -> None:
    """Write the scaled rows (r, m, n) of a place to `out`, and their information (m, m) to `matrix`.

    The rows g of all sites are multiplied by sqrt(scale); the row of site `off` is set to zero (-1: no site).
    The information is base + sum w g g', with the weights w (n,) and the information `base` (m, m) without
    the sites.
    """
    r, m, n = rows.shape
    root = np.sqrt(scale)
    for a in range(m):
        for b in range(m):
            matrix[a, b] = base[a, b]
    for q in range(r):
        for a in range(m):
            for j in range(n):
                out[q, a, j] = root * rows[q, a, j]
            if off >= 0:
                out[q, a, off] = 0.0
        for a in range(m):
            for b in range(a + 1):
                s = 0.0
                for j in range(n):
                    s += w[j] * out[q, a, j] * out[q, b, j]
                matrix[a, b] += s
                if a != b:
                    matrix[b, a] += s


@compiled
def slope(rows: Array, inverse: Array, weight: Array, u: Array, v: Array, gradient: Array) -> None:
    """Write u = M^-1 g and v = W C u of each row g, and subtract their products from the gradient (n,) of tr(W Cov).

    `rows` (r, m, n) are the rows of n sites, `inverse` is M^-1 (m, m) and `weight` is W (d, d). C selects the
    first d entries. The outputs are u (r, m, n) and v (r, d, n). The product is u'v over the first d entries,
    summed over the rows of each site.
    """
    r, m, n = rows.shape
    d = weight.shape[0]
    for q in range(r):
        for a in range(m):
            for j in range(n):
                u[q, a, j] = 0.0
            for b in range(m):
                x = inverse[a, b]
                for j in range(n):
                    u[q, a, j] += x * rows[q, b, j]
        for a in range(d):
            for j in range(n):
                v[q, a, j] = 0.0
            for b in range(d):
                x = weight[a, b]
                for j in range(n):
                    v[q, a, j] += x * u[q, b, j]
        for a in range(d):
            for j in range(n):
                gradient[j] -= u[q, a, j] * v[q, a, j]


@compiled
def bend(
    rows: Array, u: Array, v: Array, factor: float, extra: float, hessian: Array, near: Array, along: Array
) -> None:
    """Add the second derivatives of tr(W Cov) by the weights to the lower triangle of a Hessian (n, n).

    The entry is factor * (2 (g_i'M^-1 g_j)(c_i'W c_j) + extra (c_i'W c_j)^2); for log det Cov, `extra` is -1.
    `slope` explains `rows` and computes `u` and `v`. `near` and `along` (n,) are scratch.
    """
    r, m, n = rows.shape
    d = v.shape[1]
    for q in range(r):
        for p in range(r):
            for i in range(n):
                x = u[q, 0, i]
                for j in range(i + 1):
                    near[j] = x * rows[p, 0, j]
                for a in range(1, m):
                    x = u[q, a, i]
                    for j in range(i + 1):
                        near[j] += x * rows[p, a, j]
                x = v[q, 0, i]
                for j in range(i + 1):
                    along[j] = x * u[p, 0, j]
                for a in range(1, d):
                    x = v[q, a, i]
                    for j in range(i + 1):
                        along[j] += x * u[p, a, j]
                for j in range(i + 1):
                    hessian[i, j] += factor * along[j] * (2.0 * near[j] + extra * along[j])


@compiled
def add_square(vector: Array, factor: float, hessian: Array) -> None:
    """Add factor * x x' to the lower triangle of a matrix (n, n), with x = `vector` (n,)."""
    n = vector.shape[0]
    for i in range(n):
        x = factor * vector[i]
        for j in range(i + 1):
            hessian[i, j] += x * vector[j]


@compiled
def evaluate(
    rows: Array,
    bases: Array,
    weight: Array,
    d: int,
    w: Array,
    off: Array,
    scale: Array,
    kind: int,
    worst: int,
    state: tuple[Array, ...],
    values: Array,
) -> float:
    """Return the criterion at the weights w, and store the quantities that `derive` needs.

    P places, n free sites, S scenarios (no loss, or the loss of one site), Q items of the maximum: places,
    scenarios or both.

    Parameters
    ----------
    rows : array (P, r, m, n)
        Whitened rows of the free sites.
    bases : array (S, P, m, m)
        Information without the free sites, in each scenario.
    weight : array (P,)
        Weights of the places, sum 1.
    d : int
        Number of position coordinates among the m unknowns.
    w : array (n,)
        Weights of the sites.
    off : int array (S,)
        Free site that fails in each scenario, or -1.
    scale : array (S,)
        Factor on the weights of the free sites in each scenario.
    kind, worst : int
        TRACE, VOLUME or AXIS; 1 for the maximum over the places, 0 for their mean.
    state : tuple of arrays
        Output for each scenario and place: inverse (S, P, m, m), weights and directions (S, P, d, d), shares (S,
        P, d).
    values : array (2, Q)
        Output for each item of the maximum: smoothed value, and value of the tangent.
    """
    # `mean` is the criterion of a scenario: over all places, or of one place for `worst`. `best` is the largest.
    places, r, m, n = rows.shape
    inverse, turn, basis, shares = state
    scaled, matrix, lower = np.empty((r, m, n)), np.empty((m, m)), np.empty((m, m))
    values[:] = 0.0
    best = -np.inf
    for s in range(bases.shape[0]):
        mean = 0.0
        for p in range(places):
            gather(rows[p], bases[s, p], w, off[s], scale[s], scaled, matrix)
            invert(matrix, inverse[s, p], lower)
            cov = inverse[s, p, :d, :d].copy()
            top, smooth, touched = measure(kind, cov, turn[s, p], basis[s, p], shares[s, p])
            part = 1.0 if worst else weight[p]
            q = s * places + p if worst else s
            values[0, q] += part * smooth
            values[1, q] += part * touched
            mean = top if worst else mean + part * top
            best = max(best, mean) if worst else best
        best = best if worst else max(best, mean)
    return best


@compiled
def derive(
    rows: Array,
    bases: Array,
    weight: Array,
    d: int,
    w: Array,
    off: Array,
    scale: Array,
    kind: int,
    worst: int,
    state: tuple[Array, ...],
    share: Array,
    slopes: Array,
    hessian: Array,
) -> None:
    """Write the gradients (Q, n) of the items with a positive share, and the Hessian (n, n) of their weighted sum.

    Call `evaluate` first; the arguments `rows` to `worst` are the same, and `state` is its output. `share` (Q,)
    are the weights of the items. The outputs are `slopes` (Q, n) and the lower triangle of `hessian` (n, n).
    """
    places, r, m, n = rows.shape
    inverse, turn, basis, shares = state
    scaled, matrix = np.empty((r, m, n)), np.empty((m, m))
    u, v, near, along = np.empty((r, m, n)), np.empty((r, d, n)), np.empty(n), np.empty(n)
    single = np.empty(n)
    slopes[:] = 0.0
    hessian[:] = 0.0
    for s in range(bases.shape[0]):
        for p in range(places):
            q = s * places + p if worst else s
            if share[q] == 0.0:
                continue
            part = 1.0 if worst else weight[p]
            gather(rows[p], bases[s, p], w, off[s], scale[s], scaled, matrix)
            single[:] = 0.0
            slope(scaled, inverse[s, p], turn[s, p], u, v, single)
            for j in range(n):
                slopes[q, j] += part * single[j]
            factor = share[q] * part
            bend(scaled, u, v, factor, -1.0 if kind == VOLUME else 0.0, hessian, near, along)
            if kind == AXIS:
                cov = inverse[s, p, :d, :d].copy()
                turned(cov, u, basis[s, p], shares[s, p], single, factor, hessian, near)


@compiled
def turned(
    cov: Array, u: Array, basis: Array, shares: Array, gradient: Array, factor: float, hessian: Array, along: Array
) -> None:
    """Add the change of eigenvectors and eigenvalue shares with w to the Hessian (n, n); `bend` omits this change.

    `cov` (d, d) is the covariance, with the eigenvectors `basis` (d, d, columns) and their `shares` (d,); see
    `measure`. `u` (r, m, n) is an output of `slope`, and `gradient` (n,) is the gradient of tr(W Cov).
    `factor` is the weight of the item. `along` (n,) is scratch.
    """
    d, n = shares.shape[0], hessian.shape[0]
    values = np.empty(d)
    top = 0.0
    for k in range(d):
        values[k] = 0.0
        for a in range(d):
            for b in range(d):
                values[k] += basis[a, k] * cov[a, b] * basis[b, k]
        top = max(top, values[k])
    for k in range(d):
        for i in range(k + 1):
            # divided difference of the shares; the factor 2 counts both orders of the pair (k, i)
            rate = shares[k] / (_SMOOTH * top)
            if i < k:
                apart = values[k] - values[i]
                if abs(apart) > 1e-3 * _SMOOTH * top:
                    rate = (shares[k] - shares[i]) / apart
                rate *= 2.0
            for j in range(n):
                along[j] = 0.0
            for q in range(u.shape[0]):
                for j in range(n):
                    x, y = 0.0, 0.0
                    for a in range(d):
                        x += basis[a, k] * u[q, a, j]
                        y += basis[a, i] * u[q, a, j]
                    along[j] += x * y
            add_square(along, factor * rate, hessian)
    add_square(gradient, -factor / (_SMOOTH * top), hessian)
