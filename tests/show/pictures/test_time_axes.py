"""Axes of time: times since 1970 are dates, and other times have a readable unit."""

import numpy as np
import pytest

from optloc.show.pictures.style import figure_class
from optloc.show.pictures.time_axes import time_scale

MAY = np.datetime64("2026-05-28T20:26:40").astype("datetime64[s]").astype(float)


@pytest.mark.parametrize(
    ("span", "unit", "last"), [(60.0, "s", 60.0), (600.0, "min", 10.0), (36e3, "h", 10.0), (864e3, "d", 10.0)]
)
def test_times_are_in_a_readable_unit(span, unit, last):
    times = np.array([0.0, np.nan, span])
    scale = time_scale(times)
    assert scale.unit == unit
    assert scale.values(times)[-1] == pytest.approx(last)


def test_dates_are_dates_and_clock_times():
    from matplotlib.dates import ConciseDateFormatter, num2date

    times = MAY + np.arange(60.0)
    scale = time_scale(times, dated=True)
    panel = figure_class()().subplots()
    panel.plot(scale.values(times), times)
    scale.name(panel)
    assert panel.get_xlabel() == "time (UTC)"
    assert isinstance(panel.xaxis.get_major_formatter(), ConciseDateFormatter)
    assert f"{num2date(scale.values(times)[0]):%Y-%m-%d %H:%M:%S}" == "2026-05-28 20:26:40"
    panel.figure.draw_without_rendering()
    assert "20:27" in [tick.get_text() for tick in panel.get_xticklabels()]


def test_seconds_without_a_scale_are_no_dates():
    for first in (345_600_000.0, 1.4e9):  # a time of week in milliseconds read as seconds, and GPS time of 2024
        scale = time_scale(first + np.arange(60.0))
        assert scale.unit == "s"
        assert scale.values(np.array([first]))[0] == first


def test_unknown_times_have_a_scale():
    assert time_scale(np.array([np.nan])).unit == "s"
