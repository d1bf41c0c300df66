"""Noise as blocks: weights that fade rows out, correlation across kinds, and arrival times seen through differences."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, dense_covariance, kitchen_sink

from optloc import assemble, measured, simulate, solve
from optloc.engine import normal
from optloc.linear.normal import linearise
from optloc.linear.simulate import draw
from optloc.problem import noise as noises
from optloc.problem.noise import Block, Noise


def weighed(noise, weight):
    """W'W of all rows as one matrix."""
    count = weight.shape[-1]
    out = np.zeros((count, count))
    for w in noises.whiten(noise, weight):
        white = w.apply(np.eye(count))
        out += white.T @ white
    return out


def random_noise(rng, count, kept=None):
    root = rng.standard_normal((count, count))
    return root @ root.T + 0.3 * np.eye(count)


def test_weight_zero_is_absence_and_weight_w_inflates_the_own_variance():
    rng = np.random.default_rng(1)
    full = random_noise(rng, 7)
    noise = Noise((Block(np.arange(7)[None], full[None]),))
    weight = np.array([1.0, 0.0, 0.25, 1.0, 0.0, 0.9, 1.0])
    present = np.flatnonzero(weight)
    part = full[np.ix_(present, present)]
    part = part + np.diag(np.diag(part) * (1.0 / weight[present] - 1.0))
    expected = np.zeros((7, 7))
    expected[np.ix_(present, present)] = np.linalg.inv(part)
    assert np.allclose(weighed(noise, weight), expected, rtol=1e-10, atol=1e-12)


def test_independent_rows_count_by_their_weight():
    noise = noises.independent(np.array([4.0, 9.0, 1.0]))
    assert np.allclose(weighed(noise, np.array([1.0, 0.5, 0.0])), np.diag([0.25, 0.5 / 9.0, 0.0]))


def test_fading_a_row_out_is_continuous():
    full = random_noise(np.random.default_rng(2), 5)
    noise = Noise((Block(np.arange(5)[None], full[None]),))
    weight = np.ones(5)
    weight[2] = 0.0
    limit = weighed(noise, weight)
    weight[2] = 1e-12
    assert np.allclose(weighed(noise, weight), limit, atol=1e-9)


@pytest.mark.parametrize("name", ["tdoa-2d", "tdoa-3d", "tdoa~groa-3d", "range-2d", "toa-3d"])
def test_weight_zero_gives_the_fix_of_the_problem_without_the_row(name):
    problem = CASES[name].problem
    gone = [1, problem.count - 1]
    weight = np.ones(problem.count)
    weight[gone] = 0.0
    z = problem.z.copy()
    z[gone] = [np.nan, 1e9]
    faded = solve(problem.with_rows(z=z, weight=weight))
    keep = np.setdiff1d(np.arange(problem.count), gone)
    rows = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        inner = keep[(keep >= start) & (keep < start + block.count)] - start
        names = ("z", "a", "b", "epoch", "target", "weight", "correction")
        rows.append(replace(block, **{field: getattr(block, field)[inner] for field in names}))
    full = dense_covariance(problem)[np.ix_(keep, keep)]
    without = replace(problem, rows=tuple(rows), noise=Noise((Block(np.arange(len(keep))[None], full[None]),)))
    fix = solve(without)
    assert faded.status == fix.status
    assert np.allclose(faded.x, fix.x, rtol=1e-10, atol=1e-7)
    assert np.allclose(faded.cov, fix.cov, rtol=1e-8, atol=1e-14)
    assert faded.cost == pytest.approx(fix.cost, rel=1e-8)
    assert faded.dof == fix.dof


