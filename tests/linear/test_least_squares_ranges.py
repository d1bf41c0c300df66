"""Rows linear in ranges against their sufficient statistic: the same fix and covariance, the cost less the loops'."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, RATE, STATIONS, TARGET, dense_covariance, kitchen_sink, stations

from optloc import InvalidProblem, Motion, Status, assemble, measured, simulate, solve
from optloc.engine import linearise, normal, reduce
from optloc.linear.normal import covariance, step
from optloc.problem import Bias, Prior

PAIRS = {d: np.triu_indices(len(STATIONS[d]), 1) for d in (2, 3)}


def ring(d):
    a = np.arange(len(STATIONS[d]))
    return assemble(STATIONS[d], measured("tdoa", a=a, b=np.roll(a, -1), sigma=np.linspace(2, 5, len(a))))


def all_pairs(d):
    a, b = PAIRS[d]
    return assemble(STATIONS[d], measured("tdoa", a=a, b=b, sigma=np.linspace(2, 5, len(a))))


def arrivals(d):
    """All pairs of the same arrivals: a singular covariance, loops that close exactly."""
    a, b = PAIRS[d]
    return assemble(STATIONS[d], measured("tdoa", a=a, b=b, arrival_sigma=np.linspace(2, 5, len(STATIONS[d]))))


def tree(d):
    a = np.arange(1, len(STATIONS[d]))
    return assemble(STATIONS[d], measured("tdoa", a=a, b=a - 1, sigma=3.0))


def toa(d):
    a = np.r_[np.arange(len(STATIONS[d])), 0, 2]
    return assemble(STATIONS[d], measured("toa", a=a, sigma=np.linspace(2, 5, len(a))))


def odd_sums(d):
    """Sums around a triangle fix the ranges themselves."""
    a = np.arange(len(STATIONS[d]))
    return assemble(STATIONS[d], measured("range_sum", a=np.r_[a, 0], b=np.r_[np.roll(a, -1), 2], sigma=3.0))


def even_sums(d):
    """Sums between two halves leave r - t, s + t: one unknown, with both signs."""
    left, right = np.meshgrid([0, 1, 2], np.arange(3, len(STATIONS[d])))
    return assemble(STATIONS[d], measured("range_sum", a=left.ravel(), b=right.ravel(), sigma=3.0))


def sums_and_differences(d):
    a = np.arange(1, len(STATIONS[d]))
    return assemble(
        STATIONS[d], measured("range_sum", a=a, b=0, sigma=3.0), measured("tdoa", a=a, b=np.roll(a, -1), sigma=2.0)
    )


def ranged(d):
    a, b = PAIRS[d]
    return assemble(STATIONS[d], measured("tdoa", a=a, b=b, sigma=2.0), measured("range", a=[0, 3, 3], sigma=4.0))


def everything(d):
    """Differences, arrival times, sums: correlated across kinds."""
    a, b = PAIRS[d]
    rows = [measured("tdoa", a=a, b=b, sigma=1.0), measured("toa", a=[0, 1, 2], sigma=1.0)]
    rows += [measured("range_sum", a=[1, 2], b=[3, 4], sigma=1.0)]
    count = len(a) + 5
    root = np.random.default_rng(d).standard_normal((count, count))
    return assemble(STATIONS[d], *rows, covariance=root @ root.T + 4.0 * np.eye(count))


def with_angles(d):
    a, b = PAIRS[d]
    return assemble(
        STATIONS[d],
        measured("tdoa", a=a, b=b, sigma=3.0),
        measured("azimuth", a=[0, 2], sigma=0.003),
        measured("groa", a=[1], b=[2], sigma=0.01),
    )


def angles_first(d):
    a, b = PAIRS[d]
    correlated = np.array([[1.0, 0.5], [0.5, 1.0]]) * 1e-5
    return assemble(
        STATIONS[d], measured("azimuth", a=[0, 2], covariance=correlated), measured("tdoa", a=a, b=b, arrival_sigma=3.0)
    )


SHAPES = [ring, all_pairs, arrivals, tree, toa, odd_sums, even_sums, sums_and_differences, ranged, everything]
SHAPES += [with_angles, angles_first]
FREE = {
    "ring",
    "all_pairs",
    "arrivals",
    "tree",
    "toa",
    "even_sums",
    "sums_and_differences",
    "with_angles",
    "angles_first",
}


def start(problem):
    return np.r_[TARGET[problem.dimension], [-1234.0] * (problem.layout.size - problem.dimension)]


def polish(problem, x):
    """Gauss-Newton to the last digit from a near point."""
    for _ in range(8):
        x = x + step(normal(linearise(problem, x), problem.epochs), np.zeros(()))[0]
    made = normal(linearise(problem, x), problem.epochs)
    return x, covariance(made)[0], float(made.cost)


def loop_chi_square(problem):
    """Weighted misfit of the range rows among themselves: dense least squares over ranges and emission times."""
    from optloc.models import MODELS

    rows, total = [], 0
    for block, first in zip(problem.rows, problem.starts, strict=True):
        if MODELS[block.kind].ranges is None:
            continue
        for i in range(block.count):
            line = np.zeros(problem.stations.count + 1)
            for station, coefficient in zip((block.a[i], block.b[i]), MODELS[block.kind].ranges, strict=True):
                if coefficient:
                    line[station] += coefficient
            line[-1] = float(MODELS[block.kind].emission)
            rows.append((first + i, line))
    index, D = np.array([r for r, _ in rows]), np.array([line for _, line in rows])
    full = dense_covariance(problem)[np.ix_(index, index)]
    values, vectors = np.linalg.eigh(full)
    keep = values > 1e-9 * values[-1]
    W = (vectors[:, keep] / np.sqrt(values[keep])).T
    z = problem.z[index]
    best, *_ = np.linalg.lstsq(W @ D, W @ z, rcond=1e-10)
    total = W @ (z - D @ best)
    return float(total @ total)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("build", SHAPES)
def test_reduced_rows_give_the_same_fix_covariance_and_cost(build, d):
    problem = build(d)
    drawn = simulate(problem, start(problem), 11)
    reduced = reduce(drawn)
    assert reduced.batch_shape == ()
    x, cov, cost = polish(drawn, start(drawn))
    y, other, rest = polish(reduced, start(reduced))
    scale = np.abs(STATIONS[d]).max()
    assert np.abs(x[:d] - y[:d]).max() < 1e-9 * scale
    assert np.abs(cov[:d, :d] - other[:d, :d]).max() < 1e-9 * np.abs(cov).max()
    assert cost - rest == pytest.approx(loop_chi_square(drawn), rel=1e-6, abs=1e-6)
    assert np.linalg.matrix_rank(dense_covariance(reduced)) == reduced.count
    assert reduced.count <= drawn.count


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("build", SHAPES)
def test_solve_finds_the_same_fix_either_way(build, d):
    problem = build(d)
    drawn = simulate(problem, start(problem), 12)
    raw, less = solve(drawn), solve(reduce(drawn))
    assert raw.status == less.status == Status.OK
    assert np.abs(raw.position - less.position).max() < 1e-4
    assert np.allclose(raw.covariance(), less.covariance(), rtol=1e-6, atol=1e-9)
    loops = raw.dof - less.dof
    assert loops >= 0
    assert float(raw.cost - less.cost) == pytest.approx(loop_chi_square(drawn), rel=1e-5, abs=1e-5)


def test_forty_differences_become_seven():
    """The sentence of DESIGN section 3: a ring and chords over eight stations."""
    rng = np.random.default_rng(1)
    place = rng.uniform(-10.0, 10.0, (8, 3))
    a = np.tile(np.arange(8), 5)
    b = (a + np.repeat(np.arange(1, 6), 8)) % 8
    problem = simulate(assemble(place, measured("tdoa", a=a, b=b, sigma=0.1)), np.array([1.0, 2.0, 3.0]), 1)
    reduced = reduce(problem)
    assert (problem.count, reduced.count) == (40, 7)
    assert {rows.kind for rows in reduced.rows} == {"tdoa"}
    assert len(set(np.concatenate([rows.b for rows in reduced.rows]))) == 1


@pytest.mark.parametrize("build", SHAPES)
def test_kinds_of_the_reduced_rows(build):
    problem = build(2)
    kinds = {rows.kind for rows in reduce(simulate(problem, start(problem), 1)).rows}
    linear = kinds - {"azimuth", "groa"}
    if build.__name__ in FREE:
        assert linear in ({"tdoa"}, {"range_sum"}, {"tdoa", "range_sum"})
    else:
        assert linear == {"range"}


def test_batches_are_reduced_as_one():
    problem = ring(3)
    many = simulate(problem, np.tile(TARGET[3], (2, 1)), 3, trials=4)
    reduced = reduce(many)
    assert reduced.batch_shape == (4, 2)
    single = reduce(problem.with_rows(z=many.z[3, 1]))
    assert np.allclose(reduced.z[3, 1], single.z, rtol=1e-12)
    assert np.allclose(solve(reduced).x, solve(many).x, atol=1e-5)


def test_weights_and_own_stations_of_a_batch():
    problem = all_pairs(2)
    weight = np.random.default_rng(2).uniform(0.2, 1.0, (3, problem.count))
    many = simulate(problem, TARGET[2], 3, trials=3).with_rows(weight=weight)
    assert np.allclose(solve(reduce(many)).cov, solve(many).cov, rtol=1e-7)


@pytest.mark.parametrize("extra", [False, True])
def test_absent_rows_are_no_links(extra):
    problem = simulate(ring(2), TARGET[2], 3)
    weight = np.ones(6)
    weight[2] = 0.0
    reduced = reduce(problem.with_rows(weight=weight))
    assert reduced.count == 5
    weight[5] = 0.0
    with pytest.raises(InvalidProblem, match="one connected set"):
        reduce(problem.with_rows(weight=weight))


def test_station_errors_stay_what_they_were():
    spread = np.tile(25.0 * np.eye(2), (6, 1, 1))
    problem = replace(ring(2), stations=stations(2, covariance=spread))
    drawn = simulate(problem, np.r_[TARGET[2], np.zeros(12)], 2)
    raw, less = solve(drawn), solve(reduce(drawn))
    assert np.allclose(raw.position, less.position, atol=1e-5)
    assert np.allclose(raw.covariance(), less.covariance(), rtol=1e-7)


def test_nothing_to_reduce_is_left_alone():
    problem = CASES["azimuth-2d"].problem
    assert reduce(problem) is problem


def test_priors_on_the_position_stay():
    held = replace(simulate(ring(2), TARGET[2], 2), priors=(Prior("position", TARGET[2] + 20.0, 9.0 * np.eye(2)),))
    assert np.allclose(solve(reduce(held)).position, solve(held).position, atol=1e-5)


# ----------------------------------------------------------------------------- what must be refused, not reduced
def test_a_moving_target_has_other_ranges_at_each_epoch():
    a, epoch = np.tile(np.arange(6), 4), np.repeat(np.arange(4), 6)
    problem = assemble(STATIONS[2], measured("tdoa", a=a, b=(a + 1) % 6, epoch=epoch, sigma=3.0), motions=(Motion(1),))
    drawn = simulate(problem, np.r_[TARGET[2], RATE[2]], 3)
    x, cov, _ = polish(drawn, np.r_[TARGET[2], RATE[2]])
    try:
        reduced = reduce(drawn)
    except InvalidProblem:
        return
    y, other, _ = polish(reduced, np.r_[TARGET[2], RATE[2]])
    assert np.allclose(x, y, atol=1e-4)
    assert np.allclose(cov, other, rtol=1e-6)


def test_ranges_of_two_targets_are_not_one():
    a = np.tile(np.arange(6), 2)
    problem = assemble(
        STATIONS[2],
        measured("range", a=a, target=np.repeat([0, 1], 6), sigma=3.0),
        motions=(Motion(0), Motion(0)),
    )
    truth = np.r_[TARGET[2], TARGET[2] + 2e3]
    drawn = simulate(problem, truth, 3)
    with pytest.raises(InvalidProblem, match="target"):
        reduce(drawn)


def test_biased_rows_are_not_reduced():
    bias = Bias("clock", ("one",), np.array([0]), np.array([0]), np.array([1.0]))
    with pytest.raises(InvalidProblem, match="bias"):
        reduce(replace(simulate(ring(2), TARGET[2], 1), biases=(bias,)))
    sink = kitchen_sink(2)
    with pytest.raises(InvalidProblem):
        reduce(simulate(sink, np.zeros(sink.layout.size), 1))


def test_correlation_across_kinds_is_named():
    problem = CASES["tdoa~groa-2d"].problem
    with pytest.raises(InvalidProblem, match="correlated with other kinds"):
        reduce(problem)
