"""Initial states without a guess: from exact rows, from two fixes, and which positions are too vague to follow."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc import Frame, InvalidProblem, Motion, NoSolution, assemble, measured
from optloc.linear.constraints import height
from optloc.tracking import polynomial
from optloc.tracking.start import _trial_scans, begun, counts, out_of_sight, reach, two_point, with_height_rows

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0]])
START, RATE = np.array([300.0, 400.0]), np.array([5.0, -3.0])


def run(k, stations=4):
    times = np.arange(float(k))
    z = np.linalg.norm((START + times[:, None] * RATE)[:, None] - PLACES[:stations], axis=-1)
    a, epoch = np.tile(np.arange(stations), k), np.repeat(np.arange(k), stations)
    rows = measured("range", z.ravel(), a=a, epoch=epoch, sigma=2.0)
    return assemble(PLACES, rows, motions=(Motion(1, "run"),), times=times)


def test_exact_rows_of_two_scans_give_the_state_at_the_second():
    state = begun(run(6), polynomial(1))
    assert state.time == 1.0
    assert state.mean == pytest.approx([*(START + RATE), *RATE], abs=1e-4)
    with pytest.raises(NoSolution):
        begun(run(1, stations=1), polynomial(1))


def test_each_try_takes_half_more_scans_than_the_last():
    assert counts(12, 1) == [2, 3, 4, 6, 9, 12]
    assert counts(3, 0) == [1, 2, 3]
    assert counts(4, 1, speed=10.0) == [1, 2, 3, 4]
    assert counts(4, 2, speed=10.0) == [3, 4]
    assert list(_trial_scans(5.0)) == [0, 1, 2, 3, 4]
    assert list(_trial_scans(np.inf))[-3:] == [19, 28, 42]


def test_two_fixes_are_a_state_whose_velocity_has_the_errors_of_both():
    one, two = np.diag([4.0, 1.0]), np.array([[9.0, 2.0], [2.0, 5.0]])
    fixes = [SimpleNamespace(position=START + t * RATE, covariance=lambda c=c: c) for t, c in ((0.0, one), (2.0, two))]
    state = two_point(*fixes, (1.0, 3.0))
    # The state is a linear map of both positions.
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2) / 2.0, np.eye(2) / 2.0]])
    both = np.block([[one, np.zeros((2, 2))], [np.zeros((2, 2)), two]])
    assert state.mean == pytest.approx([*(START + 2.0 * RATE), *RATE])
    assert state.cov == pytest.approx(A @ both @ A.T)
    with pytest.raises(InvalidProblem, match="give the earlier fix first"):
        two_point(*fixes, (3.0, 1.0))


def test_a_position_is_out_of_sight_beyond_twice_the_spread_and_a_third_of_the_range():
    problem = run(1)
    centre = PLACES.mean(0)
    spread = reach(problem, centre)
    for sigma, away, vague in ((1.9, 0.0, False), (2.1, 0.0, True), (2.1, 7.0, False), (2.5, 7.0, True)):
        mean = centre + np.array([away * spread, 0.0])
        said = out_of_sight(problem, mean, np.diag([(sigma * spread) ** 2, 1.0]))
        assert bool(said) is vague, (sigma, away)
    assert reach(problem, centre + np.array([1e6, 0.0])) == pytest.approx(1e6)


def test_a_known_height_is_a_row_of_every_scan_with_rows():
    frame = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    places = np.pad(PLACES, ((0, 0), (0, 1)))
    rows = measured("range", a=[0, 1, 2, 3, 0, 1], epoch=[0, 0, 0, 0, 2, 2], sigma=1.0)
    held = height(500.0, 500.0)
    problem = assemble(places, rows, times=[0.0, 1.0, 2.0], frame=frame, constraints=held)
    found = with_height_rows(problem)
    assert found.constraints == ()
    assert (found.rows[-1].kind, found.rows[-1].z.tolist(), found.rows[-1].epoch.tolist()) == (
        "height",
        [500.0, 500.0],
        [0, 2],
    )
    plain = assemble(places, rows, times=[0.0, 1.0, 2.0], frame=frame)
    assert with_height_rows(plain) is plain
