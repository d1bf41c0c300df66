"""Health of stations over many fixes: offset, noise and gross errors of each, compared with the other stations.

Letters: N fixes, G groups (stations, pairs or kinds), q errors and c offsets of a fix, n residuals. `Elements` are the
linearised fixes, and `Tested` are the tests of their errors and offsets.

Arguments of functions: `batch` are the problems of the fixes, one for each. `by` is the grouping: "station", "pair" or
"kind". `names` are the groups.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import SI_UNIT
from optloc.model_checks.elements import By, Elements, batch_of, elements, ends_of
from optloc.model_checks.evidence import NOTICEABLE
from optloc.model_checks.variance_components import Tested, snooped, tested
from optloc.models import MODELS
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.station_health.levels import NoiseLevels, levels_of, usable

# Residual, in sigmas, at which Huber's function becomes linear: 95 % efficient for normal errors (Holland and Welsch
# 1977).
_HUBER = 1.345
# Median of the absolute value of a standard normal variable, which converts a median to a standard deviation.
_MAD = 0.6744897501960817
# Maximum number of reweighting steps, and the change of every offset, in its sigmas, that ends them: far below any use.
_STEPS, _STILL = 60, 1e-4
# Minimum number of fixes of a station for an estimate of growth with the path. With fewer it would follow single
# errors.
_FEW = 10
# Eigenvalue of the scaled normal matrix, relative to the largest, below which a combination of offsets is undetermined.
# Second: entry of a projector below which two groups are unrelated. Both limits are rounding error.
_UNSEEN, _TIED = 1e-9, 1e-6
# Relative size below which an entry of a direction counts as zero, and relative difference below which entries are
# equal.
_PART = 1e-3
# Replaces a scale of zero in a quotient.
_TINY = 1e-300
# Number of alternations of levels and offsets. The noise only weights the offsets, so two are enough.
_ROUNDS = 2

OUTLIER = 3.0
"""Size of a test, in standard deviations, above which a measurement counts as an outlier."""


@dataclass(frozen=True, slots=True)
class Health:
    """Health of G stations (pairs, kinds) from many fixes, in SI units and radians; NaN where there is no information.

    A residual is a left-out residual: the measurement minus its prediction from the rest of its fix, without this
    station, and with the offsets of the others removed. So the fix does not absorb the error of the station. For
    compass bearings, biases and residuals are clockwise.

    Parameters
    ----------
    by : "station", "pair" or "kind"
        Grouping of the errors.
    names, units : tuple of G str
        Names of the groups, and units of their measurements.
    count : int array (G,)
        Number of fixes with the group in which other stations can check it.
    bias, bias_error : array (G,)
        Offset, estimated jointly for all stations, and its standard error.
    scale, scale_error : array (G,)
        Growth of the offset with the path length, metres per metre.
    noise, noise_error : array (G,)
        Standard deviation of the errors, corrected for the part that fixes absorb, and its standard error.
    outliers : array (G,)
        Share of its measurements that are outliers: a test of one measurement exceeds three standard deviations.
    suspect : array (G,)
        Share of its fixes in which it is a suspect; NaN if the method does not search for suspects.
    levels : NoiseLevels
        Details of the noise.
    epoch, group : int array (n,)
        Problem number in the batch, and group number, of each residual.
    residual, sigma : array (n,)
        Left-out residuals, with biases, and their standard deviations.
    outlying : bool array (n,)
        Whether each residual is an outlier.
    sentences : tuple of str
        Statements about values that the data do not determine.
    """

    by: By
    names: tuple[str, ...]
    units: tuple[str, ...]
    count: Array
    bias: Array
    bias_error: Array
    scale: Array
    scale_error: Array
    noise: Array
    noise_error: Array
    outliers: Array
    suspect: Array
    levels: NoiseLevels
    epoch: Array
    group: Array
    residual: Array
    sigma: Array
    outlying: Array
    sentences: tuple[str, ...]

    @property
    def least_noticed(self) -> Array:
        """Return the error (G,) that a search for suspects detects with probability 95 %, as the median over fixes.

        The unit is the unit of the group, see `units`.
        """
        sigmas = (self.sigma[self.group == g] for g in range(len(self.names)))
        return np.array([NOTICEABLE * np.median(sigma) for sigma in sigmas])


def health(problem: Problem, by: By = "station", *, method: str = "auto", fix: Fix | None = None) -> Health:
    """Return the health of the stations of a problem with many epochs.

    Parameters
    ----------
    problem : Problem
        Problem whose epochs, or batch, are the fixes.
    by : "station", "pair" or "kind"
        Groups with a bias and a noise level each.
    method : str
        Method of the fixes, see `solve`. A method that is robust to outliers is best.
    fix : Fix, optional
        Existing fixes of `batch_of(problem)`.

    Returns
    -------
    Health
        If the data determine biases only relative to each other, they are relative to their mean over all rows, and
        `sentences` states this.

    Raises
    ------
    InvalidProblem
        If no epoch has a fix, or no fix has redundancy.
    """
    from optloc.solvers.solution import solve

    batch = batch_of(problem)
    if fix is None and batch.layout.size:
        fix = solve(batch, method)
    return health_of(batch, usable(batch, fix), by, None if fix is None else getattr(fix, "explanations", None))


def health_of(batch: Problem, fixed: tuple[Array, Array], by: By, explained: Array | None = None) -> Health:
    """Return the health of stations from existing fixes.

    Parameters
    ----------
    batch : Problem
        Result of `batch_of`, with N problems.
    fixed : int array (n,), array (n, size)
        Result of `usable`: numbers of the problems with a fix, and their parameter vectors.
    by : "station", "pair" or "kind"
        As for `health`.
    explained : object array (N,), optional
        Explanations of all fixes, if suspects were searched for.
    """
    fixes, x = fixed
    linearised = elements(batch.take(fixes), x, by)
    _check_redundancy(linearised)
    # Gross errors are detected after noise and offsets are known. Otherwise a bias would be an outlier of every fix.
    levels, offsets = _estimate_jointly(linearised, by)
    tests = snooped(
        tested(_subtract(linearised, offsets), _variance(linearised, levels)),
        slice(linearised.effect.shape[-1], None),
        OUTLIER,
    )
    # One entry for each residual: its fix (`item`), its column among the offsets of the fix, and its group.
    item, column = np.nonzero(np.isfinite(tests.sigma) & (linearised.of_offset >= 0))
    group = linearised.of_offset[item, column]
    outlying = tests.gross[item, column]
    count = np.bincount(group, minlength=len(linearised.names))
    with_residuals = np.flatnonzero(count)
    number = np.full(len(linearised.names), -1)
    number[with_residuals] = np.arange(len(with_residuals))
    names = tuple(linearised.names[g] for g in with_residuals)
    # A group without a level (-1) selects the NaN that is appended to the levels.
    level_of = [levels.names.index(name) if name in levels.names else -1 for name in names]
    noise, noise_error = (np.append(v, np.nan)[level_of] for v in (levels.sigma, levels.sigma_error))
    return Health(
        by=by,
        names=names,
        units=_units(batch, by, names),
        count=count[with_residuals],
        bias=offsets.value[with_residuals],
        bias_error=offsets.error[with_residuals],
        scale=offsets.slope[with_residuals],
        scale_error=offsets.slope_error[with_residuals],
        noise=noise,
        noise_error=noise_error,
        outliers=np.bincount(group, outlying, len(linearised.names))[with_residuals] / count[with_residuals],
        suspect=_suspect_shares(batch, explained, by, names),
        levels=levels,
        epoch=fixes[item],
        group=number[group],
        residual=tests.shift[item, column] + offsets.value[group],
        sigma=tests.sigma[item, column],
        outlying=outlying,
        sentences=(*levels.sentences, *_sentences(offsets, linearised.names, with_residuals)),
    )


def _check_redundancy(linearised: Elements) -> None:
    """Raise InvalidProblem if no measurement of any fix can be checked by the others."""
    tests = tested(linearised, np.ones(()))
    size = np.diagonal(tests.matrix[:, tests.errors :, tests.errors :], axis1=-2, axis2=-1)
    if not ((size > 0.0) & (linearised.of_offset >= 0)).any():
        what = "no fix has redundancy, so its measurements cannot be checked"
        raise InvalidProblem(what, "health", "add stations, or known values such as a height, a bias or a prior")


def _estimate_jointly(linearised: Elements, by: By) -> tuple[NoiseLevels, Offsets]:
    """Return noise levels and offsets that are consistent: each is estimated with the other given."""
    # Offsets first, with the stated noise, because biases in the residuals would increase the estimated noise.
    offsets = offsets_of(linearised, tested(linearised, np.ones(())))
    for _ in range(_ROUNDS):
        levels = levels_of(_subtract(linearised, offsets), by, tails=False)
        offsets = offsets_of(linearised, tested(linearised, _variance(linearised, levels)))
    return levels, offsets


def _subtract(linearised: Elements, offsets: Offsets) -> Elements:
    """Return the elements with the offsets subtracted from the residuals; an offset of NaN counts as zero."""
    # The appended zero is for index -1, an unused column.
    value = np.append(np.nan_to_num(offsets.value), 0.0)[linearised.of_offset]
    return replace(linearised, residual=linearised.residual - (linearised.offset @ value[..., None])[..., 0])


def _variance(linearised: Elements, levels: NoiseLevels) -> Array:
    """Return the variance (N, q) of each error as a multiple of the stated variance; 1 for groups without a level."""
    factor = dict(zip(levels.names, levels.factor.tolist(), strict=True))
    return np.array([*(factor.get(name, 1.0) for name in linearised.names), 1.0])[linearised.of_effect] ** 2


def _units(batch: Problem, by: By, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the SI unit of the measurements of each group (G,)."""
    ends = ends_of(batch, by).name
    unit_of: dict[str, str] = {}
    for rows, start in zip(batch.rows, batch.starts, strict=True):
        unit = SI_UNIT[MODELS[rows.kind].quantity]  # type: ignore[index]  # the table has known quantities only
        unit_of |= dict.fromkeys(ends[start : start + rows.count].ravel().tolist(), unit)
    return tuple(unit_of[name] for name in names)


