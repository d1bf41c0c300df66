"""The wave of measurement tables: speeds, wind and two-way times, and the question for a missing speed.

The tables of sound are rebuilt from public problems, with their numbers only: the recorders and delays of
opensoundscape (kitzeslab/opensoundscape, tests/csvs/LOCA_2021_aru_coords.csv and tests/test_localization.py), its
soundfinder test with four receivers, and a published exercise with four acoustic transponders.
"""

import math

import numpy as np
import pytest

from optloc import InvalidProblem, load, solve
from optloc.files.convert import convert, interpret_table
from optloc.files.table_import import ColumnHints
from optloc.files.wave_speed import WaveOptions

SQUARE = "station,x,y\nA,0,0\nB,0,20\nC,20,20\nD,20,0\n"
EQUAL = "event,station,time_s\n1,A,1\n1,B,1\n1,C,1\n1,D,1\n"
POLES = (
    "recorder,x,y,z\nR3,17.129,8.878,14.392\nR4,17.129,8.878,2.9\nR5,0.0,0.0,15.092\nR6,0.0,0.0,3.6\n"
    "R7,0.771,19.147,14.392\nR8,0.771,19.147,2.9\n"
)
DELAYS = "recorder,tdoa_s\nR4,0.0325\nR5,-0.002\nR6,0.0316\nR7,-0.0086\nR8,0.024\n"
SEABED = "transponder,x,y,depth_m\nT1,100,-100,30\nT2,-100,100,30\nT3,100,100,30\nT4,-100,-100,30\n"
FLIGHTS = "transponder,tof_ms\nT1,92.848\nT2,97.600\nT3,89.183\nT4,100.910\n"


def hints(folder, stations, rows, wave=None, **more):
    """Return the table of a text with its hints."""
    (folder / "s.csv").write_text(stations)
    (folder / "rows.csv").write_text(rows)
    return folder / "rows.csv", ColumnHints(stations=folder / "s.csv", wave=wave or WaveOptions(), **more)


def read(folder, stations, rows, wave=None, **more):
    """Return the problem of a table."""
    return interpret_table(*hints(folder, stations, rows, wave, **more)).read()


