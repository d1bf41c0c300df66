"""Run a study into its folder: methods in processes apart, on this machine, a Dask cluster or Ray, through joblib.

Whoever executes, a method runs in a process of its own that is watched over (`Apart`): it has a limit of time and of
memory, what it answers is checked there, and it ends with the process that began it, however that ends.
"""

from __future__ import annotations

import logging
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any
from warnings import catch_warnings, filterwarnings, warn

from optloc.lab.study.design import Chunk, StudyDesign, workers
from optloc.lab.study.folder import Progress, begin, finished_parts, known_data, locked, note_data, progress, store
from optloc.lab.study.trial import DIED, LATE, Lost, TrialPart, join_parts, part_of_lost
from optloc.lab.study.worker_process import WorkerPool
from optloc.problem import InvalidProblem, nearest, plugins

CONNECT = 10.0
"""Seconds to wait for a scheduler: one on the same network answers in less than one; people wait for no more."""

TASK_LIMIT = 600.0
"""Seconds that a task may take where nobody says otherwise: it should take seconds, of the shipped studies the longest
takes half of one, and compiling everything on a machine that has not yet done so takes a minute."""
# A week: no wait on any system can be so long that numbers overflow.
_LONGEST = 604_800.0

Tell = Callable[[int, dict[str, int]], None]
"""Called with the number of new rows and their statuses after each part."""


@dataclass(frozen=True, slots=True)
class Executor:
    """Who computes.

    Parameters
    ----------
    name : str
        A key of `EXECUTORS`.
    jobs : int, optional
        Processes; all processors by default. A cluster that exists decides itself.
    address : str, optional
        Of a Dask scheduler ("tcp://host:8786") or a Ray cluster; by default a local one is begun.
    limit : float
        Seconds that a task may take.
    """

    name: str = "processes"
    jobs: int | None = None
    address: str | None = None
    limit: float = TASK_LIMIT


def executor(name: str, jobs: int | None = None, address: str | None = None, limit: float = TASK_LIMIT) -> Executor:
    """Return an executor; raise InvalidProblem for an unknown one, or an address or a limit that cannot be."""
    if name not in EXECUTORS:
        raise InvalidProblem(f"unknown executor {name!r}", "--executor", nearest(name, list(EXECUTORS)))
    if address is not None and not EXECUTORS[name].scheduler:
        raise InvalidProblem(f"{name} has no scheduler", "--scheduler", "add --executor dask")
    if not 0.0 < limit <= _LONGEST:
        raise InvalidProblem(f"a task cannot take {limit:g} s", "--task-limit", f"give seconds, {_LONGEST:g} at most")
    return Executor(name, jobs, address, limit)


def run_design(
    design: StudyDesign, folder: Path, by: Executor, tell: Tell | None = None, say: Callable[[str], None] = warn
) -> Progress:
    """Compute what is missing of a study, and return how far it is.

    Parameters
    ----------
    design : StudyDesign
        The study.
    folder : Path
        Its output folder: new, or begun by the same study and the same version.
    by : Executor
        Who computes.
    tell : callable, optional
        Hears of every part, and first of those that were there.
    say : callable
        Hears sentences about parts that were damaged and are made again.

    Raises
    ------
    InvalidProblem
        Where the folder belongs to another study, holds other data or cannot be written; finished parts are kept.
    """
    with locked(folder):
        # From here to the end nobody else writes: what is counted as finished stays so.
        manifest = begin(design, folder)
        done = finished_parts(folder, manifest, say)
        known = known_data(design, folder, done)
        if tell is not None and done:
            had = progress(folder)
            tell(had.rows, had.counts)
        left = [chunk for chunk in design.chunks if chunk.key not in done]
        with closing(compute_all(left, by)) as parts:
            for part in parts:
                note_data(known, part.table, folder)
                store(folder, part)
                if tell is not None:
                    tell(sum(part.counts.values()), part.counts)
        return progress(folder)


def compute_all(chunks: Iterable[Chunk], by: Executor) -> Generator[TrialPart]:
    """Yield the parts of chunks as they are finished.

    A chunk whose process died is computed again in another. If that dies too, or where a chunk is over its time, halves
    are tried down to the single trial that is to blame, which then has the status `died` or `timeout`.

    Parameters
    ----------
    chunks : iterable of Chunk
        What is to be done.
    by : Executor
        Who does it.

    Raises
    ------
    InvalidProblem
        Where the executor is not installed, its scheduler cannot be reached, or no process can be begun.
    """
    work = _Work(chunks, by.limit)
    if not work.left:
        return
    with EXECUTORS[by.name].begin(by) as begun, closing(WorkerPool(1)) as here:
        while work.left:
            try:
                for found in _parallel(work.hand_out(), begun):
                    yield from work.take(found)
            except begun.deaths:
                # A cluster lost a worker again and again: what it had is computed here, and the others there.
                for task in list(work.out.values()):
                    yield from work.take(here.compute(task.chunk, by.limit))


