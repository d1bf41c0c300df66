"""Signs of bearings: corrections, declination and biases of a compass are clockwise, in files, calls and reports."""

import json
import math
import re
import sys
from datetime import date

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, locate, solve, with_bias
from optloc.base.frames import CARTESIAN, ECEF, Frame
from optloc.cli import app
from optloc.files import from_table, load, read
from optloc.files.declination import declinations
from optloc.files.writer import write_measured
from optloc.problem import with_known_bias
from optloc.station_health import health

RUN = CliRunner()
# Two compasses that read 4 deg too little: magnetic north is 4 deg east of north.
SITES = {"A": (47.90, 11.20), "B": (47.80, 11.05)}
MAGNETIC = {"A": 176.0, "B": 74.8}
RIGHT = (47.8199, 11.2000)


def compass(folder, lines, rows=None, name="magnetic.toml"):
    """Write the problem of the two compasses with further lines of the measurements."""
    cells = rows or ", ".join(f'{{ a = "{a}", z = {z} }}' for a, z in MAGNETIC.items())
    sites = ", ".join(f'{{ name = "{a}", lat = {lat}, lon = {lon} }}' for a, (lat, lon) in SITES.items())
    path = folder / name
    path.write_text(
        f'format = 2\n[stations]\nrows = [{sites}]\n[[measurements]]\nkind = "bearing"\nunit = "deg"\nsigma = 1.0\n'
        f'{lines}\nrows = [{cells}]\n[[constraints]]\nkind = "height"\nexactly = "0 m"\n'
    )
    return path


def latlon(fix):
    return tuple(np.round(np.degrees(fix.geodetic[:2]), 4).tolist())


@pytest.mark.parametrize(
    "lines",
    [
        "correction = 4.0",
        'correction = "240 arcmin"',
        f"correction = '{float(np.radians(4.0))!r} rad'",
        "declination = 4.0",
        'declination = "4 deg"',
        'correction = "1.5 deg"\ndeclination = "2.5 deg"',
    ],
)
def test_a_declination_east_of_north_is_added(lines, tmp_path):
    assert latlon(solve(load(compass(tmp_path, lines)))) == RIGHT


def test_corrections_of_single_rows_are_added_too(tmp_path):
    rows = '{ a = "A", z = 176.0, correction = 4.0 }, { a = "B", z = 80.8, correction = -2.0 }'
    assert latlon(solve(load(compass(tmp_path, "", rows)))) == RIGHT


@pytest.mark.parametrize(
    ("convention", "from_true"),
    [
        ("north-clockwise", lambda true: true - 4.0),
        ("north-counterclockwise", lambda true: 4.0 - true),
        ("east-counterclockwise", lambda true: 90.0 - true + 4.0),
    ],
)
@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_correction_turns_azimuths_clockwise_however_they_are_counted(convention, from_true, unit):
    stations = {"A": (0.0, 0.0), "B": (5e3, 0.0), "C": (0.0, 5e3)}
    target = np.array([3e3, 4e3])
    true = [float(np.degrees(np.arctan2(*(target - place)))) for place in stations.values()]
    factor = 1.0 if unit == "deg" else np.pi / 180.0
    options = {"unit": unit, "sigma": factor, "azimuth": convention, "kind": "azimuth"}
    rows = {"a": list(stations), "z": [factor * from_true(v) for v in true]}
    problem = from_table(rows, stations, correction=4.0 * factor, **options)
    assert solve(problem).position == pytest.approx(target, abs=1e-6)
    if convention.startswith("north"):
        declined = from_table(rows, stations, declination="4 deg", **options)
        assert solve(declined).position == pytest.approx(target, abs=1e-6)


def test_a_simulation_keeps_the_declination(tmp_path):
    source = compass(tmp_path, 'declination = "4 deg"\ncorrection = 1.0')
    problem = load(source)
    out, *_ = write_measured(source, tmp_path / "again.toml", problem.z[None])
    assert 'declination = "4 deg"' in out.read_text()
    again = load(out)
    np.testing.assert_allclose(again.observed, problem.observed, atol=1e-12)