def test_a_batch_may_lack_different_rows():
    problem = CASES["tdoa-3d"].problem
    weight = np.ones((4, problem.count))
    weight[1, 0], weight[2, [2, 3]], weight[3, 5] = 0.0, 0.0, 0.5
    fix = solve(problem.with_rows(weight=weight))
    for i in range(4):
        alone = solve(problem.with_rows(weight=weight[i]))
        assert np.allclose(fix.x[i], alone.x, rtol=1e-12, atol=1e-8)
        assert np.allclose(fix.cov[i], alone.cov, rtol=1e-9)
        assert fix.dof[i] == alone.dof


def test_arrival_sigma_is_the_covariance_of_differences():
    sigma = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    a, b = np.array([1, 2, 3, 4]), np.array([0, 0, 0, 5])
    problem = assemble(STATIONS[2], measured("tdoa", a=a, b=b, arrival_sigma=sigma))
    expected = np.diag(sigma[a] ** 2) + np.array([[1.0 if p == q else 0.0 for p in b] for q in b]) * sigma[b] ** 2
    assert np.allclose(dense_covariance(problem), expected)
    sums = assemble(STATIONS[2], measured("range_sum", a=[1, 2], b=[0, 1], arrival_sigma=sigma))
    assert np.allclose(dense_covariance(sums), [[5.0, 4.0], [4.0, 13.0]])


def test_arrivals_of_other_epochs_and_targets_are_independent():
    problem = assemble(
        STATIONS[2],
        measured("tdoa", a=[1, 2, 1, 1], b=[0, 0, 0, 0], epoch=[0, 0, 1, 0], target=[0, 0, 0, 1], arrival_sigma=1.0),
        motions=(CASES["tdoa-2d"].problem.motions[0],) * 2,
    )
    expected = 2.0 * np.eye(4)
    expected[0, 1] = expected[1, 0] = 1.0
    assert np.allclose(dense_covariance(problem), expected)


def test_dense_and_variances_read_the_blocks():
    problem = kitchen_sink(3)
    full = dense_covariance(problem)
    rows = np.array([40, 3, 17, 60])
    assert np.allclose(noises.dense(problem.noise, rows), full[np.ix_(rows, rows)])
    assert np.allclose(noises.variances(problem.noise, problem.count), np.diag(full))
    mixed = CASES["tdoa~groa-3d"].problem
    rows = np.array([8, 0, 5])
    assert np.allclose(noises.dense(mixed.noise, rows), dense_covariance(mixed)[np.ix_(rows, rows)])


def test_a_batch_of_grouped_noise_whitens_values_that_all_share():
    rng = np.random.default_rng(4)
    covariance = np.stack([np.stack([random_noise(rng, 2) for _ in range(3)]) for _ in range(5)])
    noise = Noise((Block(np.arange(6).reshape(3, 2), covariance),))
    (white,) = noises.whiten(noise, np.ones(6))
    values = rng.standard_normal((6, 4))
    together = white.apply(values)
    assert together.shape == (5, 6, 4)
    for i in range(5):
        (own,) = noises.whiten(Noise((Block(noise.blocks[0].row, covariance[i]),)), np.ones(6))
        assert np.array_equal(together[i], own.apply(values))


def test_grouping_blocks_changes_nothing():
    rng = np.random.default_rng(3)
    blocks = [Block(np.array([[2 * i, 2 * i + 1]]), random_noise(rng, 2)[None]) for i in range(4)]
    weight = np.array([1.0, 1.0, 0.0, 1.0, 0.3, 1.0, 1.0, 1.0])
    apart, together = Noise(tuple(blocks)), noises.group(blocks)
    assert len(together.blocks) == 1
    assert np.allclose(weighed(apart, weight), weighed(together, weight), rtol=1e-14)


@pytest.mark.parametrize("name", ["tdoa-3d", "tdoa~groa-2d", "range-3d"])
def test_simulated_noise_has_the_covariance_of_the_rows(name):
    problem = CASES[name].problem
    full = dense_covariance(problem)
    sample = draw(problem.noise, problem.count, (20000,), np.random.default_rng(6))
    unit = np.sqrt(np.diag(full))
    assert np.abs(np.cov(sample.T) - full).max() <= 0.06 * (unit[:, None] * unit).max()
    assert np.abs((np.cov(sample.T) - full) / unit[:, None] / unit).max() < 0.06
    assert np.abs(sample.mean(0) / unit).max() < 0.04


