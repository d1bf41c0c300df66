"""Tables of the paper `registration`: cells, accuracies of biases, and how flat and close stations are."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc.lab.papers.registration import RegistrationScore
from optloc.lab.papers.registration_tables import (
    _chance,
    _mean_accuracy,
    _single_accuracy,
    accuracy,
    flatness,
    metres,
    separation,
)


def test_accuracies_and_cells():
    assert accuracy(np.array([0.5, -20.0]), np.array([-10.0, 10.0])) == pytest.approx([95.0, 0.0])
    assert [metres(v) for v in (0.1462, 40.2826, 25262.08, 0.0, np.nan)] == ["0.1462", "40.28", "25262", "0", "–"]


def test_a_mean_error_and_the_error_of_one_run_leave_out_lost_trials():
    error = np.array([[0.0, 1.0], [0.0, -3.0], [0.0, 1e9]])
    score = RegistrationScore(error, np.array([False, False, True]))
    exact = np.array([0.0, 10.0])
    assert _mean_accuracy(score, 1, exact) == pytest.approx([90.0])  # of -1
    assert _single_accuracy(score, 1, exact) == pytest.approx([100.0 - 10.0 * np.sqrt(5.0)])  # of the root of 5
    assert _mean_accuracy(RegistrationScore(error, np.ones(3, dtype=bool)), 1, exact).size == 0


def test_stations_one_metre_off_a_plane_are_flat_by_a_metre():
    square = np.array([[9.0, 9, 1], [-9, 9, -1], [-9, -9, 1], [9, -9, -1]])
    run = SimpleNamespace(track=lambda epochs: np.stack([square * (1.0, 1.0, 1.0 + k) for k in range(epochs)]))
    assert flatness(run, 3) == pytest.approx(1.0)
    assert separation(run, 1) == pytest.approx(np.hypot(18.0, 2.0))


def test_chances_are_not_told_below_one_in_a_thousand_million():
    assert [_chance(share) for share in (0.0312, 1e-9, 1e-12)] == ["0.031", "1e-09", "< 1e-9"]