# Biases: what a compass reads too much, clockwise.

PLACES = {"N": (0.0, 4e3), "E": (5e3, 0.0), "S": (-500.0, -4e3), "W": (-4e3, 300.0)}
TARGETS = [(1e3, 900.0), (-1.2e3, 700.0), (300.0, -1.4e3), (1.5e3, -400.0), (-700.0, -600.0), (200.0, 1.3e3)]


def bearing(place, target):
    return float(np.degrees(np.arctan2(target[0] - place[0], target[1] - place[1])) % 360.0)


def calibration(folder, errors, bias, *, unit="deg", section="", convention="north-clockwise", name="run.toml"):
    """Write bearings of known targets by compasses that read too much by some degrees."""
    size = {"deg": 1.0, "arcmin": 60.0, "rad": math.pi / 180.0}[unit]
    read_as = {
        "north-clockwise": lambda true, error: true + error,
        "north-counterclockwise": lambda true, error: -true + error,
    }[convention]
    rows = [
        f"{{ a = '{a}', epoch = {k}, time = {float(k)}, z = {size * read_as(bearing(place, target), error(k))!r} }}"
        for k, target in enumerate(TARGETS)
        for a, place in PLACES.items()
        for error in [errors[a] if callable(errors[a]) else (lambda _, e=errors[a]: e)]
    ]
    known = ", ".join(f"{{ epoch = {k}, x = {x}, y = {y} }}" for k, (x, y) in enumerate(TARGETS))
    sites = ", ".join(f"{{ name = '{a}', x = {x}, y = {y} }}" for a, (x, y) in PLACES.items())
    path = folder / name
    path.write_text(
        f'format = 2\n[stations]\nrows = [{sites}]\n[[measurements]]\nkind = "azimuth"\nazimuth = "{convention}"\n'
        f"unit = '{unit}'\nsigma = {0.1 * size!r}\n{section}\nrows = [{', '.join(rows)}]\n"
        f"[target]\nrows = [{known}]\n[[biases]]\nname = 'mount'\n{bias}\n"
    )
    return path


ERRORS = {"N": 3.0, "E": -2.0, "S": 0.5, "W": 0.0}


@pytest.mark.parametrize("unit", ["deg", "arcmin", "rad"])
def test_a_bias_is_what_a_compass_reads_too_much(unit, tmp_path):
    path = calibration(tmp_path, ERRORS, 'per = "station"', unit=unit)
    fix = solve(load(path))
    assert np.degrees(fix.bias["mount"]) == pytest.approx(list(ERRORS.values()), abs=1e-6)
    size = {"deg": 1.0, "arcmin": 60.0, "rad": np.pi / 180.0}[unit]
    text = RUN.invoke(app, ["fix", str(path)]).stdout
    found = re.findall(rf"mount\s*│\s*([NESW])\s*│\s*(-?[\d.]+) ± [\d.]+ {unit}", text)
    assert {a: float(v) for a, v in found} == pytest.approx({a: size * e for a, e in ERRORS.items()}, abs=0.05 * size)
    found = json.loads(RUN.invoke(app, ["fix", str(path), "--json"]).stdout)["fixes"][0]["biases"]
    assert {row["member"]: np.degrees(row["value"]) for row in found} == pytest.approx(ERRORS, abs=1e-6)
    assert re.search(r"<td[^>]*>N</td><td[^>]*>0?\.0?52\d* ± ", fix._repr_html_()), fix._repr_html_()


def test_a_bias_of_angles_anticlockwise_from_north_is_anticlockwise(tmp_path):
    path = calibration(tmp_path, ERRORS, 'per = "station"', convention="north-counterclockwise")
    assert np.degrees(solve(load(path)).bias["mount"]) == pytest.approx(list(ERRORS.values()), abs=1e-6)


