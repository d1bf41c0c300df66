"""Tables as they come: long and wide, units, gaps, repeats, dates, and what is asked for instead of guessed."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, locate, solve
from optloc.base.frames import ECEF
from optloc.base.units import SPEED_OF_LIGHT
from optloc.cli import app
from optloc.files.convert import interpret_table
from optloc.files.table_import import ColumnHints, named_columns

RUN = CliRunner()
SITES = {"Lake": (47.812, 11.183, 612.0), "Chapel": (47.861, 11.246, 701.0), "Quarry": (47.843, 11.121, 655.0)}
SITES |= {"Summit": (47.764, 11.262, 1410.0), "Mill": (47.751, 11.148, 640.0), "Tower": (47.79, 11.31, 842.0)}
ANCHORS = {
    "A1": (0.0, 0.0, 2.5),
    "A2": (6.0, 0.0, 0.3),
    "A3": (6.0, 8.0, 2.6),
    "A4": (0.0, 8.0, 0.2),
    "B-1": (3.0, 4.0, 3.0),
}
TAG = np.array([2.0, 3.0, 1.0])
NOW = 1_790_000_000_000_000_000


def place(lat, lon, height):
    return ECEF.from_geodetic(np.radians(lat), np.radians(lon), height)


def rx(folder):
    path = folder / "rx.csv"
    path.write_text("name,lat,lon,alt_m\n" + "".join(f"{n},{a},{b},{h}\n" for n, (a, b, h) in SITES.items()))
    return path


def anchors(folder):
    path = folder / "anchors.csv"
    rows = "".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in ANCHORS.items())
    path.write_text("anchor,x [m],y [m],z [m]\n" + rows)
    return path


def table(folder, text, name="t.csv"):
    path = folder / name
    path.write_text(text)
    return path


def table_problem(folder, text, name="t.csv", **told):
    return interpret_table(
        table(folder, text, name), ColumnHints(**{"sigma": "10 cm", "stations": anchors(folder), **told})
    )


def ranges():
    return {name: float(np.linalg.norm(TAG - at)) for name, at in ANCHORS.items()}


def run(*words, code=0):
    told = RUN.invoke(app, [str(word) for word in words])
    assert told.exit_code == code, told.output
    return told


# The newcomer's problems: one command from a table to the right answer.


def test_five_hundred_aircraft_messages_from_a_wide_table(tmp_path):
    rng = np.random.default_rng(4)
    places = {name: place(*at) for name, at in SITES.items()}
    truth, rows = [], []
    for k in range(500):
        truth.append(place(*(np.array([47.8, 11.2]) + rng.uniform(-0.04, 0.04, 2)), 9000.0 + 100.0 * rng.normal()))
        flight = {n: np.linalg.norm(truth[-1] - at) / SPEED_OF_LIGHT * 1e9 for n, at in places.items()}
        cells = [str(NOW + 250_000_000 * k + round(t + 5.0 * rng.normal())) for t in flight.values()]
        if k % 50 == 7:
            cells[k % 6] = ""
        rows.append(f"{k},3c{k % 4:04x}," + ",".join(cells) + ",7000")
    header = "msg,icao," + ",".join(f"{name}_ns" for name in SITES) + ",squawk\n"
    source, out = table(tmp_path, header + "\n".join(rows)), tmp_path / "fixes.csv"
    words = ["fix", source, "--stations", rx(tmp_path), "--sigma", "5 ns"]
    asked = run(*words, code=2)
    assert "do not identify their content; state it with --as arrivals" in asked.stderr
    told = run(*words, "--as", "arrivals", "--out", out, "--allow", "curved,ambiguous,unproven")
    assert "10 cells without a number: no reading" in told.stdout
    assert "not used  squawk" in told.stdout
    import pandas as pd

    found = pd.read_csv(out).sort_values("epoch", key=lambda label: label.astype(int))
    good = (found["status"] == "ok").to_numpy()
    assert good.mean() > 0.95
    off = np.linalg.norm(found[["x", "y", "z"]].to_numpy() - np.array(truth), axis=-1)[good]
    assert np.median(off) < 30.0
    assert set(found["target"]) == {f"3c{i:04x}" for i in range(4)}


NET = {"AQU": (42.354, 13.405, 710.0), "FIAM": (42.268, 13.117, 1070.0), "TERO": (42.623, 13.604, 673.0)}
NET |= {"CAMP": (42.536, 13.409, 1283.0), "FAGN": (42.266, 13.584, 761.0), "INTR": (42.011, 13.904, 924.0)}
FOCUS = place(42.342, 13.38, -9500.0)


def picks(folder, form):
    """Return a table of P and S picks, and the one of its stations."""
    stations = table(folder, "station,latitude,longitude,elevation_m\n", "net.csv")
    lines = {"columns": "station,P,S\n", "phases": "event,station,phase,time\n", "difference": "station,S-P (s)\n"}[
        form
    ]
    text = stations.read_text()
    for name, (lat, lon, height) in NET.items():
        text += f"{name},{lat},{lon},{height}\n"
        far = np.linalg.norm(FOCUS - place(lat, lon, height))
        p, s = (f"2026-04-06T01:32:{40.0 + far / v:013.10f}Z" for v in (6000.0, 3460.0))
        lines += {
            "columns": f"{name},{p},{s}\n",
            "phases": f"7,{name},Pg,{p}\n7,{name},Sn,{s}\n",
            "difference": f"{name},{far / 3460.0 - far / 6000.0:.9f}\n",
        }[form]
    stations.write_text(text)
    return table(folder, lines), stations


@pytest.mark.parametrize("form", ["columns", "phases", "difference"])
def test_an_earthquake_with_picks_of_p_and_s(form, tmp_path):
    source, stations = picks(tmp_path, form)
    words = ["fix", source, "--stations", stations, "--sigma", "0.02 s"]
    assert "state both, such as --vp '6 km/s' --vs '3.5 km/s'" in run(*words, code=2).stderr
    told = run(*words, "--vp", "6 km/s", "--vs", "3.46 km/s", "--json")
    fix = json.loads(told.stdout)["fixes"][0]
    assert fix["status"] == "ok"  # the mirror image is above ground
    assert np.linalg.norm([fix[axis] - at for axis, at in zip("xyz", FOCUS, strict=True)]) < 0.1
    assert fix["height"] == pytest.approx(-9500.0, abs=0.1)
    assert "are not faster" in run(*words, "--vp", "3 km/s", "--vs", "6 km/s", code=2).stderr


def test_three_compass_bearings_that_bring_their_places(tmp_path):
    from pymap3d import geodetic2aer

    sites = {"North": (47.9, 11.2), "West": (47.8, 11.05), "South": (47.72, 11.25)}
    rows = [f"{n},{a},{b},{geodetic2aer(47.82, 11.2, 0.0, a, b, 0.0)[0]:.4f}\n" for n, (a, b) in sites.items()]
    told = run("fix", table(tmp_path, "site,lat,lon,bearing_deg\n" + "".join(rows)), "--sigma", "1 deg", "--json")
    fix = json.loads(told.stdout)["fixes"][0]
    assert (fix["lat_deg"], fix["lon_deg"]) == pytest.approx((47.82, 11.2), abs=1e-5)
    assert fix["status"] == "ok"


# Long or wide, in all units.


def wide(form, unit, factor, extra=""):
    """Return a wide table of one row of ranges."""
    header = ",".join(form.format(name) + unit for name in ANCHORS)
    return (
        f"t_s,{header}{',note' if extra else ''}\n0.0,"
        + ",".join(f"{d / factor:.9f}" for d in ranges().values())
        + extra
    )


NESTED = {"columns": {"station": "at_anchor"}}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (wide("dist_{}", "_m", 1.0), {}),
        (wide("range {}", " [cm]", 0.01), {}),
        (wide("{} twr", " / ns", 1e-9 * SPEED_OF_LIGHT), {}),
        (wide("{}", "", 1.0), {"what": "range", "unit": "m"}),
        (wide("{}", " (mm)", 1e-3, ",x"), {"what": "distance"}),
        ("t_s,anchor,distance (m)\n" + "".join(f"0,{n},{d:.9f}\n" for n, d in ranges().items()), {}),
        ("t_s;Anchor;D\n" + "".join(f"0;{n};{d:.9f}\n" for n, d in ranges().items()), {"unit": "m"}),
        (json.dumps([{"at": {"anchor": n}, "slant_range_m": d} for n, d in ranges().items()]), NESTED),
    ],
)  # fmt: skip
def test_ranges_in_every_dress_are_the_same_fix(text, told, tmp_path):
    found = table_problem(tmp_path, text, "t.json" if text.startswith("[") else "t.csv", **told)
    fix = solve(found.read().problem)
    assert np.linalg.norm(fix.position.reshape(-1, 3) - TAG, axis=-1).max() < 1e-6


def test_columns_of_two_units_are_one(tmp_path):
    d = ranges()
    text = "A1_cm,A2_m,A3_mm,A4_km\n" + f"{d['A1'] * 1e2!r},{d['A2']!r},{d['A3'] * 1e3!r},{d['A4'] / 1e3!r}\n"
    loaded = table_problem(tmp_path, text, what="range").read()
    np.testing.assert_allclose(loaded.problem.rows[0].z, [d[f"A{i}"] for i in range(1, 5)], rtol=1e-12)
    with pytest.raises(InvalidProblem, match="some columns are in ns, others in cm"):
        table_problem(tmp_path, "A1_cm,A2_ns\n1,2\n", what="range")


def test_names_of_columns_hold_names_of_stations():
    def seen(columns, stations):
        return [(one.column, one.form, one.ends, one.minus) for one in named_columns(columns, stations)]

    stations = ["A1", "A2", "rx 10", "1"]
    assert seen(["toa_a1_ns", "RX10 [m]", "rx_1", "squawk", "A11", "alt_A1"], stations) == [
        ("toa_a1_ns", "arrivals", ("A1",), False),
        ("RX10 [m]", None, ("rx 10",), False),
        ("rx_1", None, ("1",), False),
    ]
    assert seen(["A1-A2 (ns)", "tdoa_A2_A1_ns", "A1_A2_rx10"], stations) == [
        ("A1-A2 (ns)", None, ("A1", "A2"), True),
        ("tdoa_A2_A1_ns", "tdoa", ("A2", "A1"), False),
    ]


def differences(against="A2"):
    d = ranges()
    return {name: (d[name] - d[against]) / SPEED_OF_LIGHT * 1e9 for name in d if name != against}


@pytest.mark.parametrize(
    ("header", "row", "told"),
    [
        (",".join(f"{n}-A2_ns" for n in differences() if n != "B-1"), "wide", {}),
        (",".join(f"tdoa_{n}_A2_ns" for n in differences()), "wide", {"positive": "a-farther"}),
        (",".join(f"tdoa_A2_{n}_ns" for n in differences()), "wide", {"positive": "b-farther"}),
        (",".join(f"{n}_ns" for n in differences()), "wide", {"what": "tdoa", "reference": "A2"}),
        ("rx1,rx2,tdoa_ns", "long", {"positive": "a-farther"}),
        ("station,reference,tdoa_ns", "long", {}),
        ("a,b,time difference [ns]", "long", {}),
    ],
)
def test_differences_have_a_sign_that_is_known(header, row, told, tmp_path):
    d = differences()
    chosen = [n for n in d if row == "long" or n in header]
    lines = [f"{n},A2,{d[n]:.9f}" for n in d] if row == "long" else [",".join(f"{d[n]:.9f}" for n in chosen)]
    loaded = table_problem(tmp_path, "\n".join([header, *lines]), **{"sigma": "1 ns", **told}).read()
    names = loaded.problem.stations.names
    rows = loaded.problem.rows[0]
    found = {names[a]: z for a, b, z in zip(rows.a, rows.b, rows.z, strict=True) if names[b] == "A2"}
    found |= {names[b]: -z for a, b, z in zip(rows.a, rows.b, rows.z, strict=True) if names[a] == "A2"}
    assert found == pytest.approx({n: d[n] * 1e-9 * SPEED_OF_LIGHT for n in chosen}, abs=1e-6)
    if "positive" in told:
        with pytest.raises(InvalidProblem, match="use --positive a-farther"):
            table_problem(tmp_path, "\n".join([header, *lines]), sigma="1 ns")


def test_dates_and_numbers_of_an_instant_are_the_same_arrivals(tmp_path):
    arrivals = {name: 9_000_123_456 + 7919 * i for i, name in enumerate(SITES)}  # picoseconds behind the second
    stations, base = rx(tmp_path), 1_777_636_800
    numbers = "".join(f"1,{n},{base}.{t:012d}\n" for n, t in arrivals.items())
    dates = "".join(f"1,{n},2026-05-01T14:00:00.{t:012d}+02:00\n" for n, t in arrivals.items())
    bare = dates.replace("+02:00", "")
    told = {"stations": stations, "sigma": "1 ns"}
    z = [
        table_problem(tmp_path, "msg,rx,toa_s\n" + text, **told, zone=zone).read().problem.rows[0].z
        for text, zone in ((numbers, None), (dates, None), (bare, "Europe/Berlin"))
    ]
    np.testing.assert_allclose(z[0], [7919e-12 * i * SPEED_OF_LIGHT for i in range(6)], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(z[1], z[0])
    np.testing.assert_array_equal(z[2], z[0])
    with pytest.raises(InvalidProblem, match=r"'toa_s': the dates have no time zone; use --zone UTC"):
        table_problem(tmp_path, "msg,rx,toa_s\n" + bare, **told)
    with pytest.raises(InvalidProblem, match=r"row 1, .* has no time zone, but others have one"):
        table_problem(tmp_path, "msg,rx,toa_s\n" + dates.replace("+02:00", "", 1), **told)
    with pytest.raises(InvalidProblem, match="no time zone 'Mars'"):
        table_problem(tmp_path, "msg,rx,toa_s\n" + bare, **told, zone="Mars")


# Numbers that may be none, and readings that are there twice.


@pytest.mark.parametrize(("mark", "good"), [("-1", 3.0), ("0", 3.0), ("9999", 3.0), ("-999", 3.0), ("99999", 3.0)])
def test_a_number_that_may_mean_nothing_is_asked_for(mark, good, tmp_path):
    rows = "".join(f"{k},{good + 0.1 * k},{mark if k == 2 else 4.0 + 0.1 * k},{5.0 + 0.01 * k}\n" for k in range(4))
    text = "epoch,dist_A1_m,dist_A2_m,dist_A3_m\n" + rows
    with pytest.raises(InvalidProblem, match=rf"row 3, .*'dist_A2_m': {mark} occurs once, .* --missing {mark}, or"):
        table_problem(tmp_path, text)
    found = table_problem(tmp_path, text, missing=mark)
    assert found.read().problem.count == 11
    assert any(f"1 cell with {mark}: no reading" in note for note in found.notes)
    stated = table_problem(tmp_path, text, missing="none")
    if mark.startswith("-"):  # a reading, as stated, but no distance
        with pytest.raises(InvalidProblem, match=rf"range at A2 is {mark} m, and no distance is negative; .*{mark}"):
            stated.read()
    else:
        assert stated.read().problem.count == 12


def test_a_zero_of_the_first_arrival_is_a_reading(tmp_path):
    told = {"stations": rx(tmp_path), "sigma": "1 ns", "what": "arrivals"}
    text = "msg,Lake_ns,Mill_ns,Tower_ns\n1,0,100.5,200\n2,70,0,30\n"
    assert table_problem(tmp_path, text, **told).read().problem.count == 6
    with pytest.raises(InvalidProblem, match=r"0 occurs 4 times, first here"):
        table_problem(tmp_path, text + "3,0,900,0\n".replace("70", "71"), **told)


@pytest.mark.parametrize("word", ["", "NaN", "n/a", "-", "NULL"])
def test_words_for_nothing_are_no_readings(word, tmp_path):
    text = f"epoch,dist_A1_m,dist_A2_m\n1,3.2,{word}\n2,3.3,4.4\n"
    found = table_problem(tmp_path, text)
    assert found.read().problem.count == 3
    assert any("1 cell without a number: no reading" in note for note in found.notes)


def test_repeats_are_refused_with_their_count_or_averaged(tmp_path):
    text = "frame,anchor,range_m\n1,A1,3.0\n1,A2,4.0\n1,A1,3.2\n1,A1,3.4\n"
    with pytest.raises(InvalidProblem, match=r"row 3: station 'A1' has a second .* in row 1; 2 repeats in total"):
        table_problem(tmp_path, text)
    found = table_problem(tmp_path, text, average=True)
    np.testing.assert_allclose(found.read().problem.rows[0].z, [3.2, 4.0])
    assert "2 repeated readings were averaged" in found.notes[0]
    around = table_problem(tmp_path, "anchor,bearing_deg\nA1,359\nA1,3\nA2,10\n", average=True, sigma="1 deg").sections[
        0
    ]
    np.testing.assert_allclose([float(z) for z in around.columns["z"]], [1.0, 10.0], atol=1e-9)


# What may mean two things is asked for.


@pytest.mark.parametrize(
    ("text", "told", "words"),
    [
        (
            "anchor,range\nA1,3\nA2,4\n",
            {},
            r"unit of the column 'range' is unknown; state it with --unit ns, or --unit m",
        ),
        ("anchor,bearing\nA1,3\nA2,1.5\n", {"sigma": "1 deg"}, r"state it with --unit deg, or --unit rad"),
        ("anchor,azimuth_deg\nA1,3\nA2,4\n", {"sigma": "1 deg"}, r"use --azimuth north-clockwise for a compass"),
        ("A1,A2\n3,4\n", {}, r"columns such as 'A1', 'A2' do not identify their content"),
        ("anchor,range_m,bearing_deg\nA1,3,4\nA2,4,5\n", {}, r"write --sigma 'range=1 m,azimuth=1 deg'"),
        ("anchor,range_m,bearing_deg\nA1,3,4\n", {"sigma": "range=1 m"}, r"azimuth has no sigma"),
        ("anchor,range_m\nA1,3\nQ,4\n", {}, r"row 2, column 'anchor': there is no station 'Q' in anchors\.csv"),
        ("epoch,range_m\n1,3\n", {}, "no column looks like the station"),
        ("anchor,range_m\nA1,3\n", {"stations": None}, "the station positions are unknown"),
        ("anchor,range_m\nA1,3\n", {"sigma": None}, "the accuracy of"),
        ("anchor,range_m\nA1,3\n", {"what": "rnge"}, "there is no input 'rnge'; did you mean 'range'"),
        ("anchor,range_m\nA1,3\n", {"window": "1 s"}, "a window needs a column of times"),
        ("t_s,anchor,range_m\n1,A1,3\n,A2,3\n", {}, "row 2, column 't_s': the cell is empty"),
        ("station,P_s,S_s\nA1,2,1\n", {"vp": "2 m/s", "vs": "1 m/s"}, "row 1: the S wave is not after the P wave"),
    ],
)
def test_what_is_ambiguous_is_one_sentence(text, told, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        table_problem(tmp_path, text, **told)


def test_angles_beyond_a_turn_are_degrees(tmp_path):
    found = table_problem(tmp_path, "anchor,bearing\nA1,30\nA2,1.5\n", sigma="1 deg")
    assert found.sections[0].unit == "deg"
    assert "exceed a full turn in radians" in found.notes[0]


def test_several_kinds_in_one_table(tmp_path):
    d = ranges()
    rows = "".join(f"{n},{d[n]:.6f},{np.degrees(np.arctan2(*(TAG - at)[:2])):.6f},0.1\n" for n, at in ANCHORS.items())
    source, out = table(tmp_path, "anchor,range_m,bearing_deg,sigma\n" + rows), tmp_path / "both.toml"
    run("convert", source, "--stations", anchors(tmp_path), "--sigma", "range=1 cm,bearing=1 deg", "--out", out)
    assert {path.name for path in tmp_path.glob("both*")} >= {"both.toml", "both-range.csv", "both-azimuth.csv"}
    fix = json.loads(run("fix", out, "--json").stdout)["fixes"][0]
    assert [fix[axis] for axis in "xyz"] == pytest.approx(TAG.tolist(), abs=1e-4)


def test_readings_within_a_window_or_of_a_target_that_stays(tmp_path):
    rows = "".join(f"{0.01 * i:.2f},{n},{d:.6f}\n" for i, (n, d) in enumerate(ranges().items()))
    text = "t_s,anchor,range_m\n" + rows + rows.replace("0.0", "1.0")
    assert "--window '0.1 s' to join readings within 0.1 s" in table_problem(tmp_path, text).notes[0]
    assert table_problem(tmp_path, text, window="0.2 s").read().problem.epochs == 2
    assert table_problem(tmp_path, text, still=True).read().problem.epochs == 1
    heard = "rx,toa_us\nLake,5\nMill,7\nTower,9\nLake,900005\nMill,900011\n"
    told = {"stations": rx(tmp_path), "sigma": "1 us", "window": "1 ms"}
    assert table_problem(tmp_path, heard, **told).read().problem.epochs == 2


def test_depths_grow_downwards_and_axes_may_have_their_units(tmp_path):
    stations = table(tmp_path, "buoy;node;x_km;y_m;depth_m\n1;A;0.1;20;5\n2;B;1;30;-2\n", "sea.csv")
    found = table_problem(tmp_path, "node,range_m\nA,10\nB,20\n", stations=stations, columns={"name": "node"}).read()
    np.testing.assert_allclose(found.problem.stations.position[0], [[100, 20, -5], [1000, 30, 2]])


# Files of other programs.


def test_an_mlat_server_dump_brings_its_receivers(tmp_path):
    spots = [np.round(place(*at)) for at in SITES.values()]
    truth, lines = place(47.81, 11.2, 9000.0), []
    for k in range(2):
        heard = sorted((float(np.linalg.norm(truth - at) / SPEED_OF_LIGHT * 1e6), i) for i, at in enumerate(spots))
        cluster = [[*spots[i].tolist(), round(t - heard[0][0], 4), 0.0004] for t, i in heard]
        lines.append(json.dumps({"icao": "3c6444", "time": 1.79e9 + k, "ecef": [0, 0, 0], "cluster": cluster}))
    source = table(tmp_path, "\n".join(lines), "pseudoranges.json")
    found = json.loads(run("fix", source, "--json").stdout)["fixes"]
    assert [fix["target"] for fix in found] == ["3c6444"] * 2
    assert all(np.linalg.norm([fix[axis] - at for axis, at in zip("xyz", truth, strict=True)]) < 1.0 for fix in found)
    clients = {n: {"user": n, "lat": a, "lon": b, "alt": h} for n, (a, b, h) in SITES.items()}
    out = tmp_path / "rx-table.csv"
    run("convert", table(tmp_path, json.dumps(clients), "clients.json"), "--as", "stations", "--out", out)
    assert out.read_text().startswith('"name","lat_deg","lon_deg","height"\n"Lake",47.812,11.183,612')


def test_a_kraken_log_has_the_heading_added(tmp_path):
    line = "1700000000000, {}, 5.2, -42.0, 148524000, UCA, 436, {}, {}, {}, {}, 0, GPS, R, R, R, R" + ", 1.2" * 360
    rows = [line.format(150, "north", 47.9, 11.2, 30), line.format(90, "west", 47.8, 11.0, 350)]
    found = interpret_table(table(tmp_path, " \n".join(rows), "k.csv"), ColumnHints(sigma="1 deg", still=True))
    assert [float(z) for z in found.sections[0].columns["z"]] == [180.0, 80.0]
    assert found.sections[0].lines == ('azimuth = "north-clockwise"',)
    assert "is added" in found.notes[0]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("log.txt", "# \n# Header Description:\n# Raw,utcTimeMillis,TimeNanos\n", "--navigation"),
        (
            "base.txt",
            "     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE\n",
            "--navigation",
        ),
        ("aircraft.json", '{"now": 1, "aircraft": [{"hex": "3c0000"}]}', "positions of aircraft, not measurements"),
    ],
)
def test_what_holds_no_measurements_is_said(name, text, words, tmp_path):
    with pytest.raises(InvalidProblem, match=words):
        interpret_table(table(tmp_path, text, name), ColumnHints(sigma="1 m"))


# Broken tables: one sentence, exit code 2, nothing written.

RX = "name,lat,lon,alt_m\nA,47.0,11.0,500\nB,47.02,11.1,620\nC,47.1,11.05,560\n"
TOA = "msg,station,toa_ns\n1,A,9000\n1,B,23100\n1,C,19800\n"
BROKEN = {
    "empty": b"",
    "blank": b"\n\n\n",
    "header alone": b"msg,station,toa_ns\n",
    "binary": bytes(range(256)),
    "utf-16": TOA.encode("utf-16"),
    "latin-1": TOA.replace("A,9000", "\u00c4,9000").encode("latin-1"),
    "an image": b"\x89PNG\r\n\x1a\n" + bytes(64),
    "ragged": (TOA + "1,A\n").encode(),
    "too wide": (TOA + "1,A,2,3\n").encode(),
    "double header": b"msg,station,toa_ns,toa_ns\n1,A,1,2\n",
    "empty header": b",,\n1,A,2\n",
    "quotes": b'msg,station,toa_ns\n1,"A,2\n',
    "unknown station": (TOA + "2,Q,5\n").encode(),
    "no station": (TOA + "2,,5\n").encode(),
    "words": (TOA + "2,A,soon\n").encode(),
    "infinite": (TOA + "2,A,inf\n").encode(),
    "huge": (TOA + "2,A,1e400\n").encode(),
    "thousands": (TOA + "2,A,1_000\n").encode(),
    "all empty": b"msg,station,toa_ns\n1,A,\n1,B,NaN\n",
    "mark": (TOA + "2,A,-1\n2,B,-1\n").encode(),
    "repeat": (TOA + "1,A,9001\n").encode(),
    "controls": b"msg,station,toa_ns\n1,A\x1b[31m,5\n",
    "a bad date": b"msg,station,time\n1,A,2026-13-45T99:00:00Z\n",
    "two sorts of date": b"msg,station,time\n1,A,2026-05-01T00:00:00Z\n1,B,12.5\n",
    "html": b"<html><body>Not found</body></html>",
    "a formula": b"msg,station,toa_ns\n=1+1,A,=cmd\n",
}


@pytest.mark.parametrize("verb", ["convert", "fix"])
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_table_is_one_sentence_and_nothing_is_written(name, verb, tmp_path):
    source, stations = tmp_path / "t.csv", table(tmp_path, RX, "rx.csv")
    source.write_bytes(BROKEN[name])
    before = {path.name for path in tmp_path.iterdir()}
    told = run(verb, source, "--stations", stations, "--sigma", "20 ns", "--out", tmp_path / "o.toml", code=2)
    assert told.stderr.count("\n") == 1
    assert len(told.stderr) < 400
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    "text", ["", "[", "{}", "[]", "[1, 2]", '{"a": 1}', '[{"cluster": 3}]', '[{"cluster": [[1]]}]', "\x00"]
)
def test_broken_records_are_one_sentence(text, tmp_path):
    told = run("fix", table(tmp_path, text, "t.json"), "--sigma", "20 ns", code=2)
    assert told.stderr.count("\n") == 1


def test_options_of_tables_are_not_for_problem_files(tmp_path):
    told = run("fix", table(tmp_path, "format = 1\n", "site.toml"), "--unit", "ns", code=2)
    assert told.stderr.startswith("--unit: this option is for a table; site.toml is a problem file")


def test_without_out_a_table_is_only_looked_at(tmp_path):
    source, stations = table(tmp_path, TOA), table(tmp_path, RX, "rx.csv")
    told = run("convert", source, "--stations", stations, "--sigma", "20 ns")
    assert "3 readings in ns from toa_ns: arrival times" in told.stdout
    assert "Nothing is written" in told.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"t.csv", "rx.csv"}


def test_digits_that_are_lost_are_told(tmp_path):
    told = {"stations": rx(tmp_path), "sigma": "1 ns"}
    with pytest.raises(InvalidProblem, match=r"row 1, column 'toa_ns': the arrival 1.79E\+18 has lost its digits"):
        table_problem(tmp_path, "msg,rx,toa_ns\n1,Lake,1.79E+18\n1,Mill,1.79E+18\n", **told)
    seconds = "1790000000.250000123456"
    rows = f'[{{"rx": "Lake", "toa_s": {seconds}}}, {{"rx": "Mill", "toa_s": 1790000000.25}}]'
    found = table_problem(tmp_path, rows, "t.json", **told).sections[0]
    assert [float(z) for z in found.columns["z"]] == [1.23456e-7, 0.0]
    import pandas as pd

    pd.DataFrame({"rx": ["Lake", "Mill"], "toa_s": [1790000000.25, 1790000000.5]}).to_parquet(tmp_path / "t.parquet")
    assert "rounded to 71.5 m" in interpret_table(tmp_path / "t.parquet", ColumnHints(**told)).notes[0]


def test_a_column_like_those_of_receivers_that_names_none_is_refused(tmp_path):
    text = "t_s,A1_m,A2_m,A9_m,note\n1,3,4,5,x\n"
    with pytest.raises(InvalidProblem, match=r"column 'A9_m': there is no station 'A9'; did you mean 'A4'"):
        table_problem(tmp_path, text, what="range")
    assert len(table_problem(tmp_path, text, what="range", ignore=("A9_m",)).sections[0].columns["z"]) == 2


def test_differences_share_the_errors_of_their_stations_as_in_one_call(tmp_path):
    far = ranges()
    pairs = [("A1", "A2"), ("A1", "A3"), ("A2", "A3"), ("A1", "A4"), ("B-1", "A4"), ("A1", "B-1")]
    values = {pair: far[pair[0]] - far[pair[1]] for pair in pairs}
    text = "station,reference,tdoa [m]\n" + "".join(f"{a},{b},{value:.6f}\n" for (a, b), value in values.items())
    read = solve(table_problem(tmp_path, text, positive="a-farther").read().problem)
    told = locate(ANCHORS, tdoa=values, unit="m", sigma=0.1)
    assert np.allclose(read.position, told.position, atol=1e-4)
    assert np.allclose(read.cov, told.cov, rtol=1e-3)
    # pairs that close loops say what the others do, and no more
    tree = locate(ANCHORS, tdoa={pair: values[pair] for pair in pairs if pair[0] == "A1"}, unit="m", sigma=0.1)
    assert np.allclose(told.cov, tree.cov, rtol=1e-3)


def passing(folder):
    """Return a table of ranges of a tag that passes four anchors, and the one of these."""
    rng = np.random.default_rng(3)
    stations = table(folder, "name,x,y\n" + "".join(f"{n},{x},{y}\n" for n, (x, y) in PASSED.items()), "sites.csv")
    text = "time_s," + ",".join(f"{name}_m" for name in PASSED) + "\n"
    for k in range(8):
        at = np.array([2000.0 + 80.0 * k, 1500.0 + 50.0 * k])
        ways = [np.linalg.norm(at - place) + 3.0 * rng.standard_normal() for place in PASSED.values()]
        text += ",".join([str(2 * k), *(f"{way:.3f}" for way in ways)]) + "\n"
    return table(folder, text), stations


PASSED = {"A": (0.0, 0.0), "B": (8000.0, 0.0), "C": (8000.0, 6000.0), "D": (0.0, 6000.0)}


def test_a_table_is_checked_tracked_and_fixed_by_the_same_options(tmp_path):
    source, stations = passing(tmp_path)
    words = (source, "--stations", stations, "--sigma", "3 m", "--as", "range")
    checked = json.loads(run("check", *words, "--json").stdout)
    assert checked["file"] == source.name
    assert checked["rows"] == {"range": 32}
    assert [one["name"] for one in checked["health"]["stations"]] == [*PASSED]
    assert "is understood as" in run("check", *words).stdout
    scans = json.loads(run("track", *words, "--json").stdout)["scans"]
    assert [scans[-1][axis] for axis in "xy"] == pytest.approx([2560.0, 1850.0], abs=15.0)
    # the same as from the file that is written of it
    run("convert", *words, "--out", tmp_path / "passing.toml")
    again = json.loads(run("track", tmp_path / "passing.toml", "--json").stdout)["scans"]
    assert [scan["x"] for scan in again] == [scan["x"] for scan in scans]
    for command in ("check", "track"):
        assert "--stations" in run(command, source, code=2).stderr
        assert "this option is for a table" in run(command, "demo", "--sigma", "3 m", code=2).stderr
