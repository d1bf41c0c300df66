"""Registration from files and the command line: biases by name, bounds in time, and what such files get wrong."""

import json
import re
import shutil
from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bad_input import HEAD, write
from progress import without_progress
from typer.testing import CliRunner

from optloc.cli import app
from optloc.cli.file_fixes import fix_file
from optloc.files import load, read
from optloc.show.pictures import plot_course, plot_fixes
from optloc.show.pictures.scene import scene_of

DEMO = package_files("optloc") / "scenarios" / "registration.toml"
RUN = CliRunner()
# That a run has no other minimum is not proven.
ALLOW = ("--allow", "unproven")
TRUE = {"R2": 100.0, "R3": -133.0, "R4": 167.0, "R5": -100.0}
PLACE = (200e3, 300e3, 0.0)
AT = ",".join(map(str, PLACE))
NANOSECOND = 0.299792458


def run(*arguments, code=0):
    result = RUN.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result


def copied(folder, change=lambda text: text, rows=lambda table: table, stations=lambda table: table):
    """Write the shipped registration with changes and return its place."""
    for name, edit in (("rows", rows), ("stations", stations)):
        edit(pd.read_csv(DEMO.parent / f"registration-{name}.csv")).to_csv(
            folder / f"registration-{name}.csv", index=False
        )
    return write(folder, change(DEMO.read_text()), "registration.toml")


@pytest.fixture(scope="module")
def fixed():
    return fix_file(read(DEMO), "auto", quiet=True)


def test_the_shipped_registration_is_solved_without_a_guess():
    found = json.loads(run("fix", DEMO, *ALLOW, "--json").stdout)
    (fix,) = found["fixes"]
    assert fix["status"] == "ok"
    error = np.array([fix[axis] for axis in "xyz"]) - PLACE
    covariance = np.array([[fix["cov_xx"], fix["cov_xy"], fix["cov_xz"]], [0, fix["cov_yy"], fix["cov_yz"]], [0, 0, 0]])
    covariance[2, 2] = fix["cov_zz"]
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    assert error @ np.linalg.solve(covariance, error) < 16.3  # 99.9 % of a chi-square with three degrees of freedom
    assert [bias["member"] for bias in fix["biases"]] == list(TRUE)
    for bias in fix["biases"]:
        assert abs(bias["value"] - TRUE[bias["member"]] * NANOSECOND) < 3.5 * bias["sigma"]
        assert (bias["name"], bias["unit"], bias["from_data"]) == ("clock", "m", 1.0)
    assert fix["not_separable"] == []


def test_the_table_names_the_members(fixed):
    text = run("fix", DEMO, *ALLOW).stdout
    assert all(name in text for name in ("Biases", "clock", "R2", "R5", "from data", "100 %"))
    assert fixed.fix.members("clock") == tuple(TRUE)


def test_a_prior_on_all_clocks_leaves_their_common_error_open(tmp_path):
    path = copied(tmp_path, lambda text: text.partition("members")[0] + 'sigma = "200 ns"\n')
    result = run("fix", path, *ALLOW)
    told = " ".join(result.stdout.replace("│", " ").split())
    assert "the data do not determine a common change of every clock" in told
    (fix,) = json.loads(run("fix", path, *ALLOW, "--json").stdout)["fixes"]
    assert fix["not_separable"] == ["the data do not determine a common change of every clock"]
    values = np.array([bias["value"] for bias in fix["biases"]])
    np.testing.assert_allclose(values.sum(), 0.0, atol=1e-3)
    np.testing.assert_allclose(values[1:] - values[0], [v * NANOSECOND for v in TRUE.values()], atol=8.0)
    assert all(0.5 < bias["from_data"] < 0.9 for bias in fix["biases"])


def early(table):
    """Return the rows of the first two minutes, of which commands answer in a moment."""
    return table[table["time"] < 120.0]


def test_clocks_that_nothing_holds_are_named(tmp_path):
    result = run("fix", copied(tmp_path, lambda text: text.partition("members")[0], rows=early), code=1)
    assert "singular" in result.stdout
    assert "nan" not in result.stdout


