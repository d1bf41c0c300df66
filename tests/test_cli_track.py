"""`optloc track`: tables, JSON and pictures; what goes wrong is a sentence or a status, and nothing is lost."""

import json
import subprocess
import sys
from importlib.resources import files as package_files

import numpy as np
import pandas as pd
import pytest
from progress import without_progress
from typer.testing import CliRunner

from optloc.cli import app
from optloc.files import read
from optloc.tracking import collected, polynomial, tracked

RUN = CliRunner()
SHIPPED = package_files("optloc") / "scenarios" / "run.toml"
BEACONS = {"A": (0, 0), "B": (1000, 0), "C": (0, 1000), "D": (1000, 900)}
HEAD = 'format = 1\n[stations]\nfile = "stations.csv"\n'
ROWS = '[[measurements]]\nkind = "range"\nfile = "rows.csv"\nsigma = 1.0\n'


def run(*arguments, code=0):
    result = RUN.invoke(app, ["track", *(str(argument) for argument in arguments)])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result


def sentence(*arguments):
    result = run(*arguments, code=2)
    assert len(without_progress(result.stderr)) == 1
    assert "Traceback" not in result.output
    return result.stderr


def drive(folder, times=range(12), target=None, more="", table=None):
    """Write ranges to something that drives by; return the problem file."""
    rng = np.random.default_rng(1)
    rows = []
    for t in times:
        place = np.array([100.0 + 20 * t, 300 + 10 * t])
        for name, at in BEACONS.items():
            rows.append({"time": t, "a": name, "z": np.linalg.norm(place - at) + rng.standard_normal()})
            if target:
                rows[-1]["target"] = target
    stations = pd.DataFrame([{"name": n, "x": x, "y": y} for n, (x, y) in BEACONS.items()])
    stations.to_csv(folder / "stations.csv", index=False)
    (pd.DataFrame(rows) if table is None else table(pd.DataFrame(rows))).to_csv(folder / "rows.csv", index=False)
    path = folder / "drive.toml"
    path.write_text(HEAD + ROWS + more)
    return path


def test_the_shipped_run_as_a_table(tmp_path):
    out = tmp_path / "track.csv"
    shown = run(SHIPPED, "--out", out).stdout
    assert "60 scans" in shown
    table = pd.read_csv(out)
    names = "epoch time target status reason x y vx vy sigma_x sigma_y sigma_vx sigma_vy cov_xx cov_xy cov_yy"
    assert list(table) == [*names.split(), "nis", "rows", "rejected"]
    assert table["status"].tolist() == ["starting", "started"] + ["ok"] * 58
    assert table["x"].isna().tolist() == [True] + [False] * 59
    np.testing.assert_allclose(table["sigma_x"] ** 2, table["cov_xx"])
    assert table["nis"].sum() / table["rows"][2:].sum() == pytest.approx(1.0, abs=0.25)
    loaded = read(SHIPPED)
    ours = collected(list(tracked(loaded.problem, polynomial(1, 1.0))), 2)
    np.testing.assert_allclose(table[["x", "y", "vx", "vy"]], ours.mean, rtol=1e-9)


def test_tables_agree_and_quiet_is_quiet(tmp_path):
    for name in ("a.csv", "a.parquet"):
        assert run(SHIPPED, "--out", tmp_path / name, "--quiet").output == ""
    one, two = pd.read_csv(tmp_path / "a.csv"), pd.read_parquet(tmp_path / "a.parquet")
    np.testing.assert_allclose(one[["x", "nis"]], two[["x", "nis"]].to_numpy(float))


def test_json_is_the_table_and_nothing_else():
    found = json.loads(run(SHIPPED, "--json").stdout)
    assert found["title"] == "A drive past five beacons"
    assert len(found["scans"]) == 60
    assert found["scans"][0]["x"] is None
    assert found["scans"][-1]["status"] == "ok"


@pytest.mark.parametrize("model", ["cv", "ca", "static", "singer", "csm"])
@pytest.mark.parametrize("name", ["iekf", "mvekf"])
def test_models_and_filters(tmp_path, model, name):
    noise = {"static": 25.0}.get(model, 2.0 if model != "csm" else 10.0)
    path = drive(tmp_path)
    run(path, "--model", model, "--filter", name, "--noise", noise, "--out", tmp_path / "t.csv")
    last = pd.read_csv(tmp_path / "t.csv").iloc[-1]
    assert np.hypot(last["x"] - 320, last["y"] - 410) < 5.0
    assert ("vx" in last) == (model != "static")
    assert ("ax" in last) == (model in {"ca", "singer", "csm"})


