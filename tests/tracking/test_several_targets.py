"""Several targets: channels of rows without names, the run of one target, and tracks that each take their own rows."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured
from optloc.problem.noise import dense
from optloc.tracking import State, polynomial
from optloc.tracking.associate import nearest
from optloc.tracking.several_targets import alone, associated, candidates, channels_of

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0]])
TARGETS = np.array([[300.0, 400.0], [-500.0, 200.0]])
RATES = np.array([[5.0, 0.0], [0.0, 5.0]])


def run(k=3):
    """Return scans of both targets by all stations, the rows of each channel in turned order at odd scans."""
    z, a, epoch = [], [], []
    for t in range(k):
        for station in range(3):
            both = np.linalg.norm(TARGETS + t * RATES - PLACES[station], axis=-1)
            z += both.tolist()[:: 1 if t % 2 == 0 else -1]
            a += [station] * 2
            epoch += [t] * 2
    rows = measured("range", z, a=a, epoch=epoch, sigma=1.0, target=-1)
    return assemble(PLACES, rows, motions=(Motion(1, "run"),), times=np.arange(float(k)))


def test_rows_of_one_station_and_epoch_are_one_channel():
    problem = run(2)
    first, members = channels_of(problem)
    assert first.tolist() == [0, 2, 4, 6, 8, 10]
    assert [rows.tolist() for rows in members] == [[i, i + 1] for i in range(0, 12, 2)]
    given = candidates(problem)
    assert np.array_equal(given.z, problem.z.reshape(6, 2))
    absent = candidates(problem.with_rows(weight=np.r_[0.0, np.ones(11)]))
    assert np.isnan(absent.z).tolist() == [[True, False], *[[False, False]] * 5]


def test_each_target_takes_its_own_rows():
    mean = np.concatenate([TARGETS, RATES], axis=-1)
    start = State(-1.0, mean - np.concatenate([RATES, 0.0 * RATES], axis=-1), np.tile(np.eye(4) * 4.0, (2, 1, 1)))
    found = associated(candidates(run()), start, polynomial(1, 0.1), nearest())
    assert found.track.position[:, -1] == pytest.approx(TARGETS + 2.0 * RATES, abs=1.0)
    for t, pick in enumerate(found.picks):
        assert pick.tolist() == ([[0, 0, 0], [1, 1, 1]] if t % 2 == 0 else [[1, 1, 1], [0, 0, 0]])
    with pytest.raises(InvalidProblem, match="no axis of targets"):
        associated(candidates(run()), State(-1.0, mean[0], np.eye(4)), polynomial(1), nearest())


def test_the_run_of_one_target_has_the_covariance_of_its_rows():
    rows = measured("tdoa", [1.0, 2.0, 3.0, 4.0], a=[1, 2, 1, 2], b=0, epoch=[0, 0, 1, 1], arrival_sigma=2.0)
    problem = assemble(PLACES, rows, times=[5.0, 7.0])
    kept = np.array([False, True, True, True])
    found = alone(problem, kept)
    assert found.z.tolist() == [2.0, 3.0, 4.0]
    assert found.times.tolist() == [5.0, 7.0]
    expected = dense(problem.noise, np.arange(4))[np.ix_(kept, kept)]
    assert dense(found.noise, np.arange(3)) == pytest.approx(expected)
    with pytest.raises(InvalidProblem, match="no rows"):
        alone(problem, np.zeros(4, dtype=bool))
