"""Filters of three models against a plain second program: seconds, kilometres, and derivatives written out."""

from dataclasses import replace

import numpy as np
import pytest
from verdicts import alone

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Motion, Status
from optloc.lab.papers.kinematic import KinematicScenario, draw, start_from_fix
from optloc.problem.epochs import cut
from optloc.tracking import State, followed, polynomial
from optloc.tracking.several_models import parallel, resized, softmax

C = 299792.458  # km/s
STATIONS = np.array([[0.0, 0.0]] + [[100.0 * np.cos(a), 100.0 * np.sin(a)] for a in np.radians([90.0, 210.0, 330.0])])
DT, SIGMA = 2.25, 80e-9


def h(x):
    r = np.linalg.norm(x[:2] - STATIONS, axis=1)
    return (r[1:] - r[0]) / C


def jacobian(x, n):
    u = (x[:2] - STATIONS) / np.linalg.norm(x[:2] - STATIONS, axis=1, keepdims=True)
    return np.hstack([(u[1:] - u[0]) / C, np.zeros((3, n - 2))])


def first_fix(tau):
    """Return Gauss-Newton from inside the array, and its covariance."""
    x = np.array([1.0, 1.0])
    for _ in range(100):
        H = jacobian(x, 2)
        step = np.linalg.solve(H.T @ H, H.T @ (tau - h(x)))
        x = x + step
        if np.linalg.norm(step) < 1e-9:
            break
    return x, SIGMA**2 * np.linalg.inv(H.T @ H)


def plain(tau, order, noise=0.0):
    """Return means, covariances and log-likelihoods of the filter of the spec, from the fix of the first epoch."""
    n, eye = 2 * (order + 1), np.eye(2)
    F = np.kron(np.array([[1.0, DT, DT**2 / 2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])[: order + 1, : order + 1], eye)
    G = np.kron(np.array([[[DT]], [[DT**2 / 2], [DT]], [[DT**3 / 6], [DT**2 / 2], [DT]]][order]), eye)
    R = SIGMA**2 * np.eye(3)
    x, P = np.zeros(n), np.zeros((n, n))
    x[:2], P[:2, :2] = first_fix(tau[0])
    P[range(2, n), range(2, n)] = np.repeat([4.0, 1.0], 2)[: n - 2]
    out = []
    for z in tau[1:]:
        x, P = F @ x, F @ P @ F.T + noise**2 * G @ G.T
        H = jacobian(x, n)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        nu = z - h(x)
        x, left = x + K @ nu, np.eye(n) - K @ H
        P = left @ P @ left.T + K @ R @ K.T
        out.append((x, P, -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2.0 * np.pi * S)[1])))
    return [np.array(part) for part in zip(*out, strict=True)]


@pytest.fixture(scope="module")
def drawn():
    scene = KinematicScenario()
    return {order: draw(scene, scene.course(order), 2, (11, order)) for order in (0, 1, 2)}


def tau(runs, index):
    return runs.z[index].reshape(-1, 3) / (1e3 * C)


@pytest.mark.parametrize(("order", "noise"), [(0, 0.0), (0, 0.3), (1, 0.0), (1, 0.1), (2, 0.0), (2, 0.02)])
def test_filters_agree_with_a_plain_second_program(drawn, order, noise):
    own = drawn[order]
    track = followed(own.runs, start_from_fix(own, order), polynomial(order, 1e3 * noise), "ekf")
    for index in np.ndindex(2, 3):
        mean, cov, fit = plain(tau(own.runs, index), order, noise)
        assert track.mean[index] / 1e3 == pytest.approx(mean, rel=1e-6, abs=1e-6)
        assert np.abs(track.cov[index] / 1e6 - cov).max() < 1e-6 * np.abs(cov).max()
        # The density of range differences in metres is that of seconds over (1000 C)^3.
        assert track.loglikelihood[index] == pytest.approx(fit - 3.0 * np.log(1e3 * C), rel=1e-6)


def test_the_start_is_the_best_linear_unbiased_fix(drawn):
    own = drawn[0]
    for index in np.ndindex(2, 3):
        x, P = first_fix(tau(own.runs, index)[0])
        assert own.fix.mean[index] / 1e3 == pytest.approx(x, rel=1e-6)
        assert own.fix.cov[index] / 1e6 == pytest.approx(P, rel=1e-5)


