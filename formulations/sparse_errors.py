r"""Linear rows of which a few have gross errors, with the position in second-order cones.

.. math::
    \min_{y, e} \; \tfrac12 |B y - g - e|^2 + \sum_g \lambda_g |e_g| \quad\text{subject to}\quad
    |M_k (y, 1)| \le m_k^\top (y, 1), \; k = 1, \dots, K

The rows are whitened; `e` are gross errors in sigmas, zero in all rows but a few; :math:`e_g` are the errors of one
group of rows (one row by default, or all rows of one station). The penalty is the convex hull of counting the groups in
error, so the programme is convex: without cones it is the regression with Huber's loss of threshold :math:`\lambda`,
and

.. math:: e_g = (1 - \lambda_g / |r_g|)_+ \, r_g, \quad r = B y - g

at every optimum. Groups with :math:`e_g \ne 0` are the *support*. The relaxation: the count of wrong groups becomes
the sum of their sizes, which shrinks each of them towards zero by :math:`\lambda_g`. The quadrics of squared ranges
become the cones that they bound. So the solution is not an estimate. It is a start and a guess of the support, to be
refined and tested without the rows of the support.

The threshold is the universal one, :math:`\lambda = \sqrt{2 \ln m}` of m rows, which the largest of m normal errors
exceeds with a probability that goes to zero. A group of p rows has the threshold that :math:`\chi_p` exceeds with the
same probability.

Sources: D. L. Donoho and I. M. Johnstone, "Ideal spatial adaptation by wavelet shrinkage", Biometrika 81 (1994) (the
universal threshold); M. Yuan and Y. Lin, "Model selection and estimation in regression with grouped variables", J. R.
Stat. Soc. B 68 (2006), section 2 (groups); Y. She and A. B. Owen, "Outlier detection using nonconvex penalized
regression", J. Am. Stat. Assoc. 106 (2011) (the penalty on errors is Huber's loss).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, erfc

from formulations.algebra import Array
from formulations.conic import ConicAnswer, Relaxation, keep, tight
from formulations.unit_scale import power_of_two

Groups = NDArray[np.intp]

_RANK = 1e-10  # singular value of the rows, relative to the largest, below which a direction of y is undetermined


@dataclass(frozen=True, slots=True)
class SparseFit:
    """The result of a fit with gross errors.

    Parameters
    ----------
    y : Array, shape (n,)
        Unknowns; NaN if the programme has no solution or the rows leave a direction of y undetermined.
    errors : Array, shape (m,)
        Gross error of each row in sigmas, exactly zero outside the support.
    value : float
        Cost at `y` and `errors`.
    bound : float
        Lower bound of the cost, recomputed from the dual; minus infinity if it was not requested.
    answer : ConicAnswer, optional
        The solver's report; None if the rows leave a direction undetermined.
    """

    y: Array
    errors: Array
    value: float
    bound: float
    answer: ConicAnswer | None


def thresholds(sizes: Groups) -> Array:
    """Return the universal threshold of each group of rows.

    Parameters
    ----------
    sizes : int array, shape (G,)
        Number of rows of each group; an empty group has the threshold of one row.

    Returns
    -------
    Array, shape (G,)
        Thresholds in sigmas: ``sqrt(2 ln G)`` for single rows; for larger groups the value that ``chi`` exceeds with
        the same probability.

    Notes
    -----
    Donoho and Johnstone (1994). At least one, so that a single group has a threshold too.
    """
    count = max(int((np.asarray(sizes) > 0).sum()), 2)
    level = max(np.sqrt(2.0 * np.log(count)), 1.0)
    return np.asarray(np.sqrt(chdtri(np.maximum(sizes, 1), erfc(level / np.sqrt(2.0)))), dtype=np.float64)


def sparse_problem(n: int, groups: tuple[int, ...], cones: tuple[int, ...]) -> Any:
    """Build the programme as a cvxpy problem with parameters.

    Parameters
    ----------
    n : int
        Length of y.
    groups : tuple of m int
        Group of each row, counted from zero.
    cones : tuple of K int
        Length of the vector in each cone.

    Returns
    -------
    cvxpy.Problem
        Parameters ``rows`` (m, n), ``right`` (m,), ``price`` (G,) and one ``cone k`` (length + 1, n + 1) for each cone:
        the rows of the vector, then the row of its bound; variables ``y``, ``error``.

    Notes
    -----
    Yuan and Lin (2006), section 2, with one more unknown for each row.
    """
    import cvxpy as cp

    m, member = len(groups), np.asarray(groups)
    rows, right = cp.Parameter((m, n), name="rows"), cp.Parameter(m, name="right")
    price = cp.Parameter(int(member.max(initial=-1)) + 1, nonneg=True, name="price")
    y, error = cp.Variable(n, name="y"), cp.Variable(m, name="error")
    # single rows as absolute values: linear inequalities are cheaper than cones of length two
    if len(set(groups)) == m:
        size = price[member] @ cp.abs(error)
    else:
        size = sum(price[i] * cp.norm(error[np.flatnonzero(member == i)]) for i in sorted(set(groups)))
    inside = []
    for k, length in enumerate(cones):
        matrix = cp.Parameter((length + 1, n + 1), name=f"cone {k}")
        both = matrix[:, :n] @ y + matrix[:, n]
        inside.append(cp.SOC(both[length], both[:length]))
    return cp.Problem(cp.Minimize(0.5 * cp.sum_squares(rows @ y - right - error) + size), inside)


@keep
def _relaxation(n: int, groups: tuple[int, ...], cones: tuple[int, ...], backend: str) -> Relaxation:
    """Return the relaxation, built once for each structure and back end."""
    return Relaxation(sparse_problem(n, groups, cones), backend=backend, settings=settings_of(backend))


def settings_of(backend: str = "CLARABEL") -> dict[str, float]:
    """Return the settings of the programme for a back end: two decades below Clarabel's default tolerance.

    The size of an error then distinguishes errors within a threshold from exact zeros.
    """
    return tight(backend, 1e-10)


def sparse_fit(
    B: Array,
    g: Array,
    groups: Groups | None = None,
    *,
    price: Array | None = None,
    cones: Sequence[Array] = (),
    backend: str = "CLARABEL",
    bound: bool = False,
) -> SparseFit:
    """Return a fit of linear rows of which a few have gross errors.

    Parameters
    ----------
    B : Array, shape (m, n)
        Whitened rows; absent rows are zero.
    g : Array, shape (m,)
        Right sides.
    groups : int array, shape (m,), optional
        Group of each row, counted from zero; by default each row is a group.
    price : Array, shape (G,), optional
        Threshold of each group in sigmas; by default `thresholds` of the present rows.
    cones : sequence of Array, shape (p + 1, n + 1)
        Constraint: the vector of the first p rows times ``(y, 1)`` is no longer than the last row times ``(y, 1)``.
    backend : str
        Conic solver.
    bound : bool
        Whether to recompute the lower bound from the dual.

    Returns
    -------
    SparseFit
        The fit. The programme is built once for each structure and back end in each process.

    Raises
    ------
    ValueError
        If the shapes do not fit each other.

    Notes
    -----
    Solved in the coordinates ``z = S V' y`` of the singular value decomposition ``B = U S V'`` less the least-squares
    fit: all numbers are in sigmas, even if the noise is small compared with the distances.
    """
    B, g = np.asarray(B, dtype=np.float64), np.asarray(g, dtype=np.float64)
    m, n = B.shape
    program = sparse_program(B, g, groups, price=price, cones=cones)
    if program is None:
        return SparseFit(np.full(n, np.nan), np.zeros(m), np.nan, -np.inf, None)
    scale = program.scale
    answer = _relaxation(*program.structure, backend).solve(program.values, bound=bound)
    if not np.isfinite(answer.primal):
        return SparseFit(np.full(n, np.nan), np.zeros(m), np.nan, answer.bound * scale**2, answer)
    y = program.centre + program.back @ answer.values["y"]
    # in closed form at the solution y: exact zeros, while the errors in the solver's solution are only small
    errors = shrink(B @ y - g, program.member, program.price)
    rest = B @ y - g - errors
    value = 0.5 * float(rest @ rest) + float(program.price @ group_sizes(errors, program.member, len(program.price)))
    return SparseFit(y, errors, value, answer.bound * scale**2, answer)


@dataclass(frozen=True, slots=True)
class SparseProgram:
    """The data of one programme.

    Parameters
    ----------
    structure : tuple
        Arguments of `sparse_problem`.
    values : dict of str to Array
        Its parameters.
    centre, back : Array, shapes (n,) and (n, n)
        The unknowns are ``centre + back z`` with the variable z of the programme.
    scale : float
        Unit of the residuals and errors of the programme, sigmas. The cost is its square times the objective.
    member, price : int array (m,) and Array (G,)
        Group of each row, and thresholds.
    """

    structure: tuple[int, tuple[int, ...], tuple[int, ...]]
    values: dict[str, Array]
    centre: Array
    back: Array
    scale: float
    member: Groups
    price: Array


def sparse_program(
    B: Array, g: Array, groups: Groups | None = None, *, price: Array | None = None, cones: Sequence[Array] = ()
) -> SparseProgram | None:
    """Return the data of a programme; None if a number is not finite or the rows leave a direction undetermined.

    `sparse_fit` has the same arguments and raises the same error.
    """
    m, n = B.shape
    member = np.arange(m) if groups is None else np.asarray(groups)
    if g.shape != (m,) or member.shape != (m,) or any(c.shape[1] != n + 1 for c in cones):
        raise ValueError(f"rows {B.shape}, right sides {g.shape}, groups {member.shape} and cones do not fit")
    present = np.asarray((B != 0.0).any(axis=1))
    price = thresholds(np.bincount(member, weights=present).astype(np.intp)) if price is None else price
    if m < n or not (np.isfinite(B).all() and np.isfinite(g).all()):
        return None
    left, size, across = np.linalg.svd(B, full_matrices=False)
    if size[-1] <= _RANK * size[0]:
        return None
    # y = centre + back z, with the least-squares fit at the centre
    back, centre = across.T / size, (across.T / size) @ (left.T @ g)
    off = g - B @ centre
    scale = max(float(np.abs(off).max()), 1.0)
    values = {"rows": left, "right": off / scale, "price": price / scale}
    for k, given in enumerate(cones):
        light = _light_coordinates(given)
        moved = np.concatenate([light[:, :n] @ back, (light[:, :n] @ centre + light[:, n])[:, None] / scale], axis=1)
        cone = _balanced_cone(moved)
        values[f"cone {k}"] = cone / np.abs(cone).max()  # a cone may be multiplied by a factor
    structure = (n, tuple(member.tolist()), tuple(len(c) - 1 for c in cones))
    return SparseProgram(structure, values, centre, scale * back, scale, member, price)


# A cone |v| <= b with the last entry p of v: |(v_1, v_2, ..)|^2 <= (b + p)(b - p). A factor of one of these sums may go
# to the other, which keeps the cone. In metres the two rows of |x|^2 <= w, w + 1 and w - 1, would be alike.


def _light_coordinates(cone: Array) -> Array:
    """Return a cone (p + 1, n + 1) with its last two rows replaced by their sum and their difference."""
    light = cone.copy()
    if len(cone) > 1:
        light[-2], light[-1] = cone[-1] + cone[-2], cone[-1] - cone[-2]
    return light


def _balanced_cone(light: Array) -> Array:
    """Return the cone (p + 1, n + 1) of rows from `_light_coordinates`, whose sum and difference have one size."""
    cone = light.copy()
    if len(light) > 1:
        sum_, difference = (float(np.linalg.norm(row)) for row in light[-2:])
        share = power_of_two(np.sqrt(difference / sum_)) if sum_ > 0.0 and difference > 0.0 else 1.0
        first, second = share * light[-2], light[-1] / share
        cone[-2], cone[-1] = 0.5 * (first - second), 0.5 * (first + second)
    return cone


def group_sizes(values: Array, groups: Groups, count: int) -> Array:
    """Return the Euclidean length of the values of each group: the size of its gross error.

    Parameters
    ----------
    values, groups : Array and int array, shape (m,)
        A value and the number of the group of each row.
    count : int
        Number of groups G.

    Returns
    -------
    Array, shape (G,)
        The lengths; zero for an empty group.
    """
    return np.sqrt(np.bincount(groups, weights=values * values, minlength=count))


def shrink(residual: Array, groups: Groups, price: Array) -> Array:
    """Return the gross errors with the least cost at given residuals.

    Parameters
    ----------
    residual : Array, shape (m,)
        ``By - g`` in sigmas.
    groups : int array, shape (m,)
        Group of each row.
    price : Array, shape (G,)
        Thresholds.

    Returns
    -------
    Array, shape (m,)
        Residuals shrunk by the threshold of their group; exactly zero if the group is within its threshold.

    Notes
    -----
    Yuan and Lin (2006), section 2: the group form of soft thresholding.
    """
    size = group_sizes(residual, groups, len(price))
    share = np.maximum(1.0 - price / np.where(size > 0.0, size, np.inf), 0.0)
    return np.asarray(share[groups] * residual)


def range_cone(apex: Array, n: int, column: int) -> Array:
    """Return the cone ``|x - apex| <= y[column]``: a range is at least the distance.

    Parameters
    ----------
    apex : Array, shape (d,)
        Station.
    n : int
        Length of y, whose first d entries are x.
    column : int
        Entry of y that contains the range.

    Returns
    -------
    Array, shape (d + 1, n + 1)
        An element of `cones`: the convex hull of ``|x - apex| = y[column]``.
    """
    d = len(apex)
    cone = np.zeros((d + 1, n + 1))
    cone[np.arange(d), np.arange(d)], cone[:d, n], cone[d, column] = 1.0, -apex, 1.0
    return cone


def square_cone(d: int, n: int, column: int) -> Array:
    """Return the cone ``|x|^2 <= y[column]``, as ``|(2 x, y[column] - 1)| <= y[column] + 1``.

    Parameters
    ----------
    d : int
        Dimension of x.
    n : int
        Length of y, whose first d entries are x.
    column : int
        Entry of y that contains the square.

    Returns
    -------
    Array, shape (d + 2, n + 1)
        An element of `cones`: the convex hull of ``|x|^2 = y[column]``.
    """
    cone = np.zeros((d + 2, n + 1))
    cone[np.arange(d), np.arange(d)] = 2.0
    cone[d, column], cone[d, n], cone[d + 1, column], cone[d + 1, n] = 1.0, -1.0, 1.0, 1.0
    return cone