def _parallel(tasks: Iterator[tuple[Chunk, float]], begun: Begun) -> Iterator[TrialPart | Lost]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(**begun.options), catch_warnings():
        # What was computed when a run was stopped is computed again: nobody needs to hear of that.
        filterwarnings("ignore", "[0-9]+ tasks", UserWarning)
        if begun.streams:
            # One chunk a task, two for each worker in hand: none waits for its next, and few are lost when a run stops.
            run = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
            yield from run(delayed(begun.work)(*task) for task in tasks)
            return
        while some := list(islice(tasks, 2 * begun.options["n_jobs"])):
            yield from Parallel(batch_size=1)(delayed(begun.work)(*task) for task in some)


# What is left of the chunks of a run, and what becomes of those that came to grief.

# A cell may cost four limits of time beyond its work, and a death a sixteenth of one: enough to find the one trial of
# ten thousand at which a method hangs (3.1 limits), or four at which it dies; one that always does is left soon.
_PATIENCE, _DEATH = 4.0, 1 / 16
# A part of a chunk has its share of the limit, but not less than an eighth, and time for what is built once.
_LEAST, _BUILD = 1 / 8, 10.0


@dataclass(frozen=True, slots=True)
class _Task:
    """Some trials of a chunk of the design; `again` where its process has died once."""

    chunk: Chunk
    whole: Chunk
    again: bool = False

    @property
    def share(self) -> float:
        return max(self.chunk.count / self.whole.count, _LEAST)


class _Work:
    """The tasks that are left and out, the parts of chunks that were halved, and what each cell has cost."""

    def __init__(self, chunks: Iterable[Chunk], limit: float) -> None:
        self.left = deque(_Task(chunk, chunk) for chunk in chunks)
        self._limit = limit
        self.out: dict[str, _Task] = {}
        self._parts: dict[str, list[TrialPart]] = {}
        self._cost: dict[str, float] = {}
        self._given_up: dict[str, Lost] = {}

    def hand_out(self) -> Iterator[tuple[Chunk, float]]:
        """Yield chunks with the seconds that they may take: none where their cell has cost too much."""
        while self.left:
            task = self.left.popleft()
            self.out[task.chunk.key] = task
            yield task.chunk, self._seconds(task)

    def take(self, found: TrialPart | Lost) -> Iterator[TrialPart]:
        """Yield the part of a chunk of the design where it is complete with what was found."""
        task = self.out.pop(found.key)
        part = self._judge(task, found) if isinstance(found, Lost) else found
        if part is None:
            return
        parts = self._parts.setdefault(task.whole.key, [])
        parts.append(part)
        if sum(len(some.table) for some in parts) == task.whole.count:
            del self._parts[task.whole.key]
            # Names of parts are in the order of their trials.
            yield part if len(parts) == 1 else join_parts(task.whole, sorted(parts, key=lambda some: some.key))

    def _judge(self, task: _Task, lost: Lost) -> TrialPart | None:
        """Return the part of a task that was lost, or None and have it tried again, whole or in halves."""
        chunk, cell = task.chunk, task.chunk.cell.key
        if cell not in self._given_up:
            self._cost[cell] = self._cost.get(cell, 0.0) + (task.share if lost.status == LATE else _DEATH)
            if self._cost[cell] >= _PATIENCE:
                reason = f"given up, since too much of it was lost in this scenario; the last time {lost.reason}"
                self._given_up[cell] = replace(lost, reason=reason)
        if cell in self._given_up:
            return part_of_lost(chunk, self._given_up[cell])
        if lost.status == DIED and not task.again:
            # Perhaps the machine was short of memory, or somebody killed it: halves would be solved in other batches.
            self.left.append(replace(task, again=True))
        elif chunk.count == 1:
            return part_of_lost(chunk, lost)
        else:
            half = chunk.count // 2
            for first, count in ((chunk.first, half), (chunk.first + half, chunk.count - half)):
                self.left.append(_Task(replace(chunk, first=first, count=count), task.whole, again=True))
        return None

    def _seconds(self, task: _Task) -> float:
        if task.chunk.cell.key in self._given_up:
            return 0.0
        return min(self._limit, max(task.share * self._limit, _BUILD))


# The executors: how each begins, and which exceptions say that a worker died.