def test_drifts_and_biases_of_a_kind_are_clockwise(tmp_path):
    drift = calibration(tmp_path, dict.fromkeys(PLACES, lambda k: 0.25 * k), 'form = "drift"\nper = "kind"')
    assert np.degrees(solve(load(drift)).bias["mount"]) == pytest.approx([0.25], abs=1e-6)
    group = calibration(
        tmp_path, {"N": 2.0, "E": 2.0, "S": -1.0, "W": -1.0}, 'members = { a = ["N", "E"], b = ["S", "W"] }'
    )
    assert np.degrees(solve(load(group)).bias["mount"]) == pytest.approx([2.0, -1.0], abs=1e-6)


def test_a_turned_array_is_a_rotation_clockwise(tmp_path):
    # Turned by 3 deg clockwise, an array reads 3 deg too little.
    path = calibration(tmp_path, {a: -e for a, e in ERRORS.items()}, 'form = "rotation"')
    assert np.degrees(solve(load(path)).bias["mount"]) == pytest.approx(list(ERRORS.values()), abs=1e-3)


def test_a_prior_of_a_compass_is_clockwise(tmp_path):
    path = calibration(tmp_path, ERRORS, 'members = ["N"]\nmean = "3 deg"\nsigma = "0.001 deg"')
    bias = load(path).biases[0]
    assert np.degrees(bias.mean) == pytest.approx([3.0])
    other = calibration(tmp_path, ERRORS, 'members = ["N"]\nmean = "3 deg"\nsigma = "0.001 deg"', name="other.toml")
    other.write_text(other.read_text().replace('"3 deg"', '"-3 deg"'))
    right, wrong = solve(load(path)), solve(load(other))
    assert right.cost < wrong.cost


def test_a_bias_that_was_learnt_is_applied_with_its_sign(tmp_path):
    problem = load(calibration(tmp_path, ERRORS, 'per = "station"'))
    known = with_known_bias(problem, "mount", solve(problem).take("mount"))
    true = load(calibration(tmp_path, dict.fromkeys(PLACES, 0.0), 'per = "station"', name="true.toml"))
    np.testing.assert_allclose(known.observed, true.z, atol=1e-8)
    again = with_bias(with_known_bias(problem, "mount", {}), "afterwards")
    assert np.degrees(solve(again).bias["afterwards"]) == pytest.approx(list(ERRORS.values()), abs=1e-6)


def test_biases_of_azimuths_that_are_counted_both_ways_are_refused(tmp_path):
    path = calibration(tmp_path, ERRORS, 'per = "station"')
    more = '[[measurements]]\nkind = "azimuth"\nunit = "deg"\nazimuth = "east-counterclockwise"\nsigma = 0.1\n'
    more += "rows = [{ a = 'N', epoch = 0, time = 0.0, z = 1.0 }]\n[target]"
    path.write_text(path.read_text().replace("[target]", more))
    with pytest.raises(InvalidProblem, match=r"mount.*clockwise and anticlockwise"):
        load(path)
    path.write_text(path.read_text() + "members = ['E', 'S']\n")
    assert np.degrees(solve(load(path)).bias["mount"]) == pytest.approx([-2.0, 0.5], abs=1e-6)


def test_a_scale_of_bearings_is_refused(tmp_path):
    with pytest.raises(InvalidProblem, match=r"mount.*a scale of bearings.*offset"):
        load(calibration(tmp_path, ERRORS, 'form = "scale"'))


def run_of_fixes(folder, errors, rng):
    """Write bearings of unknown targets, one an epoch, by compasses that read too much."""
    rows = [
        f"{{ a = '{a}', epoch = {k}, z = {float(bearing(place, target) + errors[a] + rng.normal(0.0, 0.1))!r} }}"
        for k, target in enumerate(rng.uniform(-1.5e3, 1.5e3, (60, 2)))
        for a, place in PLACES.items()
    ]
    sites = ", ".join(f"{{ name = '{a}', x = {x}, y = {y} }}" for a, (x, y) in PLACES.items())
    path = folder / "many.toml"
    path.write_text(
        f"format = 2\n[stations]\nrows = [{sites}]\n[[measurements]]\nkind = 'bearing'\nunit = 'deg'\nsigma = 0.1\n"
        f"rows = [{', '.join(rows)}]\n"
    )
    return path


