"""Columns of foreign tables: one role each, units that fit, nothing measured that is left out without a message."""

import csv
import itertools
import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, solve
from optloc.cli import app
from optloc.files.columns import any_unit, role_of, roles, sigma_kind, stem
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints
from optloc.models import MODELS

RUN = CliRunner()
SITES = {
    "N1": (0.0, 0.0, 3.0),
    "N2": (20.0, 1.0, 0.5),
    "N3": (13.0, 17.0, 2.0),
    "N4": (-3.0, 12.0, 4.0),
    "N5": (6.0, 6.0, 9.0),
}
TAG = np.array([4.0, 5.0, 1.5])
FAR = {name: float(np.linalg.norm(TAG - at)) for name, at in SITES.items()}
C = 0.299792458  # metres in a nanosecond


def sites(folder, names=SITES, name="sites.csv"):
    path = folder / name
    rows = "".join(f"{called},{x},{y},{z}\n" for called, (x, y, z) in zip(names, SITES.values(), strict=True))
    path.write_text("name,x_m,y_m,z_m\n" + rows)
    return path


def read(folder, text, name="t.csv", **told):
    path = folder / name
    if isinstance(text, str):
        path.write_text(text)
    else:
        text.to_parquet(path)
    told.setdefault("stations", folder / "sites.csv")
    if not told["stations"].exists():
        sites(folder)
    return interpret_table(path, ColumnHints(**{"sigma": "10 cm", **told}))


def fixed(made):
    fix = solve(made.read().problem)
    return np.linalg.norm(fix.position.reshape(-1, 3) - TAG, axis=-1).max()


def rows(head, line):
    return head + "\n" + "\n".join(line.format(n=name, r=r, t=r / C) for name, r in FAR.items()) + "\n"


# The table of names.


def test_no_name_has_two_roles():
    owners = {}
    for role, entry in roles().items():
        for name, unit in itertools.product(entry.names, (None, *entry.units)):
            owners.setdefault((name, unit), []).append(role)
        for name, unit in itertools.product(entry.with_unit, entry.units):
            owners.setdefault((name, unit), []).append(role)
    assert len(owners) > 500
    assert not {key: found for key, found in owners.items() if len(found) > 1}


def test_each_name_of_the_table_is_found_with_each_of_its_units():
    for role, entry in roles().items():
        for name in entry.names:
            assert stem(name) == name
            assert role_of(name) == role
            for unit in entry.units:
                column = f"{name}_{unit}"
                if any_unit(column) == unit:  # minutes, hours and plain numbers are no units of a header
                    assert role_of(column) == role_of(f"{name.upper()} [{unit}]") == role


@pytest.mark.parametrize(
    ("column", "role"),
    [
        ("elevation_deg", "elevation"),
        ("Elevation [m]", "height"),
        ("altitude_deg", "elevation"),
        ("alt_ft", "height"),
        ("elev (rad)", "elevation"),
        ("pseudorange_m", "toa"),
        ("TOA ns", "toa"),
        ("epoch", "message"),
        ("epoch_s", "time"),
        ("field.id", "id"),
        ("%time", "time"),
        ("rssDifference_dB", "rss_difference"),
        ("range_deg", None),
        ("bearing_m", None),
        ("station_m", None),
        ("lat_m", None),
        ("x_deg", None),
        ("squawk", None),
    ],
)
def test_a_unit_must_fit_the_role(column, role):
    assert role_of(column) == role


@pytest.mark.parametrize(
    ("column", "kind"),
    [
        ("sigma_range_m", "range"),
        ("range_std [cm]", "range"),
        ("std_toa_ns", "toa"),
        ("Bearing_Sigma_deg", "azimuth"),
        ("elevation_sd_deg", "elevation"),
        ("sigma_m", None),
        ("pseudorange_uncertainty_m", "toa"),
        ("sigma_squawk", None),
    ],
)
def test_errors_name_their_kind(column, kind):
    assert sigma_kind(column) == kind