def test_stations_may_err_at_each_epoch_or_as_noise(tmp_path):
    """The two forms are one: errors that are estimated and errors that are weighed give one answer."""
    answers = []
    for span in ("noise", "epoch"):
        path = copied(tmp_path, lambda text, span=span: text.replace('"noise"', f'"{span}"'))
        assert load(path).stations.span == span
        (fix,) = json.loads(run("fix", path, *ALLOW, "--json").stdout)["fixes"]
        answers.append([fix["x"], fix["y"], fix["z"], *(bias["value"] for bias in fix["biases"])])
        sigmas = [fix["sigma_x"], fix["sigma_y"], fix["sigma_z"], *(bias["sigma"] for bias in fix["biases"])]
    assert (np.abs(np.subtract(*answers)) < 0.01 * np.array(sigmas)).all()


def test_epochs_may_come_in_any_order_and_stations_may_be_missing(tmp_path):
    mixed = load(copied(tmp_path, rows=lambda t: t.sample(frac=1.0, random_state=1), stations=lambda t: t[::-1]))
    plain = load(DEMO)
    np.testing.assert_array_equal(mixed.times, plain.times)
    order = np.argsort(
        mixed.rows[0].epoch * 5 + [int(mixed.stations.names[i][1]) for i in mixed.rows[0].a], kind="stable"
    )
    np.testing.assert_array_equal(mixed.z[order], plain.z)
    some = copied(tmp_path, rows=lambda t: t.drop(t.index[(t["a"] == "R4") & (t["time"] > 400)]))
    (fix,) = json.loads(run("fix", some, *ALLOW, "--json").stdout)["fixes"]
    assert fix["status"] == "ok"
    assert load(some).count == plain.count - (plain.times > 400.0).sum()


def test_check_tells_what_a_registration_holds(tmp_path):
    found = json.loads(run("check", DEMO, "--json").stdout)
    problem = load(DEMO)
    assert (found["epochs"], found["duration_s"]) == (problem.epochs, np.ptp(problem.times))
    assert (found["stations"], found["moving_stations"]) == (5, 5)
    assert found["biases"] == {"clock": "offset of R2, R3, R4, R5, unknown"}
    assert found["station_errors"] == "1 m, noise of each epoch"
    assert found["redundancy"]["least"] == problem.count - 7
    assert "clock" in run("check", copied(tmp_path, rows=early)).stdout


def test_the_bound_in_the_course_of_the_run(tmp_path):
    found = json.loads(run("crlb", DEMO, "--at", AT, "--plot", tmp_path / "b.png", "--json").stdout)
    by_name = {row["unknown"]: row for row in found["bounds"]}
    assert by_name["clock"]["entries"] == list(TRUE)
    last = found["course"][-1]
    problem = load(DEMO)
    assert (last["epochs"], last["time"]) == (problem.epochs, problem.times[-1])
    np.testing.assert_allclose([last["sigma"][f"position {axis}"] for axis in "xyz"], by_name["position"]["sigma"])
    assert last["biases_known"]["clock R2"] == 0.0
    assert found["course"][0]["sigma"]["position x"] is None
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    text = run("crlb", DEMO, "--at", AT).stdout
    assert "biases known" in text
    assert f"R5: {by_name['clock']['sigma'][3] / (299792458.0 * 1e-9):.4g} ns" in text
    (fix,) = json.loads(run("fix", DEMO, *ALLOW, "--json").stdout)["fixes"]
    assert fix["sigma_z"] == pytest.approx(by_name["position"]["sigma"][2], rel=0.02)


def test_the_bound_of_epochs_that_share_nothing_is_not_drawn(tmp_path):
    result = run("crlb", DEMO.parent / "run.toml", "--at", "100,200", "--plot", tmp_path / "b.png", code=2)
    assert "share no unknowns" in result.stderr


