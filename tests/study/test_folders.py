"""Output folders: parts are whole or absent, other studies are refused, disks may be full."""

import errno
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from study.texts import QUICK, assert_identical, plan, values

from optloc.base.errors import InvalidProblem
from optloc.study import draws
from optloc.study import folder as parts
from optloc.study.execute import executor, run_plan
from optloc.study.folder import progress, read_arrow, read_frame, swept
from optloc.study.summary import compared

HERE = executor("in-process")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "whole"
    assert run_plan(plan(QUICK), folder, HERE).complete
    return folder


def test_a_full_disk_is_a_sentence_and_the_same_command_goes_on(whole, tmp_path, monkeypatch):
    out, move, moved = tmp_path / "out", os.replace, []

    def full(source, target):
        if len(moved) == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        moved.append(target)
        return move(source, target)

    monkeypatch.setattr(parts.os, "replace", full)
    with pytest.raises(InvalidProblem, match=r"No space left on device.*goes on from there"):
        run_plan(plan(QUICK), out, HERE)
    monkeypatch.undo()
    assert progress(out).done == 3  # the first file is the manifest
    assert not list((out / "parts").glob(".*"))
    assert run_plan(plan(QUICK), out, HERE).complete
    assert_identical(whole, out)


def test_a_damaged_part_is_computed_again(whole, tmp_path):
    out = tmp_path / "out"
    run_plan(plan(QUICK), out, HERE)
    victim = sorted((out / "parts").glob("*.parquet"))[1]
    victim.write_bytes(victim.read_bytes()[:100])
    (out / "parts" / ".left.1").write_bytes(b"half")
    assert run_plan(plan(QUICK), out, HERE).complete
    assert not (out / "parts" / ".left.1").exists()
    assert_identical(whole, out)


@pytest.mark.parametrize(("old", "new"), [("seed = 5", "seed = 6"), ("3 m", "4 m"), ("trials = 60", "trials = 61")])
def test_the_folder_of_another_study_is_refused(old, new, whole):
    with pytest.raises(InvalidProblem, match="holds another study"):
        run_plan(plan(QUICK.replace(old, new)), whole, HERE)
    assert progress(whole).complete


def test_remarks_are_not_another_study(whole):
    assert run_plan(plan("# a remark\n" + QUICK), whole, HERE).complete


def test_the_folder_of_another_version_is_refused(tmp_path):
    out = tmp_path / "out"
    run_plan(plan(QUICK), out, HERE)
    manifest = json.loads((out / "manifest.json").read_text())
    (out / "manifest.json").write_text(json.dumps({**manifest, "version": "0.0.1"}))
    with pytest.raises(InvalidProblem, match=r"written by optloc 0\.0\.1"):
        run_plan(plan(QUICK), out, HERE)


def test_folders_that_hold_no_study(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InvalidProblem, match="holds no study"):
        run_plan(plan(QUICK), tmp_path, HERE)
    with pytest.raises(InvalidProblem, match="holds no study"):
        progress(tmp_path)
    with pytest.raises(InvalidProblem, match="cannot be written"):
        run_plan(plan(QUICK), tmp_path / "file" / "out", HERE)
    with pytest.raises(InvalidProblem, match="no such folder"):
        progress(tmp_path / "nowhere")
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(InvalidProblem, match="cannot be read"):
        progress(tmp_path)


def test_two_runs_do_not_write_to_one_folder(whole):
    pytest.importorskip("fcntl")
    held = (
        "import pathlib, sys\nfrom optloc.study.folder import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", held, str(whole)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InvalidProblem, match="another run writes"):
            run_plan(plan(QUICK), whole, HERE)
        other.communicate("")
    assert run_plan(plan(QUICK), whole, HERE).complete


def test_the_gap_is_to_the_best_method_of_the_same_trial(tmp_path):
    text = QUICK.replace('method = "gtrs+lsr"', 'method = ["gtrs+lsr", "gtrs"]')
    run_plan(plan(text), tmp_path / "out", HERE)
    frame = read_frame(tmp_path / "out")
    best = frame.groupby(["data", "trial"], observed=True)["cost"].transform("min")
    assert (frame["gap"] == frame["cost"] - best).all()
    assert (frame["gap"][frame["method"] == "gtrs"] > 0.0).any()
    assert frame["gap"].min() == 0.0
    few = read_arrow(tmp_path / "out", ["error", "method"])
    assert few.column_names == ["method", "error"]


