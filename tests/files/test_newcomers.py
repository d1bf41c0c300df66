"""Problems as newcomers have them, in their words and units: each takes one call and comes out right."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from often import few

import optloc
from optloc import InvalidProblem, locate
from optloc.base.frames import Frame
from optloc.base.units import SPEED_OF_LIGHT as C
from optloc.files import read
from optloc.models import MODELS, kind_named

SDRS = {"Nord": (48.15, 11.55), "Ost": (48.13, 11.62), "Sued": (48.09, 11.57), "West": (48.12, 11.49)}
EMITTER = (48.131, 11.575)
ANCHORS = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (8.0, 6.0), "D": (0.0, 6.0)}
TAG = np.array([3.0, 2.0])


def place(lat, lon, height=0.0):
    return optloc.problem.ECEF.from_geodetic(np.radians(lat), np.radians(lon), height)


def delays(noise=5.0, seed=1):
    """Return times of flight to the receivers, ns."""
    rng = np.random.default_rng(seed)
    way = {name: np.linalg.norm(place(*at) - place(*EMITTER)) for name, at in SDRS.items()}
    return {name: float(length / C * 1e9 + noise * rng.standard_normal()) for name, length in way.items()}


def bearing(here, there):
    east, north, _ = Frame.enu(lat_deg=here[0], lon_deg=here[1]).from_geodetic(*np.radians(there), 0.0)
    return float(np.degrees(np.arctan2(east, north)) % 360.0)


def metres(fix, truth=EMITTER):
    """Return how far a fix on Earth is off."""
    return float(np.linalg.norm(place(*fix.latlon[:2]) - place(*truth)))


# Four SDRs, places in degrees, times in nanoseconds.


@cache
def sigma_by_times():
    return locate(latlon=SDRS, toa=delays(), unit="ns", sigma=5.0).sigma()[:2]


def forms():
    time = delays()
    since = {name: int(1.7e18) + round(value) for name, value in time.items()}
    against = {name: value - time["Nord"] for name, value in time.items() if name != "Nord"}
    return {
        "differences by name": {"tdoa": against, "reference": "Nord"},
        "by pair": {"tdoa": {(name, "Nord"): value for name, value in against.items()}},
        "by written pair": {"tdoa": {f"{name}-Nord": value for name, value in against.items()}},
        "array of the others": {"tdoa": np.array(list(against.values()))},
        "series": {"tdoa": pd.Series(against)},
        "times": {"toa": time},
        "times as array": {"toa": list(time.values())},
        "whole nanoseconds of today": {"toa": since},
        "dates": {"toa": {name: np.datetime64(value, "ns") for name, value in since.items()}},
        "long frame": {"toa": pd.DataFrame({"receiver": list(time), "toa_ns": list(time.values())})},
        "wide frame": {"toa": pd.DataFrame([time])},
    }


@pytest.mark.parametrize("form", few(forms(), 6))
def test_four_sdrs(form):
    given = forms()[form]
    if "toa" in given:
        fix = locate(latlon=SDRS, unit="ns", sigma=5.0, **given)
    else:
        fix = locate(latlon=SDRS, unit="ns", sigma=5.0 * np.sqrt(2), **given)
    fix = fix[0] if fix.shape else fix
    assert fix.status.label == "ok"
    assert fix.certificate.proof == "global"
    assert metres(fix) < 10.0
    assert fix.latlon[2] == pytest.approx(0.0, abs=1e-6)
    # what a difference says follows from both arrivals: times and differences are one measurement
    assert fix.sigma()[:2] == pytest.approx(sigma_by_times(), rel=0.05)


def test_seconds_are_the_unit_where_none_is_said_and_a_wrong_one_is_seen():
    seconds = {name: value * 1e-9 for name, value in delays().items()}
    assert metres(locate(latlon=SDRS, toa=seconds, sigma="5 ns")) < 10.0
    with pytest.raises(InvalidProblem, match="unit='ns'"):
        locate(latlon=SDRS, toa=delays(), sigma=5.0)
    with pytest.raises(InvalidProblem, match="rounded"):
        locate(latlon=SDRS, toa={name: 1.7e9 + value for name, value in seconds.items()}, sigma=5e-9)


def test_what_was_not_heard_is_left_out():
    time = delays()
    since = {name: np.datetime64(int(1.7e18) + round(value), "ns") for name, value in time.items()}
    fix = locate(latlon=SDRS, toa={**since, "West": None}, sigma="5 ns")
    assert int(fix.dof) == 0
    assert metres(fix) < 20.0
    against = np.array([[time[name] - time["Nord"] for name in SDRS]] * 2)
    against[1, 2] = np.nan
    both = locate(latlon=SDRS, tdoa=against, unit="ns", sigma=7.0)
    assert both.dof.tolist() == [1, 0]
    assert metres(both[0]) < 10.0


# Three compass bearings.


def test_three_compass_bearings():
    here = {name: SDRS[name] for name in ("Nord", "Ost", "Sued")}
    seen = {name: bearing(at, EMITTER) for name, at in here.items()}
    fix = locate(latlon=here, bearings=seen, sigma=1.0)
    assert fix.status.label == "ok"
    assert metres(fix) < 0.1
    table = pd.DataFrame(
        {"Latitude": [v[0] for v in here.values()], "lng": [v[1] for v in here.values()]}, index=[*here]
    )
    assert np.allclose(locate(table, bearings=list(seen.values()), sigma=1.0).x, fix.x, atol=1e-3)
    # in the plane the compass is that of a map: y is north
    plane = locate({"P": (0, 0), "Q": (100, 0), "R": (0, 100)}, bearings={"P": 45.0, "Q": 315.0, "R": 135.0}, sigma=1.0)
    assert plane.position == pytest.approx([50.0, 50.0])


BEARINGS = """format = {version}
[stations]
rows = [{stations}]
[[measurements]]
kind = "{kind}"
unit = "deg"
sigma = 1.0
rows = [{rows}]
[[constraints]]
kind = "height"
exactly = "0 m"
"""


def bearing_file(folder: Path, version=2, kind="bearing"):
    names = ("Nord", "Ost", "Sued")
    stations = ", ".join(f'{{name = "{n}", lat = {SDRS[n][0]}, lon = {SDRS[n][1]}, alt = 0.0}}' for n in names)
    rows = ", ".join(f'{{station = "{n}", {kind}_deg = {bearing(SDRS[n], EMITTER)}}}' for n in names)
    path = folder / "bearings.toml"
    path.write_text(BEARINGS.format(version=version, kind=kind, stations=stations, rows=rows))
    return path


@pytest.mark.parametrize(("version", "kind", "compass"), [(1, "bearing", True), (2, "aoa", True), (1, "aoa", False)])
def test_a_file_of_bearings_says_how_they_are_counted(tmp_path, caplog, version, kind, compass):
    loaded = read(bearing_file(tmp_path, version, kind))
    assert loaded.problem.rows[0].kind == "azimuth"
    assert loaded.azimuths.startswith("the compass" if compass else "the axes")
    assert ("east-counterclockwise" if compass else "north-clockwise") in loaded.azimuths
    assert ("no convention is stated" in caplog.text) == (not compass)
    if compass:
        assert metres(optloc.solve(loaded.problem)) < 0.1


def test_a_bearing_is_never_taken_for_radians_from_the_x_axis():
    with pytest.raises(InvalidProblem, match="locate"):
        optloc.measured("bearing", [0.5], a=0, sigma=0.1)
    table = {"station": ["P", "Q"], "bearing": [45.0, 315.0]}
    problem = optloc.from_table(table, {"P": (0, 0), "Q": (100, 0)}, kind="bearing", sigma=1.0)
    assert optloc.solve(problem).position == pytest.approx([50.0, 50.0])


# Ranges of a tag, ultra-wide band.


def test_uwb_ranges():
    rng = np.random.default_rng(2)
    ranges = {name: float(np.linalg.norm(TAG - at) + 0.03 * rng.standard_normal()) for name, at in ANCHORS.items()}
    fix = locate(ANCHORS, ranges=ranges, sigma=0.05)
    assert fix.status.label == "ok"
    assert np.linalg.norm(fix.position - TAG) < 0.1
    # anchors at a ceiling see a mirror; a height that is known, or bounded, says which
    high = {name: (*at, 2.5) for name, at in ANCHORS.items()}
    ways = {name: float(np.linalg.norm([*TAG, 1.0] - np.array(at))) for name, at in high.items()}
    assert locate(high, ranges=ways, sigma=0.05).status.label == "ambiguous"
    fix = locate(high, ranges=ways, sigma=0.05, height=1.0)
    assert fix.status.label == "ok"
    assert fix.position == pytest.approx([3.0, 2.0, 1.0], abs=1e-6)
    assert locate(high, ranges=ways, sigma=0.05, height=(0.0, 2.4)).position[2] == pytest.approx(1.0, abs=1e-3)


def test_a_data_frame_of_many_ranges_is_many_fixes():
    ways = {name: float(np.linalg.norm(TAG - at)) for name, at in ANCHORS.items()}
    wide = pd.DataFrame([ways, {**ways, "B": None}, ways])
    fix = locate(ANCHORS, ranges=wide, sigma=0.05)
    assert fix.shape == (3,)
    assert fix.dof.tolist() == [2, 1, 2]
    assert np.allclose(fix.position, TAG, atol=1e-6)
    long = wide.reset_index(names="epoch").melt("epoch", var_name="anchor", value_name="distance_m").dropna()
    stations = pd.DataFrame(
        {"id": [*ANCHORS], "x": [v[0] for v in ANCHORS.values()], "y": [v[1] for v in ANCHORS.values()]}
    )
    other = locate(stations, ranges=long, sigma="5 cm")
    assert np.allclose(other.x, fix.x)
    assert fix.to_dataframe()["status"].tolist() == ["ok"] * 3
    twice = pd.concat([long, long.iloc[:1]])
    with pytest.raises(InvalidProblem, match="two values"):
        locate(stations, ranges=twice, sigma=0.05)


@pytest.mark.parametrize(
    ("columns", "metres"),
    [
        (["x_m", "y_m", "z_m"], 1.0),
        (["x", "y", "z_km"], np.array([1.0, 1.0, 1e3])),
        (["X [ft]", "Y [ft]", "Z"], 0.3048),
    ],
)
def test_coordinates_of_stations_may_name_their_unit(columns, metres):
    at = np.array(
        [[0.0, 0.0, 0.0], [900.0, 0.0, 20.0], [0.0, 700.0, 40.0], [900.0, 700.0, 300.0], [400.0, 300.0, 90.0]]
    )
    factor = np.broadcast_to(np.where([name == "Z" for name in columns], 1.0, metres), 3)
    stations = pd.DataFrame(at / factor, columns=columns, index=list("ABCDE"))
    truth = np.array([300.0, 400.0, 150.0])
    fix = locate(stations, ranges=np.linalg.norm(at - truth, axis=-1), sigma=1.0)
    assert fix.position == pytest.approx(truth, abs=1e-6)


def test_pseudoranges_with_a_known_height():
    rng = np.random.default_rng(5)
    truth = place(48.1, 11.5, 520.0)
    up = truth / np.linalg.norm(truth)
    sky = [v for v in rng.standard_normal((40, 3)) if v @ up > 0.3 * np.linalg.norm(v)][:6]
    satellites = np.array([truth + 2.2e7 * v / np.linalg.norm(v) for v in sky])
    seen = np.linalg.norm(satellites - truth, axis=-1) + 123456.0
    fix = locate(satellites, frame="ecef", pseudoranges=seen, sigma=3.0, height=520.0)
    assert fix.answered
    assert fix.latlon == pytest.approx([48.1, 11.5, 520.0], abs=1e-5)


def test_kinds_together_and_sound():
    time = {name: np.linalg.norm(TAG - at) / optloc.units.sound_in_air(20.0) for name, at in ANCHORS.items()}
    angle = {"A": float(np.degrees(np.arctan2(*TAG)))}
    sigma = {"toa": 1e-4, "bearings": 2.0}
    fix = locate(ANCHORS, toa=time, bearings=angle, sigma=sigma, wave_speed=optloc.units.sound_in_air(20.0))
    assert fix.position == pytest.approx(TAG, abs=1e-6)


# What is wrong is one sentence.

WRONG = {
    "nothing measured": ({"stations": ANCHORS, "sigma": 1.0}, "give one of toa"),
    "no stations": ({"ranges": [1.0], "sigma": 1.0}, "latlon="),
    "no sigma": ({"stations": ANCHORS, "ranges": [1, 2, 3, 4]}, "the accuracy of the ranges is unknown"),
    "no coordinates": (
        {"stations": pd.DataFrame({"east": [0.0, 1.0], "north": [0.0, 1.0]}), "ranges": [1.0, 1.0], "sigma": 1.0},
        "no coordinates among",
    ),
    "no such station": ({"stations": ANCHORS, "ranges": {"AA": 1.0}, "sigma": 1.0}, "'AA'"),
    "too few": ({"stations": ANCHORS, "ranges": [1.0, 2.0], "sigma": 1.0}, "2 values for 4 stations"),
    "one sigma for two kinds": (
        {"stations": ANCHORS, "ranges": [1, 2, 3, 4], "bearings": {"A": 1.0}, "sigma": 1.0},
        "several kinds",
    ),
    "unit": ({"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "unit": "deg"}, "unit of ranges"),
    "latitude": ({"latlon": {"A": (95, 1), "B": (1, 2)}, "toa": [0, 0], "sigma": 1e-9}, "95 deg"),
    "only the reference": ({"stations": ANCHORS, "tdoa": {"A": 0.0}, "sigma": 1.0}, "the other stations"),
    "x and y for degrees": ({"latlon": {"x": [0.0, 1.0], "y": [0.0, 1.0]}, "toa": [0, 0], "sigma": 1.0}, "lat and lon"),
    "words": ({"stations": ANCHORS, "ranges": {"A": "near"}, "sigma": 1.0}, "not numbers"),
    "height": ({"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "height": 2.0}, "plane"),
    "a height that is none": (
        {"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "height": {}},
        "not a height",
    ),
    "a speed that is none": (
        {"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "wave_speed": "fast"},
        "wave_speed",
    ),
    "a unit that is none": (
        {"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "unit": [1]},
        "list is not text",
    ),
    "a method that is none": ({"stations": ANCHORS, "ranges": [1, 2, 3, 4], "sigma": 1.0, "method": {}}, "dict is no"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_short_sentence(name):
    given, words = WRONG[name]
    with pytest.raises(InvalidProblem) as error:
        locate(**given)
    assert words in str(error.value)
    assert len(str(error.value)) < 200


# A fix tells itself.


def test_a_fix_prints_what_the_command_line_prints(tmp_path):
    from typer.testing import CliRunner

    from optloc.cli.application import app

    path = bearing_file(tmp_path)
    told = " ".join(CliRunner().invoke(app, ["fix", str(path)], env={"COLUMNS": "200"}).stdout.split())
    fix = optloc.solve(optloc.load(path))
    for line in str(fix).splitlines():
        label, _, text = line.partition("  ")
        assert label.strip() in told
        assert " ".join(text.split()) in told
    assert fix._repr_html_().count("<tr>") >= 10
    assert json.dumps(fix.to_dict(), allow_nan=False)
    assert fix.to_dict()["lat_deg"] == pytest.approx(EMITTER[0], abs=1e-5)
    roles = [feature["properties"]["role"] for feature in fix.to_geojson(optloc.load(path))["features"]]
    assert roles == ["station"] * 3 + ["fix", "ellipse95"]


def test_every_shape_of_fix_tells_itself():
    ways = [float(np.linalg.norm(TAG - at)) for at in ANCHORS.values()]
    for shape in ((), (1,), (3,), (2, 3)):
        fix = locate(ANCHORS, ranges=np.broadcast_to(ways, (*shape, 4)), sigma=0.1)
        assert "ok" in repr(fix)
        assert len(fix.to_dataframe()) == int(np.prod(shape))
        assert json.dumps(fix.to_dict())
    lone = locate(ANCHORS, ranges={"A": 1.0}, sigma=0.1)
    assert "too few rows" in repr(lone)
    assert json.dumps(lone.to_dict())
    assert "<b>" not in locate({"<b>": (0.0, 0.0), **ANCHORS}, ranges=[1.0, *ways], sigma=0.1)._repr_html_()


# Words.


def test_other_words_for_kinds_are_no_other_quantity():
    words = "twr distance pseudorange tsoa bistatic_range bearing doa aoa altitude doppler Bistatic-Range".split()
    assert [kind_named(word) for word in words] == (
        "range range toa range_sum range_sum azimuth azimuth azimuth height range_rate range_sum".split()
    )
    every = [word for name, model in MODELS.items() for word in (name, *model.aliases)]
    assert len(set(every)) == len(every)


@pytest.mark.parametrize(
    ("word", "guess"),
    [("tdaa", "tdoa"), ("beering", "bearing"), ("rnage", "range"), ("adoa", None), ("rtt", None), ("rssi", None),
     ("phase", None), ("pressure", None), ("heading", None), ("snr", None), ("power", None), ("angle", None)],
)  # fmt: skip
def test_no_guess_points_to_another_quantity(word, guess):
    with pytest.raises(InvalidProblem) as error:
        kind_named(word)
    assert (f"did you mean {guess!r}" in str(error.value)) if guess else ("did you mean" not in str(error.value))


def test_columns_by_other_words_and_units_in_their_names(tmp_path):
    text = """format = 1