def test_the_bound_of_a_calibration_needs_no_position(tmp_path):
    known = "[target]\nrows = [{ x = 200e3, y = 300e3, z = 0.0 }]\n"
    path = copied(tmp_path, lambda text: text.replace('[target]\nmotion = "static"\n', known))
    found = json.loads(run("crlb", path, "--json").stdout)
    sigma = {row["unknown"]: row["sigma"] for row in found["bounds"]}
    # Every difference has two arrivals of 10 ns and two stations of 1 m; those of all epochs are averaged.
    each = 2.0 * ((10.0 * NANOSECOND) ** 2 + 1.0)
    np.testing.assert_allclose(sigma["clock"], np.sqrt(each / load(DEMO).epochs), rtol=1e-6)
    (fix,) = json.loads(run("fix", path, *ALLOW, "--json").stdout)["fixes"]
    for bias, true in zip(fix["biases"], TRUE.values(), strict=True):
        assert abs(bias["value"] - true * NANOSECOND) < 3.5 * bias["sigma"]


def test_tracks_are_drawn(fixed):
    problem = fixed.loaded.problem
    scene = scene_of(problem, (fixed.fix,))
    assert len(scene.tracks) == 5
    np.testing.assert_array_equal(scene.tracks[0][[0, -1]], problem.stations.position[[0, -1], 0])
    assert scene.fixes.shape == (1, 3)
    figure = plot_fixes(problem, (fixed.fix,))
    assert "track of a station" in [text.get_text() for text in figure.legends[0].texts]
    assert len(plot_course(*_courses(problem)).axes) == 2


def _courses(problem):
    from optloc.cli.crlb import courses

    found = courses(problem, np.array([*PLACE, 0.0, 0.0, 0.0, 0.0]))
    assert found is not None
    return found


def one_epoch(tail, kind="tdoa", extra=""):
    rows = ", ".join(
        f'{{ a = "{a}", b = "A", z = {z}, time = 4.0{extra} }}' for a, z in zip("BCD", (9.0, 5.0, 7.0), strict=True)
    )
    return f'{HEAD}[[measurements]]\nkind = "{kind}"\nsigma = 1.0\nrows = [{rows}]\n{tail}'


CLOCK = '[[biases]]\nname = "clock"\nmembers = ["B", "C"]\n'
SHIPPED = {
    "row twice": (
        {"rows": lambda t: pd.concat([t, t[7:8]])},
        ["registration-rows.csv", "R5-R1 of epoch", "is already in row 8"],
    ),
    "value twice with its own noise": (
        {
            "rows": lambda t: pd.concat([t, t[7:8]]),
            "change": lambda text: text.replace("arrival_sigma", "sigma"),
        },
        ["R5-R1 of epoch", "is already in row 8"],
    ),
    "epoch with two times": (
        {"rows": lambda t: t.assign(epoch=np.where(t["time"] == 300, "3", t["time"].astype(str)))},
        ["registration.toml", "epoch '3'", "3 s", "300 s", "epoch '6' is between"],
    ),
    "prior without unit": ({"change": lambda text: text + "sigma = 200.0\n"}, ["'clock'", "no unit", '"200.0 m"']),
    "drift without unit": (
        {"change": lambda text: text + 'form = "drift"\nsigma = 0.2\n'},
        ["'clock'", "not a drift", '"0.2 m/s"'],
    ),
    "drift in metres": (
        {"change": lambda text: text + 'form = "drift"\nsigma = "0.2 m"\n'},
        ["'clock'", "'0.2 m'", '"0.2 m/s"'],
    ),
    "bias called position": (
        {"change": lambda text: text.replace('"clock"', '"position"')},
        ["registration.toml", "'position' is taken"],
    ),
    "bias twice": ({"change": lambda text: text + CLOCK.replace('"B", "C"', '"R2"')}, ["'clock' is used twice"]),
    "bias of a stranger": ({"change": lambda text: text.replace('"R5"', '"R6"')}, ["'clock'", "'R6'", "did you mean"]),
    "bias of a station that is not there": (
        {"rows": lambda t: t[t["a"] != "R5"]},
        ["'clock'", "members", "R5 affects no row"],
    ),
    "unknown span": ({"change": lambda text: text.replace('"noise"', '"nois"')}, ["span", "did you mean 'noise'"]),
    "station that is lost": ({"stations": lambda t: t[:-1]}, ["'R5'", "no position at epoch"]),
}


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("command", ["fix", "check"])
def test_what_is_wrong_is_one_sentence(name, command, tmp_path):
    options, words = SHIPPED[name]
    if command == "check" and name == "value twice with its own noise":
        pytest.skip("check reads no values")
    result = run(command, copied(tmp_path, **options), code=2)
    assert result.stdout == ""
    assert len(without_progress(result.stderr)) == 1
    assert all(word in result.stderr for word in words), result.stderr