def _suspect_shares(batch: Problem, explained: Array | None, by: By, names: tuple[str, ...]) -> Array:
    """Return, for each group (G,), the share of its fixes in which it, or one of its rows, is a suspect.

    The result is NaN if `explained`, the explanations of the fixes, is None.
    """
    if explained is None:
        return np.full(len(names), np.nan)
    ends = ends_of(batch, by).name
    total, suspected = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    weight = np.broadcast_to(batch.weight, (len(np.ravel(explained)), batch.count))
    for explanations, present in zip(np.ravel(explained), weight > 0.0, strict=True):
        for name in {*ends[present].ravel().tolist()} & total.keys():
            total[name] += 1
        # The first explanation is the best, and the fix uses it.
        suspects = explanations[0].suspects if explanations else ()
        for name in {
            n for s in suspects for n in _suspect_groups(s.name, s.group, ends[list(s.rows)], by)
        } & suspected.keys():
            suspected[name] += 1
    return np.array([suspected[name] / max(total[name], 1) for name in names])


def _suspect_groups(name: str, group: str, ends: Array, by: By) -> set[str]:
    """Return the groups of a suspect: the groups of its rows or, for a station, the groups with its name.

    `name` and `group` are fields of the `Suspect`. `ends` are the names of the groups of its rows.
    """
    groups = {*ends.ravel().tolist()} - {""}
    if group != "station" or by != "station":
        return groups
    # A station with several kinds of measurements has one group for each kind.
    station = name.removeprefix("station ")
    return {n for n in groups if n == station or n.startswith(f"{station} ")}


