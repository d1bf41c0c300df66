"""Run a study into its folder: methods in processes apart, on this machine, a Dask cluster or Ray, through joblib.

Whoever executes, a method runs in a process of its own that is watched over (`Apart`): it has a limit of time and of
memory, what it answers is checked there, and it ends with the process that began it, however that ends.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import IO, Any, NoReturn
from warnings import catch_warnings, filterwarnings, warn

from optloc.base.errors import InvalidProblem, nearest
from optloc.study.folder import Progress, begin, finished_parts, known_data, locked, note_data, progress, store
from optloc.study.plan import Chunk, Plan, memory_of, restrain, workers
from optloc.study.trial import DIED, LATE, Lost, Part, compute, join_parts, part_of_lost

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


def run_plan(
    plan: Plan, folder: Path, by: Executor, tell: Tell | None = None, say: Callable[[str], None] = warn
) -> Progress:
    """Compute what is missing of a study, and return how far it is.

    Parameters
    ----------
    plan : Plan
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
        manifest = begin(plan, folder)
        done = finished_parts(folder, manifest, say)
        known = known_data(plan, folder, done)
        if tell is not None and done:
            had = progress(folder)
            tell(had.rows, had.counts)
        left = [chunk for chunk in plan.chunks if chunk.key not in done]
        with closing(compute_all(left, by)) as parts:
            for part in parts:
                note_data(known, part.table, folder)
                store(folder, part)
                if tell is not None:
                    tell(sum(part.counts.values()), part.counts)
        return progress(folder)


def compute_all(chunks: Iterable[Chunk], by: Executor) -> Generator[Part]:
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
    with EXECUTORS[by.name].begin(by) as begun, closing(Pool(1)) as here:
        while work.left:
            try:
                for found in _parallel(work.hand_out(), begun):
                    yield from work.take(found)
            except begun.deaths:
                # A cluster lost a worker again and again: what it had is computed here, and the others there.
                for task in list(work.out.values()):
                    yield from work.take(here.compute(task.chunk, by.limit))


def _parallel(tasks: Iterator[tuple[Chunk, float]], begun: Begun) -> Iterator[Part | Lost]:
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
    """Some trials of a chunk of the plan; `again` where its process has died once."""

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
        self._parts: dict[str, list[Part]] = {}
        self._cost: dict[str, float] = {}
        self._given_up: dict[str, Lost] = {}

    def hand_out(self) -> Iterator[tuple[Chunk, float]]:
        """Yield chunks with the seconds that they may take: none where their cell has cost too much."""
        while self.left:
            task = self.left.popleft()
            self.out[task.chunk.key] = task
            yield task.chunk, self._seconds(task)

    def take(self, found: Part | Lost) -> Iterator[Part]:
        """Yield the part of a chunk of the plan where it is complete with what was found."""
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

    def _judge(self, task: _Task, lost: Lost) -> Part | None:
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


# A process apart, without multiprocessing: that would run the caller's script again, and lets no daemon begin any.

