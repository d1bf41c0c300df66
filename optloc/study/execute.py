"""Run a study into its folder: here, in local processes, on a Dask cluster or on Ray, through one joblib seam."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

from optloc.base.errors import InvalidProblem, nearest
from optloc.study.folder import Progress, begin, finished_chunks, known_data, locked, note_data, progress, store
from optloc.study.plan import Chunk, Plan, workers
from optloc.study.trial import Part, compute, dead_part, join_parts

CONNECT = 10.0
"""Seconds to wait for a scheduler: one on the same network answers in less than one; people wait for no more."""

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
    """

    name: str = "processes"
    jobs: int | None = None
    address: str | None = None


def executor(name: str, jobs: int | None = None, address: str | None = None) -> Executor:
    """Return an executor; raise InvalidProblem for an unknown one, or an address that it does not take."""
    if name not in EXECUTORS:
        raise InvalidProblem(f"unknown executor {name!r}", "--executor", nearest(name, list(EXECUTORS)))
    if address is not None and not EXECUTORS[name].scheduler:
        raise InvalidProblem(f"{name} has no scheduler", "--scheduler", "add --executor dask")
    return Executor(name, jobs, address)


def run_plan(plan: Plan, folder: Path, by: Executor, tell: Tell | None = None) -> Progress:
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

    Raises
    ------
    InvalidProblem
        Where the folder belongs to another study, holds other data or cannot be written; finished parts are kept.
    """
    manifest = begin(plan, folder)
    # From here to the end nobody else writes: what is counted as finished stays so.
    with locked(folder):
        done = finished_chunks(folder, manifest)
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

    A chunk whose worker died is computed again in a process of its own. If that dies too, halves are tried down to
    the single trial that is to blame, which then has the status `died`.

    Parameters
    ----------
    chunks : iterable of Chunk
        What is to be done.
    by : Executor
        Who does it.

    Raises
    ------
    InvalidProblem
        Where the executor is not installed or its scheduler cannot be reached.
    """
    left = {chunk.key: chunk for chunk in chunks}
    if not left:
        return
    with ExitStack() as stack:
        begun = stack.enter_context(EXECUTORS[by.name].begin(by))
        alone = stack.enter_context(_Alone())
        while left:
            out: dict[str, Chunk] = {}
            try:
                for part in _parallel(_note(list(left.values()), out), begun):
                    out.pop(part.key, None)
                    del left[part.key]
                    yield part
            except begun.deaths:
                # Which of those handed out was to blame is not told: each is tried apart, where nothing else can die.
                for key in out:
                    yield alone.part(left.pop(key))


def task(chunk: Chunk) -> Part:
    """Compute a chunk in a worker, which is one of several on its machine: on one thread."""
    # Workers times threads would be more than the processors, and slower than either.
    os.environ.setdefault("OPTLOC_THREADS", "1")
    return compute(chunk)


def _note(chunks: list[Chunk], out: dict[str, Chunk]) -> Iterator[Chunk]:
    """Yield chunks, and note which have been handed out."""
    for chunk in chunks:
        out[chunk.key] = chunk
        yield chunk


def _parallel(chunks: Iterator[Chunk], begun: Begun) -> Iterator[Part]:
    from joblib import Parallel, delayed, parallel_config

    work = task if begun.apart else compute
    with parallel_config(**begun.options):
        if begun.streams:
            # One chunk a task, two for each worker in hand: none waits for its next, and few are lost when a run stops.
            run = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
            yield from run(delayed(work)(chunk) for chunk in chunks)
            return
        while some := list(islice(chunks, 2 * begun.options["n_jobs"])):
            yield from Parallel(batch_size=1)(delayed(work)(chunk) for chunk in some)


class _Alone:
    """One process apart, begun when it is needed and again when it has died."""

    def __init__(self) -> None:
        self._pool: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=True)
            self._pool = None

    def part(self, chunk: Chunk) -> Part:
        """Return the part of a chunk; trials that take the process down have the status `died`."""
        from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

        if self._pool is None:
            # Local even where a cluster computes: another worker of it is not put at risk.
            self._pool = ProcessPoolExecutor(max_workers=1)
        try:
            found: Part = self._pool.submit(task, chunk).result()
        except BrokenProcessPool:
            self._close()
            if chunk.count == 1:
                return dead_part(chunk, "the process that solved it died, and died again")
            # Every round costs one process; of 10 000 trials the one to blame is found in 14.
            half = chunk.count // 2
            halves = (replace(chunk, count=half), replace(chunk, first=chunk.first + half, count=chunk.count - half))
            return join_parts(chunk, [self.part(some) for some in halves])
        return found


# The executors: how each begins, and which exceptions say that a worker died.


@dataclass(frozen=True, slots=True)
class Begun:
    """An executor that is ready.

    Parameters
    ----------
    options : dict
        Of joblib.
    deaths : tuple of exception types
        Those that say that a worker died.
    apart : bool
        Whether chunks are computed in workers.
    streams : bool
        Whether it gives each part when it is finished; otherwise it takes lists, a few chunks a processor at a time.
    """

    options: dict[str, Any]
    deaths: tuple[type[BaseException], ...] = ()
    apart: bool = True
    streams: bool = True


@contextmanager
def _here(by: Executor) -> Iterator[Begun]:
    yield Begun({"backend": "sequential", "n_jobs": 1}, apart=False)


@contextmanager
def _processes(by: Executor) -> Iterator[Begun]:
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    try:
        options = {"backend": "loky", "n_jobs": by.jobs or workers(), "inner_max_num_threads": 1}
        yield Begun(options, (BrokenProcessPool,))
    finally:
        # Loky keeps its workers for the next call; a study is the last, and Ctrl-C must not leave them behind.
        get_reusable_executor().shutdown(wait=True, kill_workers=True)


@contextmanager
def _dask(by: Executor) -> Iterator[Begun]:
    try:
        from distributed import Client, KilledWorker, LocalCluster
    except ImportError:
        raise InvalidProblem("Dask is not installed", "--executor", "pip install 'optloc[dask]'") from None
    with ExitStack() as stack:
        try:
            if by.address is None:
                # No page of statistics, and no warnings of workers that are lost on purpose when it ends.
                own = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
                cluster = LocalCluster(n_workers=by.jobs or workers(), **own)
                client = Client(stack.enter_context(cluster), timeout=CONNECT)
            else:
                client = Client(by.address, timeout=CONNECT)
            stack.enter_context(client)
            count = sum(client.ncores().values())
        except (OSError, TimeoutError, ValueError) as error:
            raise _unreachable(by, error) from None
        if not count:
            raise InvalidProblem(
                "the scheduler has no workers", by.address or "dask", "start one: dask worker ADDRESS --nthreads 1"
            )
        yield Begun({"backend": "dask", "client": client, "n_jobs": -1}, (KilledWorker,))


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
        yield Begun({"backend": "ray", "n_jobs": jobs}, deaths, streams=False)
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
    "in-process": Entry(_here, "one after the other, without a process of their own"),
    "processes": Entry(_processes, "processes of this machine (loky); the default"),
    "dask": Entry(_dask, "a Dask cluster that exists (--scheduler), or a local one", scheduler=True),
    "ray": Entry(_ray, "a Ray cluster that exists (--scheduler), or a local one", scheduler=True),
}
"""Executors by name."""
