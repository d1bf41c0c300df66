"""What optloc writes: never over an input, never over a file that exists, whole or not at all, harmless in a sheet."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import threading
from importlib.resources import files
from pathlib import Path

import pandas as pd
import pytest
from bad_input import tdoa
from progress import without_progress
from typer.main import get_command
from typer.testing import CliRunner

from optloc.base import outputs
from optloc.base.errors import InvalidProblem
from optloc.cli import app
from optloc.files import read
from optloc.files.writer import harmless, write_csv

RUN = CliRunner()
STREAMS = pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
ROOT = os.name != "nt" and os.geteuid() == 0


def run(*arguments, code=0):
    result = RUN.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    if code == 2:
        assert len(without_progress(result.stderr)) == 1, result.stderr
    return result


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "site.toml").write_text(tdoa(), encoding="utf-8")
    (tmp_path / "toa.csv").write_text("message,station,time_s\n1,a,0\n1,b,1e-6\n1,c,2e-6\n")
    (tmp_path / "rx.csv").write_text("name,x,y\na,0,0\nb,1000,0\nc,0,1000\n")
    return tmp_path


# Every command that writes, and the files that it writes.
WRITERS = {
    "fix demo --out o.csv": ["o.csv"],
    "fix demo --out o.parquet": ["o.parquet"],
    "fix demo --plot o.png": ["o.png"],
    "fix demo --html o.html": ["o.html"],
    "fix demo --geojson o.geojson": ["o.geojson"],
    "track run --out o.csv": ["o.csv"],
    "track run --out p.csv": ["p.csv.partial"],
    "track run --plot o.svg": ["o.svg"],
    "simulate demo --truth 1,2,3 --out o.toml": ["o.toml"],
    "simulate demo --truth 1,2,3 --out q.toml": ["q-1.csv"],
    "crlb registration --plot o.png": ["o.png"],
    "crlb demo --map o.geojson": ["o.geojson"],
    "check run --out o.csv": ["o.csv"],
    "check run --plot o.svg": ["o.svg"],
    "plot fix demo": ["fix.png"],
    "plot bound demo --out o.pdf": ["o.pdf"],
    "demo ambiguous --plot o.png": ["o.png"],
    "new tdoa --out o.toml": ["o.toml"],
    "convert toa.csv --stations rx.csv --sigma 1ns --out o.toml": ["o.toml"],
    "convert toa.csv --stations rx.csv --sigma 1ns --out q.toml": ["q-rows.csv"],
    "convert rx.csv --as stations --out o.csv": ["o.csv"],
    "reproduce registration --out .": ["README.md"],
}


@pytest.mark.parametrize("command", WRITERS)
def test_nothing_is_written_over_without_force_and_that_is_said_at_once(command, place):
    before = sorted(p.name for p in place.iterdir())
    for name in WRITERS[command]:
        (place / name).write_text("mine")
        done = RUN.invoke(app, [*command.split(), "--verbose"])
        assert done.exit_code == 2, done.output
        *steps, refusal = without_progress(done.stderr)
        assert "--force" in refusal
        # what was done before that is told step by step: files were read, and nothing was solved
        assert [step for step in steps if " read " not in step] == []
        assert (place / name).read_text() == "mine"
    assert sorted(p.name for p in place.iterdir()) == sorted([*before, *WRITERS[command]])


@pytest.mark.parametrize("command", ["fix", "check"])
def test_a_place_is_refused_before_a_long_table_is_read(command, place, monkeypatch):
    (place / "o.csv").write_text("kept")
    monkeypatch.setattr(f"optloc.cli.{command}.read_problem", lambda *_, **__: pytest.fail("it was read"))
    (place / "t.csv").write_text("epoch,station,range\n")
    (place / "s.csv").write_text("name,x,y\n")
    out = RUN.invoke(app, [command, "t.csv", "--stations", "s.csv", "--sigma", "1", "--unit", "m", "--out", "o.csv"])
    assert out.exit_code == 2
    assert "the file already exists" in out.stderr
    assert (place / "o.csv").read_text() == "kept"


def test_every_command_that_writes_has_force():
    def commands(group, path=()):
        for name, one in group.commands.items():
            yield from commands(one, (*path, name)) if hasattr(one, "commands") else [((*path, name), one)]

    lacking = set()
    for path, one in commands(get_command(app)):
        flags = {flag for p in one.params for flag in p.opts}
        if flags & {"--out", "--plot", "--html", "--geojson", "--map"} and "--force" not in flags:
            lacking.add(" ".join(path))
    assert lacking == {"study run"}  # which goes on in its own folder


@pytest.mark.parametrize("link", [None, "symlink_to", "hardlink_to"])
def test_not_even_with_force_over_what_is_read(link, place):
    text = (place / "site.toml").read_text()
    target = place / "site.toml"
    if link:
        target = place / "other.toml"
        getattr(target, link)(place / "site.toml")
    for command in ("fix site.toml --geojson", "simulate site.toml --truth 1,2,3 --out", "fix site.toml --html"):
        assert "an input file" in run(*command.split(), target, "--force", code=2).stderr
    assert (place / "site.toml").read_text() == text
    assert (
        "an input file" in run("convert", "toa.csv", "--as", "stations", "--out", "toa.csv", "--force", code=2).stderr
    )
    assert (
        "an input file" in run(*"convert toa.csv --stations rx.csv --sigma 1ns --out".split(), "rx.csv", code=2).stderr
    )


def test_two_outputs_of_one_name_are_refused(place):
    for one, two in (("x.csv", "x.csv"), ("x.csv", "./x.csv"), ("x.csv", "X.CSV"), ("x.csv", place / "x.csv")):
        assert "two outputs" in run("fix", "demo", "--out", one, "--geojson", two, code=2).stderr
    assert "two outputs" in run("fix", "demo", "--html", "x.html", "--geojson", "x.html", code=2).stderr
    assert not (place / "x.csv").exists()


def test_with_force_the_file_is_replaced_and_keeps_its_rights_and_its_link(place):
    (place / "store").mkdir()
    real = place / "store" / "real"
    real.write_text("old")
    real.chmod(0o640)
    (place / "o.csv").symlink_to(real)
    run("fix", "demo", "--out", "o.csv", "--force")
    assert (place / "o.csv").is_symlink()
    assert real.read_text().startswith('"epoch"')
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    old = os.umask(0o027)
    try:
        run("fix", "demo", "--out", "new.csv")
    finally:
        os.umask(old)
    assert stat.S_IMODE((place / "new.csv").stat().st_mode) == 0o640
    assert sorted(p.name for p in (place / "store").iterdir()) == ["real"]


def test_places_that_are_none(place):
    (place / "folder.csv").mkdir()
    (place / "loop.csv").symlink_to(place / "loop.csv")
    for name in ("folder.csv", "nowhere/o.csv", "loop.csv", "a" * 300 + ".csv", ""):
        run("fix", "demo", "--out", name, code=2)
    (place / "fresh.csv").symlink_to(place / "made.csv")
    run("fix", "demo", "--out", "fresh.csv")
    assert (place / "made.csv").exists()


@STREAMS
@pytest.mark.slow
def test_names_that_are_no_unicode(place):
    for name in ("site\udcff.toml", "toa\udcff.csv"):
        (place / name).write_bytes((place / name.replace("\udcff", "")).read_bytes())
    shutil.copy(files("optloc") / "scenarios" / "demo.toml", place / "demo\udcff.toml")
    run("fix", "demo\udcff.toml", "--html", "o.html", "--plot", "o.svg", "--geojson", "o.geojson", "--out", "o.csv")
    run(*"convert toa\udcff.csv --stations rx.csv --sigma soon --out c.toml".split(), code=2)
    assert not (place / "c.toml").exists()
    assert not (place / "c-rows.csv").exists()
    run(*"convert toa\udcff.csv --stations rx.csv --out c.toml --sigma".split(), "1 ns")
    assert read(place / "c.toml").problem.count == 3
    (place / "toa.csv").rename(place / "\U0001f4e1.csv")
    run(*"convert \U0001f4e1.csv --stations rx.csv --out \U0001f4e1.toml --sigma".split(), "1 ns")
    run(*"simulate site\udcff.toml --truth 1,2,3 --out s.toml".split())
    assert "not Unicode" in run(*"simulate demo --truth 1,2,3 --out s\udcff.toml".split(), code=2).stderr


@STREAMS
def test_pipes_and_devices_are_written_to(place):
    os.mkfifo(place / "pipe")
    got = []
    reader = threading.Thread(target=lambda: got.append((place / "pipe").read_text()))
    reader.start()
    run("fix", "demo", "--geojson", "pipe", "--out", "/dev/null", "--plot", "/dev/null")
    reader.join(timeout=30)
    assert json.loads(got[0])["type"] == "FeatureCollection"
    assert stat.S_ISFIFO((place / "pipe").stat().st_mode)
    assert "No space" in run("fix", "demo", "--geojson", "/dev/full", code=2).stderr


def test_an_error_leaves_what_was_there(tmp_path):
    path = tmp_path / "o.txt"
    path.write_text("old")

    def fail(error):
        with outputs.written(path) as file:
            file.write_text("half")
            raise error

    for error in (ValueError, KeyboardInterrupt, OSError):
        with pytest.raises(InvalidProblem if error is OSError else error):
            fail(error)
    assert [p.name for p in tmp_path.iterdir()] == ["o.txt"]
    assert path.read_text() == "old"


def test_files_that_belong_together_get_their_names_together(tmp_path):
    def both():
        with outputs.replace_together():
            with outputs.written(tmp_path / "a.txt") as file:
                file.write_text("new")
            assert not (tmp_path / "a.txt").exists()
            with outputs.written(tmp_path / "b.txt") as file:
                file.write_text("new")
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        both()
    assert not list(tmp_path.iterdir())


LIMITED = """
import resource, sys
from optloc.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
sys.argv = ["optloc", *sys.argv[2:]]
main()
"""


@pytest.mark.slow
@STREAMS
@pytest.mark.parametrize(
    "command",
    [
        "fix demo --out o.csv --force",
        pytest.param("fix demo --plot o.csv.png --out o.csv --force", marks=pytest.mark.full),
        pytest.param("fix demo --out o.parquet --force", marks=pytest.mark.full),
        pytest.param("fix demo --html o.html --force", marks=pytest.mark.full),
        pytest.param("fix demo --plot o.svg --force", marks=pytest.mark.full),
        pytest.param("fix demo --plot o.pdf --force", marks=pytest.mark.full),
        pytest.param("track run --out o.csv --force", marks=pytest.mark.full),
        pytest.param("simulate demo --truth 1,2,3 --out o.toml --force", marks=pytest.mark.full),
    ],
)
def test_a_full_disk_leaves_what_was_there(command, place):
    before = {p.name: p.read_text() for p in place.iterdir()} | {"o.csv": "mine"}
    (place / "o.csv").write_text("mine")
    script = [sys.executable, "-c", LIMITED, "100", *command.split()]
    done = subprocess.run(script, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2, done.stderr
    assert len(without_progress(done.stderr)) == 1, done.stderr
    assert "cannot be written" in done.stderr
    # a stream keeps what it has beside the file
    assert {p.name: p.read_text() for p in place.iterdir() if p.suffix != ".partial"} == before


def test_the_demo_can_be_run_again(place):
    run("demo", "ambiguous")
    (place / "optloc-demo.png").write_text("mine")
    said = run("demo", "ambiguous").stdout
    assert "--force" in " ".join(said.split())
    assert (place / "optloc-demo.png").read_text() == "mine"
    run("demo", "ambiguous", "--force")
    assert (place / "optloc-demo.png").read_bytes().startswith(b"\x89PNG")


def test_what_a_command_may_ends_with_it(tmp_path):
    path = tmp_path / "o.toml"
    run("new", "tdoa", "--out", path)
    run("new", "tdoa", "--out", path, code=2)
    with outputs.written(path) as file:  # a call of the library replaces
        file.write_text("mine")
    assert path.read_text() == "mine"


# Spreadsheets.

FORMULAS = ["=1+1", "+1+1", "-1+cmd|' /C calc'!A0", "@SUM(1)", "\t=1", "\r=1", '=HYPERLINK("http://x","y")', "-", "+"]


def test_texts_that_would_be_computed_are_harmless():
    assert [harmless(text) for text in FORMULAS] == ["'" + text for text in FORMULAS]
    for text in ("", "A", "-1.5", "+3e5", "a=b", "1-2", "'=1"):
        assert harmless(text) == text


def test_names_of_strangers_are_harmless_in_tables_for_people(place):
    run("new", "moving", "--out", "run.toml")
    text = (place / "run.toml").read_text().replace('"North"', '"=North()"')
    text = re.sub(r"\{ time = (\d+)\.0", r'{ epoch = "@e\1", time = \1.0', text)
    (place / "run.toml").write_text(text)
    run("fix", "run.toml", "--out", "o.csv")
    run("track", "run.toml", "--out", "t.csv")
    run("check", "run.toml", "--out", "h.csv")
    for name, column in (("o.csv", "epoch"), ("t.csv", "epoch"), ("h.csv", "name")):
        table = pd.read_csv(name, dtype=str, keep_default_na=False)
        assert table[column].str.match("'[@=]").sum() in (1, len(table))
        assert not [cell for cell in table.to_numpy().ravel() if cell != harmless(cell)]


def test_what_is_read_again_is_written_as_it_is(place):
    write_csv(Path("s.csv"), {"name": FORMULAS, "x": [1.0] * len(FORMULAS)})
    assert pd.read_csv("s.csv", dtype=str, lineterminator="\n")["name"].tolist() == FORMULAS
    text = (place / "site.toml").read_text().replace('"A"', '"=A()"')
    (place / "bad.toml").write_text(text)
    run("simulate", "bad.toml", "--truth", "1500,2200,900", "--out", "again.toml")
    assert read(place / "again.toml").problem.stations.names == read(place / "bad.toml").problem.stations.names
    assert "'=" not in (place / "again-1.csv").read_text()


def test_a_minus_is_standard_output_with_the_same_bytes(capfdbinary):
    with outputs.written(Path("-")) as file:
        file.write_bytes(b"a,b\r\n1,2\n")
    assert capfdbinary.readouterr().out == b"a,b\r\n1,2\n"
    assert outputs.is_stream(Path("-"))
    outputs.claim(Path("-"), Path("-"))
    assert not outputs.is_standard_output(None)
