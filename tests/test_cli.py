"""The command line: exit codes, machine-readable output, one sentence for bad input."""

import json
import shutil
from importlib.resources import files as package_files

import numpy as np
import pandas as pd
import pytest
from bad_input import BAD, GEODETIC, HEAD, TDOA, bad_files, tdoa, write
from progress import without_progress
from scipy.stats import kstest
from typer.testing import CliRunner

from optloc.cli import app
from optloc.files import read

DEMOS = package_files("optloc") / "scenarios"
RUN = CliRunner()


def run(*arguments, code=0):
    result = RUN.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result


def cell(row):
    return "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in row.items()) + " }"


def rows(table):
    return "rows = [" + ", ".join(map(cell, table)) + "]\n"


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("command", ["fix", "check"])
def test_bad_input_is_one_sentence_and_exit_code_2(name, command, tmp_path):
    if command == "check" and name in {"nan", "empty cell", "infinite"}:
        pytest.skip("check needs no values")
    text, words = BAD[name]
    bad_files(tmp_path)
    result = run(command, write(tmp_path, text), code=2)
    assert result.stdout == ""
    assert len(without_progress(result.stderr)) == 1
    assert "Traceback" not in result.output
    assert all(word in result.stderr for word in words), result.stderr


@pytest.mark.parametrize(
    ("path", "words"),
    [("nowhere.toml", "no such file"), (".", "folder"), ("latin.toml", "UTF-8"), ("p.tml", "did you mean 'p.toml'")],
)
def test_problem_files_that_are_none(path, words, tmp_path):
    (tmp_path / "latin.toml").write_bytes("format = 1\ntitle = 'é'".encode("latin-1"))
    write(tmp_path, tdoa())
    result = run("fix", tmp_path / path, code=2)
    assert words in result.stderr
    assert len(without_progress(result.stderr)) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "magic"], "magic"),
        (["--geojson", "-", "--json"], "only one output"),
        (["--out", "x.docx"], "x.docx"),
        (["--out", "/no/such/place.csv"], "written"),
        (["--plot", "/no/such/place.png"], "written"),
        (["--geojson", "x.json"], "cartesian"),
    ],
)
def test_bad_options(arguments, words, tmp_path):
    result = run("fix", write(tmp_path, tdoa()), *arguments, code=2)
    assert words in result.stderr
    assert len(without_progress(result.stderr)) == 1


def test_version_help_and_lists():
    assert run("--version").stdout.startswith("optloc ")
    assert "Exit codes" in run("--help").stdout
    assert "Examples" in run("fix", "--help").stdout
    assert "tdoa" in run("list", "kinds").stdout
    assert {row["kind"] for row in json.loads(run("list", "kinds", "--json").stdout)} >= {"tdoa", "height"}
    assert "kinds, constraints, formulations, solvers" in run("list", "books", code=2).stderr


def test_schema_is_json():
    assert json.loads(run("schema").stdout)["title"] == "ProblemFile"


def test_json_of_a_single_fix():
    result = run("fix", DEMOS / "demo.toml", "--json")
    (fix,) = json.loads(result.stdout)["fixes"]
    assert fix["status"] == "ok"
    assert abs(fix["lat_deg"] - 47.835) < 1e-4
    assert abs(fix["lon_deg"] - 11.215) < 1e-4
    assert abs(fix["height"] - 2300.0) < 100.0
    assert (fix["dof"], fix["time"], fix["alternatives"]) == (2, None, [])


def test_ambiguity_is_exit_code_1_with_the_alternatives():
    (fix,) = json.loads(run("fix", DEMOS / "ambiguous.toml", "--json", code=1).stdout)["fixes"]
    assert fix["status"] == "ambiguous"
    places = [[fix["x"], fix["y"]], *(other["position"] for other in fix["alternatives"])]
    assert min(np.hypot(x + 3000.0, y + 1000.0) for x, y in places) < 500.0
    for other in fix["alternatives"]:
        assert other["probability"] == pytest.approx(1.0 / (1.0 + np.exp(other["gap"] / 2.0)))
    text = run("fix", DEMOS / "ambiguous.toml", code=1).stdout
    assert "probability" in text
    assert "ambiguous" in text
    assert "Alternatives" in text
    assert run("fix", DEMOS / "ambiguous.toml", "-q", code=1).output == ""


