"""Tracks: initial states without a guess, scans that say nothing, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import optloc
from optloc.base.errors import InvalidProblem, NoSolution
from optloc.base.types import Motion, Status
from optloc.problem.epochs import cut
from optloc.tracking import State, begun, followed, polynomial, predicted
from optloc.tracking.start import two_point

STATIONS = np.array([[0.0, 0.0], [20e3, 1e3], [-3e3, 18e3], [12e3, -15e3]])
START = np.array([9e3, 5e3, 90.0, -40.0])


def run(epochs=15, dt=1.0, *, trials=None, seed=1, sigma=10.0, order=1):
    a, epoch = np.tile([1, 2, 3], epochs), np.repeat(np.arange(epochs), 3)
    rows = optloc.measured("tdoa", a=a, b=0, epoch=epoch, arrival_sigma=sigma)
    made = optloc.assemble(STATIONS, rows, times=dt * np.arange(epochs), motions=(Motion(1),))
    return optloc.simulate(made, START, seed, trials=trials)


def truth(times):
    return np.concatenate([START[:2] + np.outer(times, START[2:]), np.tile(START[2:], (len(times), 1))], axis=1)


def test_a_track_starts_from_nothing_and_is_consistent():
    errors = []
    for seed in range(30):
        problem = run(25, seed=seed)
        state = begun(problem, polynomial(1))
        track = followed(problem, state, polynomial(1))
        error = track.mean[-1] - truth(track.times)[-1]
        errors.append(error @ np.linalg.solve(track.cov[-1], error))
    assert np.mean(errors) == pytest.approx(4.0, abs=2.6 * np.sqrt(8.0 / 30))


def test_the_initial_state_has_the_covariance_that_it_claims():
    nees = []
    for seed in range(40):
        state = begun(run(8, seed=100 + seed), polynomial(1), epochs=4)
        error = state.mean - truth(np.array([state.time]))[0]
        nees.append(error @ np.linalg.solve(state.cov, error))
    assert np.mean(nees) == pytest.approx(4.0, abs=2.6 * np.sqrt(8.0 / 40))


def test_a_track_without_process_noise_ends_at_the_fix_of_the_whole_run():
    """A filter with the first epochs as start, and batch maximum likelihood: two roads to one estimate."""
    problem = run(30)
    track = followed(problem, begun(problem, polynomial(1), epochs=10), polynomial(1), "iekf")
    whole = optloc.solve(replace(problem, motions=(Motion(1, reference=float(problem.times[-1])),)))
    assert (np.abs(track.mean[-1] - whole.x) < 0.02 * np.sqrt(np.diag(whole.cov))).all()


def test_two_fixes_make_a_state_with_their_cross_covariance():
    problem = run(2, dt=10.0, trials=200, sigma=5.0)
    fixes = [optloc.solve(replace(cut(problem, k, k + 1), motions=(Motion(),))) for k in (0, 1)]
    state = two_point(*fixes, (0.0, 10.0))
    error = state.mean - truth(np.array([10.0]))
    nees = np.einsum("ti,tij,tj->t", error, np.linalg.inv(state.cov), error)
    assert nees.mean() == pytest.approx(4.0, abs=2.6 * np.sqrt(8.0 / 200))


def test_scans_without_a_valid_row_keep_the_prediction():
    problem = run(12)
    weight, z = np.ones(36), problem.z.copy()
    weight[15:18] = 0.0
    z[24:27] = np.nan
    z[27] = np.nan
    state = begun(problem, polynomial(1), epochs=3)
    track = followed(problem.with_rows(z=z, weight=weight), state, polynomial(1))
    code = {float(t): Status(int(c)) for t, c in zip(track.times, track.code, strict=True)}
    assert code[5.0] == Status.TOO_FEW_ROWS
    assert code[8.0] == Status.REJECTED
    assert track.count[list(track.times).index(9.0)] == 2
    ahead = predicted(State(4.0, track.mean[1], track.cov[1]), polynomial(1), 5.0, 2)
    np.testing.assert_allclose(track.mean[2], ahead.mean)
    assert np.isnan(track.nis[2])
    assert np.isfinite(track.mean).all()


def test_station_errors_of_each_scan_are_weighed():
    error = np.tile(30.0**2 * np.eye(2), (4, 1, 1))
    problem = run(15)
    stations = replace(problem.stations, covariance=error, span="noise")
    shaken = optloc.simulate(replace(problem, stations=stations), START, 3, trials=200)
    state = State(-1.0, np.tile(START - np.array([90.0, -40.0, 0.0, 0.0]), (200, 1)), np.tile(np.eye(4), (200, 1, 1)))
    track = followed(shaken, state, polynomial(1))
    assert track.nis.mean() == pytest.approx(3.0, abs=2.6 * np.sqrt(6.0 / track.nis.size))


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda p, s: followed(p, s, polynomial(1), "iekff"), "unknown filter 'iekff'"),
        (lambda p, s: followed(p, s, polynomial(2)), "a state of 4 numbers"),
        (lambda p, s: followed(p, replace(s, cov=-s.cov), polynomial(1)), "not positive semidefinite"),
        (lambda p, s: followed(p, replace(s, mean=np.nan * s.mean), polynomial(1)), "not finite"),
        (lambda p, s: followed(p, replace(s, time=99.0), polynomial(1)), "no scan is later"),
        (lambda p, s: followed(optloc.with_bias(p, "clock", members=["S1"]), s, polynomial(1)), "'clock' is unknown"),
        (lambda p, s: predicted(s, polynomial(1), s.time - 1.0, 2), "before the state"),
        (lambda p, s: polynomial(3), "a motion of order 3"),
        (lambda p, s: polynomial(1, -1.0), "process noise is -1"),
    ],
)
def test_what_makes_no_track_is_refused(act, words):
    problem = run(5)
    with pytest.raises(InvalidProblem, match=words):
        act(problem, State(0.5, START, np.eye(4)))


def test_a_run_that_never_shows_its_target_has_no_start():
    rows = optloc.measured("tdoa", np.zeros(6), a=1, b=0, epoch=np.arange(6), arrival_sigma=1.0)
    problem = optloc.assemble(STATIONS[:2], rows, times=np.arange(6.0), motions=(Motion(1),))
    with pytest.raises(NoSolution):
        begun(problem, polynomial(1))