propagation_speed = {speed}
[stations]
rows = [{{id = "A", Latitude = 48.1, lng = 11.5, alt_ft = 1000.0}},
  {{id = "B", Latitude = 48.2, lng = 11.5, alt_ft = 0.0}}]
[[measurements]]
kind = "time_difference"
sigma = 30.0
rows = [{{rx1 = "A", rx2 = "B", tdoa_ns = 1000.0}}]
"""
    path = tmp_path / "p.toml"
    path.write_text(text.format(speed='{ medium = "air", celsius = 0.0 }'))
    problem = optloc.load(path)
    assert problem.rows[0].kind == "tdoa"
    assert problem.rows[0].z == pytest.approx([331.3e-6])
    assert np.sqrt(problem.noise.blocks[0].covariance) == pytest.approx(331.3 * 30e-9)
    lat, _, height = problem.frame.to_geodetic(problem.stations.position[0])
    assert np.degrees(lat) == pytest.approx([48.1, 48.2])
    assert height == pytest.approx([304.8, 0.0], abs=1e-6)
    path.write_text(text.format(speed='"340 m/s"').replace("sigma = 30.0", 'unit = "us"\nsigma = 30.0'))
    with pytest.raises(InvalidProblem, match="another unit"):
        optloc.load(path)


def test_sound_is_as_tables_have_it():
    # CRC Handbook: dry air at 20 deg C; Medwin's own example of the sea
    assert optloc.units.sound_in_air(20.0) == pytest.approx(343.2, abs=0.3)
    assert optloc.units.sound_in_water(10.0) == pytest.approx(1490.0, abs=1.0)
    assert optloc.units.sound_in_water(20.0, salinity=0.0) == pytest.approx(1482.3, abs=1.0)
    with pytest.raises(InvalidProblem, match="outside"):
        optloc.units.sound_in_water(90.0)


def test_a_speed_that_is_not_known_is_estimated(tmp_path):
    ways = {name: float(np.linalg.norm(TAG - at)) for name, at in {**ANCHORS, "E": (4.0, 9.0)}.items()}
    stations = ", ".join(f'{{name = "{n}", x = {x}, y = {y}}}' for n, (x, y) in {**ANCHORS, "E": (4.0, 9.0)}.items())
    rows = ", ".join(f'{{a = "{n}", tof_ms = {1e3 * way / 340.0}}}' for n, way in ways.items())
    path = tmp_path / "sound.toml"
    path.write_text(f"""format = 2
propagation_speed = {{ medium = "air", celsius = 20.0 }}
[stations]
rows = [{stations}]
[[measurements]]
kind = "tof"
sigma = "0.01 ms"
rows = [{rows}]
[[biases]]
name = "speed"
form = "scale"
per = "kind"
kind = "tof"
sigma = "0.05 1"
""")
    fix = optloc.solve(optloc.load(path))
    assert fix.position == pytest.approx(TAG, abs=1e-3)
    assert fix.bias["speed"] == pytest.approx([optloc.units.sound_in_air(20.0) / 340.0 - 1.0], rel=0.02)