def test_the_static_recursion_ends_at_the_fix_of_all_epochs(drawn):
    own = drawn[0]
    track = followed(own.runs, own.fix, polynomial(0), "iekf")
    whole = optloc.solve(own.runs)
    assert (np.abs(track.position[..., -1, :] - whole.position) < 0.03 * whole.sigma()).all()
    assert track.cov[..., -1, :, :] == pytest.approx(whole.covariance(), rel=0.03)


def test_models_side_by_side_are_their_own_tracks_with_their_likelihoods(drawn):
    own, models = drawn[1], [polynomial(order) for order in (0, 1, 2)]
    made = parallel(own.runs, own.fix, models, speed=2e3, rate=1e3, update="ekf")
    for order, track in enumerate(made.tracks):
        alone = followed(own.runs, start_from_fix(own, order), polynomial(order), "ekf")
        assert (track.mean == alone.mean).all()
        fits = np.array([plain(tau(own.runs, (0, t)), order)[2] for t in range(3)])
        wanted = np.cumsum(fits - 3.0 * np.log(1e3 * C), axis=-1)
        assert made.score[0, ..., order] == pytest.approx(wanted, rel=1e-6)
    assert made.probability.sum(-1) == pytest.approx(np.ones((2, 3, 20)))
    assert (made.choice[..., 5:] == 1).all()
    assert (made.position[..., 5:, :] == made.tracks[1].position[..., 5:, :]).all()
    assert (made.probability.argmax(-1) == made.choice).all()


def test_a_model_that_loses_the_state_is_never_chosen(drawn):
    own = drawn[0]

    def broken(scan, mean, cov):
        done = optloc.tracking.UPDATES["ekf"](scan, mean, cov)
        return replace(done, mean=np.full_like(done.mean, np.nan)) if mean.shape[-1] == 4 else done

    made = parallel(own.runs, own.fix, [polynomial(1), polynomial(0)], speed=2e3, update=broken)
    assert (made.tracks[0].code == Status.NUMERICAL).all()
    assert (made.choice == 1).all()
    assert (made.probability[..., 1] == 1.0).all()


def test_states_change_their_order():
    state = State(3.0, np.arange(4.0), np.diag([1.0, 2.0, 3.0, 4.0]))
    wide = resized(state, 2, 2, rate=5.0)
    assert (wide.mean == [0.0, 1.0, 2.0, 3.0, 0.0, 0.0]).all()
    assert (np.diag(wide.cov) == [1.0, 2.0, 3.0, 4.0, 25.0, 25.0]).all()
    narrow = resized(state, 0, 2)
    assert (narrow.mean == [0.0, 1.0]).all()
    assert narrow.cov.shape == (2, 2)
    with pytest.raises(InvalidProblem, match="no acceleration"):
        resized(state, 2, 2, speed=1.0)


def test_softmax_of_nothing_is_equal_shares():
    assert softmax(np.array([-np.inf, -np.inf])) == pytest.approx([0.5, 0.5])
    assert softmax(np.array([-1e5, -1e5 - np.log(3.0)])) == pytest.approx([0.75, 0.25])


def test_no_models_are_refused(drawn):
    with pytest.raises(InvalidProblem, match="no models"):
        parallel(drawn[0].runs, drawn[0].fix, [])


def test_stations_may_move(drawn):
    """What the filters say does not change when stations and target are carried along together."""
    own = drawn[0]
    moving = replace(
        own.runs, stations=replace(own.runs.stations, position=own.runs.stations.position + carried(own.scenario.times))
    )
    track = followed(moving, resized(own.fix, 1, 2, speed=2e3), polynomial(1), "ekf")
    shift = carried(own.scenario.times)[1:, 0]
    start = resized(own.fix, 1, 2, speed=2e3)
    still = followed(own.runs, replace(start, mean=start.mean - [0, 0, 300.0, 0]), polynomial(1), "ekf")
    assert track.position - shift == pytest.approx(still.position, abs=1e-4)


def carried(times):
    return np.stack([300.0 * times, np.zeros(len(times))], axis=-1)[:, None, :]


def test_one_epoch_is_enough_to_fix(drawn):
    one = cut(drawn[0].runs, 0, 1)
    assert alone(optloc.solve(replace(one, motions=(Motion(0),)))).all()
