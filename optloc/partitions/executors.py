"""Executors of independent tasks: in this process, on a Dask cluster or on Ray.

Results come in the order of their completion. A cluster runs few tasks ahead, so that a stopped run loses little work.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from time import monotonic
from typing import Any, TypeVar

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.threads import limited_threads, thread_count
from optloc.partitions.clusters import dask_client, ray_cluster

Task = TypeVar("Task")
Result = TypeVar("Result")

# Tasks for each processor of a cluster: one runs, and one waits, so that no processor waits for this process.
_AHEAD = 2
# A worker that ends three times at one task, for example without memory, fails the task.
_DEATHS = 3
# Seconds between looks at the workers, and the longest time without any worker: a new one starts in some seconds.
_LOOK, _WITHOUT_WORKERS = 5.0, 60.0


@dataclass(frozen=True, slots=True)
class Died:
    """The failure of a task whose workers ended, with a reason."""

    reason: str


_DIED = Died(
    "the workers of this partition ended again and again; write smaller partitions, or start workers with more memory"
)

Completed = Generator[tuple[Task, Result | Died]]
"""Tasks with their results, in the order of their completion."""


@dataclass(frozen=True, slots=True)
class TaskExecutor:
    """Choice of an executor.

    Parameters
    ----------
    name : str
        A key of `TASK_EXECUTORS`.
    jobs : int, optional
        Number of processes of a local cluster; all processors by default.
    address : str, optional
        Address of a Dask scheduler or of a Ray cluster; by default a local one is started.
    """

    name: str = "local"
    jobs: int | None = None
    address: str | None = None

    def run(self, work: Callable[[Task], Result], tasks: Sequence[Task]) -> Completed[Task, Result]:
        """Yield each task with the result of ``work(task)``, or with the failure of its worker.

        Raises
        ------
        InvalidProblem
            If the executor is not installed, or its scheduler cannot be reached.
        """
        # Without tasks, no cluster is started.
        return TASK_EXECUTORS[self.name if tasks else "local"](self, work, tasks)


def task_executor(name: str, jobs: int | None = None, address: str | None = None) -> TaskExecutor:
    """Return an executor; raise InvalidProblem for an unknown name, or an option that it does not use."""
    if name not in TASK_EXECUTORS:
        raise InvalidProblem(f"unknown executor {name!r}", "--executor", nearest(name, list(TASK_EXECUTORS)))
    for flag, given in (("--scheduler", address), ("--jobs", jobs)):
        if name == "local" and given is not None:
            raise InvalidProblem("the fixes are computed in this process", flag, "add --executor dask")
    return TaskExecutor(name, jobs, address)


def _run_here(by: TaskExecutor, work: Callable[[Task], Result], tasks: Sequence[Task]) -> Completed[Task, Result]:
    """Yield the results of tasks of this process."""
    for task in tasks:
        yield task, work(task)


def run_on_one_thread(work: Callable[[Task], Result], task: Task) -> Result:
    """Return the result of a task that uses one thread: a cluster has one worker for each processor."""
    with limited_threads(1):
        return work(task)


def _submitted(
    tasks: Iterable[Task],
    submit: Callable[[Task], Any],
    finished: Callable[[Iterable[Any]], Iterable[Any]],
    processors: int,
) -> Iterator[tuple[Task, Any]]:
    """Yield tasks with their finished futures, while `_AHEAD` tasks for each processor run or wait.

    ``submit(task)`` starts a task and returns its future. ``finished(futures)`` waits, and returns finished futures.
    """
    waiting, running = iter(tasks), dict[Any, Task]()

    def hand_out(count: int) -> None:
        running.update((submit(task), task) for task in islice(waiting, count))

    hand_out(_AHEAD * processors)
    while running:
        for future in finished(running):
            task = running.pop(future)
            hand_out(1)
            yield task, future


def _run_on_dask(by: TaskExecutor, work: Callable[[Task], Result], tasks: Sequence[Task]) -> Completed[Task, Result]:
    """Yield the results of tasks on a Dask cluster, which starts tasks of lost workers again."""
    with dask_client(by.address, by.jobs or thread_count()) as client:
        from distributed import KilledWorker

        suspects = list[Task]()

        def submit(task: Task) -> Any:
            # A task is never the same as an earlier one: the input file may have changed.
            return client.submit(run_on_one_thread, work, task, pure=False)

        def finished(futures: Iterable[Any]) -> list[Any]:
            return _finished_on_dask(client, futures, by.address)

        for task, future in _submitted(tasks, submit, finished, sum(client.ncores().values())):
            try:
                yield task, future.result()
            except KilledWorker:
                suspects.append(task)
            future.release()
        # Dask also blames the tasks that waited at a lost worker, so each suspect is tried again alone.
        for task in suspects:
            try:
                yield task, finished([submit(task)])[0].result()
            except KilledWorker:
                yield task, _DIED


def _finished_on_dask(client: Any, futures: Iterable[Any], address: str | None) -> list[Any]:
    """Return the futures that have finished, as soon as there is one.

    Raises
    ------
    InvalidProblem
        If the cluster has no worker for `_WITHOUT_WORKERS` seconds: Dask would wait without end.
    """
    from distributed import wait

    wanted, end = list(futures), monotonic() + _WITHOUT_WORKERS
    while True:
        try:
            return list(wait(wanted, timeout=_LOOK, return_when="FIRST_COMPLETED").done)
        except TimeoutError:
            if client.ncores():
                end = monotonic() + _WITHOUT_WORKERS
            elif monotonic() > end:
                advice = "start workers, and run the same command: finished parts are kept"
                raise InvalidProblem("all workers have ended", address or "dask", advice) from None


def _run_on_ray(by: TaskExecutor, work: Callable[[Task], Result], tasks: Sequence[Task]) -> Completed[Task, Result]:
    """Yield the results of tasks on a Ray cluster, which starts tasks of lost workers again."""
    with ray_cluster(by.address, by.jobs or thread_count()) as ray:
        from ray.exceptions import NodeDiedError, OutOfMemoryError, WorkerCrashedError

        remote = ray.remote(max_retries=_DEATHS)(run_on_one_thread)
        futures = _submitted(
            tasks,
            lambda task: remote.remote(work, task),
            lambda running: ray.wait(list(running))[0],
            int(ray.cluster_resources().get("CPU", 1)),
        )
        for task, future in futures:
            try:
                yield task, ray.get(future)
            except (WorkerCrashedError, OutOfMemoryError, NodeDiedError):
                yield task, _DIED


TASK_EXECUTORS: dict[str, Callable[..., Completed[Any, Any]]] = {
    "local": _run_here,
    "dask": _run_on_dask,
    "ray": _run_on_ray,
}
"""Executors by name."""
