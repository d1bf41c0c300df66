"""Options of `optloc track`, and arrivals as differences whose covariance is that of their definition."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured
from optloc.cli.track import MOTIONS, Wanted, _start, differences, dynamics_of, rules
from optloc.problem.noise import dense

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0]])


@pytest.mark.parametrize("name", MOTIONS)
def test_a_model_is_made_by_its_name(name):
    made = dynamics_of(Wanted(model=name))
    assert made.order == {"static": 0, "cv": 1}.get(name, 2)


def test_unknown_models_and_rules_are_refused():
    with pytest.raises(InvalidProblem, match="unknown model 'vc'"):
        dynamics_of(Wanted(model="vc"))
    for given, where in (((0.0, None), "--gate"), ((5.0, -1.0), "--gap"), ((float("nan"), None), "--gate")):
        with pytest.raises(InvalidProblem, match="not positive") as refused:
            rules(*given)
        assert refused.value.where == where
    assert rules(9.0, 3.0, "huber").starts == "robust"


def arrivals(k):
    z = np.random.default_rng(0).normal(500.0, 100.0, 4 * k)
    rows = measured("toa", z, a=np.tile(np.arange(4), k), epoch=np.repeat(np.arange(k), 4), sigma=2.0)
    return assemble(PLACES, rows, motions=(Motion(1, "run"),), times=np.arange(float(k)))


def test_differences_of_arrivals_have_no_emission_times():
    run = arrivals(3)
    found = differences(run)
    assert run.emitting
    assert not found.emitting
    assert (found.count, [rows.kind for rows in found.rows]) == (9, ["tdoa"])
    rows, z = found.rows[0], run.z.reshape(3, 4)
    assert rows.z == pytest.approx(z[rows.epoch, rows.a] - z[rows.epoch, rows.b])
    # Two differences share the error of a station that both have, with the sign that it has in each.
    signs = np.zeros((9, 3, 4))
    np.add.at(signs, (np.arange(9), rows.epoch, rows.a), 1.0)
    np.add.at(signs, (np.arange(9), rows.epoch, rows.b), -1.0)
    flat = signs.reshape(9, -1)
    assert dense(found.noise, np.arange(9)) == pytest.approx(4.0 * flat @ flat.T)


def test_a_start_needs_a_number_for_each_part_of_the_state():
    run, dynamics = arrivals(3), dynamics_of(Wanted())
    state = _start(run, dynamics, Wanted(start="1,2,3,4", sigma="10,5"))
    assert state.mean.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert np.diagonal(state.cov).tolist() == [100.0, 100.0, 25.0, 25.0]
    assert _start(run, dynamics, Wanted()) is None
    for start, sigma, words in (("1,2", "1,1", "2 numbers for a state of 4"), ("1,2,3,4", "1", "no standard")):
        with pytest.raises(InvalidProblem, match=words):
            _start(run, dynamics, Wanted(start=start, sigma=sigma))
    with pytest.raises(InvalidProblem, match="give both or neither"):
        _start(run, dynamics, Wanted(start="1,2,3,4"))
