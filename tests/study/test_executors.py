"""One study on several executors, with workers and runs that are killed: the same table, bit for bit."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import cloudpickle
import numpy as np
import pytest
from study.texts import QUICK, SMALL, assert_identical, plan

from optloc.base.errors import InvalidProblem
from optloc.study import execute
from optloc.study.execute import EXECUTORS, executor, run_plan
from optloc.study.folder import progress, read_frame
from optloc.study.trial import compute

LONG = QUICK.replace("trials = 60", "trials = 600")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "plain"
    assert run_plan(plan(), folder, executor("in-process")).complete
    return folder


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


def test_local_processes_and_a_cluster_give_the_same_table(undisturbed, cluster, tmp_path):
    assert run_plan(plan(), tmp_path / "processes", executor("processes", 2)).complete
    assert_identical(undisturbed, tmp_path / "processes")
    assert run_plan(plan(), tmp_path / "dask", executor("dask", None, cluster[0])).complete
    assert_identical(undisturbed, tmp_path / "dask")


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_ray_gives_the_same_table(undisturbed, tmp_path):
    assert run_plan(plan(), tmp_path / "ray", executor("ray", 2)).complete
    assert_identical(undisturbed, tmp_path / "ray")


def test_a_killed_worker_and_a_killed_run_lose_nothing(cluster, tmp_path):
    address, another, workers = cluster
    (tmp_path / "long.toml").write_text(LONG)
    whole = tmp_path / "whole"
    assert run_plan(plan(LONG), whole, executor("in-process")).complete
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
    assert run_plan(plan(LONG), out, executor("dask", None, address), lambda rows, _: told.append(rows)).complete
    assert told[0] == found.rows  # what was finished is not done again
    assert sum(told) == plan(LONG).rows
    assert_identical(whole, out)


def test_a_killed_run_of_local_processes_goes_on(tmp_path, undisturbed):
    (tmp_path / "small.toml").write_text(SMALL)
    out = tmp_path / "out"
    command = ["-m", "optloc.cli", "study", "run", str(tmp_path / "small.toml"), "--out", str(out), "--jobs", "2"]
    with process(*command, stdout=subprocess.DEVNULL, start_new_session=True) as run:
        until(lambda: list(out.glob("parts/*.parquet")))
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    assert run_plan(plan(), out, executor("in-process")).complete
    assert_identical(undisturbed, out)


def test_ctrl_c_stops_with_a_sentence_and_keeps_what_is_finished(tmp_path):
    (tmp_path / "long.toml").write_text(LONG)
    out = tmp_path / "out"
    command = ["-m", "optloc.cli", "study", "run", str(tmp_path / "long.toml"), "--out", str(out), "--jobs", "2"]
    with process(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        until(lambda: list(out.glob("parts/*.parquet")))
        run.send_signal(signal.SIGINT)
        _, complaint = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "goes on from there" in complaint
    assert "Traceback" not in complaint
    assert progress(out).done > 0


def test_a_trial_that_kills_its_process_costs_one_row(tmp_path, monkeypatch):
    made, undisturbed = plan(QUICK), tmp_path / "plain"
    run_plan(made, undisturbed, executor("in-process"))
    key = made.cells[0].key

    def lethal(chunk):
        if chunk.cell.key == key and chunk.first <= 13 < chunk.first + chunk.count:
            os.kill(os.getpid(), signal.SIGKILL)
        return compute(chunk)

    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(execute, "task", lethal)
    try:
        found = run_plan(made, tmp_path / "out", executor("processes", 2))
    finally:
        cloudpickle.unregister_pickle_by_value(sys.modules[__name__])
    assert found.complete
    assert found.counts["died"] == 1
    table, whole = (read_frame(folder) for folder in (tmp_path / "out", undisturbed))
    lost = table["status"] == "died"
    assert (table["key"][lost].item(), table["trial"][lost].item()) == (key, 13)
    for name in ("seed", "trial", "truth_x", "crlb", "cost_truth", "chunk"):
        assert (table[name].astype(object) == whole[name].astype(object)).all(), name
    assert np.allclose(table["error"][~lost], whole["error"][~lost])


def test_unknown_executors_and_schedulers_that_are_not_there():
    with pytest.raises(InvalidProblem, match="did you mean 'dask'"):
        executor("desk")
    with pytest.raises(InvalidProblem, match="has no scheduler"):
        executor("processes", None, "tcp://127.0.0.1:1")
    assert set(EXECUTORS) == {"in-process", "processes", "dask", "ray"}


def test_an_unreachable_scheduler_is_one_sentence_and_nothing_is_lost(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(execute, "CONNECT", 1.0)
    out = tmp_path / "out"
    with pytest.raises(InvalidProblem, match=r"tcp://127\.0\.0\.1:1: the scheduler cannot be reached"):
        run_plan(plan(), out, executor("dask", None, "tcp://127.0.0.1:1"))
    assert progress(out).done == 0
