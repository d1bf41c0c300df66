"""Filters against plain second implementations, written from the equations of range differences and angles."""

from dataclasses import replace

import numpy as np
import pytest

import optloc
from optloc.base.types import Motion
from optloc.tracking import UPDATES, State, followed, polynomial
from optloc.tracking.track import scans
from optloc.tracking.updates import whitened

STATIONS = np.array([[0.0, 0.0, 0.0], [9e3, 1e3, 300.0], [-2e3, 8e3, 100.0], [5e3, -7e3, 500.0], [3e3, 3e3, 2e3]])
START = np.array([20e3, 14e3, 4e3, -150.0, 60.0, 5.0])
SIGMA = 12.0
R = SIGMA**2 * (np.eye(4) + 1.0)


def h(x):
    r = np.linalg.norm(x[:3] - STATIONS, axis=-1)
    return r[1:] - r[0]


def jacobian(x):
    u = (x[:3] - STATIONS) / np.linalg.norm(x[:3] - STATIONS, axis=-1, keepdims=True)
    return np.hstack([u[1:] - u[0], np.zeros((4, 3))])


def ranges_gain(x, y):
    """Return the exact g of range differences: h(x) - h(y) = g (x - y)."""
    r, s = (np.linalg.norm(v[:3] - STATIONS, axis=-1, keepdims=True) for v in (x, y))
    g = (x[:3] + y[:3] - 2.0 * STATIONS) / (r + s)
    return np.hstack([g[1:] - g[0], np.zeros((4, 3))])


def plain(name, x, P, z):
    """Return mean, covariance and NIS of one update, in the textbooks' gain form."""
    H = jacobian(x)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    innovation = z - h(x)
    nis = innovation @ np.linalg.solve(S, innovation)
    if name == "iekf":
        at = x
        for _ in range(50):
            H = jacobian(at)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            at = x + K @ (z - h(at) - H @ (x - at))
        return at, (np.eye(6) - K @ H) @ P, nis
    after = x + K @ innovation
    if name == "mvekf":
        H = jacobian(after)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    g = ranges_gain(after, x) if name == "mgekf" else H
    left = np.eye(6) - K @ g
    return after, left @ P @ left.T + K @ R @ K.T, nis


def problem(epochs=12, dt=2.0):
    a, epoch = np.tile([1, 2, 3, 4], epochs), np.repeat(np.arange(epochs), 4)
    rows = optloc.measured("tdoa", a=a, b=0, epoch=epoch, arrival_sigma=SIGMA)
    return optloc.assemble(STATIONS, rows, times=dt * np.arange(epochs), motions=(Motion(1),))


def belief(sigma=200.0):
    wrong = START + np.array([300.0, -250.0, 400.0, 20.0, -10.0, 3.0]) * sigma / 200.0
    return State(-2.0, wrong, np.diag([sigma**2] * 3 + [(sigma / 8.0) ** 2] * 3))


@pytest.mark.parametrize("name", UPDATES)
def test_a_run_agrees_with_the_plain_filter(name):
    run = optloc.simulate(problem(), START, seed=5)
    track = followed(run, belief(), polynomial(1, 0.5), name)
    x, P, dt = belief().mean, belief().cov, 2.0
    F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(3))
    Q = 0.25 * np.kron(np.outer([dt**2 / 2, dt], [dt**2 / 2, dt]), np.eye(3))
    for k, z in enumerate(run.z.reshape(-1, 4)):
        x, P, nis = plain(name, F @ x, F @ P @ F.T + Q, z)
        loose = 1e-2 if name == "mgekf" else 1e-6
        scale = np.sqrt(np.diag(P))
        assert (np.abs(track.mean[k] - x) < (0.01 if name == "mgekf" else 1e-6) * scale).all()
        np.testing.assert_allclose(track.cov[k] / scale / scale[:, None], P / scale / scale[:, None], atol=loose)
        assert track.nis[k] == pytest.approx(nis, rel=1e-2 if name == "mgekf" else 1e-6)