def test_measurements_of_equal_pairs_with_noise_of_their_own_are_welcome(tmp_path):
    double = lambda t: pd.concat([t, t.assign(z=t["z"] + 0.1)])  # noqa: E731  (one line of a table)
    path = copied(tmp_path, lambda text: text.replace("arrival_sigma", "sigma"), rows=double)
    assert load(path).count == 2 * load(DEMO).count


@pytest.mark.parametrize(
    ("tail", "code", "words"),
    [
        ('[target]\nmotion = "constant_velocity"\n', 1, "too few rows"),
        ('[target]\nmotion = "static"\n' + CLOCK + 'form = "drift"\n', 1, "too few rows"),
    ],
    ids=["moving target", "drift"],
)
def test_one_instant_shows_no_motion_and_no_drift(tail, code, words, tmp_path):
    assert words in run("fix", write(tmp_path, one_epoch(tail)), code=code).stdout


def test_epochs_of_one_time_tell_no_motion(tmp_path):
    again = lambda t: t.assign(epoch=t["time"].astype(str), time=5.0)  # noqa: E731
    for tail, words in (("constant_velocity", "a moving target"), ("static", "a drift")):
        change = lambda text, tail=tail: text.replace("static", tail) + 'form = "drift"\n' * (tail == "static")  # noqa: E731
        result = run("fix", copied(tmp_path, change, rows=again), code=2)
        assert "have the same time" in result.stderr
        assert words in result.stderr


def test_groups_of_stations_share_a_bias(tmp_path):
    path = copied(
        tmp_path, lambda text: text.replace('["R2", "R3", "R4", "R5"]', '{ front = ["R4", "R5"], wing = ["R2"] }')
    )
    assert load(path).layout.find("clock")[0].members == ("front", "wing")


def test_a_copy_of_the_shipped_files_is_all_it_needs(tmp_path):
    for entry in DEMO.parent.iterdir():
        if entry.name.startswith("registration"):
            shutil.copy(entry, tmp_path / entry.name)
    run("fix", tmp_path / "registration.toml", *ALLOW, "-q")
    run("demo", "registration", "--plot", tmp_path / "d.png", "-q")


DOCS = Path(__file__).parents[2] / "docs"
PAGES = [DOCS / "registration.md", DOCS / "details" / "registration.md"]


def blocks(language):
    """Return the code blocks of both pages about registration, in order."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_the_file_of_the_manual_is_that_which_is_shipped(tmp_path):
    path = copied(tmp_path, lambda _: blocks("toml")[0])
    one, two = load(path), load(DEMO)
    assert one.structure == two.structure
    np.testing.assert_array_equal(one.z, two.z)
    (beacon := tmp_path / "beacon.toml").write_text(blocks("toml")[1])
    assert load(beacon).motions[0].known.tolist() == [[[1000.0, 2000.0]]]


@pytest.mark.slow
def test_the_programs_of_the_manual_run(capsys):
    exec("\n".join(blocks("python")), {})
    printed = capsys.readouterr().out
    assert "R2: 30.0 ± 1.1 m" in printed
    assert "of 12 combinations are determined" in printed
    assert re.search(r"all clocks R5 +data +inf +prior +60 ", printed)


def test_the_numbers_of_the_manual_are_those_of_the_program():
    shown = [line for block in blocks("text") for line in block.splitlines() if line.startswith("│")]
    printed = run("fix", DEMO, *ALLOW).stdout + run("crlb", DEMO, "--at", AT).stdout
    lines = {" ".join(line.split()) for line in printed.splitlines()}
    own = [line for line in shown if "80 %" not in line]
    assert len(own) == 11
    assert [line for line in own if " ".join(line.split()) not in lines] == []