def test_station_health_of_compasses_is_clockwise(tmp_path):
    path = run_of_fixes(tmp_path, {"N": 2.0, "E": 0.0, "S": 0.0, "W": 0.0}, np.random.default_rng(7))
    problem = load(path)
    found = health(problem)
    assert np.degrees(found.bias[found.names.index("N")]) > 0.5
    own = found.group == found.names.index("N")
    assert np.degrees(np.median(found.residual[own])) > 0.5
    told = json.loads(RUN.invoke(app, ["check", str(path), "--json"]).stdout)
    assert {row["name"]: row["bias"] for row in told["health"]["stations"]}["N"] > 0.0
    text = RUN.invoke(app, ["check", str(path)]).stdout
    assert re.search(r"│\s*N\s*│[^│]*│\s*0\.03\d+ ± ", text), text
    assert "An offset of station N of +1.9" in text or "An offset of station N of +2.0" in text


def test_a_suspect_compass_has_a_clockwise_error():
    places = PLACES | {"Q": (4e3, 4e3), "P": (-3e3, -3e3)}
    seen = {a: bearing(place, (800.0, -300.0)) for a, place in places.items()}
    fix = locate(places, bearings=seen | {"W": seen["W"] + 20.0}, sigma=0.5, method="gtrs+lsr+suspects")
    explained = np.ravel(fix.explanations)[0]
    suspects = [one for each in explained for one in each.suspects]
    assert "W" in suspects[0].name
    assert np.degrees(suspects[0].error[0]) == pytest.approx(20.0, abs=1.0)


# Declination of a place and a date.

# Check values of the coefficients WMM2025, published with them: year, height (km), latitude, longitude, declination.
WMM = [
    ("2025-01-01", 0.0, 80.0, 0.0, 1.28),
    ("2025-01-01", 0.0, 0.0, 120.0, -0.16),
    ("2025-01-01", 0.0, -80.0, 240.0, 68.78),
    ("2027-07-02", 100.0, 80.0, 0.0, 2.16),
    ("2027-07-02", 100.0, 0.0, 120.0, -0.23),
    ("2027-07-02", 100.0, -80.0, 240.0, 67.93),
]


@pytest.mark.parametrize(("day", "height", "lat", "lon", "right"), WMM)
def test_the_world_magnetic_model_gives_its_check_values(day, height, lat, lon, right):
    place = ECEF.from_geodetic(np.radians(lat), np.radians(lon), 1e3 * height)
    found = declinations(place[None], ECEF, date.fromisoformat(day), "declination")
    assert np.degrees(found) == pytest.approx([right], abs=0.011)


@pytest.mark.parametrize("frame", ["ecef", "enu", "plane"])
def test_a_date_is_the_declination_at_each_station(frame):
    where = Frame.enu(lat_deg=-33.7, lon_deg=150.7) if frame != "ecef" else ECEF
    place = where.from_geodetic(np.radians(-33.7), np.radians(150.7), 0.0)
    own = declinations(place[None, : 2 if frame == "plane" else 3], where, date(2026, 6, 1), "declination")
    assert np.degrees(own) == pytest.approx([12.7], abs=0.2)  # Sydney: 12.7 deg east


