"""Pictures of networks: plan and elevation, ellipses of the covariance, and gross residuals in the last bars."""

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from optloc.sites.calibration.network_map import plot_network

STATIONS = np.array([[0.0, 0.0, 1.0], [8.0, 0.0, 2.0], [0.0, 6.0, 3.0]])


def drawn(d, others=(), residuals=(0.0,)):
    covariance = np.kron(np.eye(3), np.diag([4.0, 1.0, 0.25][:d]))
    known = np.full((3, d), np.nan)
    given = (STATIONS[:, :d], covariance, STATIONS[:, :d] + 1.0, known, others, np.array(residuals))
    return plot_network(("A", "B", "C"), *given, dof=4, title="a_b $x$")


def test_a_network_in_space_has_an_elevation_as_well():
    labels = [[(axes.get_xlabel(), axes.get_ylabel()) for axes in drawn(d).axes] for d in (2, 3)]
    assert [len(views) for views in labels] == [2, 3]
    assert labels[1][:2] == [("x (m)", "y (m)"), ("x (m)", "z (m)")]


def test_ellipses_hold_95_per_cent():
    plan = drawn(3).axes[0]
    first = next(line for line in plan.get_lines() if len(line.get_xdata()) == 60).get_xydata()
    radius = np.sqrt((first - STATIONS[0, :2]) ** 2 @ (1.0 / np.array([4.0, 1.0])))
    assert radius == pytest.approx(np.sqrt(-2.0 * np.log(0.05)))


def test_other_networks_are_linked_to_the_stations():
    lines = [len(axes.get_lines()) for axes in (drawn(2).axes[0], drawn(2, [STATIONS[:, :2] + 0.5]).axes[0])]
    assert lines[1] - lines[0] == 4  # three links, and the stations of the other network


def test_residuals_beyond_five_deviations_are_told():
    quiet, gross = (drawn(2, residuals=r).axes[-1].get_title() for r in ((0.1, -1.0), (0.1, -7.0, 90.0)))
    assert quiet == "residuals"
    assert gross == "residuals; 2 beyond 5 in the last bars"