CASES = {
    "square": (SQUARE, EQUAL, {"sigma": "0.1 ms"}),
    "poles": (POLES, DELAYS, {"sigma": "2 ms", "reference": "R3"}),
    "seabed": (SEABED, FLIGHTS, {"sigma": "0.02 ms"}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_missing_speed_is_asked_for(tmp_path, case):
    stations, rows, more = CASES[case]
    with pytest.raises(InvalidProblem, match="no wave speed is stated; state it: --wave-speed air:20C") as caught:
        read(tmp_path, stations, rows, **more)
    assert len(str(caught.value)) <= 200


def test_receivers_in_a_square_find_their_centre(tmp_path):
    stations, rows, more = CASES["square"]
    fix = solve(read(tmp_path, stations, rows, WaveOptions("air:20C"), **more).problem)
    assert fix.status.label == "ok"
    assert fix.position == pytest.approx([10.0, 10.0], abs=1e-6)


def test_a_bird_above_three_poles_has_a_direction(tmp_path):
    stations, rows, more = CASES["poles"]
    fix = solve(read(tmp_path, stations, rows, WaveOptions("air:20C"), **more).problem)
    # own least squares of a plane wave: elevation 79 deg, azimuth 115 deg from x; the range is open
    assert fix.status.label == "unbounded"
    directions = str(fix)
    assert "elevation 79" in directions
    assert "azimuth 114" in directions
    assert fix.p_value > 0.5


def test_transponders_on_the_seabed_find_the_vehicle(tmp_path):
    stations, rows, more = CASES["seabed"]
    fix = solve(read(tmp_path, stations, rows, WaveOptions("1500 m/s"), **more).problem)
    # the transponders are in one plane: the mirror image below them fits equally well
    assert fix.status.label == "ambiguous"
    assert fix.position[:2] == pytest.approx([8.846, 3.740], abs=0.06)


def test_the_report_always_names_the_speed_of_times(tmp_path):
    table = interpret_table(*hints(tmp_path, SQUARE, EQUAL, sigma="0.1 ns"))
    assert ("wave", "299792458 m/s, light (no --wave-speed)") in table.about
    table = interpret_table(*hints(tmp_path, SQUARE, EQUAL, WaveOptions("air:20C,50%"), sigma="0.1 ms"))
    assert dict(table.about)["wave"] == "343.987 m/s, air of 20 °C, 50 % humid (Cramer 1993)"
    assert table.read().speed == dict(table.about)["wave"]
    metres = interpret_table(*hints(tmp_path, SQUARE, "station,range_m\nA,14\nB,14\nC,14\n", sigma="1 m"))
    assert "wave" not in dict(metres.about)


@pytest.mark.parametrize(
    "speed", ["340 m/s", "340+-5 m/s", "air:20C", "air:20C,50%", "water:8C,35,50m", "profile", "light"]
)
def test_a_written_file_has_the_wave_of_the_table(tmp_path, speed):
    stations = "station,x,y,z\nA,0,0,-1\nB,0,20,-2\nC,20,20,-3\nD,20,0,-1\nE,9,9,-5\n"
    rows = "event,station,time_s\n" + "".join(f"1,{name},{1.0 + 1e-9 * i}\n" for i, name in enumerate("ABCDE"))
    if speed == "profile":
        (tmp_path / "profile.csv").write_text("depth_m,speed_m_s\n0,1500\n50,1490\n")
        speed = str(tmp_path / "profile.csv")
    source, given = hints(tmp_path, stations, rows, WaveOptions(speed), sigma="0.1 ns")
    convert(source, tmp_path / "out.toml", given)
    written, direct = load(tmp_path / "out.toml"), interpret_table(source, given).read().problem
    assert written.z == pytest.approx(direct.z)
    assert written.medium == direct.medium
    assert [bias.name for bias in written.biases] == [bias.name for bias in direct.biases]


def test_two_way_times_lose_the_turn_around_and_half_of_the_way(tmp_path):
    one_way = [float(line.split(",")[1]) for line in FLIGHTS.splitlines()[1:]]
    rows = "transponder,tof_ms\n" + "".join(f"T{i + 1},{2.0 * t + 5.0!r}\n" for i, t in enumerate(one_way))
    wave = WaveOptions("1500 m/s", two_way=True, turn_around="5 ms")
    problem = read(tmp_path, SEABED, rows, wave, sigma="0.04 ms").problem
    again = read(tmp_path, SEABED, FLIGHTS, WaveOptions("1500 m/s"), sigma="0.02 ms").problem
    assert problem.z == pytest.approx(again.z)
    assert problem.noise.blocks[0].covariance == pytest.approx(again.noise.blocks[0].covariance)
    table = interpret_table(*hints(tmp_path, SEABED, rows, wave, sigma="0.04 ms"))
    assert dict(table.about)["wave"] == "1500 m/s, there and back, 5 ms less"


WRONG = {
    "no times": ({"speed": "air:20C"}, "station,range_m\nA,14\nB,14\nC,14\n", "the values are in m"),
    "wind without times": ({"wind": "5,0"}, "station,range_m\nA,14\nB,14\nC,14\n", "--wind: the values are in m"),
    "two-way metres": ({"two_way": True}, "station,range_m\nA,14\nB,14\nC,14\n", "has range, not ranges as times"),
    "two-way arrivals": ({"speed": "air:20C", "two_way": True}, EQUAL, "add --as range"),
    "negative delay": (
        {"speed": "air:20C", "two_way": True, "turn_around": "-2 ms"},
        "station,range_ms\nA,14\nB,14\nC,14\n",
        "turn-around time is negative",
    ),
    "delay without a unit": (
        {"speed": "air:20C", "two_way": True, "turn_around": "2"},
        "station,range_ms\nA,14\nB,14\nC,14\n",
        "has no unit",
    ),
    "wind of light": ({"wind": "5,0"}, EQUAL, "a wind needs a wave speed"),
    "uncertain wind": ({"speed": "340+-5 m/s", "wind": "5,0"}, EQUAL, "wave speed without a sigma"),
    "storm": ({"speed": "340 m/s", "wind": "500,0"}, EQUAL, "above half of the wave speed"),
    "no speed": ({"speed": "quick"}, EQUAL, "no wave speed"),
}


@pytest.mark.parametrize("case", WRONG)
def test_options_without_effect_are_refused(tmp_path, case):
    wave, rows, words = WRONG[case]
    sigma = "1 m" if "range_m\n" in rows else "1 ms"
    with pytest.raises(InvalidProblem, match=words) as caught:
        read(tmp_path, SQUARE, rows, WaveOptions(**wave), sigma=sigma)
    assert len(str(caught.value)) <= 200


def test_earthquakes_state_the_speeds_of_both_waves(tmp_path):
    picks = "station,p_s,s_s\nA,1.0,2.0\nB,1.0,2.0\nC,1.0,2.0\nD,1.0,2.0\n"
    with pytest.raises(InvalidProblem, match="--vp and --vs determine"):
        read(tmp_path, SQUARE, picks, WaveOptions("6 km/s"), sigma="0.1 s", vp="6 km/s", vs="3.5 km/s")


def test_a_wind_on_earth_blows_along_east_and_north(tmp_path):
    lat, lon, radius = 47.0, 8.0, 6.37e6
    east = radius * math.cos(math.radians(lat)) * math.pi / 180.0
    north = radius * math.pi / 180.0
    points = np.array([[0, 0], [300, 0], [0, 300], [300, 300], [150, -200]], dtype=float)
    stations = "station,lat,lon,height_m\n" + "".join(
        f"{name},{lat + y / north:.9f},{lon + x / east:.9f},0\n" for name, (x, y) in zip("ABCDE", points, strict=True)
    )
    rows = "event,station,time_s\n" + "".join(f"1,{name},1.0\n" for name in "ABCDE")
    wave = WaveOptions("340 m/s", "5 m/s from 270")
    problem = read(tmp_path, stations, rows, wave, sigma="1 ms").problem
    axes = problem.frame.enu_axes(problem.stations.position[0].mean(0))
    assert axes @ np.array(problem.medium.velocity) == pytest.approx([5.0, 0.0, 0.0], abs=1e-9)
    table = interpret_table(*hints(tmp_path, stations, rows, wave, sigma="1 ms"))
    assert dict(table.about)["wave"] == "340 m/s; wind (5, 0) m/s"


def test_light_stays_the_default_of_networks_that_are_large_enough(tmp_path):
    wide = SQUARE.replace("20", "20000")
    rows = "event,station,time_us\n1,A,1\n1,B,20\n1,C,30\n1,D,40\n"
    problem = read(tmp_path, wide, rows, sigma="20 ns").problem
    assert np.ptp(problem.z) == pytest.approx(39e-6 * 299_792_458.0)
    # a wrong unit of a thousand is still reported by the advice on units, not by the question for the speed
    read(tmp_path, SQUARE, "event,station,time_us\n1,A,0\n1,B,0.02\n1,C,0.05\n1,D,0.04\n", sigma="2 ns")
