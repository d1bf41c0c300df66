"""The refinement by machine code against the one by numpy: answers, statuses, and what bad items do to others."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, random_vector
from linear.test_normal import regular_sink
from runs import drawn, estimated, run, truth

from optloc import Motion, assemble, measured, simulate, station_array
from optloc.base.linalg import inverse
from optloc.base.types import Status
from optloc.kernels.damping import judge, judge_lane
from optloc.kernels.jit import enabled
from optloc.linear.normal import marginal
from optloc.problem import Bias, Prior

hooks = import_module("optloc.kernels.least_squares")
choice = import_module("optloc.kernels.least_squares")
COUNT = 100 if enabled() else 3


@pytest.fixture
def both(monkeypatch):
    """Return a function that refines by machine code and by numpy."""

    def refined(problem, start, **more):
        out = []
        for chosen in (True, False):
            monkeypatch.setattr(choice, "serves", lambda problem, starts, chosen=chosen: chosen)
            out.append(hooks.refine(problem, start, **more))
        assert out[0].equations.local.shape == out[1].equations.local.shape
        return out

    return refined


def apart(one, two):
    """The largest difference of answers with status ok, in standard deviations of the shared unknowns."""
    settled = np.flatnonzero((one.status == Status.OK) & (two.status == Status.OK))
    cov, ok = inverse(marginal(two.equations)[0][settled])
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    n = sigma.shape[-1]
    return (np.abs(one.x[settled, :n] - two.x[settled, :n]) / sigma)[ok].max(initial=0.0)


def started(case, spread=300.0, seed=0):
    problem = simulate(case.problem, case.truth, 5, trials=COUNT).flat()
    return problem, case.truth + np.random.default_rng(seed).normal(0.0, spread, (COUNT, len(case.truth)))


@pytest.mark.parametrize("name", CASES)
def test_answers_and_statuses_are_those_of_numpy(name, both):
    problem, start = started(CASES[name])
    ours, theirs = both(problem, start)
    assert (ours.status == theirs.status).all()
    assert apart(ours, theirs) < 1e-6
    assert np.allclose(ours.cost, theirs.cost, rtol=1e-6, atol=1e-6)
    assert (ours.iterations == theirs.iterations).mean() > 0.9
    assert (theirs.status == Status.OK).mean() > 0.9


def test_from_far_away(both):
    """Many steps are refused, damping grows and falls; what takes dozens of steps ends where rounding says."""
    problem, start = started(CASES["tdoa-3d"], spread=1.5e4)
    ours, theirs = both(problem, start, limit=100)
    alike = ours.iterations == theirs.iterations
    assert alike.mean() > 0.75 or not enabled()
    assert (ours.status == theirs.status)[alike].all()
    assert np.allclose(ours.cost[alike], theirs.cost[alike], rtol=1e-6)
    assert theirs.iterations[alike].max() > 12


@pytest.mark.parametrize("damped", [True, False])
def test_limit_tolerance_and_plain_taylor_steps(both, damped):
    problem, start = started(CASES["range-2d"], spread=3e3)
    ours, theirs = both(problem, start, limit=3, tolerance=1e-3, damped=damped)
    assert (ours.status == theirs.status).all()
    assert len(np.unique(theirs.status)) > 1
    assert np.array_equal(ours.iterations, theirs.iterations)
    assert np.allclose(ours.x, theirs.x, rtol=1e-9, atol=1e-6)


def test_several_starts_of_a_problem(both):
    case = CASES["range_sum-3d"]
    problem, start = started(case)
    item = np.random.default_rng(2).integers(0, COUNT, COUNT)
    ours, theirs = both(problem, start, item=item)
    assert (ours.status == theirs.status).all()
    assert apart(ours, theirs) < 1e-6


def test_biases_moving_targets_and_priors(both):
    """A run whose only unknowns of single epochs are none: all else is there."""
    sink = regular_sink(3, "run")
    rows = tuple(block for block in sink.rows if block.kind != "toa")
    assert len(rows) < len(sink.rows)
    problem = drawn(run(30, prior=40.0, order=1), 2, COUNT).flat()
    prior = (Prior("velocity", np.array([-90.0, 5.0, 0.0]), 100.0 * np.eye(3)),)
    problem = replace(problem, priors=prior)
    start = np.tile(truth(problem), (COUNT, 1)) + np.random.default_rng(1).normal(0.0, 10.0, (COUNT, 10))
    ours, theirs = both(problem, start)
    assert (ours.status == theirs.status).all()
    assert apart(ours, theirs) < 1e-6


def test_singular_and_broken_items_leave_the_others_as_they_are(both):
    """Stations on one line, a measurement that is not a number, an infinite start: the rest is bit for bit the same."""
    place = np.tile(STATIONS[2][None, None], (COUNT, 1, 1, 1))
    problem = assemble(station_array(place), measured("range", a=np.arange(6), sigma=5.0))
    problem = simulate(problem, np.tile(TARGET[2], (COUNT, 1)), 3).flat()
    start = TARGET[2] + np.random.default_rng(4).normal(0.0, 500.0, (COUNT, 2))
    clean, _ = both(problem, start)
    bent, z = place.copy(), problem.z.copy()
    bent[0, 0] = STATIONS[2][0]
    z[1, 3], start[2] = np.nan, np.inf
    broken = replace(problem, stations=replace(problem.stations, position=bent)).with_rows(z=z)
    ours, theirs = both(broken, start)
    assert (ours.status == theirs.status).all()
    assert (ours.status[1:3] == Status.NUMERICAL).all()
    rest = np.arange(3, COUNT)
    for name in ("x", "cost", "status", "iterations"):
        assert np.array_equal(getattr(ours, name)[rest], getattr(clean, name)[rest])


def test_an_open_direction_stalls_or_ends_as_with_numpy(both):
    problem = assemble(STATIONS[3], measured("range", a=[0, 1], sigma=5.0))
    problem = simulate(problem, TARGET[3], 3, trials=COUNT).flat()
    start = TARGET[3] + np.random.default_rng(4).normal(0.0, 500.0, (COUNT, 3))
    ours, theirs = both(problem, start)
    assert (ours.status == theirs.status).mean() > 0.95
    assert np.abs(ours.cost - theirs.cost).max() < 1e-6


def test_threads_change_nothing(monkeypatch, both):
    problem, start = started(CASES["tdoa-3d"])
    one, _ = both(problem, start)
    monkeypatch.setattr("optloc.kernels.equations._SHARE", 7)
    monkeypatch.setenv("OPTLOC_THREADS", "4")
    several, _ = both(problem, start)
    for name in ("x", "cost", "status", "iterations"):
        assert np.array_equal(getattr(one, name), getattr(several, name))


def test_a_moving_target_by_range_rates(both):
    case = CASES["tdoa+fdoa-3d"]
    assert case.problem.motions == (Motion(1),)
    problem, start = started(case, spread=30.0)
    ours, theirs = both(problem, start)
    assert (ours.status == theirs.status).all()
    assert apart(ours, theirs) < 1e-6


@pytest.mark.parametrize("d", [2, 3])
def test_runs_whose_epochs_have_unknowns_of_their_own(d, both):
    """Station errors and emission times of each epoch, eliminated on the way and completed at the end."""
    problem = regular_sink(d, "epoch").flat()
    x = np.stack([random_vector(problem, seed) for seed in range(min(COUNT, 5))])
    problem = simulate(problem, x, 3).flat()
    ours, theirs = both(problem, x + 0.1, limit=100)
    assert (ours.status == theirs.status).all()
    assert (ours.status == Status.OK).all()
    assert apart(ours, theirs) < 1e-6
    assert np.allclose(ours.x, theirs.x, rtol=0.0, atol=1e-6)
    assert np.allclose(ours.cost, theirs.cost, rtol=1e-9)


def test_station_errors_eliminated_or_weighed(both):
    """Of range differences both are the same estimate; with gains the weights depend on where the target is."""
    made = run(30, prior=100.0)
    problem = drawn(made, 3, min(COUNT, 8)).flat()
    start = np.tile(truth(problem), (len(problem.z), 1)) + 20.0
    weighed, _ = both(problem, start)
    eliminated, theirs = both(estimated(problem), np.pad(start, ((0, 0), (0, 30 * 15))))
    assert (eliminated.status == theirs.status).all()
    assert np.array_equal(eliminated.iterations, theirs.iterations)
    assert apart(eliminated, theirs) < 1e-6
    assert np.allclose(eliminated.x[:, :7], weighed.x, rtol=0.0, atol=0.05)
    gains = drawn(run(30, gain=2e-3, prior=100.0), 3, min(COUNT, 8)).flat()
    ours, theirs = both(gains, np.pad(start, ((0, 0), (0, 4))))
    assert (ours.status == theirs.status).all()
    assert apart(ours, theirs) < 1e-6


def test_an_epoch_that_leaves_its_own_unknowns_open(both):
    """One row cannot place the target of its epoch; it still says something about the bias that all epochs share."""
    a, epoch = np.tile(np.arange(6), 4), np.repeat(np.arange(4), 6)
    clock = Bias("clock", ("all",), np.arange(24), np.zeros(24, int), np.ones(24))
    problem = assemble(
        STATIONS[2],
        measured("range", a=a, epoch=epoch, sigma=5.0),
        times=np.arange(4.0),
        motions=(Motion(span="epoch"),),
        biases=(clock,),
    )
    x = np.concatenate([[30.0], np.tile(TARGET[2], 4)])
    problem = simulate(problem, x, 3, trials=min(COUNT, 8)).flat()
    weight = np.ones(problem.z.shape)
    weight[1:, 7:12] = 0.0
    problem = problem.with_rows(weight=weight)
    ours, theirs = both(problem, np.tile(x + 5.0, (len(weight), 1)))
    assert (ours.status == theirs.status).all()
    assert np.allclose(ours.x[:, 0], theirs.x[:, 0], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("damped", [True, False])
def test_a_step_is_judged_the_same_by_both_forms(damped):
    rng = np.random.default_rng(3)
    size = 3000
    cost = 10.0 ** rng.uniform(-12.0, 12.0, size)
    gain = cost * 10.0 ** rng.uniform(-18.0, 1.0, size) * rng.choice([1.0, 1.0, 1.0, -1.0, 0.0], size)
    after = cost - gain * rng.choice([1.0, 0.95, 0.5, 0.0, -1e-15, -3.0], size)
    after[::50], after[1::50], after[2::50] = np.nan, np.inf, cost[2::50]
    solvable, blur = rng.random(size) < 0.9, np.where(rng.random(size) < 0.5, 0.0, 10.0 ** rng.uniform(-16, -3, size))
    damping, growth = 10.0 ** rng.uniform(-13.0, 13.0, size), 2.0 ** rng.integers(1, 12, size)
    with np.errstate(all="ignore"):
        whole = judge(cost, after, gain, solvable, blur, damping, growth, 1e-7, damped)
    lanes = [
        judge_lane(*(value.item() for value in values), 1e-7, damped)
        for values in zip(cost, after, gain, solvable, blur, damping, growth, strict=True)
    ]
    for one, other in zip(whole, zip(*lanes, strict=True), strict=True):
        assert np.array_equal(one, other)
    for flag in whole[:3]:
        assert 0 < np.count_nonzero(flag) < size