def test_a_batch_of_targets_is_that_many_single_ones():
    run = optloc.simulate(problem(), START, seed=6, trials=3)
    start = belief()
    many = State(start.time, np.tile(start.mean, (3, 1)), np.tile(start.cov, (3, 1, 1)))
    track = followed(run, many, polynomial(1, 0.5), "iekf")
    for i in range(3):
        one = optloc.simulate(problem(), START, seed=6, trials=3).with_rows(z=run.z[i])
        alone = followed(one, start, polynomial(1, 0.5), "iekf")
        np.testing.assert_allclose(track.mean[i], alone.mean, rtol=1e-9, atol=1e-6)


def test_innovations_have_the_covariance_that_the_filter_claims():
    trials = 200
    run = optloc.simulate(problem(20), START, seed=7, trials=trials)
    rng = np.random.default_rng(1)
    P = np.diag([100.0**2] * 3 + [10.0**2] * 3)
    before = START.copy()
    before[:3] -= 2.0 * START[3:]
    mean = before + rng.standard_normal((trials, 6)) * np.sqrt(np.diag(P))
    track = followed(run, State(-2.0, mean, np.tile(P, (trials, 1, 1))), polynomial(1), "iekf")
    assert track.nis.mean() == pytest.approx(4.0, abs=2.6 * np.sqrt(8.0 / track.nis.size))
    truth = START + np.concatenate([np.outer(track.times, START[3:]), np.zeros((20, 3))], axis=1)
    error = track.mean - truth
    nees = np.einsum("tki,tkij,tkj->tk", error, np.linalg.inv(track.cov), error)[:, -1]
    assert nees.mean() == pytest.approx(6.0, abs=2.6 * np.sqrt(12.0 / trials))


def test_the_iterated_filter_ends_at_the_maximum_a_posteriori_point():
    """The same point as the fix of that scan with the prediction as prior: an independent road to it."""
    run = optloc.simulate(problem(1), START, seed=8)
    state = replace(belief(4000.0), time=0.0)
    ((_, scan),) = scans(run, 1)
    done = UPDATES["iekf"](scan, state.mean, state.cov)
    priors = (
        optloc.problem.Prior("position", state.mean[:3], state.cov[:3, :3]),
        optloc.problem.Prior("velocity", state.mean[3:], state.cov[3:, 3:]),
    )
    fix = optloc.solve(replace(scan, priors=priors), "lsr", start=state.mean)
    np.testing.assert_allclose(done.mean, fix.x, atol=1e-3)


def test_likelihoods_are_those_of_the_innovations():
    run = optloc.simulate(problem(1), START, seed=9)
    state = replace(belief(), time=0.0)
    ((_, scan),) = scans(run, 1)
    done = UPDATES["ekf"](scan, state.mean, state.cov)
    H = jacobian(state.mean)
    S = H @ state.cov @ H.T + R
    innovation = run.z - h(state.mean)
    expected = -0.5 * (innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    assert done.loglikelihood == pytest.approx(expected, rel=1e-9)


def test_absent_rows_count_for_nothing():
    run = optloc.simulate(problem(1), START, seed=10)
    ((_, scan),) = scans(run, 1)
    some = scan.with_rows(weight=np.array([1.0, 0.0, 1.0, 1.0]))
    (rows,) = scan.rows
    fewer = optloc.assemble(
        STATIONS,
        optloc.measured("tdoa", rows.z[[0, 2, 3]], a=[1, 3, 4], b=0, arrival_sigma=SIGMA),
        motions=(Motion(1),),
    )
    state = belief()
    one, two = (UPDATES["ekf"](s, state.mean, state.cov) for s in (some, fewer))
    np.testing.assert_allclose(one.mean, two.mean, rtol=1e-12)
    assert one.count == two.count == 3
    assert one.loglikelihood == pytest.approx(two.loglikelihood, rel=1e-9)
    assert whitened(some, state.mean).logdet == pytest.approx(whitened(fewer, state.mean).logdet)