def _sentences(offsets: Offsets, names: tuple[str, ...], with_residuals: Array) -> tuple[str, ...]:
    """Return one sentence for each combination of offsets that the data do not determine.

    `names` are the names of all groups. `with_residuals` (g,) are the numbers of the groups with residuals.
    """
    sentences = []
    # Groups with a share above `_PART` in an undetermined combination are named. Equal shares are a common bias.
    for direction in offsets.open:
        involved = np.abs(direction[with_residuals]) > _PART * np.abs(direction).max()
        involved_names = [names[g] for g in with_residuals[involved]]
        listed = ", ".join(involved_names[:6]) + (
            f" and {len(involved_names) - 6} more" if len(involved_names) > 6 else ""
        )
        if not involved_names:  # the combination involves only groups without used rows
            continue
        if len(involved_names) == 1:
            sentences.append(f"the data do not show a bias of {listed}")
        elif np.ptp(direction[with_residuals][involved]) < _PART * np.abs(direction).max():
            sentences.append(
                f"biases of {listed} are relative to their mean over all rows: a common bias cannot be seen"
            )
        else:
            sentences.append(
                f"the data do not show every combination of the biases of {listed}: the others are set to zero"
            )
    return tuple(dict.fromkeys(sentences))


# Robust estimation of offsets that many fixes share, from the left-out residuals of each station.