def test_demo_draws(tmp_path):
    result = run("demo", "--plot", tmp_path / "d.png")
    assert "ok" in result.stdout
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    assert "known are" in run("demo", "nothing", code=2).stderr


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_run_is_written_as_a_table(suffix, tmp_path):
    out = tmp_path / f"fixes.{suffix}"
    assert "ok" in run("fix", DEMOS / "run.toml", "--out", out).stdout
    table = pd.read_csv(out) if suffix == "csv" else pd.read_parquet(out)
    assert len(table) == 60
    assert {"epoch", "time", "status", "reason", "x", "y", "sigma_x", "cov_xy", "cost", "dof", "p_value"} <= set(table)
    assert table["x"].is_monotonic_increasing
    np.testing.assert_array_equal(table["time"], np.arange(60.0))


def epochs_with(bad, extra_stations=""):
    """Return a run of five epochs of ranges differences in which the rows of epoch 2 are replaced."""
    good = [{"epoch": k, "a": a, "b": "A", "z": z} for k in (0, 1, 3, 4) for a, _, z in GOOD]
    head = HEAD.replace("\n]\n", f"\n{extra_stations}]\n")
    return f'{head}[[measurements]]\nkind = "tdoa"\nsigma = 1.0\n' + rows(good + [{"epoch": 2, **row} for row in bad])


TRUTH = np.array([1500.0, 2200.0, 900.0])
EXTRA = '  { name = "E", x = 2000.0, y = -1500.0, z = 600.0 },\n  { name = "F", x = 6500.0, y = 2500.0, z = 300.0 },\n'
MORE = HEAD.replace("\n]\n", f"\n{EXTRA}]\n")
PLACES = {"A": (0, 0, 30), "B": (4000, 300, 0), "C": (200, 5000, 80), "D": (4100, 4700, 10), "E": (2000, -1500, 600)}
PLACES |= {"F": (6500, 2500, 300), "L1": (1000, 0, 30), "L2": (2000, 0, 30), "L3": (3000, 0, 30), "L4": (4000, 0, 30)}


def difference(a, b):
    return float(np.linalg.norm(TRUTH - PLACES[a]) - np.linalg.norm(TRUTH - PLACES[b]))


GOOD = [(a, "A", difference(a, "A")) for a in "BCDEF"]
LINE = "".join(f'  {{ name = "L{i}", x = {1000 * i}.0, y = 0.0, z = 30.0 }},\n' for i in range(1, 5))


@pytest.mark.parametrize(
    ("pairs", "statuses"),
    [
        ([("B", "A"), ("C", "A")], {"too few rows"}),
        ([("B", "A"), ("C", "A"), ("E", "D"), ("F", "D")], {"searched", "ok"}),  # ok: what was searched is proven
        ([("B", "A"), ("D", "C")], {"disconnected", "too few rows"}),
        ([(f"L{i}", "A") for i in range(1, 5)], {"singular geometry", "ambiguous", "unbounded"}),
    ],
    ids=["too few", "two groups", "pairs apart", "collinear"],
)
def test_a_hopeless_epoch_leaves_the_others_alone(pairs, statuses, tmp_path):
    bad = [{"a": a, "b": b, "z": difference(a, b)} for a, b in pairs]
    path = write(tmp_path, epochs_with(bad, EXTRA + LINE))
    out = tmp_path / "o.csv"
    result = RUN.invoke(app, ["fix", str(path), "--out", str(out)])
    table = pd.read_csv(out, keep_default_na=False, na_values=[""])
    assert table["status"][2] in statuses
    assert result.exit_code == (0 if table["status"][2] == "ok" else 1)
    others = table.drop(index=2)
    assert (others["status"] == "ok").all()
    np.testing.assert_allclose(others[["x", "y", "z"]], np.tile(TRUTH, (4, 1)), atol=1e-3)


