"""All checks of a fix at once."""

import numpy as np
import pytest

import optloc
from optloc.problem import by_epoch

RING = 1e3 * np.array([[0.0, 0], [10, 0], [0, 10], [9, 9], [5, 12], [-3, 6]])


def ranges(count=1, wrong=0.0, stations=RING, sigma=2.0):
    """Return ranges of epochs of one target, the first station wrong."""
    m = len(stations)
    rows = optloc.measured("range", a=np.tile(np.arange(m), count), epoch=np.repeat(np.arange(count), m), sigma=sigma)
    motion = optloc.Motion(0, span="run" if count == 1 else "epoch")
    run = optloc.simulate(optloc.assemble(stations, rows, motions=(motion,)), at(count), seed=3)
    return run.with_rows(z=run.z + np.where(np.concatenate([one.a for one in run.rows]) == 0, wrong, 0.0))


def at(count):
    return np.array([4e3, 5e3]) if count == 1 else np.random.default_rng(5).uniform(0.0, 9e3, 2 * count)


def test_a_clean_fix_has_no_advice_and_every_station_is_checked():
    problem = ranges()
    found = optloc.diagnose(problem, optloc.solve(problem))
    assert found.status == ("ok",)
    assert found.advice == ()
    assert found.observability.rank == 2
    assert np.isfinite(found.reliability.least).all()
    assert found.health is None
    assert str(found) == "status ok"


def test_an_unchecked_fix_says_that_no_row_checks_the_stations():
    problem = ranges(stations=RING[:2])
    found = optloc.diagnose(problem, optloc.solve(problem))
    assert {one.cause for one in found.advice} & {"redundancy", "line", "mirror"}
    assert "no other measurement checks" in str(found)


def test_many_epochs_name_the_station_with_an_offset():
    problem = by_epoch(ranges(count=40, wrong=30.0))
    fix = optloc.solve(problem)
    found = optloc.diagnose(problem, fix)
    assert sum(int(text.partition(": ")[2] or 40) for text in found.status) == 40
    assert found.observability is None
    bias, error = found.health.bias, found.health.bias_error
    assert np.argmax(np.abs(bias / error)) == 0
    assert bias[0] - bias[1:].mean() == pytest.approx(30.0, abs=3.0)


def test_fixes_of_another_batch_are_refused():
    problem = by_epoch(ranges(count=12))
    fix = optloc.solve(problem)
    with pytest.raises(optloc.InvalidProblem, match=r"fixes of shape \(3,\) for problems of shape \(12,\)"):
        optloc.diagnose(problem, fix[:3])