# One role, and the role that was asked for.


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("time_s,anchor,pseudorange_m", "1000.0,{n},{r:.9f}"),
        ("t,anchor,pr [km]", "7,{n},{r:.9f}e-3"),
        ("timestamp,rx,rho_cm", "7,{n},{r:.9f}e2"),
        ("pseudorange_ft,utc_s,node", "{r:.9f}e0,5,{n}"),
        ("epoch_s,station,toa_ns", "3,{n},{t:.9f}"),
        ("toa_us,sensor,rxtime", "{t:.9f}e-3,{n},3"),
    ],
)
def test_a_time_is_not_the_reading_where_another_column_is(head, line, tmp_path):
    line = line.replace("{r:.9f}e0", "{f:.9f}")
    text = (
        head
        + "\n"
        + "".join(line.format(n=n, r=r + 12.5, t=(r + 12.5) / C, f=(r + 12.5) / 0.3048) + "\n" for n, r in FAR.items())
    )
    assert fixed(read(tmp_path, text)) < 1e-5


@pytest.mark.parametrize(
    ("pair", "names"),
    [
        (("a", "b"), "ABCDE"),
        (("a", "b"), ["a", "b", "c", "d", "e"]),
        (("station", "reference"), ["station", "reference", "x", "y", "z"]),
        (("a", "b"), ["1", "2", "3", "4", "5"]),
        (("station_a", "ref"), ["range", "m", "t", "x", "toa"]),
    ],
)
def test_stations_may_be_called_like_columns(pair, names, tmp_path):
    far = dict(zip(names, FAR.values(), strict=True))
    first, *rest = names
    lines = "".join(f"{name},{first},{(far[name] - far[first]) / C:.9f}\n" for name in rest)
    made = read(tmp_path, f"{','.join(pair)},tdoa_ns\n{lines}", stations=sites(tmp_path, names), sigma="0.1 ns")
    assert fixed(made) < 1e-5
    ranges = "".join(f"{name},{r:.9f}\n" for name, r in far.items())
    assert fixed(read(tmp_path, f"anchor,range_m\n{ranges}", stations=sites(tmp_path, names))) < 1e-5


@pytest.mark.parametrize(
    ("head", "extra"),
    [
        ("observer,lat,lon,azimuth_deg,elevation_deg", ""),
        ("observer,lat,lon,elevation_m,azimuth_deg,elevation_deg", "0,"),
        ("Site,Latitude,Longitude,Height [ft],bearing_deg,altitude_deg", "0,"),
        ("name,lat_deg,lon_deg,alt_m,az (deg),el (deg)", "0,"),
        ("rx,lat,lon,depth_m,azimuth_deg,elev_deg", "0,"),
    ],
)
def test_an_angle_is_no_height(head, extra, tmp_path):
    from pymap3d import geodetic2aer

    spots = {"Ann": (47.8, 11.2), "Ben": (47.804, 11.201), "Cat": (47.803, 11.206), "Dan": (47.7995, 11.205)}
    text = head + "\n"
    for name, (lat, lon) in spots.items():
        az, el, _ = geodetic2aer(47.8018, 11.2027, 300.0, lat, lon, 0.0)
        text += f"{name},{lat},{lon},{extra}{az:.6f},{el:.6f}\n"
    (tmp_path / "t.csv").write_text(text)
    told = RUN.invoke(app, ["fix", str(tmp_path / "t.csv"), "--sigma", "0.1 deg", "--json"])
    found = json.loads(told.stdout)
    assert found["fixes"][0]["height"] == pytest.approx(300.0, abs=0.01)
    assert found["table"]["columns"][head.split(",")[-1]] == "elevation"


