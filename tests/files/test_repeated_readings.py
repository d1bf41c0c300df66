"""Repeated readings of a table: refused with their rows, or averaged, angles by their directions."""

from math import radians

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints

RANGES = "anchor,range_m\nA1,6\nA1,8\nA2,5\nA3,7\n"


def problem_of(folder, text, **hints):
    """Return the problem of a table of three anchors."""
    (folder / "table.csv").write_text(text)
    (folder / "anchors.csv").write_text("name,x,y\nA1,0,0\nA2,10,0\nA3,0,10\n")
    return interpret_table(folder / "table.csv", ColumnHints(folder / "anchors.csv", **hints)).read().problem


def test_a_mean_of_ranges_and_of_angles_across_north(tmp_path):
    ranges = problem_of(tmp_path, RANGES, average=True, sigma="1 m")
    assert sorted(np.ravel(ranges.z).tolist()) == [5.0, 7.0, 7.0]
    angles = problem_of(tmp_path, "anchor,bearing_deg\nA1,359\nA1,3\nA2,10\n", average=True, sigma="1 deg")
    # a compass bearing of 1 degree is 89 degrees from the x axis
    assert np.ravel(angles.z)[0] == pytest.approx(radians(89.0))


def test_a_repeat_is_refused_with_both_rows(tmp_path):
    with pytest.raises(InvalidProblem, match=r"station 'A1' has a second reading .* first in row 1") as caught:
        problem_of(tmp_path, RANGES, sigma="1 m")
    assert "--average" in str(caught.value)