@dataclass(frozen=True, slots=True)
class Offsets:
    """Offsets of G groups, and their growth with the length of the path.

    Parameters
    ----------
    value, error : array (G,)
        Offset and its standard error, SI units; NaN for groups without rows.
    slope, slope_error : array (G,)
        Growth in metres per metre and its standard error; NaN if the data do not determine it.
    open : array (r, G)
        Unit vectors of the combinations of offsets that the data do not determine. Along them the offsets are zero.
    """

    value: Array
    error: Array
    slope: Array
    slope_error: Array
    open: Array


def offsets_of(linearised: Elements, tests: Tested) -> Offsets:
    """Return the offsets that many problems share.

    The test of group g in one problem is w_g = (t_g - sum_h T_gh b_h) / sqrt(T_gg): its left-out residual with the
    offsets of the others removed. T and t are the matrix and the vector of `Tested`, and b_h is the offset of group h.
    At the true offsets b of all groups it is standard normal.

    The b minimise the sum of Huber's function of all w, which is convex, by iteratively reweighted least squares.
    Combinations that do not change any w are zero on average over the rows, for instance a common delay if emission
    times are unknown. Standard errors are the larger of two: of the sandwich form with the problems as clusters, and of
    normal tests.

    Parameters
    ----------
    linearised : Elements
        N linearised problems.
    tests : Tested
        Tests of these problems.

    References
    ----------
    P. J. Huber, "Robust Statistics" (1981), sections 7.3 to 7.6.
    """
    count, q = len(linearised.names), tests.errors
    matrix, vector = tests.matrix[:, q:, q:], tests.vector[:, q:]
    size = np.diagonal(matrix, axis1=-2, axis2=-1)
    item, column = np.nonzero((size > 0.0) & (linearised.of_offset >= 0))
    scale = np.sqrt(size[item, column])
    # One equation of unit variance for every valid test, in terms of the offsets of its group and of the other groups.
    # `item` is the problem of each test, `column` its column in this problem, and `group` its group.
    y = vector[item, column] / scale
    other = linearised.of_offset[item]
    design = _sparse(matrix[item, column] / scale[:, None], other, count)
    group = linearised.of_offset[item, column]
    number = np.bincount(group, minlength=count).astype(float)
    value, error, undetermined = _regress(design, y, item, number)
    path_from_mean, spread = _centre(linearised, group, item, column, count)
    has_growth = np.isfinite(spread) & (spread > 0.0) & (number >= _FEW)
    slope, slope_error = np.full(count, np.nan), np.full(count, np.nan)
    if has_growth.any():
        # Growth in units of the spread of the paths, so that the columns of offsets and growth have similar size.
        units = np.where(has_growth, spread, 1.0)
        growth_columns = (
            matrix[item, column] / scale[:, None] * np.nan_to_num(path_from_mean[item] / np.append(units, 1.0)[other])
        )
        both_columns = sparse.hstack([design, _sparse(growth_columns, other, count)]).tocsr()
        both, errors, _ = _regress(both_columns, y, item, np.tile(number, 2))
        slope, slope_error = (np.where(has_growth, v[count:] / units, np.nan) for v in (both, errors))
    has_rows = number > 0.0
    return Offsets(
        np.where(has_rows, value, np.nan), np.where(has_rows, error, np.nan), slope, slope_error, undetermined
    )


def _sparse(values: Array, column: Array, count: int) -> sparse.csr_array:
    """Return a sparse matrix (n, count) with values (n, c) at columns (n, c); column -1 means no entry.

    The argument `column` (n, c) gives the columns; equal columns of a row add up.
    """
    kept = (column >= 0) & (values != 0.0)
    row = np.broadcast_to(np.arange(len(column))[:, None], column.shape)
    return sparse.csr_array((values[kept], (row[kept], column[kept])), shape=(len(column), count))


