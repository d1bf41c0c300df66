"""Physical checks of files, tables and `locate`: the same sentences, with the options of each surface."""

import json
import logging

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc import InvalidProblem
from optloc.cli import app
from optloc.files.reader import read
from optloc.service.engine import Engine
from optloc.service.events import Event
from optloc.service.metrics import Metrics
from optloc.service.site import FAST, read_site

ANCHORS = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (8.0, 6.0), "D": (0.0, 6.0), "E": (3.0, 7.0)}
RANGES = {name: float(np.hypot(x - 2.5, y - 4.1)) for name, (x, y) in ANCHORS.items()}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = "\n".join(f"{name},{x},{y}" for name, (x, y) in ANCHORS.items())
    (tmp_path / "anchors.csv").write_text(f"name,x_m,y_m\n{rows}\n")
    return tmp_path


def write(folder, factor, column="range_m", **changes):
    rows = "\n".join(f"{name},{factor * value:.4f}" for name, value in (RANGES | changes).items())
    (folder / "r.csv").write_text(f"anchor,{column}\n{rows}\n")


def fix(*more):
    return CliRunner().invoke(app, ["fix", "r.csv", "--stations", "anchors.csv", "--sigma", "3 cm", *more])


def site(folder, text=""):
    path = folder / "site.toml"
    path.write_text(
        'format = 2\n[stations]\nfile = "anchors.csv"\n[[measurements]]\nkind = "range"\n'
        f'file = "r.csv"\ncolumns = {{ a = "anchor", z = "range_m" }}\nsigma = 0.03\n{text}'
    )
    return path


def test_a_table_a_file_and_locate_warn_of_centimetres_with_their_own_option(folder):
    write(folder, 100.0)
    result = fix()
    assert "Warning: the range values are 100 times too large" in result.output
    assert "--unit cm" in result.output
    assert "Warning" not in fix("--unit", "cm").output
    (sentence,) = read(site(folder)).warnings
    assert 'unit = "cm"' in sentence
    with pytest.warns(UserWarning, match="unit='cm'"):
        optloc.locate(ANCHORS, ranges={k: 100.0 * v for k, v in RANGES.items()}, sigma=0.03)


def test_json_has_the_warnings_and_advice_does_not_repeat_them(folder):
    write(folder, 1000.0)
    answer = json.loads(fix("--json").stdout)
    assert [text[:38] for text in answer["warnings"]] == ["the range values are 1000 times too la"]
    assert "size" not in [one["cause"] for one in answer["advice"]]


def test_advice_in_python_names_the_unit(folder):
    write(folder, 1e-3)
    problem = read(site(folder)).problem
    assert "unit" in [one.cause for one in optloc.diagnose(problem, optloc.solve(problem)).advice]


def test_negative_ranges_are_refused_with_row_or_station(folder):
    write(folder, 1.0, C=-3.0)
    result = fix()
    assert result.exit_code != 0
    assert "the range at C is -3 m, and no distance is negative" in result.output
    with pytest.raises(InvalidProblem, match=r"r\.csv, row 3, column 'range_m': the range at C"):
        read(site(folder))
    with pytest.raises(InvalidProblem, match="ranges: the range at C"):
        optloc.locate(ANCHORS, ranges=RANGES | {"C": -3.0}, sigma=0.03)


def test_a_unit_that_contradicts_the_column_name_is_reported(folder):
    write(folder, 1.0)
    assert "--unit km replaces m of the column name" in fix("--unit", "km").output
    assert "replaces" not in fix("--unit", "m").output


def test_times_that_start_again_are_reported(folder):
    rows = [f"{(604798 + k) % 604800},{name},{value:.4f}" for k in range(4) for name, value in RANGES.items()]
    (folder / "r.csv").write_text("time_s,anchor,range_m\n" + "\n".join(rows) + "\n")
    assert "start again after a week; add the period" in " ".join(fix().output.split())


def test_some_stations_without_height_are_named():
    with pytest.raises(InvalidProblem, match="1 of 5 stations have no height, the first is B"):
        optloc.locate({k: (*v, 2.0) for k, v in ANCHORS.items()} | {"B": (8.0, 0.0)}, ranges=RANGES, sigma=0.03)


def test_a_live_site_refuses_a_negative_range_and_warns_once(folder, caplog):
    write(folder, 1.0)
    answers, site_of_stream = [], read_site(site(folder), FAST)
    engine = Engine(site_of_stream, Metrics(), lambda *answer: answers.append(answer[1]), lambda: 0.0, phases="fix")
    good = dict(enumerate(RANGES.values()))
    sent = [{i: 100.0 * z for i, z in good.items()}] * 2 + [good | {2: -3.0}]
    with caplog.at_level(logging.WARNING):
        for number, rows in enumerate(sent):
            engine.solve([Event(str(number), rows, {}, 0.0, 0.0, closed="whole")])
    assert "the range at C is -3 m, and no distance is negative" in answers[-1]["error"]
    assert sum("100 times too large" in one.message for one in caplog.records) == 1


def test_a_column_sigma_that_replaces_the_key_is_named(folder):
    rows = "\n".join(f"{name},{value:.4f},0.03" for name, value in RANGES.items())
    (folder / "r.csv").write_text(f"anchor,range_m,sigma\n{rows}\n")
    assert read(site(folder)).warnings == ("the column sigma of r.csv replaces the key sigma; remove one of them",)
    path = site(folder)
    path.write_text(path.read_text().replace("sigma = 0.03\n", ""))
    assert read(path).warnings == ()


def test_a_header_that_contradicts_ranges_is_reported(folder):
    write(folder, 1.0, "range_s")
    output = fix().output
    assert "the range values contradict the stations in their unit, and fit them as metres" in output
    assert "--unit m" in output


def test_an_option_that_replaces_a_column_sigma_is_named(folder):
    rows = "\n".join(f"{name},{value:.4f},0.03" for name, value in RANGES.items())
    (folder / "r.csv").write_text(f"anchor,range_m,sigma_m\n{rows}\n")
    assert "--sigma replaces the column sigma_m; remove one of them." in fix().output
