"""Executors: the same results everywhere; lost workers are survived, and a dead scheduler is one sentence."""

import importlib.util
import logging
import os
import signal
import subprocess
import sys
import time

import pytest

from optloc import InvalidProblem
from optloc.base.threads import thread_count
from optloc.partitions import executors
from optloc.partitions.executors import TASK_EXECUTORS, Died, TaskExecutor, task_executor

FEW = range(5)


def square(number):
    return number**2


def threads(number):
    return thread_count()


def die_once(task):
    """End this process at the first attempt at task 1."""
    folder, number = task
    if number == 1 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(number):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def slowly(number):
    time.sleep(0.3)
    return number


def test_tasks_of_this_process_come_in_order():
    assert list(TaskExecutor().run(square, FEW)) == [(i, i * i) for i in FEW]
    assert list(TaskExecutor("dask").run(square, [])) == []


def test_options_of_executors_are_checked():
    assert set(TASK_EXECUTORS) == {"local", "dask", "ray"}
    with pytest.raises(InvalidProblem, match="did you mean 'dask'"):
        task_executor("desk")
    with pytest.raises(InvalidProblem, match="--scheduler: the fixes are computed in this process"):
        task_executor("local", address="tcp://127.0.0.1:1")
    with pytest.raises(InvalidProblem, match="--jobs: the fixes are computed in this process"):
        task_executor("local", 2)


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_ray_that_is_not_installed_is_one_sentence():
    with pytest.raises(InvalidProblem, match=r"Ray is not installed; pip install 'optloc\[ray\]'"):
        list(TaskExecutor("ray").run(square, FEW))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "package"), [("dask", "distributed"), ("ray", "ray")])
def test_clusters_give_the_same_results_survive_a_lost_worker_and_report_a_fatal_task(
    tmp_path, importable, name, package
):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    by = TaskExecutor(name, 2)
    assert sorted(by.run(square, FEW)) == [(i, i * i) for i in FEW]
    assert {count for _, count in by.run(threads, FEW)} == {1}
    tasks = [(tmp_path, number) for number in FEW]
    assert sorted(number for _, number in by.run(die_once, tasks)) == list(FEW)
    results = dict(by.run(die, FEW))
    assert isinstance(results.pop(1), Died)
    assert results == {i: i for i in FEW if i != 1}


SCHEDULER = """
from distributed import LocalCluster
import time
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        time.sleep(600)
"""


@pytest.mark.slow
def test_a_scheduler_that_ends_is_one_sentence(tmp_path, importable):
    pytest.importorskip("distributed")
    (tmp_path / "cluster.py").write_text(SCHEDULER)
    with subprocess.Popen(
        [sys.executable, tmp_path / "cluster.py"], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as cluster:
        address = cluster.stdout.readline().strip()
        results = TaskExecutor("dask", address=address).run(slowly, range(100))
        assert next(results) == (0, 0)
        os.killpg(cluster.pid, signal.SIGKILL)
        with pytest.raises(InvalidProblem, match="the scheduler has ended; start it again"):
            list(results)


@pytest.mark.slow
def test_a_cluster_whose_workers_have_ended_is_one_sentence(monkeypatch, importable):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "_LOOK", 0.2)
    monkeypatch.setattr(executors, "_WITHOUT_WORKERS", 1.0)
    options = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
    with distributed.LocalCluster(n_workers=1, **options) as cluster:
        results = TaskExecutor("dask", address=cluster.scheduler_address).run(slowly, range(100))
        assert next(results) == (0, 0)
        cluster.scale(0)
        with pytest.raises(InvalidProblem, match="all workers have ended; start workers"):
            list(results)
