"""The argument `wave_speed` of `optloc.locate`."""

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem, locate
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.wave_argument import Wave, check_times, wave_of
from optloc.models import Layers

PLACES = {"A": (0.0, 0.0), "B": (0.0, 20.0), "C": (20.0, 20.0), "D": (20.0, 0.0)}


def arrivals(speed):
    """Return times of arrival from (5, 8), seconds."""
    return {name: 1.0 + float(np.hypot(x - 5.0, y - 8.0)) / speed for name, (x, y) in PLACES.items()}


@pytest.mark.parametrize(
    ("stated", "speed"),
    [
        ("air:20C", 343.2146),
        ("air:20C,50%", 343.98689),
        ("water:8C,35,50m", 1483.304),
        ("1481 m/s", 1481.0),
        (1481.0, 1481.0),
        ("343+-5 m/s", 343.0),
        (("343 m/s", "5 m/s"), 343.0),
    ],
)
def test_every_form_gives_the_position(stated, speed):
    fix = locate(PLACES, toa=arrivals(speed), sigma="0.1 ms", wave_speed=stated)
    assert fix.position == pytest.approx([5.0, 8.0], abs=1e-3)


def test_a_profile_and_light_are_stated_by_text(tmp_path):
    path = tmp_path / "profile.csv"
    path.write_text("depth_m,speed_m_s\n0,1500\n100,1490\n")
    assert isinstance(wave_of(str(path)).medium, Layers)
    assert wave_of("light") == Wave(SPEED_OF_LIGHT)
    assert wave_of(None) == Wave(SPEED_OF_LIGHT, stated=False)


def test_the_old_name_still_works_with_a_warning():
    with pytest.warns(DeprecationWarning, match="argument speed is wave_speed now"):
        fix = locate(PLACES, toa=arrivals(343.0), sigma="0.1 ms", speed=343.0)
    assert fix.position == pytest.approx([5.0, 8.0], abs=1e-3)
    with pytest.raises(TypeError, match="give one of them"):
        locate(PLACES, toa=arrivals(343.0), sigma="0.1 ms", speed=343.0, wave_speed=343.0)


def test_a_missing_speed_is_asked_for():
    with pytest.raises(InvalidProblem, match='state the speed, such as wave_speed="air:20C"') as caught:
        locate(PLACES, toa=arrivals(343.0), sigma="0.1 ms")
    assert len(str(caught.value)) <= 200
    with pytest.raises(InvalidProblem, match="wave_speed="):
        locate(PLACES, ranges={"A": 20.0, "B": 30.0, "C": 40.0, "D": 50.0}, unit="ms", sigma="0.1 ms")
    # arrivals that are equal: only their noise shows that they are not of light
    with pytest.raises(InvalidProblem, match="wave_speed="):
        locate(PLACES, toa=dict.fromkeys(PLACES, 1.0), sigma="0.1 ms")
    check_times("toa", np.array([0.0, 3e4]), 3e4, 20.0, Wave(SPEED_OF_LIGHT))  # light is stated


def test_a_wrong_unit_of_light_is_still_a_wrong_unit():
    with pytest.raises(InvalidProblem, match="unit='ns'"):
        locate(PLACES, toa={"A": 0.0, "B": 20.0, "C": 40.0, "D": 30.0}, unit="us", sigma="1 ns")


@pytest.mark.parametrize("given", [-3.0, 0.0, True, "fast", "343 ns", (1.0, 2.0, 3.0), (343.0, -5.0), object(), np.nan])
def test_other_values_are_refused(given):
    with pytest.raises(InvalidProblem) as caught:
        wave_of(given)
    assert caught.value.where == "wave_speed"
    assert len(str(caught.value)) <= 200


def test_tables_in_long_form_take_the_same_texts():
    rows = {"a": list(PLACES), "z": list(arrivals(343.2146).values())}
    stated = {"kind": "toa", "unit": "s", "sigma": "0.1 ms"}
    problem = optloc.from_table(rows, PLACES, wave_speed="air:20C", **stated)
    assert optloc.solve(problem).position == pytest.approx([5.0, 8.0], abs=1e-3)
    with pytest.warns(DeprecationWarning, match="argument propagation_speed is wave_speed now"):
        again = optloc.from_table(rows, PLACES, propagation_speed=343.2146, **stated)
    assert again.z == pytest.approx(problem.z, rel=1e-6)
    with pytest.raises(InvalidProblem, match='wave_speed="air:20C"'):
        optloc.from_table(rows, PLACES, **stated)


def test_networks_take_times_with_a_wave_speed():
    times = np.array([[0.01, 0.02, 0.03], [0.02, 0.02, np.nan]])
    net = optloc.sites.calibration.network_of(times, 1e-4, dimension=2, wave_speed="air:20C")
    again = optloc.sites.calibration.network_of(343.21462268 * times, 0.0343214623, dimension=2)
    assert net.z == pytest.approx(again.z)
    assert net.sigma == pytest.approx(again.sigma)
    with pytest.raises(InvalidProblem, match="the speed of a network is exact"):
        optloc.sites.calibration.network_of(times, 1e-4, dimension=2, wave_speed="343+-5 m/s")


