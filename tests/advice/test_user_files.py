"""The advice on problems that users had: counters that run backwards, a drive with bearings, squares of receivers."""

import numpy as np
import pytest
from advice.marks import NO_CAUSE, causes
from advice.tables import fixed

import optloc
from optloc.advice import advise

COUNTERS = """format = 2
propagation_speed = 343.0
[stations]
unit = "mm"
rows = [{name="S0",x=0.0,y=112.5},{name="S1",x=112.5,y=0.0},{name="S2",x=0.0,y=-112.5},{name="S3",x=-112.5,y=0.0}]
[[measurements]]
kind = "toa"
unit = "us"
sigma = 0.3
rows = [
"""
# Arrivals of three shots after the last microphone, microseconds. Counters that count down have the opposite sign.
SHOTS = ((0.0, -145.48, -200.49, -33.89), (-35.39, -5.87, 0.0, -29.09), (None, -306.14, -9.39, 0.0))
# Degrees from north of an emitter at 47.836, 11.214, from points on two roads, each to 2 degrees.
ROAD = [(47.80 + 0.01 * i, 11.15) for i in range(5)] + [(47.84, 11.17), (47.84, 11.19), (47.84, 11.21)]
BEARINGS = (50.7, 60.5, 70.2, 79.4, 97.1, 98.6, 102.9, 147.3)
# The same in the plane, m.
FIELD = [(0.0, 1e3 * i) for i in range(5)] + [(1e3 * i, 4e3) for i in range(1, 5)]
FIELD_BEARINGS = (39.4, 46.6, 53.8, 60.8, 77.8, 72.5, 62.4, 46.2, 0.7)
TURNED = {"opposite": lambda bearing: (bearing + 180.0) % 360.0, "anticlockwise": lambda bearing: -bearing % 360.0}


def counters(folder, sign):
    rows = [
        f'{{a="S{i}",epoch={shot},z={sign * value}}},'
        for shot, values in enumerate(SHOTS)
        for i, value in enumerate(values)
        if value is not None
    ]
    file = folder / "counters.toml"
    file.write_text(COUNTERS + "\n".join(rows) + "\n]\n", encoding="utf-8")
    return optloc.load(file)


def drive(folder, cause, heads, places, bearings):
    """Return the causes that the command prints for a table of bearings."""
    lines = [",".join(["point", *heads, "bearing_deg"])]
    lines += [
        f"S{i},{p[0]},{p[1]},{TURNED[cause](z):.1f}" for i, (p, z) in enumerate(zip(places, bearings, strict=True))
    ]
    file = folder / "drive.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = fixed([str(file), "--sigma", "2 deg"])["advice"]
    return [one["cause"] for one in found if one["cause"] not in NO_CAUSE]


def test_counters_that_count_down_have_the_opposite_sign(tmp_path):
    problem = counters(tmp_path, -1.0)
    assert [cause for cause, _ in causes(advise(problem, optloc.solve(problem)))][:1] == ["sign"]


def test_counters_that_count_up_have_no_cause(tmp_path):
    problem = counters(tmp_path, 1.0)
    assert causes(advise(problem, optloc.solve(problem))) == []


@pytest.mark.parametrize("cause", TURNED)
def test_bearings_of_a_drive_on_earth_are_turned(cause, tmp_path):
    """Half a turn leads to the other side of the Earth, which no signal reaches."""
    assert drive(tmp_path, cause, ("lat", "lon"), ROAD, BEARINGS) == [cause]


@pytest.mark.parametrize("cause", TURNED)
def test_bearings_in_a_field_are_turned(cause, tmp_path):
    assert drive(tmp_path, cause, ("x_m", "y_m"), FIELD, FIELD_BEARINGS)[:1] == [cause]


@pytest.mark.parametrize("sigma", [0.01, 0.3, 3.0])
def test_a_square_of_receivers_is_no_line(sigma):
    square = 10.0 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    problem = optloc.assemble(square, optloc.measured("tdoa", a=[1, 2, 3], b=0, arrival_sigma=sigma))
    problem = optloc.simulate(problem, np.array([3.0, 5.0]), 1)
    assert {one.cause for one in advise(problem, optloc.solve(problem))} & {"line", "plane", "mirror"} == set()


@pytest.mark.parametrize("seed", [1, 2, 16, 37])
def test_a_far_target_has_no_cause(seed):
    """Differences of ranges give a direction; with the opposite sign the same values would give a position."""
    rng = np.random.default_rng([7, seed])
    stations = rng.uniform(-1e3, 1e3, (6, 3))
    target = rng.normal(size=3)
    target *= rng.uniform(2e4, 2e6) / np.sqrt((target**2).sum())
    rows = optloc.measured("tdoa", a=np.arange(1, 6), b=[0] * 5, arrival_sigma=3.0)
    problem = optloc.simulate(optloc.assemble(stations, rows), truth=target, seed=seed)
    assert causes(advise(problem, optloc.solve(problem))) == []