def test_an_elevation_without_a_unit_is_asked_for(tmp_path):
    text = "anchor,azimuth_deg,elevation\nN1,45,30\nN2,50,20\n"
    told = {"sigma": "1 deg", "azimuth": "north-clockwise"}
    with pytest.raises(InvalidProblem, match=r"'elevation' may be an angle or a height; use --column elevation=elev"):
        read(tmp_path, text, **told)
    assert [one.kind for one in read(tmp_path, text, unit="deg", **told).sections] == ["azimuth", "elevation"]
    chosen = read(tmp_path, text, columns={"elevation": "elevation"}, **told).sections
    assert [(one.kind, one.unit) for one in chosen] == [("azimuth", "deg"), ("elevation", "deg")]
    assert [one.kind for one in read(tmp_path, text, ignore=("elevation",), **told).sections] == ["azimuth"]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"toa": "nothing"}, "there is no column 'nothing' for the toa"),
        ({"toa": "when_s"}, None),
        ({"range": "angle_deg"}, r"'angle_deg' is in deg, which is not a unit of the role range"),
        ({"time": "far_m"}, r"'far_m' is in m, which is not a unit of the role time"),
        ({"toa": "when_s", "time": "when_s"}, r"'when_s' is given two roles, toa and time"),
        ({"toa": "when_s", "arrivals": "far_m"}, r"the role toa is given to two columns, 'when_s' and 'far_m'"),
        ({"toa": "when_s", "reference": "anchor2"}, r"the role reference of the column 'anchor2' is not used"),
        ({"toa": "when_s", "phase": "anchor2"}, r"the role phase of the column 'anchor2' is not used"),
        ({"toa": "when_s", "x": "anchor2"}, r"there is no column 'anchor2' for the x"),
    ],
)
def test_a_role_that_is_named_is_used_or_refused(columns, words, tmp_path):
    text = "rx,when_s,far_m,angle_deg,anchor2\n" + "".join(
        f"{n},{r / C * 1e-9:.15f},{r},30,N1\n" for n, r in FAR.items()
    )
    if words is None:
        made = read(tmp_path, text, columns=columns)
        assert made.uses["when_s"] == "toa"
        assert fixed(made) < 1e-5
        return
    with pytest.raises(InvalidProblem, match=words):
        read(tmp_path, text, columns=columns)


def test_a_role_of_places_that_is_named_is_used_or_refused(tmp_path):
    table = tmp_path / "geo.csv"
    table.write_text("name,lat,lon,alt_m,x\nA,47,11,500,1\nB,47.1,11,600,2\nC,47,11.1,700,3\n")
    text = "rx,range_m\nA,9000\nB,8000\nC,7000\n"
    assert read(tmp_path, text, stations=table).places.frame == "geodetic"
    with pytest.raises(InvalidProblem, match=r"the role x of the column 'x' is not used in geo\.csv"):
        read(tmp_path, text, stations=table, columns={"x": "x"})


# What is left over.


@pytest.mark.parametrize(
    "column",
    [
        "distance2_range_m",
        "pseudorange_km",
        "bearing_deg",
        "elevation_deg",
        "toa_ns",
        "doppler_kn",
        "altitude_ft",
        "height_m",
        "range_sum_m",
        "slant_range_m",
        "raw.range_m",
        "dist_raw_m",
        "az_mean_deg",
        "depth_m",
        "tdoa_us",
        "rssd_dB",
    ],
)
def test_a_measurement_is_not_left_out_without_a_message(column, tmp_path):
    text = rows(f"anchor,range_m,{column}", "{n},{r:.9f},30.5")
    told = {"what": "range"}
    with pytest.raises(
        InvalidProblem, match=rf"'{column}': the column may have a measurement .* --ignore {column} leaves"
    ):
        read(tmp_path, text, **told)
    made = read(tmp_path, text, ignore=(column,), **told)
    assert column not in made.uses
    assert fixed(made) < 1e-5


@pytest.mark.parametrize(
    "columns", [("squawk", "cn0"), ("note", "el"), ("rssi_dBm", "d"), ("quality", "temperature_C")]
)
def test_other_columns_are_named_in_one_line(columns, tmp_path):
    text = rows("anchor,range_m," + ",".join(columns), "{n},{r:.9f},30.5,1")
    made = read(tmp_path, text, what="range")
    assert dict(made.about)["not used"] == ", ".join(columns)
    assert fixed(made) < 1e-5


@pytest.mark.parametrize("column", ["dist_corr_m", "far [cm]", "range_raw", "twr2", "angle_deg", "level_dB"])
def test_times_are_no_arrivals_beside_a_column_that_may_hold_the_readings(column, tmp_path):
    text = rows(f"time_s,anchor,{column}", "{t}e-9,{n},{r:.9f}")
    with pytest.raises(
        InvalidProblem, match=r"the readings may be in '.*', or may be the times in 'time_s'; use --column"
    ):
        read(tmp_path, text)
    assert fixed(read(tmp_path, rows("time_s,anchor,squawk", "{t}e-9,{n},7000"))) < 1e-5


