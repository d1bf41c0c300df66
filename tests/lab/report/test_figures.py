"""Figures of reports: what is drawn of rows that were made by hand, and how axes are named."""

import numpy as np
import pandas as pd
import pytest
from lab.study.rows import hand_made

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from optloc.lab.report.figures import _log, _noise_axis, accuracy, gaps, profiles, success, timing
from optloc.lab.study.profiles import Profiles
from optloc.lab.study.summary import cells
from optloc.show.drawing import marks, panel


@pytest.fixture(scope="module")
def frame():
    return hand_made()


LOOKS = marks(["a", "b"])


def lines(picture):
    return {line.get_gid(): line.get_xydata() for line in picture.figure.axes[0].get_lines() if line.get_gid()}


def test_right_answers_are_drawn_in_per_cent_with_their_interval(frame):
    (picture,) = success(cells(frame), LOOKS)
    (bars,) = picture.figure.axes[0].containers
    assert bars.lines[0].get_xdata().tolist() == [50.0, 50.0]
    (ends,) = bars.lines[2]
    assert all(0.0 < low < 50.0 < high < 100.0 for (low, _), (high, _) in ends.get_segments())


def test_errors_are_drawn_over_the_bound(frame):
    (picture,) = accuracy(cells(frame), LOOKS)
    found = lines(picture)
    assert set(found) == {"method-0", "method-1"}
    assert all(line.tolist() == [[1.0, 1.0]] for line in found.values())  # 10 m, by its logarithm


def test_a_trial_without_a_position_keeps_a_curve_below_one(frame):
    (picture,) = gaps(frame, LOOKS)
    found = lines(picture)
    assert found["method-0"][:, 1].max() == 0.75  # three of four trials
    assert found["method-1"][:, 1].max() == 1.0


def test_times_of_methods_of_one_size_stand_side_by_side(frame):
    (picture,) = timing(frame, LOOKS)
    found = lines(picture)
    assert found["method-0"][0, 0] < 5.0 < found["method-1"][0, 0]
    assert [found[name][0, 1] for name in ("method-0", "method-1")] == pytest.approx([1e-3, 2e-3])


def test_profiles_end_at_the_share_that_is_solved():
    spent, solved = np.array([[1.0, 1.0], [3.0, 4.0]]), np.array([[True, True], [True, False]])
    found = Profiles(1e-3, "processor", ("a", "b"), (), spent, solved, 2)
    data, performance = profiles(found, LOOKS)
    assert data.title == "Data profile over 2 trials"
    for picture in (data, performance):
        assert [line[-1, 1] for line in lines(picture).values()] == [1.0, 0.5]


def test_levels_that_one_number_does_not_tell_apart_stand_side_by_side():
    part = pd.DataFrame({"noise_label": ["1 m", "tdoa 1 m, azimuth 5 mrad"], "noise": [1.0, 1.0], "noise_unit": "m"})
    place, labels, name = _noise_axis(part)
    assert list(place.values()) == [0.0, 1.0]
    assert labels == ["1 m", "tdoa 1 m\nazimuth 5 mrad"]
    assert name == "standard deviation of a row"
    assert list(_noise_axis(part.assign(noise=[0.1, 10.0]))[0].values()) == [-1.0, 1.0]


def test_a_short_logarithmic_axis_has_plain_numbers():
    _, axes = panel("")
    _log(axes.yaxis, axes.set_yscale, 1.0, 8.0)
    axes.set_ylim(1.0, 8.0)
    assert axes.yaxis.get_major_formatter()(1.5) == "1.5"
    assert {1.0, 2.0, 5.0} <= set(axes.yaxis.get_majorticklocs())
