"""Updates weighed by a loss: against a general minimiser, on clean data, and with wild rows."""

import numpy as np
import pytest
from often import few
from robust_cases import wild_run
from scipy.optimize import minimize

from optloc import InvalidProblem, Motion, assemble, measured, simulate
from optloc.linear.evaluate import predict
from optloc.problem import LOSSES
from optloc.tracking import Rules, State, collected, polynomial, reweighted, tracked
from optloc.tracking.updates import iekf

RING = 1e3 * np.array([[3.0, 0.0], [2.0, 2.0], [0.0, 3.0], [-2.0, 2.5], [-3.0, 0.0], [-2.0, -2.0], [0.0, -3.5]])
SIGMA = 10.0


def scan(seed, wild=0.0):
    rng = np.random.default_rng(seed)
    template = assemble(RING, measured("range", a=np.arange(len(RING)), sigma=SIGMA))
    truth = rng.uniform(-1500.0, 1500.0, 2)
    drawn = simulate(template, truth, seed)
    return truth, drawn.with_rows(z=drawn.z + wild * np.eye(len(RING))[seed % len(RING)])


@pytest.mark.parametrize("name", ["huber", "cauchy"])
def test_the_state_is_the_minimum_of_prior_and_loss(name):
    loss = LOSSES[name]
    for seed in range(5):
        truth, problem = scan(seed, wild=80.0)
        prior, mean = np.diag([40.0**2, 60.0**2]), truth + np.array([25.0, -30.0])

        def cost(x, problem=problem, prior=prior, mean=mean):
            u = (problem.z - predict(problem, x)) / SIGMA
            return loss.rho(u).sum() + (x - mean) @ np.linalg.solve(prior, x - mean)

        found = reweighted("iekf", name)(problem, mean, prior)
        best = minimize(cost, found.mean, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12})
        assert np.abs(found.mean - best.x).max() < 1e-3 * SIGMA


def test_without_wild_rows_next_to_nothing_is_lost():
    plain, robust = [], []
    for seed in range(200):
        truth, problem = scan(seed)
        mean, prior = truth + 100.0 * np.random.default_rng(seed + 1000).standard_normal(2), 100.0**2 * np.eye(2)
        plain.append(iekf(problem, mean, prior).mean - truth)
        robust.append(reweighted("iekf", "cauchy")(problem, mean, prior).mean - truth)
    assert np.mean(np.square(robust)) < 1.1 * np.mean(np.square(plain))


def test_a_batch_is_its_members():
    truth, problem = scan(3, wild=500.0)
    means, prior = truth + np.array([[10.0, 0.0], [0.0, -20.0], [-30.0, 5.0]]), 50.0**2 * np.eye(2)
    many = reweighted("ekf", "huber")(problem, means, np.tile(prior, (3, 1, 1)))
    for i, mean in enumerate(means):
        one = reweighted("ekf", "huber")(problem, mean, prior)
        np.testing.assert_allclose(many.mean[i], one.mean, atol=1e-6)
        np.testing.assert_allclose(many.cov[i], one.cov, rtol=1e-6)


def test_wild_rows_do_a_track_no_harm():
    rng, epochs = np.random.default_rng(5), 60
    times = np.arange(epochs) * 1.0
    truth = np.array([-800.0, 400.0]) + times[:, None] * np.array([25.0, -10.0])
    a, epoch = np.tile(np.arange(7), epochs), np.repeat(np.arange(epochs), 7)
    z = np.linalg.norm(truth[epoch] - RING[a], axis=-1) + SIGMA * rng.standard_normal(len(a))
    z += np.where((rng.random(len(a)) < 0.05) & (epoch > 0), 400.0, 0.0)
    problem = assemble(
        RING, measured("range", z, a=a, sigma=SIGMA, epoch=epoch), times=times, motions=(Motion(span="epoch"),)
    )
    start = State(0.0, np.array([*truth[0], 25.0, -10.0]), np.diag([20.0, 20.0, 3.0, 3.0]) ** 2)
    errors = {}
    for name, update in (("plain", "iekf"), ("robust", reweighted("iekf", "cauchy"))):
        # No gate: what keeps wild rows out is the loss alone.
        entries = list(tracked(problem, polynomial(1, 0.5), update, start=start, rules=Rules(gate=1e3)))
        place = collected(entries, 2).mean[:, :2]
        errors[name] = np.sqrt(np.mean((place - truth) ** 2))
    assert errors["plain"] > 20.0
    assert errors["robust"] < 6.0


@pytest.mark.parametrize("trials", few([1, 20], 1))
def test_tracks_begin_among_wild_rows(trials):
    update, rules = reweighted("iekf", "cauchy"), Rules(starts="robust")
    for seed in range(100, 100 + trials):
        problem, places, _ = wild_run(seed, 30, 0.3)
        entries = list(tracked(problem, polynomial(1, 1.0), update, rules=rules))
        place = collected(entries, 3).mean[:, :3]
        begun = np.isfinite(place).all(-1)
        assert begun[12:].all(), seed
        assert np.linalg.norm(place - places, axis=-1)[begun].max() < 300.0, seed


def test_rows_that_a_start_leaves_out_are_counted():
    problem, _, wild = wild_run(1, 6, 0.15)
    entries = list(tracked(problem, polynomial(1, 1.0), "iekf", rules=Rules(starts="robust")))
    first = next(i for i, entry in enumerate(entries) if entry.event == "started")
    own = problem.epoch == first
    assert (int(entries[first].updated.count), entries[first].rejected) == (
        int((own & ~wild).sum()),
        int((own & wild).sum()),
    )


def test_an_unknown_loss_is_named():
    with pytest.raises(InvalidProblem, match="unknown loss 'hubr'; did you mean 'huber'"):
        reweighted("iekf", "hubr")