def test_what_is_ignored_must_be_there(tmp_path):
    with pytest.raises(InvalidProblem, match=r"t\.csv has no column 'bearing'; did you mean 'bearing_deg'"):
        read(tmp_path, rows("anchor,range_m,bearing_deg", "{n},{r},3"), ignore=("bearing",))


def test_a_wide_table_leaves_no_kind_out(tmp_path):
    head = "t_s," + ",".join(f"dist_{n}_m,toa_{n}_ns" for n in FAR)
    text = head + "\n0," + ",".join(f"{r},{r / C}" for r in FAR.values()) + "\n"
    with pytest.raises(
        InvalidProblem, match=r"column 'toa_N1_ns': the column may have a measurement \(arrival times\)"
    ):
        read(tmp_path, text, what="range")
    gone = tuple(f"toa_{n}_ns" for n in FAR)
    assert fixed(read(tmp_path, text, what="range", ignore=gone)) < 1e-6
    both = read(tmp_path, text, sigma="range=1 cm,toa=1 ns")
    assert [one.kind for one in both.sections] == ["range", "toa"]


# Standard deviations.


@pytest.mark.parametrize(
    ("head", "line", "kinds"),
    [
        ("anchor,range_m,sigma_cm", "{n},{r},20", {"range": 0.2}),
        ("anchor,range_m,std", "{n},{r},0.2", {"range": 0.2}),
        ("anchor,range_m,range_std_mm", "{n},{r},200", {"range": 0.2}),
        ("anchor,toa_ns,toa_sigma_us", "{n},{t},0.002", {"toa": 2 * C}),
        (
            "anchor,range_m,bearing_deg,range_sigma_m,sigma_bearing_deg",
            "{n},{r},3,0.2,4",
            {"range": 0.2, "azimuth": 0.0698131700797732},
        ),
        ("anchor,range_m,bearing_deg,sigma_m,sd_deg", "{n},{r},3,0.2,4", None),
        ("anchor,pseudorange_m,uncertainty_m,time_s", "{n},{r},0.2,5", {"toa": 0.2}),
    ],
)
def test_errors_of_all_kinds_are_read(head, line, kinds, tmp_path):
    from optloc.problem import noise

    if kinds is None:  # two plain columns of errors: the first one has no unit of an angle
        with pytest.raises(InvalidProblem, match="the accuracy of the readings of azimuth is"):
            read(tmp_path, rows(head, line), sigma=None)
        return
    problem = read(tmp_path, rows(head, line), sigma=None).read().problem
    at = 0
    for one in problem.rows:
        spread = np.sqrt(np.diag(noise.dense(problem.noise, np.arange(at, at + len(one.a)))))
        np.testing.assert_allclose(spread, kinds[one.kind], rtol=1e-9)
        at += len(one.a)


def test_errors_without_a_unit_are_asked_for_beside_several_kinds(tmp_path):
    text = rows("anchor,range_m,bearing_deg,sigma", "{n},{r},3,2")
    with pytest.raises(
        InvalidProblem, match=r"'sigma' may be the error of range or azimuth; use --column sigma_range=sig"
    ):
        read(tmp_path, text, sigma=None)
    chosen = {"columns": {"sigma_range": "sigma"}, "sigma": "bearing=1 deg"}
    sections = read(tmp_path, text, **chosen).sections
    assert [(one.kind, "sigma" in one.columns, one.sigma) for one in sections] == [
        ("range", True, None),
        ("azimuth", False, "1 deg"),
    ]


def test_errors_of_a_wide_table_are_read_by_row_or_by_receiver(tmp_path):
    head = "t_s," + ",".join(f"{n}_m" for n in FAR)
    line = "0," + ",".join(f"{r}" for r in FAR.values())
    by_row = read(tmp_path, f"{head},sigma_cm\n{line},7\n", what="range", sigma=None).sections[0]
    np.testing.assert_allclose(by_row.columns["sigma"], 0.07)
    errors = ",".join(f"{n}_sigma_cm" for n in FAR)
    each = read(tmp_path, f"{head},{errors}\n{line},1,2,3,4,5\n", what="range", sigma=None).sections[0]
    np.testing.assert_allclose(each.columns["sigma"], [0.01, 0.02, 0.03, 0.04, 0.05])


# Windows of time, whatever the column of times is called.


