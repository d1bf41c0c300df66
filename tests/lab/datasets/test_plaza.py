"""Ranges of a mower from small tables: the motion within a window is taken out, and calibrations undo what they fit."""

import numpy as np
import pytest

from optloc.lab.datasets.plaza import SIGMA, _calibrate, load

BEACONS = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]])


@pytest.fixture
def folder(tmp_path):
    """Return a set of exact ranges to a mower at 1 m/s; the third beacon falls silent after five seconds."""
    lines = [f"{b},{x},{y}" for b, (x, y) in enumerate(BEACONS, 1)]
    (tmp_path / "stations.csv").write_text("beacon,x_m,y_m\n" + "\n".join(lines))
    times = np.arange(0.0, 12.0, 0.1)
    lines = [f"{t},{5.0 + t},8.0,0.0" for t in times]
    (tmp_path / "truth.csv").write_text("t_s,x_m,y_m,heading_rad\n" + "\n".join(lines))
    lines = [
        f"{t},{b},{np.hypot(5.0 + t - x, 8.0 - y)}"
        for t in times
        for b, (x, y) in enumerate(BEACONS, 1)
        if b < 3 or t < 5.0
    ]
    (tmp_path / "ranges.csv").write_text("t_s,beacon,range_m\n" + "\n".join(lines))
    return tmp_path


def test_rows_of_a_window_are_ranges_to_its_centre(folder):
    data = load(folder, "raw")
    assert data.problem.times.tolist() == [2.0, 5.0]  # of two beacons alone no window is kept
    for window in data.windows:
        np.testing.assert_allclose(window.z, np.linalg.norm(window.truth - BEACONS[window.a], axis=1), atol=1e-9)
        np.testing.assert_array_equal(window.covariance, SIGMA["raw"] ** 2 * np.eye(len(window.z)))
    assert data.truth == pytest.approx(np.array([[7.0, 8.0], [10.0, 8.0]]))


def test_a_calibration_undoes_the_errors_of_each_beacon():
    distance, a = np.array([10.0, 20.0, 50.0, 12.0, 30.0, 44.0]), np.repeat([0, 1], 3)
    scaled = 1.07 * distance + np.where(a == 0, 0.5, -2.0)
    np.testing.assert_allclose(_calibrate("affine", scaled, distance, a), distance, rtol=1e-12)
    shifted = distance + np.where(a == 0, 0.5, -2.0)
    np.testing.assert_allclose(_calibrate("offset", shifted, distance, a), distance, rtol=1e-12)
    assert _calibrate("raw", scaled, distance, a) is scaled