def test_a_seed_decides_the_draw():
    case = CASES["tdoa-2d"]
    first, again, other = (simulate(case.problem, case.truth, seed, trials=3).z for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.isclose(first, other).any()
    assert len(np.unique(first)) == first.size


def ring(count):
    return np.arange(count), np.roll(np.arange(count), -1)


@pytest.mark.parametrize("absent", [None, 2])
def test_redundant_differences_count_as_their_rank(absent):
    """All pairs of six arrivals, R singular: five rows' worth of information, chi-square and degrees of freedom."""
    a, b = np.triu_indices(6, 1)
    problem = assemble(STATIONS[2], measured("tdoa", a=a, b=b, arrival_sigma=3.0))
    drawn = simulate(problem, TARGET[2], 5)
    if absent is not None:
        weight = np.ones(problem.count)
        weight[absent] = 0.0
        drawn = drawn.with_rows(weight=weight)
    fix = solve(drawn)
    star = assemble(STATIONS[2], measured("tdoa", drawn.z[b == 5] * 1.0, a=a[b == 5], b=b[b == 5], arrival_sigma=3.0))
    reference = solve(star)
    assert np.allclose(fix.x, reference.x, atol=1e-6)
    assert np.allclose(fix.cov, reference.cov, rtol=1e-7)
    assert fix.cost == pytest.approx(reference.cost, rel=1e-6)
    assert fix.dof == reference.dof == 3


@pytest.mark.parametrize("absent", [0, 1, 2, 5])
def test_degrees_of_freedom_of_a_singular_covariance_with_rows_missing(absent):
    a, b = np.triu_indices(4, 1)
    problem = assemble(STATIONS[2][:4], measured("tdoa", a=a, b=b, arrival_sigma=3.0))
    weight = np.ones(6)
    weight[absent] = 0.0
    fix = solve(simulate(problem, TARGET[2], 1).with_rows(weight=weight))
    assert fix.dof == 1


def test_station_errors_at_one_point_weigh_like_noise():
    """Eliminating station offsets with prior covariance Qs is the weighting R = Q + G Qs G'."""
    rng = np.random.default_rng(7)
    for d in (2, 3):
        a, b = np.arange(1, len(STATIONS[d])), np.zeros(len(STATIONS[d]) - 1, dtype=int)
        spread = np.stack([random_noise(rng, d) * 9.0 for _ in STATIONS[d]])
        sure = assemble(STATIONS[d], measured("tdoa", a=a, b=b, arrival_sigma=4.0))
        drawn = simulate(sure, TARGET[d], 2)
        unsure = replace(drawn, stations=replace(drawn.stations, covariance=spread))
        x = np.zeros(unsure.layout.size)
        x[:d] = TARGET[d] + 3.0
        linear = linearise(unsure, x)
        joint = normal_of(unsure, x)
        G = linear.local
        Qs = np.zeros((G.shape[1], G.shape[1]))
        for i, block in enumerate(spread):
            Qs[i * d : (i + 1) * d, i * d : (i + 1) * d] = block
        R = dense_covariance(sure) + G @ Qs @ G.T
        H, e = linear.shared, linear.residual
        from optloc.linear.normal import marginal

        information, vector, ok = marginal(joint)
        assert ok
        assert np.allclose(information, H.T @ np.linalg.solve(R, H), rtol=1e-10)
        assert np.allclose(vector, H.T @ np.linalg.solve(R, e), rtol=1e-9)


def normal_of(problem, x):
    from optloc.linear.normal import with_priors

    return with_priors(problem, x, normal(linearise(problem, x), problem.epochs))
