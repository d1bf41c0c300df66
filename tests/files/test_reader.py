"""Problem files: the same problem in any unit, from any source; every mistake is one sentence with its place."""

import json
import time
from dataclasses import fields, is_dataclass

import numpy as np
import pandas as pd
import pytest
from bad_input import BAD, GEODETIC, HEAD, STATIONS, TDOA, bad_files, inline, tdoa, write
from hypothesis import given, strategies as st

from optloc.base.errors import InvalidProblem
from optloc.base.frames import ECEF, Frame
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files import from_table, load, read
from optloc.files.schema import schema
from optloc.files.writer import write_measured
from optloc.problem.noise import dense


def same(one, two, rtol=1e-12, path="problem"):
    """Assert that two problems hold the same values; how a file writes them does not count."""
    if is_dataclass(one):
        for field in (each for each in fields(one) if each.compare):
            same(getattr(one, field.name), getattr(two, field.name), rtol, f"{path}.{field.name}")
    elif isinstance(one, tuple):
        assert len(one) == len(two), path
        for i, (first, second) in enumerate(zip(one, two, strict=True)):
            same(first, second, rtol, f"{path}[{i}]")
    elif isinstance(one, np.ndarray) and one.dtype.kind == "f":
        np.testing.assert_allclose(one, two, rtol=rtol, atol=1e-9, err_msg=path)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, two, err_msg=path)
    else:
        assert one == two, path


def test_nanoseconds_and_metres_are_the_same_problem(tmp_path):
    metres = load(write(tmp_path, tdoa(extra="arrival_sigma = 3.0\n")))
    scale = SPEED_OF_LIGHT * 1e-9
    rows = [(a, b, z / scale) for a, b, z in TDOA]
    for extra in (f'unit = "ns"\narrival_sigma = {3.0 / scale!r}\n', 'unit = "ns"\narrival_sigma = "3 m"\n'):
        same(metres, load(write(tmp_path, tdoa(rows, extra))))


def test_kilometres_and_sound(tmp_path):
    text = tdoa(extra='unit = "ms"\nsigma = "2 ms"\n').replace(
        "format = 1\n", "format = 1\npropagation_speed = 343.0\n"
    )
    problem = load(write(tmp_path, text.replace("[stations]\n", '[stations]\nunit = "km"\n')))
    np.testing.assert_allclose(problem.z, [z * 0.343 for _, _, z in TDOA])
    np.testing.assert_allclose(problem.stations.position[0], 1e3 * np.array(list(STATIONS.values())))
    np.testing.assert_allclose(dense(problem.noise, np.arange(3)), np.eye(3) * (2 * 0.343) ** 2)
    assert (problem.written.place_unit, problem.written.place_keys) == (1e3, ("x", "y", "z"))


@pytest.mark.parametrize("more", [", sigma = 1.0", ", vx = 0.0, vy = 0.0, vz = 0.0"])
def test_rows_of_stations_with_more_than_coordinates_have_no_known_keys(more, tmp_path):
    text = tdoa(extra="arrival_sigma = 3.0\n").replace(" }", f"{more} }}", len(STATIONS))
    assert load(write(tmp_path, text)).written.place_keys == ()


def long_table():
    rng = np.random.default_rng(3)
    return pd.DataFrame(
        {
            "epoch": np.repeat([3, 1, 2], 3),
            "a": ["B", "C", "D"] * 3,
            "b": "A",
            "z": rng.normal(0.0, 500.0, 9),
            "sigma": rng.uniform(1.0, 3.0, 9),
            "weight": [1.0, 1.0, 0.5, *[1.0] * 6],
            "correction": rng.normal(0.0, 1.0, 9),
        }
    )