def test_pictures(tmp_path):
    pytest.importorskip("matplotlib")
    run(SHIPPED, "--plot", tmp_path / "t.png", "--quiet")
    assert (tmp_path / "t.png").stat().st_size > 20_000
    assert "written" in sentence(SHIPPED, "--plot", "/no/such/place.png")


def test_a_gap_begins_another_track(tmp_path):
    path = drive(tmp_path, [*range(8), *range(20, 28)])
    shown = run(path, "--gap", 5, "--out", tmp_path / "t.csv", code=1)
    status = pd.read_csv(tmp_path / "t.csv")["status"].tolist()
    assert status == ["starting", "started", *["ok"] * 6, "starting", "restarted", *["ok"] * 6]
    assert "no valid row for 13 s" in shown.stdout
    run(path, "--noise", 0.1, "--out", tmp_path / "t.csv", "--force")
    assert "restarted" not in pd.read_csv(tmp_path / "t.csv")["status"].tolist()


def test_a_scan_without_valid_rows_keeps_the_prediction(tmp_path):
    path = drive(tmp_path, table=lambda t: t.assign(weight=np.where(t["time"] == 6, 0.0, 1.0)))
    run(path, "--out", tmp_path / "t.csv", code=1)
    table = pd.read_csv(tmp_path / "t.csv")
    assert table["status"].tolist()[5:8] == ["ok", "too few rows", "ok"]
    assert "only predicted" in table["reason"][6]
    np.testing.assert_allclose(table["x"][6], table["x"][5] + table["vx"][5])


def test_several_targets_have_a_track_each(tmp_path):
    one = drive(tmp_path, target="kite")
    kite = pd.read_csv(tmp_path / "rows.csv")
    run(one, "--out", tmp_path / "alone.csv")
    for more, jumble in (("", 0), ('[target]\nmotion = "constant_velocity"\n', 1)):
        two = drive(
            tmp_path,
            target="kite",
            more=more,
            table=lambda t: pd.concat([kite, kite.assign(target="crow", z=t["z"] + 0.1)]).sample(
                frac=1, random_state=1
            ),
        )
        run(two, "--out", tmp_path / f"both{jumble}.csv")
        table = pd.read_csv(tmp_path / f"both{jumble}.csv")
        assert table.groupby("target").size().to_dict() == {"crow": 12, "kite": 12}
        own = table[table["target"] == "kite"].reset_index(drop=True)
        np.testing.assert_allclose(own[["x", "vx"]], pd.read_csv(tmp_path / "alone.csv")[["x", "vx"]], rtol=1e-6)


def test_a_given_state_needs_no_start(tmp_path):
    path = drive(tmp_path)
    run(path, "--start", "100,300,20,10", "--start-sigma", "5,2", "--out", tmp_path / "t.csv")
    assert pd.read_csv(tmp_path / "t.csv")["status"].tolist() == ["ok"] * 12


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--filter", "ikf"], "did you mean 'iekf'"),
        (["--model", "cvv"], "did you mean 'cv'"),
        (["--noise", "-1"], "process noise is -1"),
        (["--gap", "0"], "--gap"),
        (["--gate", "-3"], "--gate"),
        (["--model", "csm", "--memory", "0"], "time_constant"),
        (["--start", "1,2,3,4"], "--start-sigma"),
        (["--start", "1,2", "--start-sigma", "1,1"], "2 numbers for a state of 4"),
        (["--start", "1,2,x,4", "--start-sigma", "1,1"], "not a list of numbers"),
        (["--start", "1,2,3,4", "--start-sigma", "1"], "give 2 positive numbers"),
        (["--start", "1,2,3,4", "--start-sigma", "1,-1"], "give 2 positive numbers"),
        (["--start", "900,900,0,0", "--start-sigma", "1,1"], "contradicts the first scan"),
        (["--out", "t.docx"], "t.docx"),
        (["--out", "/no/such/place.csv"], "written"),
        (["--plot", "/no/such/place.png"], "written"),
    ],
)
def test_bad_options_are_one_sentence(tmp_path, options, words):
    assert words in sentence(drive(tmp_path), *options)