@pytest.mark.parametrize(
    ("name", "unit", "told"),
    [
        ("stamp_ns", 1e-9, {"columns": {"time": "stamp_ns"}}),
        ("field.stamp", 1e-9, {"columns": {"time": "field.stamp"}, "time_unit": "ns"}),
        ("%time", 1e-3, {"time_unit": "ms"}),
        ("timestamp", 1e-9, {"time_unit": "ns"}),
        ("when", 1e-6, {"columns": {"time": "when"}, "time_unit": "us"}),
        ("t [ms]", 1e-3, {}),
    ],
)
def test_a_window_needs_the_unit_of_the_times_not_their_name(name, unit, told, tmp_path):
    base = round(1734501485.0 / unit)
    lines = ""
    for scan in range(3):
        for i, (n, r) in enumerate(FAR.items()):
            lines += f"{base + round((0.1 * scan + 0.001 * i + 0.01) / unit)},{n},{r}\n"
    text = f"{name},anchor,range_m\n{lines}"
    assert read(tmp_path, text, window="0.06 s", **told).read().problem.epochs == 3
    assert read(tmp_path, text, window="3 s", **told).read().problem.epochs == 1
    if "time_unit" in told:
        with pytest.raises(
            InvalidProblem, match=r"unit of the times in column '.*' is unknown; state it with --time-unit"
        ):
            read(tmp_path, text, window="0.06 s", **{key: value for key, value in told.items() if key != "time_unit"})


@pytest.mark.parametrize(
    ("head", "size"), [("rx,toa_us", 1e-6), ("rx,pseudorange_km", 1e3 / 299792458.0), ("rx,arrival [ns]", 1e-9)]
)
def test_a_window_puts_arrivals_together_by_their_gaps(head, size, tmp_path):
    lines = "".join(f"{n},{(0.5 * k + 1e-9 * r / C) / size!r}\n" for k in range(3) for n, r in FAR.items())
    made = read(tmp_path, f"{head}\n{lines}", window="1 ms")
    assert made.read().problem.epochs == 3
    assert fixed(made) < 1e-3


