"""The linearisation against finite differences in every unknown, and the prediction against one written row by row."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, kitchen_sink, plain_predict, random_vector, turned, wrapped

from optloc import Motion, Stations, assemble, measured, simulate
from optloc.engine import linearise, predict
from optloc.problem import Bias, Prior


def _free(d):
    sink = kitchen_sink(d)
    return replace(sink, motions=(Motion(1, span="epoch"), Motion(0, span="epoch"), sink.motions[2]))


# Every form of unknown: station errors of an epoch or the run, targets that move or are new at each epoch.
SINKS = {f"{d}d-{span}": kitchen_sink(d, span) for d in (2, 3) for span in ("epoch", "run")}
SINKS |= {f"{d}d-free": _free(d) for d in (2, 3)}
every_sink = pytest.mark.parametrize("problem", SINKS.values(), ids=SINKS.keys())


def dense_jacobian(problem, x):
    """The Jacobian (m, size) over the full vector, put together from shared and local parts."""
    linear = linearise(problem, x)
    n, length = problem.layout.n_shared, problem.layout.n_local
    out = np.zeros((problem.count, problem.layout.size))
    out[:, :n] = linear.shared
    for row, k in enumerate(linear.epoch):
        out[row, n + k * length : n + (k + 1) * length] = linear.local[row]
    return out


def numeric_jacobian(problem, x):
    """Central differences, and what rounding of the values can do to them."""
    out, doubt = np.zeros((problem.count, len(x))), np.zeros((problem.count, len(x)))
    size = np.abs(predict(problem, x)) + 1e-9
    if any(rows.kind == "height" for rows in problem.rows):
        size = size + 6.4e6
    for j in range(len(x)):
        step = 1e-5 * max(abs(x[j]), 1.0)
        high, low = np.array(x), np.array(x)
        high[j] += step
        low[j] -= step
        out[:, j] = wrapped(problem, predict(problem, high) - predict(problem, low)) / (high[j] - low[j])
        doubt[:, j] = 4.0 * np.finfo(float).eps * size / (high[j] - low[j])
    return out, doubt


@every_sink
def test_prediction_is_that_of_the_words(problem):
    x = random_vector(problem)
    assert np.abs(wrapped(problem, predict(problem, x) - plain_predict(problem, x))).max() < 1e-9


@every_sink
def test_jacobian_of_every_unknown(problem):
    x = random_vector(problem)
    exact, (numeric, doubt) = dense_jacobian(problem, x), numeric_jacobian(problem, x)
    assert (np.abs(exact).max(axis=0) > 0.0).mean() > 0.9  # the problem touches its unknowns
    assert (np.abs(exact - numeric) <= 1e-6 * np.abs(exact).max(axis=0) + doubt).all()


@pytest.mark.parametrize("name", CASES)
def test_cases_predict_and_linearise(name):
    case = CASES[name]
    assert (
        np.abs(wrapped(case.problem, predict(case.problem, case.truth) - plain_predict(case.problem, case.truth))).max()
        < 1e-8
    )
    exact, (numeric, doubt) = dense_jacobian(case.problem, case.truth), numeric_jacobian(case.problem, case.truth)
    assert (np.abs(exact - numeric) <= 1e-6 * np.abs(exact).max(axis=0) + doubt).all()


@every_sink
def test_residual_is_the_measurement_less_the_prediction_wrapped(problem):
    x = random_vector(problem)
    drawn = simulate(problem, x, 4)
    turns = np.where(wrapped(problem, np.full(problem.count, 4.0)) != 4.0, 2.0 * np.pi, 0.0)
    shifted = drawn.with_rows(z=drawn.z + 3.0 * turns)
    assert turns.any()
    other = random_vector(problem, seed=12)
    residual = linearise(shifted, other).residual
    assert np.allclose(residual, wrapped(problem, drawn.observed - plain_predict(problem, other)), atol=1e-8)


def test_a_batch_is_its_members_one_by_one():
    problem = kitchen_sink(3)
    xs = np.stack([random_vector(problem, seed) for seed in range(4)])
    drawn = simulate(problem, xs, 8)
    together = linearise(drawn, xs)
    values = predict(drawn, xs)
    for i in range(4):
        alone = linearise(problem.with_rows(z=drawn.z[i]), xs[i])
        assert np.array_equal(values[i], predict(problem, xs[i]))
        for name in ("residual", "shared", "local"):
            assert np.array_equal(getattr(together, name)[i], getattr(alone, name))


def test_one_measurement_many_points_and_many_measurements_one_point():
    case = CASES["tdoa+azimuth-3d"]
    xs = case.truth + np.random.default_rng(0).normal(0, 10.0, (5, len(case.truth)))
    assert linearise(case.problem, xs).residual.shape == (5, case.problem.count)
    many = simulate(case.problem, case.truth, 1, trials=5)
    linear = linearise(many, case.truth)
    assert linear.residual.shape == (5, case.problem.count)
    assert np.allclose(linear.residual, wrapped(case.problem, many.observed - predict(case.problem, case.truth)))


def test_every_problem_of_a_batch_has_its_own_stations_axes_and_known_target():
    rng = np.random.default_rng(4)
    place = STATIONS[3] + rng.normal(0, 500.0, (3, 1, *STATIONS[3].shape))
    count = len(STATIONS[3])
    axes = np.stack([turned(i, 3, count) for i in range(3)])
    rates = rng.normal(0, 100.0, place.shape)
    known = rng.normal(0, 4e3, (3, 1, 2, 3))
    motions = (Motion(1), Motion(1, known=known))
    names = tuple("ABCDEFG")
    rows = [
        measured("azimuth", a=[0, 1, 2, 3], sigma=0.01, target=[0, 1, 0, 1]),
        measured("fdoa", a=[4, 5], b=[0, 1], sigma=1.0, target=[0, 1]),
        measured("elevation", a=[2, 6], sigma=0.01, target=[1, 0]),
    ]
    batch = assemble(Stations(place, names, rates, axes), *rows, motions=motions)
    x = np.r_[TARGET[3], 30.0, -20.0, 5.0]
    values, linear = predict(batch, x), linearise(batch, x)
    assert values.shape == (3, 8)
    for i in range(3):
        alone = assemble(
            Stations(place[i], names, rates[i], axes[i]), *rows, motions=(Motion(1), Motion(1, known=known[i]))
        )
        assert np.allclose(values[i], plain_predict(alone, x), atol=1e-10)
        assert np.array_equal(linear.shared[i], linearise(alone, x).shared)


def test_two_biases_of_one_family_on_one_row_add_up():
    clock = Bias("clock", ("a", "b"), np.array([0, 0, 1]), np.array([0, 1, 0]), np.array([1.0, -1.0, 2.0]))
    problem = assemble(STATIONS[2], measured("range", a=[0, 1, 2], sigma=1.0), biases=(clock,))
    x = np.r_[TARGET[2], 7.0, 3.0]
    plain = np.linalg.norm(TARGET[2] - STATIONS[2][:3], axis=1)
    assert np.allclose(predict(problem, x) - plain, [4.0, 14.0, 0.0])
    assert np.allclose(dense_jacobian(problem, x)[:, 2:], [[1, -1], [2, 0], [0, 0]])


def test_problems_that_differ_in_coefficients_alone_do_not_share_links():
    def problem_of(coefficient, form, kind):
        bias = Bias("turn", ("all",), np.arange(3), np.zeros(3, int), np.full(3, coefficient), form)
        return assemble(STATIONS[2], measured(kind, a=[0, 1, 2], sigma=1.0), biases=(bias,))

    for form, kind in (("rotation", "azimuth"), ("scale", "range"), ("offset", "range"), ("drift", "range")):
        x = np.r_[TARGET[2], 0.02]
        for coefficient in (1.0, -0.5, 3.0):
            problem = problem_of(coefficient, form, kind)
            assert np.allclose(predict(problem, x), plain_predict(problem, x), atol=1e-10)


def test_a_turn_of_one_row_by_two_mounts_is_not_lost():
    """Station mounts ride on a common platform: two members turn the same row."""
    bias = Bias("turn", ("platform", "mount"), np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]), np.ones(4), "rotation")
    problem = assemble(STATIONS[2], measured("azimuth", a=[0, 1], sigma=0.01), biases=(bias,))
    x = np.r_[TARGET[2], 0.03, 0.02]
    level = predict(problem, np.r_[TARGET[2], 0.0, 0.0])
    assert np.allclose(predict(problem, x), level - 0.05, atol=2e-5)
    assert np.allclose(dense_jacobian(problem, x), numeric_jacobian(problem, x)[0], rtol=1e-6, atol=1e-9)


def test_absent_rows_may_hold_anything():
    case = CASES["range-3d"]
    weight = np.ones(case.problem.count)
    weight[2] = 0.0
    z = case.problem.z.copy()
    z[2] = np.nan
    linear = linearise(case.problem.with_rows(z=z, weight=weight), case.truth)
    assert np.isfinite(linear.residual).all()
    assert linear.residual[2] == 0.0


def test_known_corrections_come_off_the_measurement():
    plain = assemble(STATIONS[2], measured("range", [100.0, 200.0], a=[0, 1], sigma=1.0))
    corrected = assemble(STATIONS[2], measured("range", [103.0, 205.0], a=[0, 1], sigma=1.0, correction=[3.0, 5.0]))
    assert np.array_equal(linearise(plain, TARGET[2]).residual, linearise(corrected, TARGET[2]).residual)
    again = simulate(corrected, TARGET[2], 3)
    assert np.allclose(again.observed, simulate(plain, TARGET[2], 3).observed)
    assert np.allclose(again.z - again.observed, [3.0, 5.0])


def test_a_prior_does_not_change_the_prediction():
    case = CASES["range-2d"]
    with_prior = replace(case.problem, priors=(Prior("position", np.zeros(2), np.eye(2)),))
    assert np.array_equal(predict(with_prior, case.truth), predict(case.problem, case.truth))
