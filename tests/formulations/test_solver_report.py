"""Reports of back ends: the worst of three numbers, and the gap of two objectives."""

import dataclasses

import numpy as np
import pytest

from formulations.solver_report import SolverReport, relative_gap


def test_a_report_is_frozen_and_unknown_numbers_are_nan():
    report = SolverReport("X", "odd")
    assert np.isnan([report.primal_residual, report.dual_residual, report.gap, report.seconds, report.worst]).all()
    assert (report.iterations, report.message, report.outcome) == (0, "", "failed")
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.status = "solved"


def test_the_worst_number_and_the_text():
    report = SolverReport("X", "solved", 1e-9, 3e-7, 1e-8, 5, 0.1, "", "solved")
    assert report.worst == 3e-7
    assert str(report) == "X: solved"
    assert str(dataclasses.replace(report, message="it stopped")) == "X: it stopped"


@pytest.mark.parametrize(
    ("primal", "dual", "gap"), [(2.0, 1.0, 1.0), (200.0, 100.0, 1.0), (1e-3, 0.0, 1e-3), (-4.0, -2.0, 1.0)]
)
def test_the_gap_is_relative_to_the_smaller_objective_above_one(primal, dual, gap):
    assert relative_gap(primal, dual) == relative_gap(dual, primal) == gap
