"""Biases as states: constants do not move, starts find them, and drifts are refused."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, assemble, measured, with_bias
from optloc.tracking import polynomial
from optloc.tracking.constants import _with_constants, begun_with_constants, followed_with_constants

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0], [400.0, -300.0]])
START, RATE, OFFSET = np.array([300.0, 400.0]), np.array([5.0, -3.0]), 25.0


def run(k, form="offset"):
    times = np.arange(float(k))
    place = START + times[:, None] * RATE
    z = np.linalg.norm(place[:, None] - PLACES, axis=-1) + OFFSET
    rows = measured("range", z.ravel(), a=np.tile(np.arange(5), k), epoch=np.repeat(np.arange(k), 5), sigma=2.0)
    return with_bias(assemble(PLACES, rows, motions=(Motion(1, "run"),), times=times), "clock", form=form, per="kind")


def test_constants_stay_and_get_no_noise():
    moving = polynomial(1, 2.0)
    F, Q, drive = _with_constants(moving, 2).step(3.0, np.arange(6.0), 2)
    own, noise, _ = moving.step(3.0, np.arange(4.0), 2)
    assert np.array_equal(F, np.block([[own, np.zeros((4, 2))], [np.zeros((2, 4)), np.eye(2)]]))
    assert np.array_equal(Q[:4, :4], noise)
    assert not Q[4:].any()
    assert drive.shape == (6,)


def test_exact_measurements_give_the_offset_from_the_first_scans_on():
    start = begun_with_constants(run(8), polynomial(1), 4)
    assert (start.time, start.mean) == (3.0, pytest.approx([*(START + 3.0 * RATE), *RATE, OFFSET], abs=1e-5))
    track = followed_with_constants(run(8), start, polynomial(1, 0.1))
    assert track.times.tolist() == [4.0, 5.0, 6.0, 7.0]
    assert track.mean[-1] == pytest.approx([*(START + 7.0 * RATE), *RATE, OFFSET], abs=1e-3)
    # What is constant is known better after each scan.
    assert (np.diff(track.cov[:, 4, 4]) < 0.0).all()


def test_what_changes_in_time_is_no_constant():
    with pytest.raises(InvalidProblem, match="'clock' changes with time"):
        begun_with_constants(run(8, "drift"), polynomial(1), 4)