def _centre(linearised: Elements, group: Array, item: Array, column: Array, count: int) -> tuple[Array, Array]:
    """Return the paths (N, c) minus their mean over each group, and the standard deviation (G,) of each, metres.

    `group`, `item` and `column` (n,) are the group, the problem and the column of each valid offset. `count` is the
    number of groups G.
    """
    path = linearised.path[item, column]
    number = np.maximum(np.bincount(group, minlength=count), 1)
    mean = np.bincount(group, path, count) / number
    spread = np.sqrt(np.bincount(group, (path - mean[group]) ** 2, count) / number)
    return linearised.path - np.append(mean, 0.0)[linearised.of_offset], spread


def _regress(design: sparse.csr_array, y: Array, item: Array, number: Array) -> tuple[Array, Array, Array]:
    """Return coefficients (p,) of Huber's regression, their standard errors (p,), and undetermined combinations (r, p).

    `design` (n, p) and `y` (n,) are equations of unit variance. `item` (n,) is the problem of each equation, because
    the equations of a problem are correlated. `number` (p,) is the number of rows of the group of each coefficient.
    """
    value = np.zeros(design.shape[1])
    for _ in range(_STEPS):
        residual = y - design @ value
        # Every step estimates the scale from the median, so gross errors do not increase it.
        bound = _HUBER * max(float(np.median(np.abs(residual))) / _MAD, 1e-12)
        weight = bound / np.maximum(np.abs(residual), bound)
        inverse, undetermined = _pseudo_inverse((design.T @ (design * weight[:, None])), number)
        step = inverse @ (design.T @ (weight * residual))
        value = value + step
        if np.abs(step / np.sqrt(np.maximum(np.diagonal(inverse), _TINY))).max() < _STILL:
            break
    # Sandwich form: the bread from rows within the bound, the filling from the total score of each problem, because the
    # tests of a problem are correlated.
    residual = y - design @ value
    inside = (np.abs(residual) <= bound).astype(float)
    bread, undetermined = _pseudo_inverse(design.T @ (design * inside[:, None]), number)
    scores = design * np.clip(residual, -bound, bound)[:, None]
    scores_of_problem = sparse.csr_array((np.ones(len(item)), (item, np.arange(len(item))))) @ scores
    covariance = bread @ (scores_of_problem.T @ scores_of_problem).toarray() @ bread
    stated = (bound / _HUBER) ** 2 * np.diagonal(bread)
    error = np.sqrt(np.maximum(np.diagonal(covariance), stated))
    return value, np.where(np.diagonal(bread) > 0.0, error, np.nan), undetermined


def _pseudo_inverse(matrix: sparse.csr_array, number: Array) -> tuple[Array, Array]:
    """Return the pseudo-inverse (p, p) with the least mean square over rows, and the undetermined combinations (r, p).

    `matrix` (p, p) is a normal matrix. `number` (p,) is the number of rows of each coefficient.
    """
    # With this scaling the shortest solution has the least mean square over rows.
    weigh = 1.0 / np.sqrt(np.maximum(number, 1.0))
    scaled = matrix.toarray() * weigh[:, None] * weigh
    values, vectors = np.linalg.eigh(scaled)
    determined = values > _UNSEEN * max(float(values[-1]), _TINY)
    scaled_vectors = weigh[:, None] * vectors
    return (scaled_vectors[:, determined] / values[determined]) @ scaled_vectors[:, determined].T, _split_by_groups(
        vectors[:, ~determined], weigh, number > 0.0
    )


def _split_by_groups(basis: Array, weigh: Array, has_rows: Array) -> Array:
    """Return unit vectors (r, p) that span an undetermined space (p, r), with few groups in each vector.

    `basis` (p, r) has orthonormal columns, in scaled coefficients. `weigh` (p,) is the scale of each coefficient, and
    `has_rows` (p,) marks coefficients with rows.
    """
    # Every basis of the space is valid. Groups that the space does not connect get separate vectors.
    projector = basis @ basis.T * np.outer(has_rows, has_rows)
    count, label = connected_components(np.abs(projector) > _TIED, directed=False)
    vectors_by_group = []
    # Restricted to connected groups, the projector has eigenvalue one on the undetermined combinations of these groups.
    for part in range(count):
        inside = np.where(label == part, projector, 0.0) * (label == part)[:, None]
        values, vectors = np.linalg.eigh(inside)
        vectors_by_group += [weigh * vector for vector in vectors[:, values > 0.5].T]
    return np.array([vector / np.linalg.norm(vector) for vector in vectors_by_group]).reshape(-1, len(weigh))
