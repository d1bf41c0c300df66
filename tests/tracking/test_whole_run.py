"""Whole-run fits of angles: bounds, pseudo-linear starts, one observer that turns."""

from dataclasses import replace

import numpy as np
import pytest
from verdicts import alone

import optloc
from optloc import InvalidProblem, Status
from optloc.base.types import Motion, Stations
from optloc.lab.papers.angles import STRAIGHT, WINDING, draw, errors, start_at_truth, track_all
from optloc.solvers.starts.angles import courses
from optloc.tracking import State, current_statistical, fitted, polynomial, posterior_bound, smoothed
from optloc.tracking.whole_run import along


def course_of(scenario, order, trials=None, seed=1):
    drawn = draw(scenario, 1 if trials is None else trials, seed, 7).problem
    return replace(drawn, motions=(Motion(order, reference=float(scenario.epochs)),))


def test_the_posterior_bound_without_noise_is_the_bound_of_the_whole_run():
    sigmas = (0.1, 0.1, 0.2)
    start = start_at_truth(draw(STRAIGHT, 1, 1, 0), sigmas)
    cov = posterior_bound(
        STRAIGHT.problem(), STRAIGHT.truth[1:], State(0.0, start.mean[0], start.cov[0]), polynomial(2)
    )
    run = course_of(STRAIGHT, 2)
    J = np.linalg.inv(optloc.crlb(run, STRAIGHT.truth[-1]).reshape(6, 6))
    back = polynomial(2).step(-50.0, np.zeros(6), 2)[0]
    J = J + back.T @ np.linalg.inv(start.cov[0]) @ back
    assert np.linalg.inv(J) == pytest.approx(cov[-1], rel=1e-5, abs=1e-12)


def parts(error):
    return np.sqrt((error.reshape(len(error), 3, 2) ** 2).sum(-1).mean(0))


def test_the_whole_track_fit_of_simulation_1():
    run = course_of(STRAIGHT, 2, 200)
    cov = optloc.crlb(course_of(STRAIGHT, 2), STRAIGHT.truth[-1]).reshape(6, 6)
    least = np.sqrt(np.diagonal(cov).reshape(3, 2).sum(-1))
    assert least == pytest.approx([0.01129, 6.00e-4, 1.63e-5], rel=1e-3)
    fix = fitted(run, 2)
    assert alone(fix).all()
    error = fix.x - STRAIGHT.truth[-1]
    assert parts(error) == pytest.approx(least, rel=0.10)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.cov), error)
    assert nees.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / 200))
    found = courses(run)
    unit = np.array([1.0, 1.0, 2.0])[:, None]
    plain, iv = ((unit * c).reshape(200, 6) - STRAIGHT.truth[-1] for c in (found.plain, found.instrumental))
    assert parts(iv) == pytest.approx(parts(error), rel=0.01)
    assert (parts(plain) > 1.15 * parts(error)).all()
    assert found.ahead.all()


def test_the_fit_beats_the_filter_where_its_model_is_true():
    drawn = draw(STRAIGHT, 100, 1, 7)
    fit = fitted(drawn.problem, 2).x - STRAIGHT.truth[-1]
    track = track_all(drawn, start_at_truth(drawn, (0.1, 0.1, 0.2), known=2), current_statistical(10.0, 30.0))
    end = errors(drawn, track)[:, -1]
    gain = np.sqrt((end**2).sum(-1).mean(0)) / parts(fit)
    assert gain[0] > 3.0
    assert gain[1] > 50.0


def test_smoothed_states_follow_the_polynomial():
    drawn = draw(STRAIGHT, 20, 1, 8)
    track = smoothed(drawn.problem, 2)
    error = track.mean - STRAIGHT.truth[1:]
    nees = np.einsum("nki,nkij,nkj->nk", error, np.linalg.inv(track.cov), error)
    assert nees.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / 20))
    fix = fitted(drawn.problem, 2)
    assert track.nis.sum(-1) == pytest.approx(fix.cost)
    assert (track.code == Status.OK).all()
    mean, cov = along(State(50.0, fix.x, fix.cov), np.array([50.0]), 2)
    assert mean[:, 0] == pytest.approx(fix.x)
    assert cov[:, 0] == pytest.approx(fix.cov)


