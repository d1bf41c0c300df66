"""Seconds of GPS time and TAI are right by UTC on both sides of each leap second."""

from datetime import UTC, datetime
from importlib.resources import files

import numpy as np
import pytest

from optloc.base.time_scales import tai_minus_utc, unix_seconds


def unix(*date):
    return datetime(*date, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("gps", "date"),
    [
        (0.0, (1980, 1, 6)),
        (1_000_000_000.0, (2011, 9, 14, 1, 46, 25)),  # published by the US Naval Observatory: 15 s ahead of UTC
        (1_167_264_016.0, (2016, 12, 31, 23, 59, 59)),
        (1_167_264_018.0, (2017, 1, 1)),
        (1_400_000_000.0, (2024, 5, 17, 16, 53, 2)),
    ],
)
def test_gps_seconds_are_known_dates(gps, date):
    assert unix_seconds(np.array([gps]), "gps")[0] == unix(*date)


@pytest.mark.parametrize(
    ("date", "ahead"),
    [((1972, 1, 2), 10), ((1980, 1, 6), 19), ((1999, 1, 1), 32), ((2016, 12, 31), 36), ((2026, 1, 1), 37)],
)
def test_tai_is_ahead_of_utc_as_published(date, ahead):
    seconds = np.array([unix(*date)])
    assert tai_minus_utc(seconds)[0] == ahead
    assert unix_seconds(seconds + ahead, "tai")[0] == seconds[0]


def test_a_leap_second_has_the_number_of_the_next_second():
    before = unix(2016, 12, 31, 23, 59, 59) + 36.0
    assert np.diff(unix_seconds(before + np.array([0.0, 1.0, 2.0, 3.0]), "tai")).tolist() == [1.0, 0.0, 1.0]


def test_other_scales_are_unchanged_and_fractions_are_kept():
    seconds = np.array([1.75, 1.4e9 + 0.25])
    assert unix_seconds(seconds, "none") is seconds
    assert unix_seconds(seconds, "unix") is unix_seconds(seconds, "utc") is seconds
    assert unix_seconds(seconds, "gps")[1] % 1.0 == 0.25


def test_the_table_is_the_list_of_the_time_zone_database():
    package = pytest.importorskip("tzdata")
    lines = (files(package) / "zoneinfo" / "leapseconds").read_text().splitlines()
    days = [line.split()[1:4] for line in lines if line.startswith("Leap")]
    after = np.array([datetime.strptime(" ".join(day), "%Y %b %d").replace(tzinfo=UTC).timestamp() for day in days])
    after += 86400.0
    assert tai_minus_utc(after).tolist() == (11.0 + np.arange(len(days))).tolist()
    assert tai_minus_utc(after - 1.0).tolist() == (10.0 + np.arange(len(days))).tolist()
    assert tai_minus_utc(np.array([unix(2100, 1, 1)]))[0] == 10 + len(days)
