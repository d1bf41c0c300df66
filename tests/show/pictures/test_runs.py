"""Curves of errors and estimates: lines hold the numbers that they are given, and limits hold the last estimates."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.show.pictures.runs import _limit_to_estimates, plot_accuracy, plot_biases

NOISE = np.array([0.1, 1.0, 10.0])


def test_errors_and_bound_are_drawn_over_the_noise():
    (panel,) = plot_accuracy(NOISE, {"gtrs": 2.0 * NOISE}, NOISE, unit="m").axes
    lines = {line.get_label(): line.get_xydata() for line in panel.lines}
    assert np.array_equal(lines["gtrs"], np.column_stack([NOISE, 2.0 * NOISE]))
    assert np.array_equal(lines["Cramer-Rao bound"], np.column_stack([NOISE, NOISE]))
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")


@pytest.mark.parametrize(
    ("noise", "errors", "words"), [(NOISE, NOISE[:2], "gtrs has 2 values for 3"), (NOISE - 0.1, NOISE, "not positive")]
)
def test_numbers_that_are_no_curve_are_refused(noise, errors, words):
    with pytest.raises(InvalidProblem, match=words):
        plot_accuracy(noise, {"gtrs": errors}, NOISE)


def test_the_axis_holds_the_last_estimates_and_their_early_errors():
    limits = []
    panel = SimpleNamespace(set_ylim=lambda *both: limits.append(both))
    _limit_to_estimates(panel, np.array([[900.0], [3.0], [2.0], [np.nan]]), np.array([[100.0], [1.0], [0.5], [np.nan]]))
    assert limits == [(2.0 - 8.0, 2.0 + 8.0)]


def test_a_run_without_biases_has_no_picture_of_them():
    slot = SimpleNamespace(name="position", members=())
    found = SimpleNamespace(layout=SimpleNamespace(shared=(slot,)))
    with pytest.raises(InvalidProblem, match="no biases to draw") as refused:
        plot_biases(found)
    assert refused.value.advice == "choose from position"


def test_biases_are_in_the_unit_of_the_file_with_their_final_value():
    slot = SimpleNamespace(name="clock", members=("R2",), entries=("R2",), unit="m")
    sigma = np.array([[9.0], [0.6], [np.nan]])
    values = np.array([[3.0], [30.0], [np.nan]])
    layout = SimpleNamespace(shared=(slot,))
    found = SimpleNamespace(layout=layout, times=np.arange(3.0), dated=False, take=lambda name: (values, sigma))
    (panel,) = plot_biases(found, units={"clock": ("ns", 0.3)}, truth={"clock": np.array([27.0])}).axes
    assert panel.get_ylabel() == "estimate with 95 % interval (ns)"
    assert panel.get_legend().get_texts()[0].get_text() == "R2: 100.0 ± 2.0 ns"
    assert panel.lines[0].get_ydata()[:2] == pytest.approx([10.0, 100.0])
    assert panel.lines[1].get_ydata() == pytest.approx([90.0, 90.0])
    (plain,) = plot_biases(found).axes
    assert plain.get_legend().get_texts()[0].get_text() == "R2: 30.00 ± 0.60 m"