def turning(turns, sigma, trials, seed):
    """Return runs of one ship that measures the azimuth of another, and the truth; it turns half-way or does not."""
    t = np.arange(0.0, 600.0, 10.0)
    speed = np.where((t < 300.0)[:, None] | (not turns), [5.0, 0.0], [0.0, 5.0])
    place = np.vstack([np.zeros((1, 2)), np.cumsum(10.0 * speed[:-1], axis=0)])
    k = len(t)
    problem = optloc.assemble(
        Stations(place[:, None], ("ship",)),
        optloc.measured("azimuth", a=np.zeros(k, int), epoch=np.arange(k), sigma=sigma),
        times=t,
        motions=(Motion(1),),
    )
    truth = np.array([3e3, 5e3, -3.0, -4.0])
    return optloc.simulate(problem, truth, seed, trials=trials), truth


@pytest.mark.parametrize("sigma", [1e-3, 1e-2])
def test_one_observer_that_turns_sees_the_course(sigma):
    runs, truth = turning(True, sigma, 200, 1)
    fix = optloc.solve(runs)
    assert alone(fix).all()
    error = fix.x - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.cov), error)
    assert nees.mean() == pytest.approx(4.0, abs=4.0 * np.sqrt(8.0 / 200))
    found = courses(runs)
    bias = [np.linalg.norm(c[:, 0].mean(0) - truth[:2]) for c in (found.plain, found.instrumental)]
    assert bias[1] < 0.35 * bias[0]


def test_one_observer_that_goes_straight_on_is_told_so():
    runs, _ = turning(False, 1e-3, 20, 1)
    assert not alone(optloc.solve(runs)).any()


@pytest.mark.parametrize(
    ("d", "stations", "epochs", "sigma", "order"), [(2, 2, 10, 5e-2, 1), (3, 3, 20, 5e-2, 1), (3, 4, 20, 2e-2, 2)]
)
def test_no_course_is_better_than_the_fit_without_a_guess(d, stations, epochs, sigma, order):
    rng, trials = np.random.default_rng(7), 100
    places = rng.uniform(-40e3, 40e3, (stations, 3)) * [1.0, 1.0, 0.05]
    a, epoch = np.tile(np.arange(stations), epochs), np.repeat(np.arange(epochs), stations)
    problem = optloc.assemble(
        places[:, :d],
        *(optloc.measured(kind, a=a, epoch=epoch, sigma=sigma) for kind in ("azimuth", "elevation")[: d - 1]),
        times=10.0 * np.arange(epochs),
        motions=(Motion(order),),
    )
    position = rng.uniform(-60e3, 60e3, (trials, 3)) * [1.0, 1.0, 0.1] + [0.0, 0.0, 7e3]
    state = [position, 150.0 * rng.standard_normal((trials, 3)), 2.0 * rng.standard_normal((trials, 3))]
    truth = np.concatenate([part[:, :d] for part in state[: order + 1]], axis=1)
    drawn = optloc.simulate(problem, truth, 7)
    fix, best = optloc.solve(drawn), optloc.solve(drawn, "lsr", start=truth)
    assert alone(fix).all()
    assert (fix.cost <= best.cost + 1e-6 * (1.0 + best.cost)).all()


def test_smoothed_tracks_say_what_is_missing():
    runs, _ = turning(True, 1e-3, 3, 2)
    weight = np.ones((3, runs.count))
    weight[1, 10] = 0.0
    track = smoothed(runs.with_rows(weight=weight), 1)
    assert track.code[1, 10] == Status.TOO_FEW_ROWS
    assert track.count[1, 10] == 0
    assert (np.delete(track.code[1], 10) == Status.OK).all()
    blind, _ = turning(False, 1e-3, 3, 2)
    assert not (smoothed(blind, 1).code == Status.OK).any()


def test_wrong_orders_are_refused():
    with pytest.raises(InvalidProblem, match="order 3"):
        fitted(WINDING.problem(), 3)