def test_wind_moves_the_wave():
    stations = {"A": (0.0, 0.0), "B": (500.0, 0.0), "C": (0.0, 500.0), "D": (500.0, 500.0), "E": (250.0, 700.0)}
    shot, wind, speed = np.array([310.0, 260.0]), np.array([6.0, -3.0]), 340.0
    line = np.array([*stations.values()]) - shot
    along, rest = line @ wind, speed**2 - wind @ wind
    times = (np.sqrt(along**2 + rest * (line**2).sum(1)) - along) / rest
    toa = dict(zip(stations, times, strict=True))
    fix = optloc.locate(stations, toa=toa, sigma="1 ms", wave_speed=speed, wind=(6.0, -3.0))
    assert np.abs(fix.position - shot).max() < 1e-3
    assert fix.status.label == "ok"
    compass = "6.7082039325 m/s from 296.56505118"  # from the west-north-west
    same = optloc.locate(stations, toa=toa, sigma="1 ms", wave_speed=speed, wind=compass)
    assert np.abs(same.position - shot).max() < 1e-3


def test_wind_on_earth_is_towards_east_and_north():
    places = {"A": (47.0, 8.0), "B": (47.0, 8.01), "C": (47.008, 8.0), "D": (47.008, 8.011), "E": (46.996, 8.005)}
    times = {name: 1.0 + 0.1 * i for i, name in enumerate(places)}
    fixes = [
        optloc.locate(latlon=places, toa=times, sigma="10 ms", wave_speed=340.0, wind=wind)
        for wind in ((5.0, 0.0), "5 m/s from 270")
    ]
    assert np.abs(fixes[0].position - fixes[1].position).max() < 1e-6


def test_two_way_times_are_halved_without_the_turn_around():
    anchors, tag = {"A": (0.0, 0.0), "B": (80.0, 0.0), "C": (0.0, 60.0), "D": (80.0, 60.0)}, np.array([30.0, 20.0])
    ms = {name: 2.0 * float(np.linalg.norm(tag - place)) / 1500.0 * 1e3 + 15.0 for name, place in anchors.items()}
    options = {"unit": "ms", "sigma": 0.2, "wave_speed": "1500 m/s"}
    fix = optloc.locate(anchors, ranges=ms, two_way=True, turn_around="15 ms", **options)
    assert np.abs(fix.position - tag).max() < 1e-6
    # 0.2 ms of the way there and back are 0.15 m
    one = optloc.locate(anchors, ranges={k: 0.75 * (v - 15.0) for k, v in ms.items()}, sigma=0.15)
    assert np.allclose(one.covariance(), fix.covariance(), rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"wind": (5.0, 0.0)}, "wind: a wind needs one wave speed"),
        ({"wind": "west", "wave_speed": 343}, "not a wind"),
        ({"wind": 5.0, "wave_speed": 343}, "float is not a wind"),
        ({"wind": (5.0, "a"), "wave_speed": 343}, "is not a wind"),
        ({"wind": (5.0, 0.0), "wave_speed": (343.0, 5.0)}, "without a sigma"),
        ({"wind": (500.0, 0.0), "wave_speed": 343}, "above half of the wave speed"),
        ({"two_way": True, "wave_speed": 343}, "there are no ranges"),
        ({"turn_around": "2 ms", "wave_speed": 343}, "turn_around: there are no ranges"),
    ],
)
def test_wrong_ways_are_named(options, words):
    stations = {"A": (0.0, 0.0), "B": (500.0, 0.0), "C": (0.0, 500.0), "D": (500.0, 500.0)}
    with pytest.raises(optloc.InvalidProblem, match=words):
        optloc.locate(stations, toa=dict.fromkeys(stations, 0.5), sigma="1 ms", **options)


def test_two_way_ranges_are_times_without_wind():
    stations = {"A": (0.0, 0.0), "B": (500.0, 0.0), "C": (0.0, 500.0)}
    ranges = dict.fromkeys(stations, 350.0)
    with pytest.raises(optloc.InvalidProblem, match="two-way ranges are times, but the unit is m"):
        optloc.locate(stations, ranges=ranges, sigma=1.0, two_way=True)
    with pytest.raises(optloc.InvalidProblem, match="there and back"):
        optloc.locate(stations, ranges=ranges, sigma=1.0, two_way=True, wind=(1.0, 0.0), wave_speed=343.0, unit="ms")
    with pytest.raises(optloc.InvalidProblem, match="the wind has no effect"):
        optloc.locate(stations, ranges=ranges, sigma=1.0, wind=(1.0, 0.0), wave_speed=343.0)
    with pytest.raises(optloc.InvalidProblem, match="negative"):
        optloc.locate(stations, ranges=ranges, sigma=1.0, two_way=True, unit="ms", turn_around="-2 ms")
