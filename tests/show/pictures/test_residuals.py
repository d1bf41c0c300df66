"""Pictures of residuals: the points are the residuals, by station, and those beyond three sigma have their mark."""

import numpy as np
import pytest
from show.ranging import PLACES, ranged

from optloc import InvalidProblem
from optloc.base.records import join
from optloc.show.pictures.residuals import plot_residuals


def test_points_are_the_residuals_of_each_station():
    problem, fix = ranged()
    (panel,) = plot_residuals(problem, fix, "four ranges").axes
    expected = problem.z - np.linalg.norm(fix.position - PLACES, axis=-1)
    drawn = [one.get_offsets()[0].tolist() for one in panel.collections if one.get_label() == "residual"]
    assert [place for _, place in drawn] == [0, 1, 2, 3]
    assert [value for value, _ in drawn] == pytest.approx(expected.tolist(), abs=1e-6)
    assert [text.get_text() for text in panel.get_yticklabels()] == list(problem.stations.names)
    assert panel.get_title() == "range"


def test_a_residual_beyond_three_sigma_has_its_mark():
    problem, fix = ranged()
    wild = problem.with_rows(z=problem.z + np.array([0.0, 0.0, 20.0, 0.0]))
    (panel,) = plot_residuals(wild, fix).axes
    far = [one.get_offsets()[0].tolist() for one in panel.collections if one.get_label() == "residual beyond 3 sigma"]
    assert [place for _, place in far] == [2]


def test_fixes_of_other_problems_are_refused():
    problem, fix = ranged()
    with pytest.raises(InvalidProblem, match="2 fixes do not belong to 1 problems"):
        plot_residuals(problem, join([fix.flat(), fix.flat()], 2))