def test_csv_parquet_inline_and_frame_are_the_same_problem(tmp_path):
    table = long_table()
    station_table = pd.DataFrame([(n, *p) for n, p in STATIONS.items()], columns=["name", "x", "y", "z"])
    for name, frame in (("rows", table), ("stations", station_table)):
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
        frame.to_parquet(tmp_path / f"{name}.parquet")
    rows = "rows = " + json.dumps(table.to_dict("records")).replace('":', '" =')
    sources = ('file = "rows.csv"', 'file = "rows.parquet"', rows)
    problems = [load(write(tmp_path, f'{HEAD}[[measurements]]\nkind = "tdoa"\n{source}\n')) for source in sources]
    for suffix in ("csv", "parquet"):
        head = f'format = 1\n[stations]\nfile = "stations.{suffix}"\n'
        problems.append(load(write(tmp_path, f'{head}[[measurements]]\nkind = "tdoa"\nfile = "rows.{suffix}"\n')))
    problems.append(from_table(table, station_table, kind="tdoa"))
    problems.append(from_table(table.to_dict("list"), STATIONS, kind="tdoa"))
    problems.append(from_table(table, problems[0].stations, kind="tdoa"))
    for other in problems[1:]:
        same(problems[0], other, rtol=1e-15)
    assert [m.span for m in problems[0].motions] == ["epoch"]
    assert read(write(tmp_path, f'{HEAD}[[measurements]]\nkind = "tdoa"\nfile = "rows.csv"\n')).epochs == (
        "1",
        "2",
        "3",
    )


