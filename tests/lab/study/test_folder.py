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
from lab.study.texts import QUICK, assert_identical, design, run_here, values
from pyarrow import parquet

from optloc.base.errors import InvalidProblem
from optloc.lab.study import execute, simulation
from optloc.lab.study.execute import executor, run_design
from optloc.lab.study.folder import (
    finished_parts,
    part_files,
    progress,
    read_arrow,
    read_frame,
    read_manifest,
    read_part,
    store,
    swept,
)
from optloc.lab.study.summary import compared
from optloc.lab.study.trial import TrialPart, compute

HERE = executor("processes", 1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "whole"
    return run_here(design(QUICK), folder)


@pytest.mark.slow
def test_a_full_disk_is_a_sentence_and_the_same_command_goes_on(whole, tmp_path, monkeypatch):
    out, move, moved = tmp_path / "out", os.replace, []

    def full(source, target):
        if len(moved) == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        moved.append(target)
        return move(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InvalidProblem, match=r"No space left on device.*the same command continues"):
        run_design(design(QUICK), out, HERE)
    monkeypatch.undo()
    assert progress(out).done == 3  # the first file is the manifest
    assert not list((out / "parts").glob(".*"))
    assert run_design(design(QUICK), out, HERE).complete
    assert_identical(whole, out)


def damage(path, how):
    content = path.read_bytes()
    table = read_part(path)
    path.unlink()
    if how == "cut":
        path.write_bytes(content[:-100])
    elif how == "a bit":
        path.write_bytes(content[:700] + bytes([content[700] ^ 4]) + content[701:])
    elif how == "empty":
        path.touch()
    elif how == "other columns":
        parquet.write_table(table.drop_columns(["seed"]), path)
    elif how == "no name":
        path.with_name(f"{path.name.partition('.')[0]}.parquet").write_bytes(content)
    elif how == "few rows":
        store(path.parent.parent, TrialPart(path.name.partition(".")[0], table.slice(1), {}))


@pytest.mark.slow
def test_damaged_parts_are_named_and_computed_again(whole, tmp_path):
    out, told = tmp_path / "out", []
    shutil.copytree(whole, out)
    before = part_files(out)
    ways = ("cut", "a bit", "empty", "other columns", "no name", "few rows")
    for i, (key, path) in enumerate(list(before.items())[1 : 1 + len(ways)]):
        how = ways[i]
        damage(path, how)
        if how != "few rows":  # a file like any other
            with pytest.raises(InvalidProblem, match=rf"{key}.*the part is damaged"):
                progress(out)
        said = []
        assert len(finished_parts(out, read_manifest(out), said.append)) == len(before) - 1 - i, how
        assert len(said) == 1
        assert key in said[0]
        told += said
    (out / "parts" / ".left.1").write_bytes(b"half")
    victim = next(iter(part_files(out).values()))
    victim.write_bytes(victim.read_bytes()[:100])
    with pytest.warns(UserWarning, match=f"{victim.name}: the part is damaged, and is computed again"):
        assert run_design(design(QUICK), out, HERE).complete
    assert len(told) == len(ways)
    assert not (out / "parts" / ".left.1").exists()
    assert_identical(whole, out)


@pytest.mark.parametrize(("old", "new"), [("seed = 5", "seed = 6"), ("3 m", "4 m"), ("trials = 60", "trials = 61")])
def test_the_folder_of_another_study_is_refused(old, new, whole):
    with pytest.raises(InvalidProblem, match="contains another study"):
        run_design(design(QUICK.replace(old, new)), whole, HERE)
    assert progress(whole).complete


def test_remarks_are_not_another_study(whole):
    assert run_design(design("# a remark\n" + QUICK), whole, HERE).complete


def test_the_folder_of_another_version_is_refused(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    manifest = json.loads((out / "manifest.json").read_text())
    (out / "manifest.json").write_text(json.dumps({**manifest, "version": "0.0.1"}))
    with pytest.raises(InvalidProblem, match=r"written by optloc 0\.0\.1"):
        run_design(design(QUICK), out, HERE)


def test_folders_that_hold_no_study(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InvalidProblem, match="contains no study"):
        run_design(design(QUICK), tmp_path, HERE)
    with pytest.raises(InvalidProblem, match="contains no study"):
        progress(tmp_path)
    with pytest.raises(InvalidProblem, match="cannot be written"):
        run_design(design(QUICK), tmp_path / "file" / "out", HERE)
    with pytest.raises(InvalidProblem, match="no such folder"):
        progress(tmp_path / "nowhere")
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(InvalidProblem, match="cannot be read"):
        progress(tmp_path)
    for odd in ('{"format": 2}', '{"format": 1}', "[]", '{"format": 2, "name": 3, "chunks": 5}'):
        (tmp_path / "manifest.json").write_text(odd)
        with pytest.raises(InvalidProblem, match=r"is incomplete|another format"):
            progress(tmp_path)


def test_two_runs_do_not_write_to_one_folder(whole):
    pytest.importorskip("fcntl")
    held = (
        "import pathlib, sys\nfrom optloc.lab.study.folder import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", held, str(whole)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InvalidProblem, match="another run writes"):
            run_design(design(QUICK), whole, HERE)
        other.communicate("")
    assert run_design(design(QUICK), whole, HERE).complete


def test_the_gap_is_to_the_best_method_of_the_same_trial(tmp_path):
    text = QUICK.replace('method = "gtrs+lsr"', 'method = ["gtrs+lsr", "gtrs"]')
    run_here(design(text), tmp_path / "out")
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
    run_here(design(text), tmp_path / "out")
    frame = swept(read_frame(tmp_path / "out"))
    arrivals = frame[frame["scenario"] == "arrivals"]
    assert (arrivals["layout.stations"] == arrivals["stations"]).all()
    assert set(arrivals["stations"]) == {5, 7}
    assert frame[frame["scenario"] == "differences"]["layout.stations"].isna().all()


def test_studies_are_compared_cell_by_cell(whole, tmp_path):
    same = compared(whole, whole)
    assert len(same) == 3
    assert all(d.identical and d.same_data for d in same)
    run_here(design(QUICK, seed=6), tmp_path / "other")
    other = compared(whole, tmp_path / "other")
    assert not any(d.identical or d.same_data for d in other)
    assert all(d.two.rmse < 3.0 * d.two.bound for d in other)
    run_here(design(QUICK.replace('"arrivals"', '"a"').replace('"differences"', '"d"')), tmp_path / "names")
    with pytest.raises(InvalidProblem, match="no cell in common"):
        compared(whole, tmp_path / "names")


@pytest.fixture
def elsewhere(monkeypatch):
    """Draw what a machine draws whose last digit is another."""
    here = simulation.simulate
    monkeypatch.setattr(
        simulation, "simulate", lambda *given: (made := here(*given)).with_rows(z=np.nextafter(made.z, 1e9))
    )


def test_the_same_seed_is_not_the_same_data(whole, tmp_path, elsewhere):
    run_here(design(QUICK), tmp_path / "other")
    other = compared(whole, tmp_path / "other")
    assert not any(d.identical or d.same_data for d in other)
    seeds = [set(values(folder)["seed"]) for folder in (whole, tmp_path / "other")]
    assert seeds[0] == seeds[1]


def test_a_study_does_not_go_on_with_other_data(whole, tmp_path, elsewhere):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    victim = sorted((out / "parts").glob("*.parquet"))[1]
    victim.unlink()
    with pytest.raises(InvalidProblem, match=r"finished trials of scenario '.*' differ from a new simulation"):
        run_design(design(QUICK), out, HERE)
    assert not victim.exists()


def test_parts_that_contradict_each_other_are_refused(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    part = sorted((out / "parts").glob("*.parquet"))[1]
    table = read_part(part)
    column = table.schema.get_field_index("data")
    other = pa.array(["0123456789abcdef"] * len(table)).dictionary_encode()
    part.unlink()
    key = part.name.partition(".")[0]
    store(out, TrialPart(key, table.set_column(column, table.schema.field(column), other), {}))
    with pytest.raises(InvalidProblem, match="contain different data for the same trials"):
        run_design(design(QUICK), out, HERE)


def test_a_part_with_other_data_is_not_stored(tmp_path, monkeypatch):
    """Two methods, of which the second is computed where the same seed draws other data."""
    made = design(QUICK.replace('method = "gtrs+lsr"', 'method = ["gtrs+lsr", "gtrs"]'))
    here = simulation.simulate

    def strays(chunks, by):
        for i, chunk in enumerate(chunks):
            with monkeypatch.context() as patch:
                if i:
                    patch.setattr(
                        simulation, "simulate", lambda *a: (d := here(*a)).with_rows(z=np.nextafter(d.z, 1e9))
                    )
                yield compute(chunk)

    monkeypatch.setattr(execute, "compute_all", strays)
    with pytest.raises(InvalidProblem, match="contain different data for the same trials"):
        run_design(made, tmp_path / "out", HERE)
    assert progress(tmp_path / "out").done >= 1


def test_the_table_does_not_depend_on_the_order_of_parts(whole):
    assert values(whole)["trial"][:60] == list(range(60))
