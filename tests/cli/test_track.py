"""Options of `optloc track`: models, rules and initial states, and what is wrong with them."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured
from optloc.cli.track import TrackOptions, _start, dynamics_of, rules

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0]])


def test_unknown_models_and_rules_are_refused():
    with pytest.raises(InvalidProblem, match="unknown model 'vc'"):
        dynamics_of(TrackOptions(model="vc"))
    for given, where in (((0.0, None), "--gate"), ((5.0, -1.0), "--gap"), ((float("nan"), None), "--gate")):
        with pytest.raises(InvalidProblem, match="not positive") as refused:
            rules(*given)
        assert refused.value.where == where
    assert rules(9.0, 3.0, "huber").starts == "robust"


def arrivals(k):
    z = np.random.default_rng(0).normal(500.0, 100.0, 4 * k)
    rows = measured("toa", z, a=np.tile(np.arange(4), k), epoch=np.repeat(np.arange(k), 4), sigma=2.0)
    return assemble(PLACES, rows, motions=(Motion(1, "run"),), times=np.arange(float(k)))


def test_a_start_needs_a_number_for_each_part_of_the_state():
    run, dynamics = arrivals(3), dynamics_of(TrackOptions())
    state = _start(run, dynamics, TrackOptions(start="1,2,3,4", sigma="10,5"))
    assert state.mean.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert np.diagonal(state.cov).tolist() == [100.0, 100.0, 25.0, 25.0]
    assert _start(run, dynamics, TrackOptions()) is None
    for start, sigma, words in (("1,2", "1,1", "2 numbers for a state of 4"), ("1,2,3,4", "1", "not standard")):
        with pytest.raises(InvalidProblem, match=words):
            _start(run, dynamics, TrackOptions(start=start, sigma=sigma))
    with pytest.raises(InvalidProblem, match="give both or neither"):
        _start(run, dynamics, TrackOptions(start="1,2,3,4"))
