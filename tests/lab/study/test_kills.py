"""Runs and workers that are killed at random moments: the same table, bit for bit, and nobody is left behind."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from lab.study.texts import QUICK, assert_identical, design, run_here

psutil = pytest.importorskip("psutil")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="asks the system for the environment of processes")

# Some parts a second for some seconds, so that kills hit between them.
TEXT = QUICK.replace("trials = 60", "trials = 200")
MARK = "OPTLOC_MARK"
GONE = 5.0  # seconds after which nobody may be left


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run_here(design(TEXT), tmp_path_factory.mktemp("kills") / "whole")


@contextmanager
def running(folder, *options):
    """Run the study in a process of its own, marked as all that it begins; end what is left at the end of the block."""
    file = folder.with_suffix(".toml")
    file.write_text(TEXT)
    command = [sys.executable, "-m", "optloc.cli", "study", "run", str(file), "--out", str(folder), *options]
    # Where tests run in the background of a shell, they ignore Ctrl-C, and so would their children.
    with subprocess.Popen(
        command,
        env={**os.environ, MARK: str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509  (no threads here)
    ) as run:
        try:
            yield run
        finally:
            run.kill()
            for one in marked(folder):
                one.kill()


def marked(folder):
    """Return the processes that a run of this folder began."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(MARK) == str(folder) and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            pass
    return found


def orphans(folder):
    """Return who is left of a run when there has been time to end."""
    end = time.monotonic() + GONE
    while (left := marked(folder)) and time.monotonic() < end:
        time.sleep(0.05)
    return left


def parts(folder):
    return len(list(folder.glob("parts/[!.]*.parquet")))


def wait(run, condition, seconds=60.0):
    """Wait for a condition while a run goes on."""
    end = time.monotonic() + seconds
    while run.poll() is None and not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def killed(folder, count, options, seed, first=None):
    """Kill runs of a folder until there were so many, at any moment from their beginning to some parts later.

    Return the kills, those after the first part, and the time to the first part: without it, the first kill is later.
    """
    dice, kills, late = random.Random(seed), 0, 0
    while kills < count:
        began = time.monotonic()
        with running(folder, *options) as run:
            if first is None:
                wait(run, lambda: parts(folder) > 0)
                first = time.monotonic() - began
                moment = time.monotonic() + dice.uniform(0.0, 0.5)
            else:
                moment = began + dice.uniform(0.0, 1.4 * first)
            wait(run, lambda moment=moment: time.monotonic() > moment)
            if run.poll() is not None:
                break  # it was complete
            before = parts(folder)
            run.send_signal(signal.SIGKILL)
            run.wait()
            assert not orphans(folder)
            kills, late = kills + 1, late + (before > 0)
    return kills, late, first


def finish(folder, *options):
    with running(folder, *options) as run:
        run.wait(timeout=120)
        assert run.returncode == 0, run.stderr.read()
        assert not orphans(folder)


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [pytest.param("1", marks=pytest.mark.full), "2"])
def test_a_killed_run_goes_on_to_the_same_table(jobs, whole, tmp_path):
    out = tmp_path / "out"
    kills, late, _ = killed(out, 1, ["-j", jobs], seed=int(jobs))
    assert 1 <= late <= kills
    finish(out, "-j", jobs)
    assert_identical(whole, out)


@pytest.mark.full
@pytest.mark.parametrize("options", [["-j", "1"], ["-j", "2"], ["-x", "dask", "-j", "2"]], ids=["1", "2", "dask"])
def test_fifty_kills_change_nothing(options, whole, tmp_path):
    if "dask" in options:
        pytest.importorskip("distributed")
    kills = late = rounds = 0
    first = None
    while kills < 50 or late < 20:
        out = tmp_path / f"out{rounds}"
        more, after, first = killed(out, 5, options, rounds, first)
        kills, late, rounds = kills + more, late + after, rounds + 1
        finish(out, *options)
        assert_identical(whole, out)
    print(f"{kills} kills, {late} after the first part, {rounds} tables identical, no orphan")  # noqa: T201  (a count)


@pytest.mark.full
@pytest.mark.parametrize("options", [["-j", "2"], ["-x", "dask", "-j", "2"]])
def test_killed_workers_change_nothing(options, whole, tmp_path):
    out, dice, kills = tmp_path / "out", random.Random(7), 0
    with running(out, *options) as run:
        wait(run, lambda: parts(out) > 3)
        while run.poll() is None and kills < 3:
            # Of a cluster the workers, too, and what looks after its memory.
            others = [one for one in marked(out) if one.pid != run.pid]
            if others:
                kills += 1
                dice.choice(others).kill()
            time.sleep(dice.uniform(0.2, 0.5))
        run.wait(timeout=120)
        assert run.returncode == 0, run.stderr.read()
        assert kills
        assert not orphans(out)
    assert_identical(whole, out)


@pytest.mark.slow
@pytest.mark.parametrize("group", [False, pytest.param(True, marks=pytest.mark.full)])
@pytest.mark.parametrize("options", [["-j", "2"], pytest.param(["-x", "dask", "-j", "2"], marks=pytest.mark.full)])
def test_ctrl_c_is_one_sentence_and_ends_everybody(options, group, tmp_path):
    dice, out = random.Random(len(options) + group), tmp_path / "out"
    with running(out, *options) as run:
        wait(run, lambda: parts(out) > 0)
        time.sleep(dice.uniform(0.0, 0.2))
        (os.killpg if group else os.kill)(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=60)
        assert run.returncode == 130, said
        assert said.count("\n") == 1, said
        assert "run the same command to continue" in said
        assert not orphans(out)
