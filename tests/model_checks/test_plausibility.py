"""Physical checks before a fix: each finds its mistake, and none accuses correct data."""

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.model_checks.plausibility import (
    CHECKS,
    OPTIONS,
    least_values,
    refuse_impossible,
    suspicious_values,
    wrapped_times,
)

ANCHORS = np.array([(0.0, 0.0, 2.5), (8.0, 0.0, 0.5), (8.0, 6.0, 2.6), (0.0, 6.0, 1.8), (4.0, 3.0, 3.0)])
TAG = np.array([2.5, 4.1, 1.2])
NANOSECOND = 1e-9 * SPEED_OF_LIGHT
LONGEST = 200


def ranges(stations=ANCHORS, tag=TAG):
    return np.sqrt(((stations - tag) ** 2).sum(-1)) + 0.02 * np.array([1, -1, 0.5, -0.3, 0.2])[: len(stations)]


def problem(z, stations=ANCHORS, kind="range", sigma=0.03, **more):
    rows = optloc.measured(kind, z, a=np.arange(np.shape(z)[-1]), sigma=sigma)
    return optloc.assemble(stations, rows, **more)


def causes(given, surface="table", **more):
    found = suspicious_values(given, surface, **more)
    assert all(len(f"Warning: {one.seen}; {one.advice}.") <= LONGEST for one in found)
    return [one.cause for one in found]


def test_correct_ranges_and_arrivals_are_not_suspicious():
    assert causes(problem(ranges())) == []
    assert causes(problem(ranges() + 1e6, kind="toa"), units={"toa": NANOSECOND}) == []
    flat = ANCHORS[:, :2]
    assert causes(problem(ranges(flat, TAG[:2]), flat)) == []
    away = ANCHORS * 0.02  # a small array and a target 200 times its size away
    assert causes(problem(np.linalg.norm(away - [30.0, 5.0, 2.0], axis=1), away, sigma=1e-3)) == []


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(100.0, "--unit cm"), (1000.0, "--unit mm"), (1e-3, "--unit km"), (0.01, "100 times too small")],
)
@pytest.mark.parametrize("sigma", [0.03, None], ids=["in metres", "in the wrong unit"])
def test_a_wrong_unit_of_ranges_is_named(factor, unit, sigma):
    (found,) = suspicious_values(problem(factor * ranges(), sigma=sigma or 0.03 * factor), "table")
    assert found.cause == "size"
    assert unit in f"{found.seen}; {found.advice}"


def test_centimetres_of_a_tag_in_the_middle_contradict_no_triangle_but_fit_no_position():
    middle = np.linalg.norm(ANCHORS[:5] - [4.0, 3.0, 1.0], axis=1)
    assert causes(problem(100.0 * middle)) == ["size"]


def test_a_wrong_unit_of_arrivals_and_differences_is_reported_without_an_example():
    (found,) = suspicious_values(problem(1000.0 * ranges(), kind="toa"))
    assert found.cause == "size"
    assert "cm" not in found.advice
    pairs = optloc.measured("tdoa", 1000.0 * (ranges()[1:] - ranges()[0]), a=[1, 2, 3, 4], b=0, sigma=0.03)
    assert causes(optloc.assemble(ANCHORS, pairs)) == ["size"]


def test_an_outlier_or_a_bias_is_no_wrong_unit():
    late = ranges() + np.array([0.0, 0.0, 40.0, 0.0, 0.0])
    assert causes(problem(late)) == []
    rows = optloc.measured("range", 100.0 * ranges(), a=np.arange(5), sigma=0.03)
    scale = optloc.problem.Bias("scale", ("all",), np.arange(5), np.zeros(5, dtype=int), np.ones(5), "scale")
    assert causes(optloc.assemble(ANCHORS, rows, biases=[scale])) == []


def test_slant_ranges_in_the_plane_name_the_height():
    flat = ANCHORS[:, :2]
    slant = np.sqrt(((flat - TAG[:2]) ** 2).sum(-1) + 2.0**2)
    (found,) = suspicious_values(problem(slant, flat), "python")
    assert found.cause == "slant"
    assert "target 2 m above or below" in found.seen
    assert "height=" in found.advice


def test_a_range_shorter_than_the_difference_of_heights_is_reported():
    high = ANCHORS + np.array([0.0, 0.0, 30.0])
    level = optloc.constraints.box([-np.inf, -np.inf, 0.0], [np.inf, np.inf, 0.0])
    (found,) = suspicious_values(problem(ranges() + 25.0, high, constraints=level), "table")
    assert found.cause == "height"
    assert "its height differs by" in found.seen
    assert "--height" in found.advice
    assert causes(problem(ranges(high, TAG * [1, 1, 0]), high, constraints=level)) == []


@pytest.mark.parametrize(
    ("period", "name"),
    [(2.0**16 * NANOSECOND, "2^16 counts"), (86400.0 * SPEED_OF_LIGHT, "a day")],
    ids=["bits", "day"],
)
def test_a_counter_that_wraps_is_named(period, name):
    wrapped = ranges() + np.array([0.0, -period, 0.0, 0.0, -period])
    (found,) = suspicious_values(problem(wrapped, kind="toa"), units={"toa": NANOSECOND})
    assert found.cause == "wrap"
    assert name in found.seen


def test_every_check_has_a_name_and_every_surface_its_options():
    assert [check.name for check in CHECKS] == ["size", "slant", "height", "wrap"]
    assert {"table", "file", "python", "live"} == OPTIONS.keys()


@pytest.mark.parametrize("kind", ["range", "range_sum"])
def test_negative_ranges_are_refused_and_negative_noise_is_not(kind):
    second = {"b": 1} if kind == "range_sum" else {}

    def made(first):
        z = np.array([5.0, first])
        return optloc.assemble(ANCHORS, optloc.measured(kind, z, a=[0, 2], sigma=0.05, **second))

    refuse_impossible(made(-0.1), lambda i: f"row {i}", "table")
    with pytest.raises(InvalidProblem, match=r"row 1: the range.* at S2 is -3 m") as info:
        refuse_impossible(made(-3.0), lambda i: f"row {i}", "table")
    assert "--missing=-3" in str(info.value)
    assert len(str(info.value)) <= LONGEST


def test_least_values_are_limits_of_ranges_alone():
    rows = [optloc.measured(kind, [1.0], a=0, b=1, sigma=0.5) for kind in ("range", "tdoa", "toa", "range_sum")]
    assert least_values(optloc.assemble(ANCHORS, *rows)).tolist() == [-3.0, -np.inf, -np.inf, -3.0]


def test_a_batch_and_a_moving_station_are_checked_too():
    z = np.stack([ranges(), ranges() + 1e-3])
    assert causes(problem(z)) == []
    assert causes(problem(100.0 * z)) == ["size"]
    moving = optloc.problem.station_array(np.stack([ANCHORS, ANCHORS + 1.0]))
    rows = [optloc.measured("range", 100.0 * ranges(ANCHORS + k), a=np.arange(5), sigma=0.1, epoch=k) for k in (0, 1)]
    assert causes(optloc.assemble(moving, *rows)) == ["size"]


def test_times_of_a_table_that_start_again_name_their_period():
    week = np.array([604797.0, 604798.0, 604799.0, 0.0, 1.0])
    assert wrapped_times(week) == "a week"
    assert wrapped_times(np.arange(5.0)) is None
    assert wrapped_times(np.array([0.0, 1.0, 2.0, 0.0, 1.0])) is None  # one target after the other
    assert wrapped_times(np.array([5.0, 4.0, 3.0])) is None  # a log with the newest row first
