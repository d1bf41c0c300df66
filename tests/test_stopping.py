"""Ctrl-C, closed pipes, full disks, terminals of any width and encoding: a command ends quietly with its code."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
from often import few
from progress import without_progress

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")

# As pip's script does. It says when optloc begins to import: before, a process is Python's, and so is what Ctrl-C does.
SCRIPT = """
import __future__, os, re, signal, sys
sys.argv = ["optloc", *sys.argv[1:]]
class Watch:
    def find_spec(self, name, *_):
        if name != "optloc":
            sys.meta_path.remove(self)
            os.write(2, b"!")
sys.meta_path.insert(0, Watch())
from optloc.cli import main
main()
"""
COMMANDS = (
    "fix demo",
    "fix run --out o.csv --force",
    "demo --plot o.png --force",
    "track run --out t.csv --force",
    "check run --plot o.svg --force",
    "crlb demo --map o.html --force",
    "list formulations",
    "plot landscape demo --out o.png --force",
    "study run divergence --trials 20 -j 1 --out s",
)


def start(command, place, **options):
    arguments = [sys.executable, "-c", SCRIPT, *command.split()]
    return subprocess.Popen(
        arguments,
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        process_group=0,
        # Tests that run in the background do not hear Ctrl-C, nor would what they begin.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509  (no threads here)
        **options,
    )


def stop(command, delay, place, presses=1):
    """Return exit code and standard error of a command that is stopped so many seconds after it began."""
    child = start(command, place)
    assert child.stderr.read(1) == b"!"
    time.sleep(delay)
    for _ in range(presses):
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGINT)
            time.sleep(0.02)
    try:
        _, said = child.communicate(timeout=60)
    finally:
        child.kill()
    return child.returncode, said.decode()


def check(command, delay, place, presses=1):
    code, said = stop(command, delay, place, presses)
    where = f"{command} after {delay:.3f} s: {code}\n{said}"
    # Python takes its handler away as the last thing before it ends: then the signal ends it, which shells call 130.
    assert code in ((130,) if delay < 0.2 else (0, 1, 130, -signal.SIGINT)), where
    assert "Traceback" not in said, where
    assert len(said.strip().splitlines()) <= 1, where
    assert not list(place.glob(".optloc-*")), where


@pytest.mark.parametrize("number", range(8))
def test_ctrl_c_at_any_moment(number, seed, tmp_path):
    draw = random.Random(f"{seed} {number}")
    check(COMMANDS[number % 5], 0.002 * 500 ** draw.random(), tmp_path)


@pytest.mark.full
@pytest.mark.parametrize("number", range(200))
def test_ctrl_c_at_any_moment_of_any_command(number, seed, tmp_path):
    draw = random.Random(f"{seed} full {number}")
    check(draw.choice(COMMANDS), 0.002 * 1500 ** draw.random(), tmp_path, presses=draw.choice((1, 1, 2)))


def test_a_reader_that_goes_away_is_no_error(tmp_path):
    child = start("list kinds --json", tmp_path)
    assert child.stderr.read(1) == b"!"
    child.stdout.close()
    assert child.stderr.read() == b""
    assert child.wait() == 141


@pytest.mark.slow
@pytest.mark.parametrize("encoding", few(["ascii", "cp1252"], 1))
def test_any_encoding_and_any_width(encoding, tmp_path):
    names = "\U0001f4e1", "[/b]", r"$\frac{"
    places = ((0, 0), (900, 0), (0, 900))
    stations = [
        f"{{ name = {json.dumps(n, ensure_ascii=False)}, x = {x}, y = {y} }}"
        for n, (x, y) in zip(names, places, strict=True)
    ]
    rows = [
        f"{{ a = {json.dumps(n, ensure_ascii=False)}, z = {z} }}" for n, z in zip(names, (500, 640, 720), strict=True)
    ]
    text = (
        f'format = 1\ntitle = "\u00b1 [red] [/nothing]"\n[stations]\nrows = [{", ".join(stations)}]\n'
        f'[[measurements]]\nkind = "range"\nsigma = 1\nrows = [{", ".join(rows)}]\n'
    )
    (tmp_path / "a.toml").write_text(text, encoding="utf-8")
    for columns in ("1",) if encoding == "ascii" else ("0",):
        more = os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": columns}
        child = start("fix a.toml --plot a.png --force --method gtrs+lsr+suspects", tmp_path, env=more)
        out, said = child.communicate(timeout=60)
        assert said.startswith(b"!")
        assert (child.returncode in (0, 1), without_progress(said[1:])) == (True, []), said.decode()
        assert b"\x1b" not in out


def test_standard_streams_that_are_closed(tmp_path):
    script = f"exec {sys.executable} -m optloc.cli new tdoa --out a.toml >&- 2>&-"
    assert subprocess.run(["sh", "-c", script], cwd=tmp_path, check=False).returncode == 0
    assert (tmp_path / "a.toml").read_text().startswith("#")
    full = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m optloc.cli new tdoa >/dev/full"], capture_output=True, text=True, check=False
    )
    assert full.returncode == 2
    assert len(without_progress(full.stderr)) == 1