def test_files_and_calls_take_a_date(tmp_path):
    east = np.degrees(
        declinations(
            np.stack([ECEF.from_geodetic(np.radians(lat), np.radians(lon), 0.0) for lat, lon in SITES.values()]),
            ECEF, date(2026, 6, 1), "declination",
        )
    )  # fmt: skip
    assert east == pytest.approx([4.2, 4.2], abs=0.1)
    rows = ", ".join(
        f'{{ a = "{a}", z = {z}, correction = {float(d)!r} }}' for (a, z), d in zip(MAGNETIC.items(), east, strict=True)
    )
    by_hand = load(compass(tmp_path, "", rows, "hand.toml"))
    for lines in (
        "declination = { date = 2026-06-01 }",
        'declination = "2026-06-01"',
        'declination = { date = "2026-06-01" }',
    ):
        loaded = read(compass(tmp_path, lines))
        np.testing.assert_allclose(loaded.problem.observed, by_hand.observed, atol=1e-6)
        assert "magnetic declination +4.18 to +4.22 deg" in loaded.azimuths
    fix = solve(by_hand)
    for given in ("2026-06-01", date(2026, 6, 1)):
        other = locate(latlon=SITES, bearings=MAGNETIC, sigma=1.0, declination=given)
        np.testing.assert_allclose(other.latlon[:2], np.degrees(fix.geodetic[:2]), atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            'declination = "1999-06-01"',
            r"no World Magnetic Model of pygeomag .* is valid on 1999-06-01; give the declin",
        ),
        ('declination = "2026-13-01"', r"'2026-13-01' is not a date"),
        ('declination = "4 m"', r"declination.*unknown unit 'm'"),
        ('declination = "east"', r"declination.*'east' is no amount"),
        ("declination = 400.0", r"a declination of 400 deg is more than half a turn"),
        ('declination = 4.0\nazimuth = "east-counterclockwise"', r"angles from the x axis have no declination"),
    ],
)
def test_declinations_that_are_none_are_refused(lines, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        load(compass(tmp_path, lines))


def test_a_date_without_its_library_or_the_earth_is_refused(tmp_path, monkeypatch):
    with pytest.raises(InvalidProblem, match=r"needs stations on Earth; give the declination as an angle"):
        declinations(np.zeros((1, 2)), CARTESIAN, date(2026, 6, 1), "declination")
    with pytest.raises(InvalidProblem, match=r"1, key 'declination': range is not an azimuth"):
        from_table({"a": ["A"], "z": [5.0]}, PLACES | {"A": (0.0, 1.0)}, kind="range", sigma=1.0, declination="4 deg")
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(InvalidProblem, match=r"needs the library pygeomag; pip install 'optloc\[magnetic\]'"):
        load(compass(tmp_path, 'declination = "2026-06-01"'))


# One call.


@pytest.mark.parametrize("declination", [4.0, "4 deg", "240 arcmin"])
def test_locate_adds_the_declination(declination):
    fix = locate(latlon=SITES, bearings=MAGNETIC, sigma=1.0, declination=declination)
    assert tuple(fix.latlon.round(4).tolist())[:2] == RIGHT


def test_locate_counts_bearings_the_other_way():
    anticlockwise = {a: -z for a, z in MAGNETIC.items()}
    fix = locate(latlon=SITES, bearings=anticlockwise, sigma=1.0, declination=4.0, azimuth="north-counterclockwise")
    assert tuple(fix.latlon.round(4).tolist())[:2] == RIGHT
    east = {a: 90.0 - z - 4.0 for a, z in MAGNETIC.items()}
    fix = locate(latlon=SITES, bearings=east, sigma=1.0, azimuth="east-counterclockwise")
    assert tuple(fix.latlon.round(4).tolist())[:2] == RIGHT


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"azimuth": "north"}, "there is no convention 'north'"),
        ({"azimuth": "east-counterclockwise", "declination": 4.0}, "no declination"),
        ({"declination": [4.0]}, "list is not a declination"),
        ({"declination": "2150-01-01"}, "no World Magnetic Model"),
    ],
)
def test_locate_refuses_what_is_no_declination(options, words):
    with pytest.raises(InvalidProblem, match=words):
        locate(latlon=SITES, bearings=MAGNETIC, sigma=1.0, **options)