def test_simulate_then_fix_and_bound(tmp_path):
    text = tdoa(
        [(a, "A", 0.0) for a in "BCDEF"],
        extra='unit = "ns"\narrival_sigma = "2 m"\npositive = "b-farther"\n',
        head=MORE,
    )
    path, out = write(tmp_path, text), tmp_path / "trials.toml"
    run("simulate", path, "--truth", "1500,2200,900", "--seed", 5, "--trials", 40, "--out", out)
    table = tmp_path / "fixes.csv"
    RUN.invoke(app, ["fix", str(out), "--out", str(table)])
    fixes = pd.read_csv(table)
    assert len(fixes) == 40
    bound = json.loads(run("crlb", path, "--at", "1500,2200,900", "--json").stdout)["bounds"][0]["sigma"]
    spread = fixes.loc[fixes["status"] == "ok", ["x", "y", "z"]] - TRUTH
    ratio = np.sqrt((spread**2).mean()) / bound
    assert ((ratio > 0.6) & (ratio < 1.5)).all()
    again = tmp_path / "again.toml"
    run("simulate", path, "--truth", "1500,2200,900", "--seed", 5, "--trials", 40, "--out", again)
    assert again.with_name("again-1.csv").read_text() == out.with_name("trials-1.csv").read_text()
    assert "Cramer-Rao" in run("crlb", path, "--at", "1500,2200,900").stdout


def test_simulate_keeps_units_kinds_and_geodesy(tmp_path):
    path, out = write(tmp_path, GEODETIC.format(frame='kind = "geodetic"')), tmp_path / "s.toml"
    run("simulate", path, "--truth", "47.15,11.05,900", "--geodetic", "--out", out)
    one, two = read(path).problem, read(out).problem
    np.testing.assert_allclose(one.stations.position, two.stations.position)
    bearing = np.degrees(np.pi / 2 - two.z)
    assert 5.0 < bearing[0] < 25.0
    assert (
        "several trials"
        in run("simulate", DEMOS / "run.toml", "--truth", "1,2", "--trials", 2, "--out", out, "--force", code=2).stderr
    )
    assert "not a list" in run("simulate", path, "--truth", "1;2", "--out", out, "--force", code=2).stderr
    assert "dimensions" in run("simulate", path, "--truth", "1,2", "--out", out, "--force", code=2).stderr


def test_simulate_knows_that_a_spread_in_decibels_goes_with_the_ratio(tmp_path):
    path, out = tmp_path / "levels.toml", tmp_path / "drawn.toml"
    run("new", "groa", "--out", path)
    run("simulate", path, "--truth", "1500,900", "--trials", 200, "--out", out)
    fixes = tmp_path / "fixes.csv"
    run("fix", out, "--method", "gtrs+lsr", "--allow", "unproven", "--out", fixes)
    p_value = pd.read_csv(fixes)["p_value"]
    assert kstest(p_value, "uniform").pvalue > 1e-3


def test_values_may_be_missing_until_they_are_needed(tmp_path):
    path = write(tmp_path, tdoa().replace(", z = 120.5", "").replace(", z = -33.25", "").replace(", z = 710.0", ""))
    assert "'z'" in run("fix", path, code=2).stderr
    run("check", path)
    run("crlb", path, "--at", "1500,2200,900")


def test_geojson(tmp_path):
    found = json.loads(run("fix", DEMOS / "demo.toml", "--geojson", "-").stdout)
    assert found["type"] == "FeatureCollection"
    roles = [feature["properties"]["role"] for feature in found["features"]]
    assert roles == ["station"] * 6 + ["fix", "ellipse95"]
    lon, lat, _ = found["features"][6]["geometry"]["coordinates"]
    assert (round(lon, 3), round(lat, 3)) == (11.215, 47.835)
    ring = np.array(found["features"][7]["geometry"]["coordinates"][0])[:, :2] - [lon, lat]
    assert (ring[0] == ring[-1]).all()
    # Counter-clockwise, as RFC 7946 asks.
    assert np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1]) > 0.0
    run("fix", DEMOS / "demo.toml", "--geojson", tmp_path / "g.json")
    assert json.loads((tmp_path / "g.json").read_text()) == found


