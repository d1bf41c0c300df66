"""Execution of a study into its output folder, on this machine, a Dask cluster or Ray, through joblib.

With every executor, each method runs in a separate worker process (`WorkerProcess`). The worker has limits of time and
memory, its replies are checked, and it ends with the process that started it.

A task is a chunk of the design, or a part of a chunk that has failed: failed chunks are halved, to find the failing
trial.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any
from warnings import catch_warnings, filterwarnings, warn

from optloc.lab.study.design import Chunk, StudyDesign, workers
from optloc.lab.study.folder import Progress, begin, finished_parts, known_data, locked, note_data, progress, store
from optloc.lab.study.problem_copies import store_problems
from optloc.lab.study.trial import DIED, LATE, Lost, TrialPart, join_parts, part_of_lost
from optloc.lab.study.worker_process import WorkerPool
from optloc.partitions import dask_client, ray_cluster
from optloc.problem import InvalidProblem, nearest, plugins

TASK_LIMIT = 600.0
"""Default time limit of a task, seconds. A task should take seconds; the longest of the shipped studies takes half a
second. On a new machine, compilation takes another minute."""
# Seconds. A week: longer waits may overflow on some systems.
_LONGEST = 604_800.0

Tell = Callable[[int, dict[str, int]], None]
"""Called with the number of new rows and their statuses after each part."""


@dataclass(frozen=True, slots=True)
class Executor:
    """Choice of an executor and its settings.

    Parameters
    ----------
    name : str
        A key of `EXECUTORS`.
    jobs : int, optional
        Number of processes; all processors by default. A running cluster ignores it.
    address : str, optional
        Address of a Dask scheduler ("tcp://host:8786") or a Ray cluster; by default a local one is started.
    limit : float
        Time limit of a task, seconds.
    """

    name: str = "processes"
    jobs: int | None = None
    address: str | None = None
    limit: float = TASK_LIMIT


def executor(name: str, jobs: int | None = None, address: str | None = None, limit: float = TASK_LIMIT) -> Executor:
    """Return an executor; raise InvalidProblem for an unknown name, an address that it cannot use, or a wrong limit."""
    if name not in EXECUTORS:
        raise InvalidProblem(f"unknown executor {name!r}", "--executor", nearest(name, list(EXECUTORS)))
    if address is not None and not EXECUTORS[name].scheduler:
        raise InvalidProblem(f"{name} has no scheduler", "--scheduler", "add --executor dask")
    if not 0.0 < limit <= _LONGEST:
        raise InvalidProblem(f"the limit {limit:g} s is out of range", "--task-limit", f"give 0 to {_LONGEST:g} s")
    return Executor(name, jobs, address, limit)


def run_design(
    design: StudyDesign, folder: Path, by: Executor, tell: Tell | None = None, say: Callable[[str], None] = warn
) -> Progress:
    """Compute the missing parts of a study, and return its progress.

    Parameters
    ----------
    design : StudyDesign
        The study.
    folder : Path
        Its output folder: new, or from the same study and the same version of optloc.
    by : Executor
        Executor of the tasks.
    tell : callable, optional
        Called with the number of new rows and their numbers by status: first for the existing parts, then after every
        part.
    say : callable
        Called with a sentence for each damaged part, which is then computed again.

    Raises
    ------
    InvalidProblem
        If the folder belongs to another study, contains other data or cannot be written; finished parts are kept.
    """
    with locked(folder):
        # The lock excludes other writers, so finished parts stay finished.
        manifest = begin(design, folder)
        store_problems(design, folder)
        done = finished_parts(folder, manifest, say)
        known = known_data(design, folder, done)
        if tell is not None and done:
            existing = progress(folder)
            tell(existing.rows, existing.counts)
        missing = [chunk for chunk in design.chunks if chunk.key not in done]
        with closing(compute_all(missing, by)) as parts:
            for part in parts:
                note_data(known, part.table, folder)
                store(folder, part)
                if tell is not None:
                    tell(sum(part.counts.values()), part.counts)
        return progress(folder)


def compute_all(chunks: Iterable[Chunk], by: Executor) -> Generator[TrialPart]:
    """Yield the parts of chunks as they are finished.

    If the process of a chunk dies, the chunk is computed again in another process. If this process dies too, or if the
    chunk exceeds its time limit, the chunk is halved until a single failing trial remains. This trial gets the status
    `died` or `timeout`.

    Parameters
    ----------
    chunks : iterable of Chunk
        The tasks.
    by : Executor
        Executor of the tasks.

    Raises
    ------
    InvalidProblem
        If the executor is not installed, its scheduler cannot be reached, or no process can be started.
    """
    work = _Work(chunks, by.limit)
    if not work.waiting:
        return
    with EXECUTORS[by.name].begin(by) as running, closing(WorkerPool(1)) as local:
        while work.waiting:
            try:
                for result in _parallel(work.hand_out(), running):
                    yield from work.take(result)
            except running.deaths:
                # A cluster has lost several workers. Their chunks are computed in a process of this machine, the others
                # on the cluster.
                for task in list(work.running.values()):
                    yield from work.take(local.compute(task.chunk, by.limit))


def _parallel(tasks: Iterator[tuple[Chunk, float]], running: Begun) -> Iterator[TrialPart | Lost]:
    """Yield the results of tasks as joblib completes them; each task is a chunk and its time limit in seconds."""
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(**running.options), catch_warnings():
        # If a run is stopped, joblib warns about tasks without a receiver; they are computed again later.
        filterwarnings("ignore", "[0-9]+ tasks", UserWarning)
        if running.streams:
            # One chunk a task, two tasks for each worker: no worker waits, and a stopped run loses few chunks.
            run = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
            yield from run(delayed(running.work)(*task) for task in tasks)
            return
        while batch := list(islice(tasks, 2 * running.options["n_jobs"])):
            yield from Parallel(batch_size=1)(delayed(running.work)(*task) for task in batch)


# Remaining chunks of a run, and the treatment of chunks that failed.

# A cell may lose four time limits beyond its work, and a death counts as a sixteenth of one. This is enough to find
# among ten thousand trials one trial at which a method hangs (3.1 limits), or four at which it dies. A method that
# always fails is abandoned early.
_PATIENCE, _DEATH = 4.0, 1 / 16
# A part of a chunk has its share of the time limit, but at least an eighth, and at least 10 s for compilation.
_LEAST, _BUILD = 1 / 8, 10.0


@dataclass(frozen=True, slots=True)
class _Task:
    """Some trials (`chunk`) of a chunk of the design (`whole`).

    `again` is True if one attempt at these trials has already failed.
    """

    chunk: Chunk
    whole: Chunk
    again: bool = False

    @property
    def share(self) -> float:
        """Return the share of the time limit of the whole chunk."""
        return max(self.chunk.count / self.whole.count, _LEAST)


class _Work:
    """Bookkeeping of a run: waiting and running tasks, parts of halved chunks, and abandoned cells.

    `waiting` are the tasks to start, and `running` are the started tasks by the key of their chunk. `_parts` are the
    parts of halved chunks by the key of the whole chunk. `_lost` is the time that failures of a cell cost, in time
    limits, by the key of the cell. `_given_up` is the last failure of each abandoned cell.
    """

    def __init__(self, chunks: Iterable[Chunk], limit: float) -> None:
        self.waiting = deque(_Task(chunk, chunk) for chunk in chunks)
        self._limit = limit
        self.running: dict[str, _Task] = {}
        self._parts: dict[str, list[TrialPart]] = {}
        self._lost: dict[str, float] = {}
        self._given_up: dict[str, Lost] = {}

    def hand_out(self) -> Iterator[tuple[Chunk, float]]:
        """Yield waiting chunks with their time limits in seconds; the limit is 0 if their cell was abandoned."""
        while self.waiting:
            task = self.waiting.popleft()
            self.running[task.chunk.key] = task
            yield task.chunk, self._seconds(task)

    def take(self, result: TrialPart | Lost) -> Iterator[TrialPart]:
        """Record the result of a task, and yield the part of the whole chunk if all its trials are complete."""
        task = self.running.pop(result.key)
        part = self._part_of_failure(task, result) if isinstance(result, Lost) else result
        if part is None:
            return
        parts = self._parts.setdefault(task.whole.key, [])
        parts.append(part)
        if sum(len(piece.table) for piece in parts) == task.whole.count:
            del self._parts[task.whole.key]
            # Keys of parts sort in the order of their trials.
            yield part if len(parts) == 1 else join_parts(task.whole, sorted(parts, key=lambda piece: piece.key))

    def _part_of_failure(self, task: _Task, lost: Lost) -> TrialPart | None:
        """Return the part of a failed task, with a failure in every row; None if the task is tried again.

        After the first death of its process, the task is tried again. Otherwise it is divided into halves. A single
        trial, and a task of an abandoned cell, gets the failure in its rows.
        """
        chunk, cell = task.chunk, task.chunk.cell.key
        # `_lost` sums the failures of a cell, in time limits of a whole chunk.
        if cell not in self._given_up:
            self._lost[cell] = self._lost.get(cell, 0.0) + (task.share if lost.status == LATE else _DEATH)
            if self._lost[cell] >= _PATIENCE:
                reason = f"given up after too many failures in this scenario; last failure: {lost.reason}"
                self._given_up[cell] = replace(lost, reason=reason)
        if cell in self._given_up:
            return part_of_lost(chunk, self._given_up[cell])
        if lost.status == DIED and not task.again:
            # The machine may have been short of memory, or a user killed the process. First the whole chunk is tried
            # again, because halves would be solved in other batches.
            self.waiting.append(replace(task, again=True))
        elif chunk.count == 1:
            return part_of_lost(chunk, lost)
        else:
            half = chunk.count // 2
            for first, count in ((chunk.first, half), (chunk.first + half, chunk.count - half)):
                self.waiting.append(_Task(replace(chunk, first=first, count=count), task.whole, again=True))
        return None

    def _seconds(self, task: _Task) -> float:
        """Return the time limit of a task in seconds; 0 if its cell was abandoned."""
        if task.chunk.cell.key in self._given_up:
            return 0.0
        return min(self._limit, max(task.share * self._limit, _BUILD))


# Executors: how each starts, and the exceptions that report the death of a worker.


@dataclass(frozen=True, slots=True)
class Begun:
    """A running executor.

    Parameters
    ----------
    options : dict
        Options of joblib.
    work : callable
        ``(chunk, seconds) -> TrialPart or Lost``: the function that workers run; `seconds` is its time limit.
    deaths : tuple of exception types
        Exceptions that report the death of a worker.
    streams : bool
        Whether it returns each part when it is finished; otherwise it takes lists of a few chunks for each processor.
    """

    options: dict[str, Any]
    work: Callable[[Chunk, float], TrialPart | Lost]
    deaths: tuple[type[BaseException], ...] = ()
    streams: bool = True


@cache
def _local_workers() -> WorkerPool:
    """Return the workers on the machine of a cluster's worker; they are started once for each process."""
    return WorkerPool(workers())


