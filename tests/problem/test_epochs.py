"""Runs cut into stretches and put together again, and sums that do not depend on how they are cut."""

from dataclasses import replace

import numpy as np
import pytest
from runs import drawn, estimated, run, truth

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Motion
from optloc.kernels.sums import equations_at
from optloc.linear.normal import linearise, normal, with_priors
from optloc.problem import epochs as stretches
from optloc.problem.epochs import cut, joined, windows
from optloc.problem.noise import variances


def shuffled(problem):
    """Return the run with its rows in another order, and some of them absent."""
    (rows,) = problem.rows
    order = np.random.default_rng(3).permutation(rows.count)
    weight = np.ones(rows.count)
    weight[::7] = 0.0
    mixed = optloc.measured(
        "tdoa",
        rows.z[..., order],
        a=rows.a[order],
        b=rows.b[order],
        epoch=rows.epoch[order],
        arrival_sigma=3.0,
        weight=weight,
    )
    return optloc.assemble(problem.stations, mixed, times=problem.times, motions=problem.motions)


CASES = {
    "noise": drawn(run(40), 1, 3),
    "eliminated": drawn(estimated(run(9)), 2, 2),
    "moving, gains": drawn(run(20, order=1, gain=3e-3), 3, 2),
    "prior": drawn(run(30, prior=200.0), 4, 1),
    "shuffled": shuffled(drawn(run(25, station=0, biased=False), 5, 2)),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("numbers", [1, 300, 3000])
def test_sums_do_not_depend_on_the_windows(name, numbers, monkeypatch):
    problem = CASES[name]
    x = np.zeros((*problem.batch_shape, problem.layout.size)) + 1.0
    x[..., :3] = [190e3, 290e3, 4e3]
    whole = with_priors(problem, x, normal(linearise(problem, x), problem.epochs))
    monkeypatch.setattr(stretches, "_NUMBERS", numbers)
    count = len(list(windows(problem, len(x))))
    assert numbers > 1 or count == problem.epochs
    summed = equations_at(problem, x)
    for one, two in ((whole.shared, summed.shared), (whole.local, summed.local), (whole.cross, summed.cross)):
        np.testing.assert_allclose(two, one, rtol=1e-9, atol=1e-9 * max(1e-30, np.abs(one).max(initial=0.0)))
    for one, two in ((whole.shared_vector, summed.shared_vector), (whole.local_vector, summed.local_vector)):
        np.testing.assert_allclose(two, one, rtol=1e-9, atol=1e-9 * max(1e-30, np.abs(one).max(initial=0.0)))
    np.testing.assert_allclose(summed.cost, whole.cost, rtol=1e-12)


@pytest.mark.parametrize("name", ["noise", "moving, gains", "prior", "shuffled"])
@pytest.mark.parametrize("at", [1, 11])
def test_cut_and_joined_runs_are_the_run(name, at):
    problem = CASES[name]
    whole = joined(cut(problem, 0, at), cut(problem, at, problem.epochs))
    assert whole.epochs == problem.epochs
    np.testing.assert_array_equal(whole.times, problem.times)
    x = np.zeros((*problem.batch_shape, problem.layout.size)) + 2.0
    x[..., :3] = [190e3, 290e3, 4e3]
    one, two = equations_at(problem, x), equations_at(whole, x)
    scale = np.abs(one.shared).max()
    np.testing.assert_allclose(two.shared, one.shared, rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_allclose(two.cost, one.cost, rtol=1e-12)


def test_runs_join_whose_kinds_differ():
    places = [[0.0, 0.0], [900.0, 0.0], [0.0, 900.0]]

    def at(time, *given):
        rows = [optloc.measured(kind, z, a=range(len(z)), sigma=s) for kind, z, s in given]
        return replace(optloc.assemble(places, *rows), times=np.array([time]))

    made = joined(at(0.0, ("range", [1.0, 2.0], 3.0)), at(1.0, ("azimuth", [0.1], 0.2), ("range", [4.0], 5.0)))
    assert [(rows.kind, rows.z.tolist(), rows.epoch.tolist()) for rows in made.rows] == [
        ("range", [1.0, 2.0, 4.0], [0, 0, 1]),
        ("azimuth", [0.1], [1]),
    ]
    np.testing.assert_allclose(np.sqrt(variances(made.noise, made.count)), [3.0, 3.0, 5.0, 0.2])


def test_a_cut_keeps_the_time_of_states_and_drifts():
    problem = run(20, order=1)
    drift = replace(problem.biases[0], form="drift")
    problem = replace(problem, biases=(drift,))
    x = truth(problem)
    late = cut(problem, 12, 20)
    np.testing.assert_allclose(optloc.engine.predict(late, x), optloc.engine.predict(problem, x)[48:], rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: cut(run(10), 0, 5), "is not later than the last epoch of the run"),
        (lambda p: replace(p, biases=()), "the biases of the two runs differ"),
        (lambda p: replace(p, motions=(Motion(1),)), "the targets of the two runs differ"),
        (lambda p: replace(p, stations=replace(p.stations, names=tuple("abcde"))), "the stations of the two"),
    ],
)
def test_runs_that_do_not_fit_are_refused(change, words):
    problem = run(10)
    with pytest.raises(InvalidProblem, match=words):
        joined(cut(problem, 0, 5), change(cut(problem, 5, 10)))


def test_an_empty_stretch_is_refused():
    with pytest.raises(InvalidProblem, match="have no rows"):
        cut(run(10), 4, 4)