def test_check_counts_redundancy_and_groups(tmp_path):
    found = json.loads(run("check", DEMOS / "run.toml", "--json").stdout)
    assert (found["stations"], found["epochs"], found["unknowns"]) == (5, 60, 2)
    assert "redundancy" in run("check", DEMOS / "demo.toml").stdout
    apart = write(tmp_path, epochs_with([{"a": "B", "b": "A", "z": 1.0}, {"a": "D", "b": "C", "z": 1.0}], EXTRA))
    found = json.loads(run("check", apart, "--json", code=1).stdout)
    assert (found["epochs_with_too_few_rows"], found["epochs_with_disconnected_pairs"]) == (1, 1)


def test_biases_are_reported(tmp_path):
    ranges = [{"a": a, "z": float(np.linalg.norm(TRUTH - PLACES[a])) + 25.0} for a in "ABCDEF"]
    bias = '[[biases]]\nname = "common"\nper = "kind"\n'
    path = write(tmp_path, f'{MORE}[[measurements]]\nkind = "range"\nsigma = 1.0\n{rows(ranges)}{bias}')
    (fix,) = json.loads(run("fix", path, "--json").stdout)["fixes"]
    (bias,) = fix["biases"]
    assert bias["value"] == pytest.approx(25.0, abs=1e-3)
    assert (bias["name"], bias["member"], bias["unit"], bias["from_data"]) == ("common", "range", "m", 1.0)
    assert "common" in run("fix", path).stdout


def test_a_copy_of_the_demo_files_is_all_they_need(tmp_path):
    for entry in DEMOS.iterdir():
        shutil.copy(entry, tmp_path / entry.name)
    run("fix", tmp_path / "run.toml", "-q")


def test_inline_rows_of_this_table_are_read(tmp_path):
    assert read(write(tmp_path, tdoa())).problem.count == len(TDOA)


def ranges(targets, times=(0.0, 1.0, 2.0, 3.0)):
    """Return noise-free ranges of targets that move uniformly: name to (place, velocity)."""
    table = []
    for name, (place, velocity) in targets.items():
        for t in times:
            at = np.array(place) + t * np.array(velocity)
            away = {a: float(np.linalg.norm(at - PLACES[a])) for a in "ABCDEF"}
            table += [{"time": t, "target": name, "a": a, "z": z} for a, z in away.items()]
    return f'{MORE}[[measurements]]\nkind = "range"\nsigma = 1.0\n{rows(table)}'


MOVING = {"u": (TRUTH, (50.0, -20.0, 5.0)), "v": (TRUTH + 300.0, (-10.0, 40.0, 0.0))}


def test_several_moving_targets_of_one_run(tmp_path):
    path = write(tmp_path, ranges(MOVING) + '[target]\nmotion = "constant_velocity"\n')
    found = json.loads(run("fix", path, "--allow", "unproven", "--json").stdout)
    assert [row["target"] for row in found["fixes"]] == ["u", "v"]
    for row, (place, velocity) in zip(found["fixes"], MOVING.values(), strict=True):
        np.testing.assert_allclose([row["x"], row["y"], row["z"]], place, atol=1e-3)
        np.testing.assert_allclose([row["vx"], row["vy"], row["vz"]], velocity, atol=1e-3)
        assert 0.0 < row["sigma_vx"] < 5.0
    assert "vx" in run("fix", path, code=1).stdout  # the proof is for one target


def test_free_targets_are_fixed_apart(tmp_path):
    path = write(tmp_path, ranges(MOVING))
    found = json.loads(run("fix", path, "--json").stdout)["fixes"]
    assert [(row["time"], row["target"]) for row in found] == [(t, n) for t in (0.0, 1.0, 2.0, 3.0) for n in "uv"]
    place, velocity = MOVING["v"]
    last = found[-1]
    np.testing.assert_allclose([last["x"], last["y"], last["z"]], place + 3.0 * np.array(velocity), atol=1e-3)


def test_free_positions_that_share_a_bias(tmp_path):
    text = ranges({"u": MOVING["u"]}) + '[[biases]]\nname = "common"\nper = "kind"\nsigma = "10 m"\n'
    out = tmp_path / "o.csv"
    run("fix", write(tmp_path, text), "--allow", "unproven", "--out", out, "--plot", tmp_path / "o.png")
    table = pd.read_csv(out)
    assert len(table) == 4
    np.testing.assert_allclose(table["x"], TRUTH[0] + 50.0 * np.arange(4), atol=1e-2)
