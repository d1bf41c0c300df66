"""Arrow-shaped normal equations against dense ones; sums, priors; the bound against a numerical Fisher matrix."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, dense_covariance, kitchen_sink, plain_predict, random_vector, wrapped
from often import few

from optloc import Motion, assemble, crlb, measured, simulate
from optloc.engine import linearise, normal
from optloc.linear.normal import covariance, decrement, marginal, step, with_priors
from optloc.problem import Bias, Prior


def equations(problem, x):
    return with_priors(problem, x, normal(linearise(problem, x), problem.epochs))


def prior_information(problem):
    """Dense prior precision and mean of stations and biases, from the words of the types."""
    layout, d = problem.layout, problem.dimension
    precision, mean = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    if problem.stations.covariance is not None:
        slot, shared = layout.find("stations")
        starts = (
            [slot.start]
            if shared
            else [layout.n_shared + k * layout.n_local + slot.start for k in range(problem.epochs)]
        )
        for start in starts:
            for i, block in enumerate(problem.stations.covariance):
                part = slice(start + i * d, start + (i + 1) * d)
                precision[part, part] = np.linalg.inv(block)
    for bias in problem.biases:
        if bias.sigma is not None:
            slot, _ = layout.find(bias.name)
            part = np.arange(slot.start, slot.start + slot.size)
            precision[part, part] = np.ravel(bias.sigma) ** -2.0
            mean[part] = np.ravel(bias.mean)
    for prior in problem.priors:
        slot, _ = layout.find(prior.name)
        part = slice(slot.start, slot.start + slot.size)
        precision[part, part] += np.linalg.inv(prior.covariance)
        mean[part] = prior.mean
    return precision, mean


def numeric_jacobian(problem, x):
    """Of the prediction written row by row in the table of cases."""
    out = np.zeros((problem.count, len(x)))
    for j in range(len(x)):
        shift = np.zeros(len(x))
        shift[j] = 1e-4 * max(abs(x[j]), 0.1)
        out[:, j] = wrapped(problem, plain_predict(problem, x + shift) - plain_predict(problem, x - shift)) / (
            2 * shift[j]
        )
    return out


def regular_sink(d, span):
    """The kitchen sink with priors wherever its few rows leave something open."""
    problem = kitchen_sink(d, span)
    biases = []
    for bias in problem.biases:
        each = (1 if d == 2 else 3) if bias.form == "rotation" else 1
        size = len(bias.members) * each
        sigma = {"offset": 30.0, "scale": 1e-3, "drift": 3.0, "rotation": 0.02}[bias.form]
        biases.append(replace(bias, mean=np.linspace(-1, 1, size) * sigma, sigma=np.full(size, sigma)))
    priors = (
        Prior("position[0]", TARGET[d], 1e6 * np.eye(d)),
        Prior("velocity[1]", np.zeros(d), 1e4 * np.eye(d)),
        Prior("acceleration[1]", np.ones(d), 4.0 * (np.eye(d) + 0.5)),
    )
    emission = tuple(
        Prior(slot.name, np.array([0.0]), np.array([[1e6]])) for slot in problem.layout.local if "emission" in slot.name
    )
    return replace(problem, biases=tuple(biases), priors=priors + emission)


def dense(problem, x):
    """Information, vector and cost of everything in one dense system; emission priors are local to each epoch."""
    local = {prior.name: prior for prior in problem.priors if prior.name.startswith("emission")}
    shared = replace(problem, priors=tuple(prior for prior in problem.priors if prior.name not in local))
    precision, mean = prior_information(shared)
    layout = problem.layout
    for name, prior in local.items():
        slot, _ = layout.find(name)
        for k in range(problem.epochs):
            at = layout.n_shared + k * layout.n_local + slot.start
            precision[at, at], mean[at] = 1.0 / prior.covariance[0, 0], prior.mean[0]
    J = numeric_jacobian(problem, x)
    weight = np.linalg.inv(dense_covariance(problem))
    residual = wrapped(problem, problem.observed - plain_predict(problem, x))
    information = J.T @ weight @ J + precision
    vector = J.T @ weight @ residual + precision @ (mean - x)
    cost = residual @ weight @ residual + (mean - x) @ precision @ (mean - x)
    return information, vector, cost


@cache
def dense_sink(d, span):
    """The kitchen sink drawn at its truth, a point beside it, and everything dense there."""
    problem = regular_sink(d, span)
    truth = random_vector(problem)
    drawn = simulate(problem, truth, 3)
    x = truth + np.random.default_rng(1).normal(0, 1e-3, len(truth)) * np.abs(truth)
    return drawn, x, dense(drawn, x)


@pytest.mark.parametrize("span", ["epoch", "run"])
@pytest.mark.parametrize("d", few([2, 3], 1))
def test_elimination_is_the_dense_inverse(d, span):
    problem, x, (information, vector, cost) = dense_sink(d, span)
    made = equations(problem, x)
    n = problem.layout.n_shared
    assert made.cost == pytest.approx(cost, rel=1e-8)
    inverse = np.linalg.inv(information)
    cov, ok = covariance(made)
    assert ok
    scale = np.sqrt(np.diag(inverse[:n, :n]))
    assert np.abs((cov - inverse[:n, :n]) / scale[:, None] / scale).max() < 1e-5
    move, ok = step(made, np.zeros(()))
    assert ok
    sigma = np.sqrt(np.diag(inverse))
    assert np.abs((move - inverse @ vector) / sigma).max() < 1e-4 * np.abs(inverse @ vector / sigma).max()
    assert decrement(made, move, n) == pytest.approx(vector @ inverse @ vector, rel=1e-5)


def test_the_cost_falls_by_the_decrement_where_the_model_is_linear():
    problem = regular_sink(2, "epoch")
    truth = random_vector(problem)
    drawn = simulate(problem, truth, 3)
    start = equations(drawn, truth)
    near = truth + step(start, np.zeros(()))[0]
    for _ in range(6):
        move, _ = step(equations(drawn, near), np.zeros(()))
        near = near + move
    end = equations(drawn, near)
    assert decrement(end, step(end, np.zeros(()))[0], problem.layout.n_shared) < 1e-16
    assert end.cost < start.cost


def only_epoch(problem, k):
    """The rows of one epoch, in a problem of that epoch alone."""
    weight = (problem.epoch == k).astype(float)
    return problem.with_rows(weight=weight)


def test_sum_over_disjoint_epochs_is_the_joint_problem():
    bias = Bias("clock", ("s0",), np.arange(18), np.zeros(18, int), np.ones(18))
    a, epoch = np.tile(np.arange(6), 3), np.repeat(np.arange(3), 6)
    joint = assemble(STATIONS[2], measured("toa", a=a, epoch=epoch, sigma=3.0), motions=(Motion(1),), biases=(bias,))
    joint = replace(joint, stations=replace(joint.stations, covariance=np.tile(4.0 * np.eye(2), (6, 1, 1))))
    x = np.zeros(joint.layout.size)
    x[:2] = TARGET[2]
    drawn = simulate(joint, x, 3)
    whole = normal(linearise(drawn, x), 3)
    total = None
    n, length = joint.layout.n_shared, joint.layout.n_local
    for k in range(3):
        inner = np.flatnonzero(epoch == k)
        part = assemble(
            joint.stations,
            measured("toa", drawn.z[inner], a=a[inner], sigma=3.0),
            motions=(Motion(1, reference=-float(k)),),
            biases=(replace(bias, row=np.arange(6), member=np.zeros(6, int), coefficient=np.ones(6)),),
        )
        own = normal(linearise(part, np.r_[x[:n], x[n + k * length : n + (k + 1) * length]]), 1)
        total = own if total is None else total + own
    for ours, theirs in zip(total.parts, whole.parts, strict=True):
        assert np.allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    assert np.allclose(marginal(with_priors(joint, x, total))[0], marginal(with_priors(joint, x, whole))[0])


def test_normal_equations_of_a_batch_are_those_of_its_members():
    problem = regular_sink(3, "epoch")
    xs = np.stack([random_vector(problem, seed) for seed in range(3)])
    drawn = simulate(problem, xs, 8)
    together = equations(drawn, xs)
    for i in range(3):
        alone = equations(problem.with_rows(z=drawn.z[i]), xs[i])
        for ours, theirs in zip(together.parts, alone.parts, strict=True):
            assert np.allclose(ours[i], theirs, rtol=1e-12, atol=1e-12)


def test_a_prior_pulls_like_a_measurement_of_the_unknown():
    case = CASES["range-2d"]
    mean, spread = TARGET[2] + [30.0, -20.0], np.array([[80.0, 30.0], [30.0, 50.0]])
    held = replace(case.problem, priors=(Prior("position", mean, spread),))
    free, tied = equations(case.problem, TARGET[2]), equations(held, TARGET[2])
    error = mean - TARGET[2]
    assert np.allclose(tied.shared - free.shared, np.linalg.inv(spread))
    assert np.allclose(tied.shared_vector - free.shared_vector, np.linalg.solve(spread, error))
    assert tied.cost - free.cost == pytest.approx(error @ np.linalg.solve(spread, error))


def test_priors_of_a_batch_are_its_own():
    case = CASES["range-2d"]
    means = TARGET[2] + np.random.default_rng(1).normal(0, 50, (3, 2))
    spreads = np.stack([np.eye(2) * s for s in (1.0, 10.0, 100.0)])
    batch = equations(replace(case.problem, priors=(Prior("position", means, spreads),)), TARGET[2])
    for i in range(3):
        alone = equations(replace(case.problem, priors=(Prior("position", means[i], spreads[i]),)), TARGET[2])
        assert np.allclose(batch.shared[i], alone.shared)
        assert np.allclose(batch.shared_vector[i], alone.shared_vector)
        assert batch.cost[i] == pytest.approx(alone.cost)


@pytest.mark.parametrize("name", CASES)
def test_crlb_is_the_inverse_of_a_numerical_fisher_matrix(name):
    case = CASES[name]
    information, _, _ = dense(case.problem, case.truth)
    n = case.problem.layout.n_shared
    inverse = np.linalg.inv(information)[:n, :n]
    scale = np.sqrt(np.diag(inverse))
    found = crlb(case.problem, case.truth)
    assert np.abs((found - inverse) / scale[:, None] / scale).max() < 1e-4


@pytest.mark.parametrize("span", ["epoch", "run"])
@pytest.mark.parametrize("d", [2, 3])
def test_crlb_with_unsure_stations_is_that_of_all_unknowns_kept(d, span):
    problem, x, (information, _, _) = dense_sink(d, span)
    n = problem.layout.n_shared
    inverse = np.linalg.inv(information)[:n, :n]
    scale = np.sqrt(np.diag(inverse))
    assert np.abs((crlb(problem, x) - inverse) / scale[:, None] / scale).max() < 1e-5


def test_crlb_of_a_batch_of_truths_and_of_a_singular_geometry():
    case = CASES["tdoa-3d"]
    truths = case.truth + np.random.default_rng(2).normal(0, 500.0, (4, 3))
    bounds = crlb(case.problem, truths)
    for i in range(4):
        assert np.allclose(bounds[i], crlb(case.problem, truths[i]), rtol=1e-12)
    line = assemble(
        np.array([[0.0, 0.0, 0.0], [1e3, 0, 0], [2e3, 0, 0], [5e3, 0, 0]]), measured("range", a=[0, 1, 2, 3], sigma=1.0)
    )
    assert np.isnan(crlb(line, TARGET[3])).all()


def test_an_epoch_that_heard_nothing_does_not_hide_the_others():
    """The emission time of an epoch without rows is nobody's business."""
    a, epoch = np.tile(np.arange(6), 2), np.repeat([0, 2], 6)
    gap = assemble(STATIONS[2], measured("toa", a=a, epoch=epoch, sigma=3.0))
    close = assemble(STATIONS[2], measured("toa", a=a, epoch=np.repeat([0, 1], 6), sigma=3.0))
    assert gap.epochs == 3
    there = np.r_[TARGET[2], np.zeros(3)]
    assert np.allclose(crlb(gap, there), crlb(close, there[:-1]), rtol=1e-12)
    move, ok = step(equations(simulate(gap, there, 1), there), np.zeros(()))
    assert ok
    assert np.isfinite(move).all()
