"""Tracks in one axes: the plan, and quantities against times or dates."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.show.pictures.track_axes import track_axes
from optloc.tracking.track import Track


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def moving(start=0.0, batch=()):
    k = 5
    mean = np.zeros((*batch, k, 4))
    mean[..., 0] = 10.0 * np.arange(k)
    mean[..., 0, :] = np.nan
    cov = np.broadcast_to(4.0 * np.eye(4), (*batch, k, 4, 4))
    shape = (*batch, k)
    zeros = np.zeros(shape)
    code = np.zeros(shape, dtype=int)
    return Track(start + np.arange(k), mean, cov, zeros + 3.0, code + 4, zeros, code, 2, start > 0.0)


def test_the_plan_starts_at_the_first_known_state():
    axes = moving().plot()
    (start,) = [one for one in axes.collections if one.get_label() == "start, from a fix"]
    assert start.get_offsets().tolist() == [[10.0, 0.0]]
    assert axes.get_xlabel() == "x (m)"


def test_a_quantity_is_drawn_against_dates():
    axes = moving(1.78e9).plot(what="sigma", title="drive")
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("time (UTC)", "sigma (m)", "drive")
    assert axes.lines[0].get_ydata() == pytest.approx(np.full(5, np.sqrt(8.0)))
    assert moving().plot(what="nis").get_xlabel() == "time (s)"


def test_a_batch_has_a_line_for_each_target():
    assert {"target 1", "target 2"} <= set(track_axes(moving(batch=(2,))).get_legend_handles_labels()[1])


def test_unknown_pictures_are_refused():
    with pytest.raises(InvalidProblem, match="no picture 'height'"):
        moving().plot(what="height")