@pytest.mark.parametrize("epochs", [1, 3])
def test_a_window_without_times_is_refused_before_repeats_are(epochs, tmp_path):
    text = "stamp_ms,anchor,range_m\n" + "".join(f"{k},{n},{r}\n" for k in range(epochs) for n, r in FAR.items())
    with pytest.raises(InvalidProblem, match="a window needs a column of times; state the time column"):
        read(tmp_path, text, window="0.2 s")


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"time_unit": "m"}, "'m' is not a unit of time"),
        ({"time_unit": "s"}, r"the column 't_ms' ends in ms, not in s"),
        ({"window": "soon"}, "soon"),
    ],
)
def test_wrong_units_of_times_are_refused(told, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        read(tmp_path, rows("t_ms,anchor,range_m", "5,{n},{r}"), **told).read()


# Signs.


@pytest.mark.parametrize(
    ("head", "sign", "further"),
    [
        ("a,b,rss_difference_dB", "second", lambda a, b: 20 * np.log10(b / a)),
        ("station,reference,rssd [dB]", "second", lambda a, b: 20 * np.log10(b / a)),
        ("a,b,tdoa_m", "first", lambda a, b: a - b),
        ("a,b,groa_dB", "first", lambda a, b: 20 * np.log10(a / b)),
        ("a,ref,gain_ratio_dB", "first", lambda a, b: 20 * np.log10(a / b)),
    ],
)
def test_the_sign_is_told_as_it_is(head, sign, further, tmp_path):
    lines = "".join(f"{n},N1,{further(r, FAR['N1']):.9f}\n" for n, r in FAR.items() if n != "N1")
    made = read(tmp_path, f"{head}\n{lines}", sigma="0.1 dB" if "dB" in head else "1 cm")
    assert dict(made.about)["sign"] == f"positive if the {sign} is farther"
    problem = made.read().problem
    where = problem.stations.position.reshape(-1, 3)
    one = problem.rows[0]
    r = np.linalg.norm(TAG - where, axis=-1)
    z = further(r[one.a], r[one.b])
    np.testing.assert_allclose(_plain(one), z, atol=1e-6)
    turned = read(tmp_path, f"{head}\n{lines}", sigma="0.1 dB" if "dB" in head else "1 cm", positive="b-farther")
    assert dict(turned.about)["sign"] == f"positive if the {'first' if sign == 'second' else 'second'} is farther"


def _plain(one):
    """Return measured values as they stand in a file: ratios in decibels."""
    return 20 * np.log10(one.z) if one.kind == "groa" else one.z


# Lists in documents and in cells.


NESTED = {
    "a list in an object": {"time_s": 5, "readings": [{"anchor": n, "range_m": r} for n, r in FAR.items()]},
    "two levels": {
        "log": {"scans": [{"t_s": 1, "tag": {"ranges": [{"anchor": n, "range_m": r} for n, r in FAR.items()]}}]}
    },
    "lists beside each other": [{"t_s": 1, "anchor": list(FAR), "range_m": list(FAR.values())}],
    "an object of lists": {"anchors": list(FAR), "anchor": list(FAR), "range_m": list(FAR.values())},
    "objects by name": [{"t_s": 1, "range": {f"{n}_m": r for n, r in FAR.items()}}],
    "a list in a list": [{"t_s": 1, "parts": [{"part": [{"anchor": n, "range_m": r}]} for n, r in FAR.items()]}],
}


@pytest.mark.parametrize("name", NESTED)
def test_lists_are_found_at_any_depth(name, tmp_path):
    made = read(tmp_path, json.dumps(NESTED[name]), "t.json", what="range")
    assert made.read().problem.count == len(FAR)
    assert fixed(made) < 1e-6


@pytest.mark.parametrize("kind", ["json", "python", "parquet", "objects"])
def test_lists_in_cells_are_rows(kind, tmp_path):
    frame = pd.DataFrame({"t_s": [0.0, 1.0], "anchor": [list(FAR)] * 2, "range_m": [list(FAR.values())] * 2})
    if kind == "parquet":
        made = read(tmp_path, frame, "t.parquet")
    elif kind == "objects":
        objects = [[{"anchor": n, "range_m": r} for n, r in FAR.items()]] * 2
        made = read(tmp_path, pd.DataFrame({"t_s": [0.0, 1.0], "readings": objects}), "t.parquet")
    else:
        spell = json.dumps if kind == "json" else str
        path = tmp_path / "t.csv"
        with path.open("w", newline="") as out:
            table = csv.writer(out)
            table.writerow(frame.columns)
            for row in frame.itertuples(index=False):
                table.writerow([row[0], spell(row[1]), spell(row[2])])
        made = read(tmp_path, path.read_text())
    assert made.read().problem.epochs == 2
    assert fixed(made) < 1e-6


def test_stations_of_a_document_may_have_lists_of_coordinates(tmp_path):
    path = tmp_path / "sites.json"
    path.write_text(json.dumps({n: {"position": list(at)} for n, at in SITES.items()}))
    assert fixed(read(tmp_path, rows("anchor,range_m", "{n},{r}"), stations=path)) < 1e-6


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([{"anchor": ["N1", "N2"], "range_m": [1.0]}], r"row 1: the lists have different lengths: anchor has 2"),
        ([{"a_b": 1, "a": {"b": 2}}], r"row 1: the value 'a_b' is given twice"),
        ([{"anchor": "N1", "range_m": [[1, 2]]}], r"finite number"),
        ({"readings": []}, r"no list of records|do not identify"),
    ],
)
def test_lists_that_say_nothing_are_refused(data, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        read(tmp_path, json.dumps(data), "t.json")


def test_json_contains_how_the_table_was_read(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(rows("time_s,anchor,pseudorange_m,squawk", "5,{n},{r},7000"))
    words = [str(path), "--stations", str(sites(tmp_path)), "--sigma", "1 m", "--quiet", "--json"]
    for command in ("fix", "check"):
        found = json.loads(RUN.invoke(app, [command, *words]).stdout)["table"]
        assert found["columns"] == {"pseudorange_m": "toa", "anchor": "station", "time_s": "time"}
        assert ["not used", "squawk"] in found["understood"]
    looked = json.loads(RUN.invoke(app, ["convert", *words]).stdout)
    assert looked["columns"] == found["columns"]


def test_every_kind_with_stations_is_a_role():
    assert {kind for kind, model in MODELS.items() if model.stations} <= set(roles())