def compute_next_to_worker(names: Sequence[str], chunk: Chunk, seconds: float) -> TrialPart | Lost:
    """Return the part of a chunk, or its failure, from a process next to a cluster's worker.

    A worker of a cluster has no limits of time and memory for a chunk; this process has them. `names` are the plugins
    of the process that runs the study, and `seconds` is the time limit.
    """
    return _local_workers().compute(chunk, seconds, names)


@contextmanager
def _processes(by: Executor) -> Iterator[Begun]:
    """Yield an executor of worker processes on this machine."""
    jobs = by.jobs or workers()
    # The workers of joblib are threads: each waits for a worker process.
    with closing(WorkerPool(jobs)) as pool:
        yield Begun({"backend": "threading", "n_jobs": jobs}, pool.compute)


@contextmanager
def _dask(by: Executor) -> Iterator[Begun]:
    """Yield an executor on a Dask cluster; start a local cluster if there is no address."""
    with dask_client(by.address, by.jobs or workers()) as client:
        from distributed import KilledWorker

        yield Begun(
            {"backend": "dask", "client": client, "n_jobs": -1},
            partial(compute_next_to_worker, plugins()),
            (KilledWorker,),
        )


@contextmanager
def _ray(by: Executor) -> Iterator[Begun]:
    """Yield an executor on a Ray cluster; start a local cluster if there is no address."""
    with ray_cluster(by.address, by.jobs or workers()) as ray:
        from ray.util.joblib import register_ray

        register_ray()
        jobs = int(ray.cluster_resources().get("CPU", 1))
        deaths = (ray.exceptions.RayActorError, ray.exceptions.WorkerCrashedError)
        yield Begun(
            {"backend": "ray", "n_jobs": jobs}, partial(compute_next_to_worker, plugins()), deaths, streams=False
        )


@dataclass(frozen=True, slots=True)
class ExecutorEntry:
    """Entry of the table of executors.

    Parameters
    ----------
    begin : callable
        ``(Executor) -> context manager`` of the running executor.
    summary : str
        One line for listings.
    scheduler : bool
        Whether it can use a running scheduler at an address.
    """

    begin: Callable[[Executor], AbstractContextManager[Begun]]
    summary: str
    scheduler: bool = False


EXECUTORS: dict[str, ExecutorEntry] = {
    "processes": ExecutorEntry(_processes, "processes of this machine; the default"),
    "dask": ExecutorEntry(_dask, "a running Dask cluster (--scheduler), or a local one", scheduler=True),
    "ray": ExecutorEntry(_ray, "a running Ray cluster (--scheduler), or a local one", scheduler=True),
}
"""Executors by name."""