def test_swept_values_become_columns(tmp_path):
    text = QUICK.replace("[[method]]", '[[method]]\nname = "m"').replace("trials = 60", "trials = 10")
    text = text.replace('noise = ["3 m"]', 'noise = ["3 m"]\nsweep = { "layout.stations" = [5, 7] }')
    run_plan(plan(text), tmp_path / "out", HERE)
    frame = swept(read_frame(tmp_path / "out"))
    arrivals = frame[frame["scenario"] == "arrivals"]
    assert (arrivals["layout.stations"] == arrivals["stations"]).all()
    assert set(arrivals["stations"]) == {5, 7}
    assert frame[frame["scenario"] == "differences"]["layout.stations"].isna().all()


def test_studies_are_compared_cell_by_cell(whole, tmp_path):
    same = compared(whole, whole)
    assert len(same) == 3
    assert all(d.identical and d.same_data for d in same)
    run_plan(plan(QUICK, seed=6), tmp_path / "other", HERE)
    other = compared(whole, tmp_path / "other")
    assert not any(d.identical or d.same_data for d in other)
    assert all(d.two.rmse < 3.0 * d.two.bound for d in other)
    run_plan(plan(QUICK.replace('"arrivals"', '"a"').replace('"differences"', '"d"')), tmp_path / "names", HERE)
    with pytest.raises(InvalidProblem, match="no cell in common"):
        compared(whole, tmp_path / "names")


@pytest.fixture
def elsewhere(monkeypatch):
    """Draw what a machine draws whose last digit is another."""
    here = draws.simulate
    monkeypatch.setattr(draws, "simulate", lambda *given: (made := here(*given)).with_rows(z=np.nextafter(made.z, 1e9)))


def test_the_same_seed_is_not_the_same_data(whole, tmp_path, elsewhere):
    run_plan(plan(QUICK), tmp_path / "other", HERE)
    other = compared(whole, tmp_path / "other")
    assert not any(d.identical or d.same_data for d in other)
    seeds = [set(values(folder)["seed"]) for folder in (whole, tmp_path / "other")]
    assert seeds[0] == seeds[1]


def test_a_study_does_not_go_on_with_other_data(whole, tmp_path, elsewhere):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    victim = sorted((out / "parts").glob("*.parquet"))[1]
    victim.unlink()
    with pytest.raises(InvalidProblem, match=r"finished trials of scenario '.*' hold other data than are drawn here"):
        run_plan(plan(QUICK), out, HERE)
    assert not victim.exists()


def test_parts_that_contradict_each_other_are_refused(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    part = sorted((out / "parts").glob("*.parquet"))[1]
    table = parquet.read_table(part)
    column = table.schema.get_field_index("data")
    other = pa.array(["0123456789abcdef"] * len(table)).dictionary_encode()
    parquet.write_table(table.set_column(column, table.schema.field(column), other), part)
    with pytest.raises(InvalidProblem, match="hold different data for the same trials"):
        run_plan(plan(QUICK), out, HERE)


def test_a_part_with_other_data_is_not_stored(whole, tmp_path, monkeypatch):
    """Two methods, of which the second is computed where the same seed draws other data."""
    text = QUICK.replace('method = "gtrs+lsr"', 'method = ["gtrs+lsr", "gtrs"]')
    here, calls = draws.simulate, []

    def strays(*given):
        calls.append(given)
        made = here(*given)
        return made if len(calls) == 1 else made.with_rows(z=np.nextafter(made.z, 1e9))

    monkeypatch.setattr(draws, "simulate", strays)
    with pytest.raises(InvalidProblem, match="hold different data for the same trials"):
        run_plan(plan(text), tmp_path / "out", HERE)
    assert progress(tmp_path / "out").done >= 1


def test_the_table_does_not_depend_on_the_order_of_parts(whole):
    assert values(whole)["trial"][:60] == list(range(60))
