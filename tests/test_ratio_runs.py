"""Runs of gain ratios or received levels alone: no closed form starts them, and rivals are close; all are listed."""

import numpy as np
import pytest
from often import few
from verdicts import alone

import optloc
from optloc import Motion, Status, solve
from optloc.base.types import Stations

PLACES = 1e3 * np.array([[0, 0, 0], [9, 1, 0.5], [8, 10, 1], [-1, 8, 0.3], [4, 5, 2]])
SPEEDS = np.array([[0, 50, 0], [20, 40, 0], [0, 60, 5], [-30, 30, 0], [10, 50, 0]])
SIGMA = {"groa": 0.02, "rss_difference": 0.5}
EPOCHS = 40


def run(kind, *, biased, moves):
    times = np.arange(float(EPOCHS))
    place = PLACES[None] if moves else PLACES + SPEEDS * times[:, None, None]
    stations = Stations(place, tuple(f"S{i}" for i in range(5)))
    epoch, a = np.repeat(np.arange(EPOCHS), 4), np.tile(np.arange(1, 5), EPOCHS)
    rows = optloc.measured(kind, a=a, b=0, epoch=epoch, sigma=SIGMA[kind])
    problem = optloc.assemble(stations, rows, times=times, motions=(Motion(1 if moves else 0),))
    return optloc.with_bias(problem, "gain", members=stations.names[1:]) if biased else problem


@pytest.mark.parametrize("moves", few([True, False], 1), ids=["moving target", "moving stations"])
@pytest.mark.parametrize("biased", [False, True], ids=["", "biased"])
@pytest.mark.parametrize("trials", few([10, 20], 1))
@pytest.mark.parametrize("kind", SIGMA)
def test_no_fix_that_is_alone_misses_a_better_minimum_near_the_truth(kind, biased, moves, trials):
    problem = run(kind, biased=biased, moves=moves)
    state = [2e3, 3e3, 1.5e3, *([60.0, 40.0, 2.0] if moves else [])]
    truth = np.concatenate([state, np.linspace(-3.0, 3.0, 4) * SIGMA[kind] if biased else []])
    drawn = optloc.simulate(problem, truth=np.tile(truth, (trials, 1)), seed=2)
    # Without the proof, which takes seconds a run and has tests of its own.
    fix, near = solve(drawn, "searched"), solve(drawn, "lsr", start=truth)
    missed = fix.cost > near.cost + 1e-3
    assert not (missed & alone(fix)).any()
    assert missed.sum() <= 1  # with ten unknowns of weak rows, one in some hundred, and then ambiguous
    assert (alone(fix) | (fix.code == Status.AMBIGUOUS)).all()
