"""Public problems of the trades that use sound and waves, solved from their numbers with at most one option.

Each docstring names the source. Speeds and standard deviations are data: the sources state the speed or its medium, and
the digits of the values give the standard deviation where a source states none.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc.cli import app

FOOT = 0.3048


def written(name, head, rows):
    """Write a CSV file."""
    with Path(name).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([head, *rows])


def fixed(*words):
    """Return the single fix of a command as JSON; the command may end with a status other than ok."""
    result = CliRunner().invoke(app, ["fix", *words, "--json"])
    assert result.stdout.startswith("{"), result.output
    return json.loads(result.stdout)["fixes"][0]


def test_three_listening_stations_and_an_explosion(tmp_path, monkeypatch):
    """Gunshots: R. Larson, Precalculus, exercise on hyperbolas; as problem 52 on studyquestionhub.com (470214).

    Stations in feet hear an explosion 0, 1 and 4 s after the first one, with sound of 1100 ft/s. The answer is
    (3300, -2750) ft. It lies on the line of the first two stations, beyond them, where their delay is the largest that
    is possible. Small changes of the position do not change this delay, and the status says so.
    """
    monkeypatch.chdir(tmp_path)
    written("posts.csv", ["name", "x_ft", "y_ft"], [["A", 3300, 0], ["B", 3300, 1100], ["C", -3300, 0]])
    written("heard.csv", ["station", "toa_s"], [["A", 0], ["B", 1], ["C", 4]])
    fix = fixed("heard.csv", "--stations", "posts.csv", "--sigma", "1 ms", "--wave-speed", "1100 ft/s")
    assert np.array([fix["x"], fix["y"]]) / FOOT == pytest.approx([3300.0, -2750.0], abs=0.5)
    assert fix["status"] == "unproven"


def test_three_listeners_kilometres_apart():
    """Gunshots: problem 69 on studyquestionhub.com (1413931).

    A at (-8, 0) km hears an explosion 12 s after B at (8, 0) and C at (8, 10), with sound of 1/3 km/s. The page prints
    (0, 5), where A and B would hear it together. The data give y = 5 and 15 x^2 = 85, a root of its own equations.
    """
    places = {"A": (-8e3, 0.0), "B": (8e3, 0.0), "C": (8e3, 10e3)}
    fix = optloc.locate(places, toa={"A": 12.0, "B": 0.0, "C": 0.0}, sigma="10 ms", wave_speed=1e3 / 3.0)
    assert fix.status is optloc.Status.OK
    assert fix.position == pytest.approx([1e3 * np.sqrt(85.0 / 15.0), 5e3], abs=1.0)


def test_a_gun_and_three_microphones_on_a_line():
    """Gunshots: seniorphysics.com, chapter 16: microphones 1000 m apart on a line, 0, 1.2 and 3.7 s, 330 m/s.

    The solution by compass has the gun 900 m from A, at an angle of 82 degrees to the line, with a mirror image. The
    computed distance is 959 m at 87.5 degrees; the drawing is accurate to its circles. One option decides the side.
    """
    places = {"A": (0.0, 0.0), "B": (1000.0, 0.0), "C": (2000.0, 0.0)}
    data = {"toa": {"A": 0.0, "B": 1.2, "C": 3.7}, "sigma": "10 ms", "wave_speed": 330.0}
    fix = optloc.locate(places, **data)
    assert fix.status is optloc.Status.AMBIGUOUS
    assert abs(fix.alternatives.x[0, 1]) == pytest.approx(abs(fix.position[1]), abs=0.1)
    d = np.linalg.norm(fix.position - np.array(list(places.values())), axis=1)
    assert (d[1:] - d[0]) / 330.0 == pytest.approx([1.2, 3.7], abs=1e-4)
    side = optloc.locate(places, **data, constraints=optloc.constraints.box([-np.inf, 0.0], [np.inf, np.inf]))
    assert side.position[1] == pytest.approx(abs(fix.position[1]), abs=0.1)


def test_ranges_of_a_uwb_module(tmp_path, monkeypatch):
    """UWB: github.com/lemmingapex/trilateration, issue 15 and README: four positions and ranges of a DWM1000 tag.

    Four ranges of rounded metres contradict each other by half a metre. The published answer (-0.6, -11.8) minimises
    errors of squares. Least squares of the ranges gives (-0.370, -12.228), by SciPy from 100 starts.
    """
    monkeypatch.chdir(tmp_path)
    rows = [("1", 5.0, -6.0), ("2", 13.0, -15.0), ("3", 21.0, -3.0), ("4", 12.4, -21.2)]
    written("anchors.csv", ["anchor", "x_m", "y_m"], rows)
    written("r.csv", ["anchor", "range_m"], zip("1234", (8.06, 13.97, 23.32, 15.31), strict=True))
    fix = fixed("r.csv", "--stations", "anchors.csv", "--sigma", "0.5 m")
    assert fix["status"] == "ok"
    assert [fix["x"], fix["y"]] == pytest.approx([-0.370, -12.228], abs=0.002)
    assert fixed("r.csv", "--stations", "anchors.csv", "--sigma", "5 cm")["status"] == "misfit"


def test_ranges_of_a_tag_below_three_anchors():
    """UWB in a hall: freegrow-1.gitbook.io, "Understanding trilateration": anchors 2 m high, tag (3, 2, 1.5).

    Anchors in one plane do not know the side. The height of the tag, one option, decides.
    """
    anchors = {"A": (0.0, 0.0, 2.0), "B": (6.0, 0.0, 2.0), "C": (3.0, 5.0, 2.0)}
    ranges = {"A": 3.64, "B": 3.64, "C": 3.04}
    assert optloc.locate(anchors, ranges=ranges, sigma="5 cm").status is not optloc.Status.OK
    fix = optloc.locate(anchors, ranges=ranges, sigma="5 cm", height=1.5)
    assert fix.status is optloc.Status.OK
    assert fix.position == pytest.approx([3.0, 2.0, 1.5], abs=0.01)


def test_a_terminal_and_three_access_points():
    """UWB in a hall: tutorsglobe.com, question 52203535: three access points, measured ranges 18, 35 and 38 m.

    The terminal is at (20, 10), so the ranging errors are -4.4, 3.4 and -6.7 m.
    """
    places = {"AP1": (0.0, 0.0), "AP2": (50.0, 0.0), "AP3": (0.0, 50.0)}
    fix = optloc.locate(places, ranges={"AP1": 18.0, "AP2": 35.0, "AP3": 38.0}, sigma=5.0)
    assert fix.status is optloc.Status.OK
    off = np.array(fix.position) - [20.0, 10.0]
    assert float(off @ np.linalg.solve(fix.cov[:2, :2], off)) < 6.0  # inside the 95 % ellipse


@pytest.mark.filterwarnings("ignore:the range values")
def test_ultrasonic_ranges_in_a_room(tmp_path, monkeypatch):
    """Room acoustics: github.com/hexamite/hx19-java, TrilateratorTest: receivers and ranges in mm, (1734, 1967, 2979).

    Three receivers in the floor do not know the side; one option states it. Ranges in millimetres that are read as
    metres are recognised before the fix.
    """
    monkeypatch.chdir(tmp_path)
    written("r.csv", ["station", "range_mm"], [["1", 3217], ["2", 3158], ["3", 3073]])
    written("s.csv", ["name", "x_mm", "y_mm", "z_mm"], [[1, 1000, 1000, 0], [2, 2140, 1000, 0], [3, 1000, 2140, 0]])
    fix = fixed("r.csv", "--stations", "s.csv", "--sigma", "1 mm", "--box=-inf,-inf,0:inf,inf,inf")
    assert fix["status"] == "ok"
    # the published answer is rounded down to whole millimetres by integer arithmetic
    assert [1e3 * fix[axis] for axis in "xyz"] == pytest.approx([1734.0, 1967.0, 2979.0], abs=1.1)
    wrong = CliRunner().invoke(app, ["fix", "r.csv", "--stations", "s.csv", "--sigma", "1 mm", "--unit", "m"]).output
    assert "--unit m replaces mm of the column name" in wrong
    assert "1000 times too large" in wrong


def test_a_bird_and_six_recorders():
    """Bioacoustics: github.com/kitzeslab/opensoundscape, tests/test_localization.py, test_gillette_localize_3d."""
    recorders = np.array([[0, 0, 10], [0, 20, 1], [20, 20, -1], [20, 0, 0.1], [10, 10, 0], [5, 5, 5]], dtype=float)
    flight = np.linalg.norm(recorders - [10.0, 12.0, 2.0], axis=1) / 343.0
    fix = optloc.locate(recorders, toa=flight.round(6), sigma="10 us", wave_speed=343.0)
    assert fix.status is optloc.Status.OK
    assert fix.position == pytest.approx([10.0, 12.0, 2.0], abs=0.002)


def test_a_call_that_four_recorders_hear_together():
    """Bioacoustics: github.com/kitzeslab/opensoundscape, tests/test_localization.py, test_soundfinder_3d.

    Four arrivals of 1 s: the point with equal distances from all recorders is the centre of their sphere, near
    (10, 10, 0).
    """
    recorders = np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 1.0], [20.0, 20.0, -1.0], [20.0, 0.0, 0.1]])
    fix = optloc.locate(recorders, toa=[1.0, 1.0, 1.0, 1.0], sigma="0.1 ms", wave_speed=343.0)
    centre = np.linalg.solve(2.0 * recorders[1:], (recorders[1:] ** 2).sum(1))
    assert fix.position == pytest.approx(centre, abs=0.01)
    assert fix.position == pytest.approx([10.0, 10.0, 0.0], abs=0.1)


def test_a_transponder_far_from_a_small_array_under_water():
    """Underwater: github.com/paulaaagraca/USBL-Acoustic-ACSM, angleofarrival/testTOA.m.

    Four hydrophones within 2 m, the emission time is known, the target is at (250, 250, 250) m, 1500 m/s. Ranges are
    217 times the size of the array: the physical checks do not accuse them.
    """
    hydrophones = -np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    seconds = np.linalg.norm(hydrophones - 250.0, axis=1) / 1500.0
    fix = optloc.locate(hydrophones, ranges=seconds, unit="s", sigma="0.1 us", wave_speed=1500.0)
    assert fix.status is optloc.Status.OK
    assert fix.position == pytest.approx([250.0, 250.0, 250.0], abs=0.05)


SAMPLES = [((0, 80, 125, 83), (-0.082, 0.087)), ((77, 0, 81, 120), (0.077, 0.083)), ((15, 0, 60, 66), (0.013, 0.078))]


@pytest.mark.parametrize(("samples", "published"), SAMPLES)
def test_a_stroke_on_a_plate_with_four_sensors(samples, published):
    """Acoustic emission: github.com/madwort/rodrigo-drum-sensor, tests/test_tdoa.py.

    Sensors at the corners of a square of 0.202 m, arrivals in samples of 44.1 kHz, 82 m/s. The published points are
    means of intersections, with standard deviations of 2 to 7 mm.
    """
    half = 0.101
    sensors = {"NW": (-half, half), "NE": (half, half), "SE": (half, -half), "SW": (-half, -half)}
    toa = dict(zip(sensors, np.array(samples) / 44100.0, strict=True))
    fix = optloc.locate(sensors, toa=toa, sigma="0.05 ms", wave_speed=82.0)
    assert fix.status is optloc.Status.OK
    assert fix.position == pytest.approx(published, abs=0.007)


def test_p_arrivals_of_a_microseismic_event(tmp_path, monkeypatch):
    """Seismics: github.com/groupeLIAMG/hypopy, hypopy-tutorial.py: 13 receivers in km, mean P speed 4 km/s.

    The event is the centre of its events, (160, 140, 60) m; arrivals are rounded to 10 us.
    """
    monkeypatch.chdir(tmp_path)
    km = np.array(
        [
            (0.112, 0.115, 0.013),
            (0.111, 0.116, 0.040),
            (0.111, 0.113, 0.090),
            (0.151, 0.117, 0.017),
            (0.180, 0.115, 0.016),
            (0.113, 0.145, 0.011),
            (0.160, 0.150, 0.017),
            (0.185, 0.149, 0.015),
            (0.117, 0.184, 0.011),
            (0.155, 0.192, 0.009),
            (0.198, 0.198, 0.010),
            (0.198, 0.196, 0.040),
            (0.198, 0.193, 0.090),
        ]
    )
    names = [f"R{i + 1}" for i in range(len(km))]
    toa = (np.linalg.norm(km - [0.16, 0.14, 0.06], axis=1) / 4.0).round(5)
    written("geophones.csv", ["name", "x_km", "y_km", "z_km"], [(n, *row) for n, row in zip(names, km, strict=True)])
    written("picks.csv", ["station", "toa_s"], zip(names, toa, strict=True))
    fix = fixed("picks.csv", "--stations", "geophones.csv", "--sigma", "10 us", "--wave-speed", "4 km/s")
    assert fix["status"] == "ok"
    assert [1e3 * fix[axis] for axis in "xyz"] == pytest.approx([160e3, 140e3, 60e3], abs=50.0)


def test_s_minus_p_times_of_an_earthquake(tmp_path, monkeypatch):
    """Earthquakes: Saint Louis University, eas.slu.edu/Outreach/eqexercise.html: S minus P of 10, 25 and 38 s.

    The page multiplies by 8 km/s, which are P waves of 5.84 km/s and S waves of 3.37 km/s by its ratio of 1.37. The
    positions of the stations are approximate, to a kilometre or so. A focus at the surface near Jonesboro, Arkansas,
    fits the whole seconds.
    """
    monkeypatch.chdir(tmp_path)
    rows = [("MPH", 35.12, -89.93), ("UALR", 34.78, -92.34), ("SLM", 38.64, -90.24)]
    written("net.csv", ["station", "lat", "lon"], rows)
    written("sp.csv", ["station", "sp_s"], [("MPH", 10), ("UALR", 25), ("SLM", 38)])
    words = ["sp.csv", "--stations", "net.csv", "--sigma", "2 s", "--vp", "5.84 km/s", "--vs", "3.37 km/s"]
    fix = fixed(*words, "--height", "0")
    assert [fix["lat_deg"], fix["lon_deg"]] == pytest.approx([35.80, -90.44], abs=0.05)
    assert fix["status"] == "ok"
