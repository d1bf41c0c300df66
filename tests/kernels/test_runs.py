"""Runs with epochs in lanes: sums, answers and covariances against numpy, and which runs they serve."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from runs import drawn, estimated, run, truth

from optloc import Motion, Status, assemble, measured, solve, with_bias
from optloc.base import linalg
from optloc.kernels.jit import enabled
from optloc.kernels.least_squares import refine
from optloc.kernels.pack import fold, folding, pack_runs
from optloc.linear.normal import linearise, local_covariance, marginal, normal, whitener_at, with_priors
from optloc.problem import Prior
from optloc.solvers import planned

SENSORS = 1e3 * np.array([[0.0, 0.0], [10.0, 1.0], [9.0, 9.0], [1.0, 10.0], [5.0, 4.0]])
CLOCKS, SIGMA = np.array([40.0, -25.0, 60.0, -80.0]), 5.0
pytestmark = pytest.mark.skipif(not enabled(), reason="plain Python takes minutes")


def free(epochs, seed=1, trials=None):
    """Arrival times of targets at unknown places and times, with four unknown clocks, and the clocks and places."""
    rng = np.random.default_rng(seed)
    shape = (epochs,) if trials is None else (trials, epochs)
    place, emission = rng.uniform(0.0, 10e3, (*shape, 2)), rng.uniform(0.0, 1e5, shape)
    r = np.linalg.norm(place[..., None, :] - SENSORS, axis=-1)
    z = r + emission[..., None] + np.r_[0.0, CLOCKS] + SIGMA * rng.standard_normal(r.shape)
    station, epoch = np.tile(np.arange(5), epochs), np.repeat(np.arange(epochs), 5)
    rows = measured("toa", z.reshape(*shape[:-1], -1), a=station, epoch=epoch, sigma=SIGMA)
    made = assemble(SENSORS, rows, motions=[Motion(0, "epoch")], times=np.arange(float(epochs)))
    return with_bias(made, "clock", members=("S1", "S2", "S3", "S4")), place


def known(problem):
    """The same run with priors of the clocks and of each position."""
    mean, wide = np.zeros(2), 1e8 * np.eye(2)
    bias = replace(problem.biases[0], sigma=np.full(4, 50.0), mean=np.full(4, 10.0))
    return replace(problem, biases=(bias,), priors=(Prior("position", mean, wide),))


def noisy(problem):
    """The same run with weights, absent rows that hold anything, and measurements in another order."""
    rng = np.random.default_rng(8)
    weight = rng.choice([0.0, 0.4, 1.0, 1.0], problem.count)
    return problem.with_rows(z=np.where(weight > 0.0, problem.z, np.nan), weight=weight)


RUNS = {
    "free": lambda: free(70)[0],
    "several": lambda: free(70, trials=3)[0],
    "priors": lambda: known(free(10)[0]),
    "weights": lambda: noisy(free(70)[0]),
    "station errors": lambda: drawn(estimated(run(40)), 3, 2),
    "gains": lambda: drawn(estimated(run(12, gain=2e-3, prior=50.0)), 3, 2),
}


def start_of(problem):
    """Vectors near the targets of a run."""
    if problem.layout.shares("position"):
        return np.tile(truth(problem), (problem.batch_shape[0], 1)) + 0.5
    x = np.zeros((problem.batch_shape[0], problem.layout.size))
    x[:, problem.layout.n_shared :] = np.tile([5.2e3, 3.1e3, 5e4], problem.epochs)
    return x


@pytest.mark.parametrize("name", RUNS)
def test_sums_are_those_of_numpy(name):
    from optloc.kernels.runs import sums_of_runs

    problem = RUNS[name]().flat()
    x, item = start_of(problem), np.arange(problem.batch_shape[0])
    found = sums_of_runs(pack_runs(problem, whitener_at(problem, x)), x, item, priors=True)
    theirs = with_priors(problem, x, normal(linearise(problem, x), problem.epochs))
    for one, two in zip(found.parts, theirs.parts, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-11 * np.abs(two).max(initial=1e-300))


@pytest.mark.parametrize("name", [name for name in RUNS if name != "weights"])
def test_answers_are_those_of_numpy(name, monkeypatch):
    problem = RUNS[name]().flat()
    if problem.layout.shares("position"):
        start = start_of(problem)
    else:
        start = solve(problem, "gtrs").x.reshape(problem.batch_shape[0], -1)
    ours = refine(problem, start)
    monkeypatch.setattr(import_module("optloc.kernels.least_squares"), "serves", lambda problem, starts: False)
    theirs = refine(problem, start)
    assert (ours.status == theirs.status).all()
    np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-9)
    cov = linalg.inverse(marginal(theirs.equations)[0])[0]
    n, sigma = cov.shape[-1], np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    assert (np.abs(ours.x - theirs.x)[:, :n] < 1e-5 * sigma).all()


def test_covariances_are_those_of_the_normal_equations():
    from optloc.kernels.damping import StopRules
    from optloc.kernels.runs import fixed_runs, sums_of_runs

    problem = free(70, trials=2)[0].flat()
    x, item = solve(problem, "gtrs+lsr").x, np.arange(2)
    runs = pack_runs(problem, whitener_at(problem, x))
    done, found = fixed_runs(runs, item, x, StopRules(), 2)
    equations = sums_of_runs(runs, done.x, item, priors=True)
    shared, _ = linalg.inverse(marginal(equations)[0])
    assert found.regular.all()
    np.testing.assert_allclose(found.information, marginal(equations)[0], rtol=1e-8)
    np.testing.assert_allclose(found.covariance, shared, rtol=1e-8)
    np.testing.assert_allclose(found.local, local_covariance(equations, shared, 2), rtol=1e-8, atol=1e-9)


def test_a_fix_by_the_plan_of_an_epoch_is_that_of_the_stages(monkeypatch):
    problem, place = free(60, trials=3)
    quick = solve(problem, "gtrs+lsr")
    monkeypatch.setattr(planned, "run_plan_of", lambda problem: None)
    slow = solve(problem, "gtrs+lsr")
    for name in ("code", "dof", "weights", "marks"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(slow, name))
    for name, room in (("cost", 1e-9), ("cov", 1e-6), ("local", 1e-6), ("x", 1e-6)):
        np.testing.assert_allclose(getattr(quick, name), getattr(slow, name), rtol=room, atol=1e-5)
    assert np.sqrt(((quick.position - place) ** 2).sum(-1).mean()) < 3.0 * SIGMA
    # an estimate of four clocks lies within its own uncertainty
    off = quick.take("clock") - CLOCKS
    assert (np.abs(off) < 4.0 * quick.sigma("clock")).all()


def test_runs_that_are_not_plain_take_the_stages():
    problem, _ = free(12, trials=2)
    z = problem.z
    z[1, 3] = np.nan
    fix = solve(problem.with_rows(z=z), "gtrs+lsr")
    alone = solve(problem.take(np.array([0])), "gtrs+lsr")
    assert Status(int(fix.code[1])) == Status.REJECTED
    np.testing.assert_allclose(fix.x[0], alone.x[0], rtol=1e-9)


def test_epochs_that_differ_are_not_folded():
    problem = free(6)[0].flat()
    found = folding(problem)
    assert fold(problem, found).batch_shape == (6,)
    rows = problem.rows[0]
    fewer = replace(problem, rows=(replace(rows, a=np.where(rows.epoch == 3, rows.a[::-1], rows.a)),))
    assert folding(fewer) is None
    drift = replace(problem, biases=(replace(problem.biases[0], form="drift"),))
    assert folding(drift) is None
    moving = replace(problem, motions=(Motion(1),))
    assert folding(moving) is None


def test_runs_of_one_structure_keep_their_own_priors():
    """Structures leave numbers out: a run must not have the prior of one before it."""
    one = drawn(estimated(run(20, prior=100.0)), 3, 1)
    other = replace(one, biases=tuple(replace(bias, sigma=np.full(4, 1.0)) for bias in one.biases))
    assert one.structure == other.structure
    costs = []
    for problem in (one, other):
        x = truth(problem)[None]
        found = refine(problem, x)
        linear = with_priors(problem, found.x, normal(linearise(problem, found.x), problem.epochs))
        np.testing.assert_allclose(found.cost, linear.cost, rtol=1e-9)
        costs.append(float(found.cost[0]))
    assert costs[1] > 1.01 * costs[0]
