"""Tables of the paper `angles`: errors of a curve and of its phases, and numbers in cells."""

from dataclasses import replace

import numpy as np
import pytest

from optloc.lab.papers.angles import STRAIGHT
from optloc.lab.papers.angles_tables import SETTLED, ErrorCurve, short, table_clamps, table_starts


def test_numbers_in_cells():
    values = (0.0, 0.01234, 6.0e-4, 5.4321, 1285.7, 2e6, np.nan)
    assert [short(v) for v in values] == ["0", "0.0123", "6.00e-04", "5.43", "1286", "lost", "lost"]


def test_the_error_of_a_curve_is_the_root_mean_square_of_its_seconds():
    seconds = np.arange(1.0, 5.0)
    curve = ErrorCurve("", seconds, np.column_stack([seconds, 2.0 * seconds, np.zeros(4)]))
    assert curve.total() == pytest.approx(np.sqrt([7.5, 30.0, 0.0]))
    assert curve.total(2, 3) == pytest.approx([3.0, 6.0, 0.0])  # the third second alone


def test_the_first_phase_is_scored_once_the_filter_has_settled():
    seconds = np.arange(1.0, 61.0)
    error = np.where(seconds <= SETTLED, 1e3, np.where(seconds <= 40, 2.0, 5.0))
    curve = ErrorCurve("", seconds, np.stack([error] * 3, axis=-1))
    assert curve.phases(replace(STRAIGHT, phases=(40, 60))) == pytest.approx([2.0, 5.0])


def test_shares_of_lost_tracks_are_in_per_cent():
    shares = {"ekf": 0.25, "iekf": 0.0, "mgekf": 1.0, "mvekf": 0.125}
    assert table_starts({(0.0, 30.0): shares}).rows == (("fit of 3 s", "30", "25.0 %", "0.0 %", "100.0 %", "12.5 %"),)
    assert table_clamps({"clamped": 0.5}).cell("clamped", "lost") == "50.0 %"