# Seconds: to begin, half of one where a processor is free; without a task, after which it ends, as nobody tells a
# cluster that a study is over; between the end of its pipe and its own, which says how it ended.
_START, _IDLE, _MOMENT = 120.0, 60.0, 0.2
# Workers times threads would be more than the processors, and each thread of BLAS reserves memory.
_ONE = ("OPTLOC", "OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "VECLIB_MAXIMUM", "NUMEXPR_NUM", "NUMBA_NUM")
# From its beginning the system kills its group where the other end of its pipe is closed, or written to. A thread that
# waits for that does so everywhere, but not while machine code holds the interpreter.
_BEGIN = """
import contextlib, os, pickle, select, signal, sys
def die_with(file, on):
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl
        fcntl.fcntl(file, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(file, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(file, fcntl.F_SETFL, os.O_ASYNC if on else 0)
        if on and select.select([file], [], [], 0)[0]:
            os.killpg(os.getpgrp(), signal.SIGKILL)
sys.path[:], run = pickle.load(sys.stdin.buffer) if sys.stdin.buffer.peek() else sys.exit()
die_with(0, True)
pickle.loads(run)(die_with)
"""


class Apart:
    """A process apart that computes chunks, one at a time; what it begins ends with it."""

    def __init__(self) -> None:
        # -P: nothing is imported from the current folder, unless this process does that, too. A session of its own:
        # Ctrl-C is for this process, which ends it.
        self._process = subprocess.Popen(  # noqa: S603  (this interpreter, and a text of this file)
            [sys.executable, "-P", "-c", _BEGIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {f"{name}_THREADS": "1" for name in _ONE},
            start_new_session=True,
        )
        self._ended, self._pipes = Lock(), Lock()

    def lives(self) -> bool:
        """Return whether it can be asked."""
        return self._process.poll() is None

    def ask(self, message: object, seconds: float) -> Any:
        """Return the answer to a message; raise TimeoutError after so many seconds, EOFError where the process ends."""
        answer: SimpleQueue[Any] = SimpleQueue()

        def exchange() -> None:
            # In a thread: pipes have no time limit on every system.
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            found = None
            with self._pipes, suppress(Exception):  # whatever a process that ends leaves in its pipe
                _send(self._process.stdin, message)
                found = pickle.load(self._process.stdout)  # noqa: S301  (of a process of our own)
            answer.put(found)

        Thread(target=exchange, daemon=True).start()
        try:
            found = answer.get(timeout=seconds)
        except Empty:
            self.end()
            raise TimeoutError from None
        if found is None:
            raise EOFError(self.end(_MOMENT))
        return found

    def end(self, seconds: float = 0.0) -> str:
        """End the process, after some seconds, with all that it began, whatever it does, and return how it ended."""
        with self._ended:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
            # Its group lives on where what it began has not ended; some systems have none.
            with suppress(AttributeError, ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            code = self._process.wait()
        # A copy of it that left its group may hold the other ends.
        if self._pipes.acquire(timeout=_MOMENT):
            with suppress(OSError), self._process:
                self._pipes.release()
        how = f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
        return f"its process ended with {how}"


def _send(file: IO[bytes], message: object) -> None:
    pickle.dump(message, file)
    file.flush()


class Pool:
    """Processes apart: begun when they are needed, and others where they died.

    Parameters
    ----------
    count : int
        How many share the machine.
    """

    def __init__(self, count: int) -> None:
        self._memory, self._lock, self._closed = memory_of(count), Lock(), False
        self._all: set[Apart] = set()
        self._idle: list[Apart] = []

    def compute(self, chunk: Chunk, seconds: float) -> Part | Lost:
        """Return the part of a chunk, computed in a process apart, or what came of it in so many seconds.

        Raises
        ------
        InvalidProblem
            Where the method cannot be run at all, or no process can be begun.
        """
        if not seconds:
            return Lost(chunk.key, LATE, "not tried")
        apart = self._take()
        try:
            # Pickled twice: who listens need not import what belongs to the chunk.
            found = apart.ask(pickle.dumps(chunk), seconds)
            if isinstance(found, InvalidProblem):
                raise found
            if isinstance(found, Part) and (found.key, len(found.table)) == (chunk.key, chunk.count):
                return found
            # A process without memory, or one that answers something else, is of no use to others.
            apart.end()
            return found if isinstance(found, Lost) else Lost(chunk.key, DIED, "its process answered something else")
        except TimeoutError:
            return Lost(chunk.key, LATE, f"it took more than {seconds:g} s")
        except EOFError as error:
            return Lost(chunk.key, DIED, str(error))
        finally:
            with self._lock:
                (self._idle.append if apart.lives() else self._all.discard)(apart)

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            self._closed, left = True, list(self._all)
        for apart in left:
            apart.end()

    def _take(self, *, again: bool = True) -> Apart:
        """Return a process that waits, or another."""
        with self._lock:
            while self._idle:
                if (apart := self._idle.pop()).lives():
                    return apart
                self._all.discard(apart)
        try:
            return self._begin()
        except (EOFError, TimeoutError) as error:
            # Once somebody may have killed it; twice, nothing can be computed here.
            if again:
                return self._take(again=False)
            advice = "what it said stands above; check the installation, and the memory that is left"
            raise InvalidProblem(f"no process can be begun ({error})", sys.executable, advice) from None

    def _begin(self) -> Apart:
        with self._lock:
            if self._closed:
                raise InvalidProblem("the run was stopped", "study", "the same command goes on")
            self._all.add(apart := Apart())
        # What runs there is found when the path is that of this process.
        apart.ask(([str(place) for place in sys.path], pickle.dumps(partial(serve, self._memory))), _START)
        return apart


# What runs in the process apart.


def serve(memory: int | None, die_with: Callable[[IO[bytes], bool], None]) -> NoReturn:
    """Compute the chunks that come in at standard input, one by one, and answer at standard output, until it closes."""
    restrain(memory)
    # A method may read and print what it likes. First, lest a pipe's copy takes the place of closed standard error.
    nowhere, own, line = os.open(os.devnull, os.O_RDWR), os.getpid(), SimpleQueue[bytes]()
    tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    for number in range(3):
        os.dup2(nowhere, number)
    Thread(target=_listen, args=(tasks, line, die_with), daemon=True).start()
    found: object = True
    try:
        while True:
            if os.getpid() != own:
                os._exit(0)  # a method forked, and its copy has arrived here, too
            die_with(tasks, False)
            _send(answers, found)
            chunk = pickle.loads(line.get(timeout=_IDLE))  # noqa: S301
            try:
                found = compute(chunk)
            except InvalidProblem as error:
                found = error
            except Exception as error:  # noqa: BLE001  (short of memory, most of all)
                found = Lost(chunk.key, DIED, f"{type(error).__name__}: {error}")
    finally:
        _end()


def _listen(tasks: IO[bytes], line: SimpleQueue[bytes], die_with: Callable[[IO[bytes], bool], None]) -> None:
    """Pass on what comes in; where nothing can come any more, who sent it has ended, and so does this process."""
    try:
        while True:
            message = pickle.load(tasks)  # noqa: S301
            die_with(tasks, True)
            line.put(message)
    finally:
        _end()


def _end() -> NoReturn:
    """End this process and its group, whatever threads it has."""
    if hasattr(os, "killpg"):
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)


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
    work: Callable[[Chunk, float], Part | Lost]
    deaths: tuple[type[BaseException], ...] = ()
    streams: bool = True


@cache
def _pool() -> Pool:
    return Pool(workers())


def beside(chunk: Chunk, seconds: float) -> Part | Lost:
    """Compute a chunk beside a worker of a cluster."""
    return _pool().compute(chunk, seconds)


@contextmanager
def _processes(by: Executor) -> Iterator[Begun]:
    jobs = by.jobs or workers()
    # Its workers are threads: each waits for a process apart.
    with closing(Pool(jobs)) as pool:
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
        yield Begun({"backend": "dask", "client": client, "n_jobs": -1}, beside, (KilledWorker,))


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
        yield Begun({"backend": "ray", "n_jobs": jobs}, beside, deaths, streams=False)
    finally:
        ray.shutdown()


def _unreachable(by: Executor, error: BaseException) -> InvalidProblem:
    first = (str(error) or type(error).__name__).splitlines()[0]
    what = f"the scheduler cannot be reached ({first})"
    return InvalidProblem(what, by.address or by.name, "start it, or check the address; what is finished is kept")


@dataclass(frozen=True, slots=True)
class Entry:
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


EXECUTORS: dict[str, Entry] = {
    "processes": Entry(_processes, "processes of this machine; the default"),
    "dask": Entry(_dask, "a Dask cluster that exists (--scheduler), or a local one", scheduler=True),
    "ray": Entry(_ray, "a Ray cluster that exists (--scheduler), or a local one", scheduler=True),
}
"""Executors by name."""
