"""One study on several executors, with workers and runs that are killed: the same table, bit for bit."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import pytest
from lab.study.texts import QUICK, SMALL, assert_identical, design, run_here

from optloc.base.errors import InvalidProblem
from optloc.lab.study.execute import EXECUTORS, executor, run_design
from optloc.lab.study.folder import progress
from optloc.partitions import clusters

# Thirty parts or so: enough that a worker, and then the run, is killed between them.
LONG = QUICK.replace("trials = 60", "trials = 200")


# Two methods in parts of two sizes; without the relaxation processes need less time to begin.
TWO = SMALL.replace("socp+lsr", "roots+lsr")


@pytest.fixture(scope="module", params=[TWO, pytest.param(SMALL, marks=pytest.mark.full)], ids=["quick", "relaxed"])
def undisturbed(request, tmp_path_factory):
    """Return a study's text and the folder where it was computed in this process."""
    return request.param, run_here(design(request.param), tmp_path_factory.mktemp("study") / "plain")


@contextmanager
def process(*arguments, **options):
    """Run a Python process until the end of the block."""
    own = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    # Where tests run in the background of a shell, they ignore Ctrl-C, and so would their children.
    heard = {} if os.name == "nt" else {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    with subprocess.Popen([sys.executable, *arguments], env=own, **heard, **options) as running:
        try:
            yield running
        finally:
            running.kill()


def until(condition, seconds=90.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A real scheduler and two workers on loopback: address, and a function that starts one more worker."""
    pytest.importorskip("distributed")
    file = tmp_path_factory.mktemp("dask") / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    place = ["--scheduler-file", str(file)]
    with ExitStack() as stack:
        parts = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        stack.enter_context(process(*parts, *place, **quiet))
        until(file.exists)
        import json

        address = json.loads(file.read_text())["address"]

        def worker():
            own = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
            return stack.enter_context(
                process("-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", *own, **quiet)
            )

        first = [worker(), worker()]
        from distributed import Client

        with Client(address) as client:
            client.wait_for_workers(2, timeout=60)
        yield address, worker, first


def test_local_processes_give_the_same_table(undisturbed, tmp_path):
    text, expected = undisturbed
    assert run_design(design(text), tmp_path / "processes", executor("processes", 2)).complete
    assert_identical(expected, tmp_path / "processes")


@pytest.mark.slow
def test_a_cluster_gives_the_same_table(undisturbed, cluster, tmp_path):
    text, expected = undisturbed
    assert run_design(design(text), tmp_path / "dask", executor("dask", None, cluster[0])).complete
    assert_identical(expected, tmp_path / "dask")


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_ray_gives_the_same_table(undisturbed, tmp_path):
    text, expected = undisturbed
    assert run_design(design(text), tmp_path / "ray", executor("ray", 2)).complete
    assert_identical(expected, tmp_path / "ray")


@pytest.mark.full  # the run in processes of its own, killed, is in every run
def test_a_killed_worker_and_a_killed_run_lose_nothing(cluster, tmp_path):
    address, another, workers = cluster
    (tmp_path / "long.toml").write_text(LONG)
    whole = tmp_path / "whole"
    run_here(design(LONG), whole)
    out = tmp_path / "out"
    command = ["-m", "optloc.cli", "study", "run", str(tmp_path / "long.toml"), "--out", str(out)]

    def parts():
        return len(list(out.glob("parts/*.parquet")))

    with process(*command, "--scheduler", address, stdout=subprocess.DEVNULL) as run:
        until(lambda: parts() >= 5)
        workers[0].kill()
        before = parts()
        until(lambda: parts() >= before + 5)
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
    found = progress(out)
    assert 0 < found.done < found.chunks
    another()
    told = []
    assert run_design(design(LONG), out, executor("dask", None, address), lambda rows, _: told.append(rows)).complete
    assert told[0] == found.rows  # what was finished is not done again
    assert sum(told) == design(LONG).rows
    assert_identical(whole, out)


def test_unknown_executors_and_schedulers_that_are_not_there():
    with pytest.raises(InvalidProblem, match="did you mean 'dask'"):
        executor("desk")
    with pytest.raises(InvalidProblem, match="has no scheduler"):
        executor("processes", None, "tcp://127.0.0.1:1")
    assert set(EXECUTORS) == {"processes", "dask", "ray"}


def test_an_unreachable_scheduler_is_one_sentence_and_nothing_is_lost(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "CONNECT", 1.0)
    out = tmp_path / "out"
    with pytest.raises(InvalidProblem, match=r"tcp://127\.0\.0\.1:1: the scheduler cannot be reached"):
        run_design(design(), out, executor("dask", None, "tcp://127.0.0.1:1"))
    assert progress(out).done == 0


PLUGIN = """
from optloc.lab.study.baselines import BASELINES, Baseline

def same(drawn, start):
    return BASELINES["truth"].run(drawn, start)

BASELINES["mine"] = Baseline(same, "what is known", guess=False)
"""


@pytest.mark.slow
def test_a_plugin_of_the_command_line_is_known_to_the_processes_of_a_study(tmp_path):
    (tmp_path / "mine.py").write_text(PLUGIN)
    (tmp_path / "study.toml").write_text(
        QUICK.replace("trials = 60", "trials = 2") + '\n[[method]]\nbaseline = "mine"\n'
    )
    ask = [
        sys.executable,
        "-m",
        "optloc.cli",
        "--plugin",
        "mine.py",
        "study",
        "run",
        "study.toml",
        "--out",
        "out",
        "-j",
        "1",
    ]
    made = subprocess.run([*ask, "--json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    found = {(one["method"], one["status"]) for one in json.loads(made.stdout)["methods"]}
    assert ("mine", "unproven") in found  # an answer, and one that nobody has proven