@dataclass(frozen=True, slots=True)
class Begun:
    """An executor that is ready.

    Parameters
    ----------
    options : dict
        Of joblib.
    work : callable
        ``(chunk, seconds) -> Part or Lost``: what its workers do.
    deaths : tuple of exception types
        Those that say that a worker died.
    streams : bool
        Whether it gives each part when it is finished; otherwise it takes lists, a few chunks a processor at a time.
    """

    options: dict[str, Any]
    work: Callable[[Chunk, float], TrialPart | Lost]
    deaths: tuple[type[BaseException], ...] = ()
    streams: bool = True


@cache
def _pool() -> WorkerPool:
    return WorkerPool(workers())


def beside(names: Sequence[str], chunk: Chunk, seconds: float) -> TrialPart | Lost:
    """Compute a chunk beside a worker of a cluster, with the plugins of the process that runs the study."""
    return _pool().compute(chunk, seconds, names)


@contextmanager
def _processes(by: Executor) -> Iterator[Begun]:
    jobs = by.jobs or workers()
    # Its workers are threads: each waits for a process apart.
    with closing(WorkerPool(jobs)) as pool:
        yield Begun({"backend": "threading", "n_jobs": jobs}, pool.compute)


@contextmanager
def _dask(by: Executor) -> Iterator[Begun]:
    try:
        from distributed import Client, KilledWorker, LocalCluster
    except ImportError:
        raise InvalidProblem("Dask is not installed", "--executor", "pip install 'optloc[dask]'") from None
    with ExitStack() as stack:
        try:
            with _deaf():
                place: Any = by.address
                if place is None:
                    # No page of statistics, and no warnings of workers that are lost on purpose when it ends.
                    own = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
                    place = stack.enter_context(LocalCluster(n_workers=by.jobs or workers(), **own))
                client = stack.enter_context(Client(place, timeout=CONNECT))
                count = sum(client.ncores().values())
        except (OSError, TimeoutError, ValueError) as error:
            raise _unreachable(by, error) from None
        if not count:
            advice = "start one: dask worker ADDRESS --nthreads 1"
            raise InvalidProblem("the scheduler has no workers", by.address or "dask", advice)
        yield Begun({"backend": "dask", "client": client, "n_jobs": -1}, partial(beside, plugins()), (KilledWorker,))


@contextmanager
def _deaf() -> Iterator[None]:
    """Have processes that are begun meanwhile, and what they begin, not hear Ctrl-C, which waits for this one."""
    if not hasattr(signal, "pthread_sigmask"):  # on a system where each is told apart
        yield
        return
    resource_tracker.ensure_running()  # it would unblock what is blocked here
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _ray(by: Executor) -> Iterator[Begun]:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError:
        raise InvalidProblem("Ray is not installed", "--executor", "pip install 'optloc[ray]'") from None
    try:
        ray.init(
            address=by.address,
            num_cpus=(by.jobs or workers()) if by.address is None else None,
            include_dashboard=False if by.address is None else None,
            log_to_driver=False,
            logging_level="error",
        )
    except (OSError, ConnectionError, RuntimeError, ValueError) as error:
        raise _unreachable(by, error) from None
    try:
        register_ray()
        jobs = int(ray.cluster_resources().get("CPU", 1))
        deaths = (ray.exceptions.RayActorError, ray.exceptions.WorkerCrashedError)
        yield Begun({"backend": "ray", "n_jobs": jobs}, partial(beside, plugins()), deaths, streams=False)
    finally:
        ray.shutdown()


def _unreachable(by: Executor, error: BaseException) -> InvalidProblem:
    first = (str(error) or type(error).__name__).splitlines()[0]
    what = f"the scheduler cannot be reached ({first})"
    return InvalidProblem(what, by.address or by.name, "start it, or check the address; what is finished is kept")


@dataclass(frozen=True, slots=True)
class ExecutorEntry:
    """A way to compute.

    Parameters
    ----------
    begin : callable
        ``(Executor) -> context manager`` of what has begun.
    summary : str
        One line for listings.
    scheduler : bool
        Whether it may be one that exists, at an address.
    """

    begin: Callable[[Executor], AbstractContextManager[Begun]]
    summary: str
    scheduler: bool = False


EXECUTORS: dict[str, ExecutorEntry] = {
    "processes": ExecutorEntry(_processes, "processes of this machine; the default"),
    "dask": ExecutorEntry(_dask, "a Dask cluster that exists (--scheduler), or a local one", scheduler=True),
    "ray": ExecutorEntry(_ray, "a Ray cluster that exists (--scheduler), or a local one", scheduler=True),
}
"""Executors by name."""