@pytest.mark.parametrize(
    ("table", "more", "words"),
    [
        (lambda t: t.drop(columns="time").assign(epoch=t["time"]), "", "needs the time"),
        (lambda t: t.assign(epoch=t["time"], time=np.where(t["time"] == 5, 4, t["time"])), "", "have the same time"),
        (None, '[[priors]]\nname = "position"\nmean = [0, 0]\nsigma = 1.0\n', "--start"),
        (None, '[[biases]]\nname = "clock"\n', "clock"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path, table, more, words):
    assert words in sentence(drive(tmp_path, table=table, more=more))


def test_rows_in_any_order_are_sorted(tmp_path):
    run(drive(tmp_path), "--out", tmp_path / "a.csv")
    run(drive(tmp_path, table=lambda t: t.sample(frac=1.0, random_state=3)), "--out", tmp_path / "b.csv")
    one, two = pd.read_csv(tmp_path / "a.csv"), pd.read_csv(tmp_path / "b.csv")
    np.testing.assert_allclose(one["x"], two["x"], rtol=1e-9)


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_rows_are_there_as_they_are_made(tmp_path, monkeypatch, name):
    from optloc.tracking import UPDATES

    seen, partial = [], tmp_path / f"{name}.partial"

    def looking(scan, mean, cov):
        seen.append(pd.read_csv(partial)["status"].tolist())
        return UPDATES["ekf"](scan, mean, cov)

    monkeypatch.setitem(UPDATES, "looking", looking)
    monkeypatch.setattr("optloc.cli.track._MIN_GAP", 0.0)  # at once, no longer ten times a second
    run(drive(tmp_path), "--filter", "looking", "--out", tmp_path / name)
    assert seen == [["starting", "started", *["ok"] * count] for count in range(10)]
    assert not partial.exists()
    table = pd.read_csv(tmp_path / name) if name == "t.csv" else pd.read_parquet(tmp_path / name)
    assert table["status"].tolist() == ["starting", "started", *["ok"] * 10]


def test_a_killed_run_leaves_its_rows(tmp_path):
    """The process ends between two scans, without a word: what was tracked is a readable table."""
    script = (
        "import os, time, optloc.tracking as track\n"
        "from optloc.cli import app\n"
        "ekf, calls = track.UPDATES['ekf'], []\n"
        "def dying(scan, mean, cov):\n"
        "    calls.append(scan)\n"
        "    time.sleep(0.12)\n"  # rows are written ten times a second at most
        "    os.kill(os.getpid(), 9) if len(calls) > 6 else None\n"
        "    return ekf(scan, mean, cov)\n"
        "track.UPDATES['dying'] = dying\n"
        f"app(['track', {str(drive(tmp_path))!r}, '--filter', 'dying', '--out', {str(tmp_path / 't.csv')!r}])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, timeout=120)
    assert done.returncode == -9, done.stderr
    assert not (tmp_path / "t.csv").exists()
    assert pd.read_csv(tmp_path / "t.csv.partial")["status"].tolist() == ["starting", "started"] + ["ok"] * 6


def test_the_track_so_far_is_kept(tmp_path, monkeypatch):
    from optloc.tracking import UPDATES

    calls = []

    def failing(scan, mean, cov):
        calls.append(scan)
        if len(calls) > 4:
            raise KeyboardInterrupt
        return UPDATES["ekf"](scan, mean, cov)

    monkeypatch.setitem(UPDATES, "failing", failing)
    result = RUN.invoke(app, ["track", str(drive(tmp_path)), "--filter", "failing", "--out", str(tmp_path / "t.csv")])
    assert result.exit_code not in (0, 1) or result.exception
    assert pd.read_csv(tmp_path / "t.csv")["status"].tolist() == ["starting", "started"] + ["ok"] * 4


@pytest.mark.parametrize("gaps", [False, True])
def test_arrivals_are_tracked_by_what_their_differences_say(gaps, tmp_path):
    arrivals, rng = drive(tmp_path), np.random.default_rng(3)
    rows = pd.read_csv(tmp_path / "rows.csv")
    sent = rng.uniform(-500.0, 500.0, 12)
    rows["z"] += sent[rows["time"]]
    # one of four arrivals is missing now and then; the first of an epoch is then another station
    rows = rows.drop(index=[9, 16, 35]) if gaps else rows
    rows.to_csv(tmp_path / "rows.csv", index=False)
    arrivals.write_text(arrivals.read_text().replace('"range"', '"toa"'))
    first = rows.groupby("time")[["a", "z"]].transform("last")  # another reference than that of the arrivals
    pairs = rows.assign(b=first["a"], z=rows["z"] - first["z"])
    pairs[pairs["a"] != pairs["b"]].to_csv(tmp_path / "pairs.csv", index=False)
    differences = tmp_path / "differences.toml"
    text = arrivals.read_text().replace("rows.csv", "pairs.csv").replace('"toa"', '"tdoa"')
    differences.write_text(text.replace("sigma = 1.0", "arrival_sigma = 1.0"))
    one, two = (json.loads(run(path, "--json", "--gate", "50").stdout)["scans"] for path in (arrivals, differences))
    assert [scan["status"] for scan in one] == [scan["status"] for scan in two]
    assert [scan["status"] for scan in one].count("ok") >= 9
    for name in ("x", "y", "vx", "vy", "sigma_x", "cov_xy", "nis"):
        shown = [[np.nan if scan[name] is None else scan[name] for scan in scans] for scans in (one, two)]
        np.testing.assert_allclose(shown[0], shown[1], rtol=1e-5, atol=1e-4)
    assert np.hypot(one[-1]["x"] - 320.0, one[-1]["y"] - 410.0) < 5.0


def test_arrivals_keep_the_rows_beside_them(tmp_path):
    path = drive(tmp_path, more='[[measurements]]\nkind = "azimuth"\nfile = "bearings.csv"\nsigma = 0.01\n')
    path.write_text(path.read_text().replace('"range"', '"toa"'))
    times = np.arange(12)
    seen = np.arctan2(300.0 + 10.0 * times, 100.0 + 20.0 * times)
    pd.DataFrame({"time": times, "a": "A", "z": seen}).to_csv(tmp_path / "bearings.csv", index=False)
    scans = json.loads(run(path, "--json").stdout)["scans"]
    # three differences of four arrivals, and the bearing
    assert {scan["rows"] for scan in scans if scan["status"] == "ok"} == {4}


def boat(folder, first=1_464_739_218.0):
    """Write ranges to a boat from four shores, with GPS seconds without a unit, and the stations; return both files."""
    places, centre = (
        {"A": (54.30, 10.10), "B": (54.34, 10.20), "C": (54.38, 10.12), "D": (54.33, 10.05)},
        (54.34, 10.12),
    )
    north, east = 111_300.0, 111_300.0 * np.cos(np.radians(centre[0]))
    rng, rows = np.random.default_rng(2), []
    for k in range(4):
        for name, (lat, lon) in places.items():
            far = np.hypot(60.0 * k - (lon - centre[1]) * east, 30.0 * k - (lat - centre[0]) * north)
            rows.append({"time": first + 10 * k, "station": name, "range_m": far + 5.0 * rng.standard_normal()})
    pd.DataFrame(rows).to_csv(folder / "boat.csv", index=False)
    table = pd.DataFrame([{"name": n, "lat": lat, "lon": lon, "height": 0.0} for n, (lat, lon) in places.items()])
    table.to_csv(folder / "shore.csv", index=False)
    return folder / "boat.csv", "--stations", folder / "shore.csv", "--sigma", "50 m", "--height", "0 m"


def test_a_table_without_a_unit_of_time_names_the_option(tmp_path):
    error = sentence(*boat(tmp_path), "-q")
    assert "the unit of the times in column 'time' is unknown; state it with --time-unit" in error


def test_gps_seconds_are_dates_of_a_boat(tmp_path):
    run(*boat(tmp_path), "--time-scale", "gps", "--out", tmp_path / "boat.gpx")
    text = (tmp_path / "boat.gpx").read_text()
    assert "<time>2026-06-06T00:00:10.000Z</time>" in text  # GPS time is 18 s ahead of UTC
    run(*boat(tmp_path), "--time-unit", "s", "--out", tmp_path / "plain.gpx")
    assert "<time>" not in (tmp_path / "plain.gpx").read_text()
    error = sentence(*boat(tmp_path), "--time-unit", "s", "--out", tmp_path / "boat.cot", "-q")
    assert "Cursor on Target needs dates, but the times have no time scale; state --time-scale" in error


def test_a_scale_of_times_needs_numbers(tmp_path):
    given = boat(tmp_path)
    table = pd.read_csv(given[0])
    table["time"] = pd.to_datetime(table["time"], unit="s").dt.strftime("%Y-%m-%dT%H:%M:%SZ")
    table.to_csv(given[0], index=False)
    assert "the times of boat.csv are dates, which have the scale utc" in sentence(*given, "--time-scale", "gps", "-q")
    assert "'gsp' is not a time scale; did you mean 'gps'?" in sentence(*given, "--time-scale", "gsp", "-q")
