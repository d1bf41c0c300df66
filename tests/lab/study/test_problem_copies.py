"""Copies of problem files: a report reads the folder of the study alone, whatever its manifest names."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from lab.study.texts import run_here
from typer.testing import CliRunner

from optloc.cli import app
from optloc.files import access
from optloc.lab.study.design import design_of
from optloc.lab.study.folder import part_files, read_manifest
from optloc.lab.study.problem_copies import design_of_manifest, store_problems
from optloc.problem import InvalidProblem

STUDY = """
format = 1
name = "one"
seed = 5
trials = 20

[[scenario]]
name = "file"
problem = "sub/p.toml"
truth = { kind = "hull" }
noise = ["3 m"]

[[method]]
method = "gtrs+lsr"
"""
OPENED: list[str] = []


def note(event, args):
    if event == "open" and isinstance(args[0], str | Path):
        OPENED.append(os.path.realpath(args[0]))


@pytest.fixture(scope="module")
def hook():
    sys.addaudithook(note)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a study file, its problem, a private problem beside it, and the output folder `out`."""
    place = tmp_path_factory.mktemp("study")
    problem = Path(sys.modules["optloc"].__file__).parent / "scenarios" / "demo.toml"
    for name in ("sub/p.toml", "secret/private.toml"):
        (place / name).parent.mkdir()
        shutil.copy(problem, place / name)
    (place / "study.toml").write_text(STUDY)
    design = design_of(place / "study.toml")
    run_here(design, place / "out")
    store_problems(design, place / "out")
    return place


def test_the_problem_files_are_copied_and_read_from_the_folder(place):
    design = design_of(place / "study.toml")
    assert [path.name for path in design.files] == ["p.toml"]
    copy = place / "out" / "problems" / "sub" / "p.toml"
    assert copy.read_bytes() == (place / "sub" / "p.toml").read_bytes()
    found = design_of_manifest(read_manifest(place / "out"), place / "out")
    assert found.fingerprint == design.fingerprint
    before = copy.stat().st_mtime_ns
    store_problems(design, place / "out")
    assert copy.stat().st_mtime_ns == before


def hostile(place, tmp_path):
    """Return a copy of the output folder whose manifest names the private file beside it."""
    folder = tmp_path / "out"
    shutil.copytree(place / "out", folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["folder"] = str(place / "secret")
    manifest["text"] = manifest["text"].replace("sub/p.toml", "private.toml")
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ["status"],
        pytest.param(["report"], marks=pytest.mark.slow),  # it draws all figures
        ["profiles", "--json"],
        ["histories", "--method", "gauss-newton", "--json"],
    ],
)
def test_a_manifest_does_not_decide_what_is_read(place, tmp_path, hook, command):
    folder = hostile(place, tmp_path)
    OPENED.clear()
    done = CliRunner().invoke(app, ["study", command[0], str(folder), *command[1:]])
    assert done.exception is None or isinstance(done.exception, SystemExit)
    assert not [path for path in OPENED if path.startswith(str(place / "secret"))]
    if command[0] == "histories":
        assert done.exit_code == 2
        assert "--outside" in done.output
        OPENED.clear()
        shutil.rmtree(folder / "problems")
        CliRunner().invoke(app, ["study", command[0], str(folder), *command[1:], "--outside"])
        assert str(place / "secret" / "private.toml") in OPENED
    else:
        assert done.exit_code == 0


def test_links_in_a_folder_do_not_lead_out_of_it(place, tmp_path):
    folder = tmp_path / "out"
    shutil.copytree(place / "out", folder)
    shutil.rmtree(folder / "problems")
    (folder / "problems").symlink_to(place)
    assert design_of_manifest(read_manifest(folder), folder) is None
    with access(outside=True):
        assert design_of_manifest(read_manifest(folder), folder) is not None
    part = next(iter(part_files(folder).values()))
    shutil.move(part, tmp_path / part.name)
    part.symlink_to(tmp_path / part.name)
    with pytest.raises(InvalidProblem, match="is outside the folder"):
        part_files(folder)


@pytest.mark.parametrize("address", ["s3://bucket/study", "gs://bucket/study"])
def test_an_address_is_refused_in_one_sentence(place, address, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["study", "run", str(place / "study.toml"), "--out", address])
    assert done.exit_code == 2
    assert "address of an object store" in done.output
    assert not list(tmp_path.iterdir())