def test_a_column_of_kinds_with_a_unit_each():
    table = pd.DataFrame(
        {"kind": ["tdoa", "azimuth", "tdoa"], "a": ["B", "A", "C"], "b": ["A", "", "A"], "z": [1.0, 90.0, 2.0]}
    )
    table["sigma"] = [0.1, 1.0, 0.1]
    problem = from_table(table, STATIONS, unit={"tdoa": "km", "azimuth": "deg"}, azimuth="north-clockwise")
    assert [rows.kind for rows in problem.rows] == ["tdoa", "azimuth"]
    np.testing.assert_allclose(problem.z, [1000.0, 2000.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(dense(problem.noise, np.arange(3))), [1e4, 1e4, np.radians(1.0) ** 2])


@given(st.lists(st.floats(-180.0, 360.0), min_size=1, max_size=5))
def test_compass_bearings_and_counterclockwise_azimuths_agree(bearings):
    a = ["A"] * len(bearings)
    north = from_table(
        {"a": a, "z": bearings}, STATIONS, kind="azimuth", unit="deg", sigma=1.0, azimuth="north-clockwise"
    )
    east = from_table({"a": a, "z": [90.0 - v for v in bearings]}, STATIONS, kind="azimuth", unit="deg", sigma=1.0)
    same(north, east)


@given(st.floats(-5e3, 5e3), st.sampled_from(["m", "km", "ft", "ns", "us"]), st.floats(0.01, 100.0))
def test_any_unit_of_length(value, unit, sigma):
    from optloc.base.units import to_si

    problem = from_table({"a": ["B"], "b": ["A"], "z": [value]}, STATIONS, kind="tdoa", unit=unit, sigma=sigma)
    np.testing.assert_allclose(problem.z, to_si([value], unit, "length"))
    np.testing.assert_allclose(dense(problem.noise, np.arange(1)), to_si([[sigma]], unit, "length") ** 2)


def test_sign_of_differences_and_excess_paths():
    b_farther = from_table({"a": ["B"], "b": ["A"], "z": [7.0]}, STATIONS, kind="tdoa", sigma=1.0, positive="b-farther")
    same(b_farther, from_table({"a": ["A"], "b": ["B"], "z": [7.0]}, STATIONS, kind="tdoa", sigma=1.0))
    excess = from_table({"a": ["B"], "b": ["A"], "z": [7.0]}, STATIONS, kind="range_sum", sigma=1.0, excess=True)
    baseline = np.linalg.norm(np.subtract(STATIONS["A"], STATIONS["B"]))
    np.testing.assert_allclose(excess.z, [7.0 + baseline])


def test_arrivals_that_rows_share_correlate_them(tmp_path):
    problem = load(write(tmp_path, tdoa(extra="arrival_sigma = { A = 1.0, B = 2.0, C = 3.0, D = 4.0 }\n")))
    np.testing.assert_allclose(dense(problem.noise, np.arange(3)), np.ones((3, 3)) + np.diag([4.0, 9.0, 16.0]))


def test_a_matrix_is_repeated_in_every_epoch_and_may_span_kinds(tmp_path):
    matrix = [[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 1.0]]
    rows = [{"epoch": k, "a": a, "b": "A", "z": 1.0} for k in (0, 1) for a in "BCD"]
    problem = from_table(pd.DataFrame(rows), STATIONS, kind="tdoa", unit="km", covariance=matrix)
    for k in (0, 1):
        np.testing.assert_allclose(dense(problem.noise, 3 * k + np.arange(3)), 1e6 * np.array(matrix))
    text = f"""covariance = {matrix}\n{HEAD}[[measurements]]\nkind = "tdoa"\n{inline(TDOA[:2])}
[[measurements]]\nkind = "azimuth"\nunit = "deg"\nazimuth = "north-clockwise"\nrows = [{{ a = "A", z = 10.0 }}]\n"""
    problem = load(write(tmp_path, text.replace("format = 1\n", "").replace("covariance", "format = 1\ncovariance", 1)))
    scale = np.array([1.0, 1.0, -np.pi / 180])
    np.testing.assert_allclose(dense(problem.noise, np.arange(3)), np.array(matrix) * scale * scale[:, None])


def test_latitudes_and_longitudes(tmp_path):
    place = np.radians([47.0, 47.1, 47.2]), np.radians([11.0, 11.1, 10.9]), np.array([500.0, 600.0, 700.0])
    earth = load(write(tmp_path, GEODETIC.format(frame='kind = "geodetic"')))
    np.testing.assert_allclose(earth.stations.position[0], ECEF.from_geodetic(*place))
    np.testing.assert_allclose(earth.stations.axes[0], ECEF.enu_axes(ECEF.from_geodetic(*place)))
    origin = Frame.enu(lat_deg=47.0, lon_deg=11.0, height=400.0)
    text = 'kind = "enu"\norigin = { lat_deg = 47.0, lon_deg = 11.0, height = 400.0 }'
    local = load(write(tmp_path, GEODETIC.format(frame=text)))
    assert local.frame == origin
    np.testing.assert_allclose(local.stations.position[0, 0], [0.0, 0.0, 100.0], atol=1e-6)
    middle = load(write(tmp_path, GEODETIC.format(frame='kind = "enu"')))
    np.testing.assert_allclose(middle.stations.position.mean(-2), 0.0, atol=1e-6)
    plane = load(write(tmp_path, GEODETIC.format(frame='kind = "enu"\ndimension = 2')))
    assert plane.dimension == 2


def test_axes_of_stations():
    stations = pd.DataFrame({"name": ["A", "B"], "x": [0.0, 9.0], "y": [0.0, 1.0], "heading_deg": [90.0, 0.0]})
    rows = {"a": ["A", "B"], "z": [0.0, 0.0]}
    problem = from_table(rows, stations, kind="azimuth", unit="deg", sigma=1.0, azimuth="north-clockwise")
    # Bearing zero from a station that heads east points east: along its second axis.
    np.testing.assert_allclose(problem.stations.axes[0, 0], [[0.0, -1.0], [1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(problem.stations.axes[0, 1], np.eye(2), atol=1e-12)
    half = np.sqrt(0.5)
    spatial = pd.DataFrame({"name": ["A"], "x": 0.0, "y": 0.0, "z": 0.0, "qw": half, "qx": 0.0, "qy": 0.0, "qz": half})
    turned = from_table({"a": ["A"], "z": [0.0]}, spatial, kind="azimuth", sigma=1.0)
    np.testing.assert_allclose(turned.stations.axes[0, 0], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_epochs_by_window_and_by_time(tmp_path):
    table = {"time": [5.00, 0.02, 0.0, 5.01, 9.0], "a": list("BBCDB"), "b": ["A"] * 5, "z": np.arange(5.0)}
    windowed = from_table(table, STATIONS, kind="tdoa", sigma=1.0, window="0.1 s")
    np.testing.assert_array_equal(windowed.epoch, [1, 0, 0, 1, 2])
    np.testing.assert_allclose(windowed.times, [0.01, 5.005, 9.0])
    exact = from_table(table, STATIONS, kind="tdoa", sigma=1.0, motion="constant_velocity")
    np.testing.assert_array_equal(exact.epoch, [2, 1, 0, 3, 4])
    assert (exact.motions[0].order, exact.motions[0].span) == (1, "run")
    dates = {**table, "time": np.array(["2026-01-01T00:00:05", "2026-01-01"] * 2 + ["2026-01-02"], dtype="M8[ms]")}
    np.testing.assert_array_equal(from_table(dates, STATIONS, kind="tdoa", sigma=1.0).epoch, [1, 0, 1, 0, 2])


TIMED = """format = 2
[stations]
rows = [{ name = "A", x = 0.0, y = 0.0 }, { name = "B", x = 100.0, y = 0.0 }, { name = "C", x = 0.0, y = 100.0 }]
[[measurements]]
kind = "range"
sigma = 1.0
columns = { time = "t" }
rows = [
  { t = %s, a = "A", z = 50.0 }, { t = %s, a = "B", z = 70.0 }, { t = %s, a = "C", z = 80.0 },
]
[target]
motion = "constant_velocity"
reference = 1400000000.0
"""


@pytest.mark.parametrize(("scale", "first"), [("gps", 1_715_964_782.0), ("tai", 1_399_999_965.0), ("unix", 1.4e9)])
def test_times_of_a_scale_are_since_1970(scale, first, tmp_path):
    text = TIMED % (1.4e9, 1.4e9, 1.4e9) + f'[epochs]\ntime_scale = "{scale}"\n'
    found = read(write(tmp_path, text))
    assert (found.dated, found.problem.dated, found.times.tolist()) == (True, True, [first])
    assert found.problem.motions[0].reference == first
    assert found.epochs == ("1400000000",)


@pytest.mark.parametrize("scale", ["", '[epochs]\ntime_scale = "none"\n'])
def test_seconds_without_a_scale_are_no_dates(scale, tmp_path):
    found = read(write(tmp_path, TIMED % (1.4e9, 1.4e9, 1.4e9) + scale))
    assert (found.dated, found.problem.dated, found.times.tolist()) == (False, False, [1.4e9])


def test_dates_have_no_other_scale(tmp_path):
    text = TIMED % (('"2024-05-17T16:53:02Z"',) * 3)
    assert read(write(tmp_path, text)).dated
    with pytest.raises(InvalidProblem, match="the measurements have dates, which are UTC, but the time scale is gps"):
        read(write(tmp_path, text + '[epochs]\ntime_scale = "gps"\n'))


def test_free_targets_have_epochs_of_their_own():
    rows = {
        "time": [0.0, 0.0, 1.0, 1.0],
        "target": ["u", "v", "u", "u"],
        "a": list("BBCD"),
        "b": ["A"] * 4,
        "z": [1.0] * 4,
    }
    free = from_table(rows, STATIONS, kind="tdoa", sigma=1.0)
    assert (free.epochs, len(free.motions)) == (3, 1)
    static = from_table(rows, STATIONS, kind="tdoa", sigma=1.0, motion="static")
    assert (static.epochs, len(static.motions)) == (2, 2)
    np.testing.assert_array_equal(static.rows[0].target, [0, 1, 0, 0])


def test_stations_move():
    labelled = pd.DataFrame(
        {"epoch": [0, 0, 1, 1], "name": ["A", "B"] * 2, "x": [0.0, 9.0, 1.0, 9.5], "y": [0.0, 1.0, 2.0, 3.0]}
    )
    rows = {"epoch": [1, 0], "time": [4.0, 2.0], "a": ["A", "B"], "z": [5.0, 6.0]}
    problem = from_table(rows, labelled, kind="range", sigma=1.0)
    np.testing.assert_allclose(problem.stations.position, [[[0, 0], [9, 1]], [[1, 2], [9.5, 3]]])
    timed = labelled.rename(columns={"epoch": "time"}).assign(time=[0.0, 0.0, 8.0, 8.0])
    problem = from_table(rows, timed, kind="range", sigma=1.0)
    np.testing.assert_allclose(problem.stations.position[:, 0], [[0.25, 0.5], [0.5, 1.0]])
    with pytest.raises(InvalidProblem, match="station 'A' has no position at epoch '1'"):
        from_table(rows, labelled[:3].drop(index=2), kind="range", sigma=1.0)


def test_biases_and_priors(tmp_path):
    text = (
        tdoa()
        + """[[biases]]\nname = "clock"\nmembers = ["B", "C", "D"]\nsigma = "200 m"\n
[[biases]]\nname = "scale"\nform = "scale"\nper = "kind"\n[[biases]]\nname = "pairs"\nper = "pair"\nsigma = "10 ns"
[[priors]]\nname = "position"\nmean = [1.0, 2.0, 3.0]\nunit = "km"\nsigma = "50 m"\n"""
    )
    problem = load(write(tmp_path, text))
    clock, scale, pairs = problem.biases
    assert (clock.members, scale.members, pairs.members) == (("B", "C", "D"), ("tdoa",), ("B-A", "C-A", "D-A"))
    np.testing.assert_array_equal(clock.member, [0, 1, 2])
    np.testing.assert_allclose(clock.sigma, 200.0)
    np.testing.assert_allclose(pairs.sigma, SPEED_OF_LIGHT * 1e-8)
    assert scale.sigma is None
    np.testing.assert_allclose(problem.priors[0].mean, [1e3, 2e3, 3e3])
    np.testing.assert_allclose(problem.priors[0].covariance, 2500.0 * np.eye(3))


def test_station_errors(tmp_path):
    head = HEAD.replace("[stations]\n", '[stations]\nsigma = "5 m"\nspan = "run"\n')
    stations = load(write(tmp_path, tdoa(head=head))).stations
    assert stations.span == "run"
    np.testing.assert_allclose(stations.covariance, np.broadcast_to(25.0 * np.eye(3), (4, 3, 3)))


def test_ten_thousand_epochs_load_in_a_second(tmp_path):
    k, names = 10_000, list("BCDBC")
    frame = pd.DataFrame({"t": np.repeat(np.arange(k) * 0.1, 5), "a": names * k, "b": "A", "z": np.arange(5.0 * k)})
    frame.loc[frame.index % 5 > 2, "b"] = "D"
    frame.to_csv(tmp_path / "rows.csv", index=False)
    text = (
        f'{HEAD}[[measurements]]\nkind = "tdoa"\narrival_sigma = 3.0\nfile = "rows.csv"\ncolumns = {{ time = "t" }}\n'
    )
    path = write(tmp_path, text)
    load(path)
    start = time.process_time()
    problem = load(path)
    assert time.process_time() - start < 3.0
    assert problem.epochs == k


def test_schema_is_json_and_names_every_kind():
    text = json.dumps(schema())
    assert all(f'"{kind}"' in text for kind in ("tdoa", "groa", "range_sum", "fdoa"))


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_one_sentence_with_its_place(name, tmp_path):
    text, words = BAD[name]
    bad_files(tmp_path)
    with pytest.raises(InvalidProblem) as caught:
        load(write(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_a_simulation_keeps_the_format_and_so_the_bearings_of_its_file(tmp_path):
    path = tmp_path / "site.toml"
    rows = "".join(f'{{a = "{n}", z = {z}}},' for n, z in (("P", 45.0), ("Q", 315.0)))
    path.write_text(
        'format = 2\n[stations]\nrows = [{name = "P", lat = 48.0, lon = 11.0, alt = 0.0},'
        '{name = "Q", lat = 48.0, lon = 11.1, alt = 0.0}]\n[[measurements]]\nkind = "azimuth"\nunit = "deg"\n'
        f'sigma = 1.0\nrows = [{rows}]\n[[constraints]]\nkind = "height"\nexactly = "0 m"\n'
    )
    problem = load(path)
    write_measured(path, tmp_path / "again.toml", problem.z[None])
    assert "format = 2" in (tmp_path / "again.toml").read_text()
    assert load(tmp_path / "again.toml").z == pytest.approx(problem.z)
