"""Where chunks are computed: in this process, in local ones, on a Dask cluster or on Ray, through one joblib seam."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Self

from optloc.base.errors import InvalidProblem, nearest
from optloc.study.chunk import Part, compute, failure, part_of, spread
from optloc.study.draws import draw
from optloc.study.plan import Chunk, workers
from optloc.study.score import exact_of, truth_values

CONNECT = 10.0
"""Seconds to wait for a scheduler."""


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
    if address is not None and name not in ("dask", "ray"):
        raise InvalidProblem(f"{name} has no scheduler", "--scheduler", "add --executor dask")
    return Executor(name, jobs, address)


def computed(chunks: Iterable[Chunk], by: Executor) -> Generator[Part]:
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
        options, deaths = stack.enter_context(EXECUTORS[by.name].begin(by))
        alone = stack.enter_context(_Alone())
        while left:
            begun: dict[str, Chunk] = {}
            try:
                for part in _parallel(_noted(list(left.values()), begun), options):
                    begun.pop(part.key, None)
                    del left[part.key]
                    yield part
            except deaths:
                for key in begun:
                    yield alone.part(left.pop(key))


def task(chunk: Chunk) -> Part:
    """Compute a chunk in a worker, which is one of several on its machine: on one thread."""
    os.environ.setdefault("OPTLOC_THREADS", "1")
    return compute(chunk)


def _noted(chunks: list[Chunk], begun: dict[str, Chunk]) -> Iterator[Chunk]:
    """Yield chunks, and note which have been handed out."""
    for chunk in chunks:
        begun[chunk.key] = chunk
        yield chunk


def _parallel(chunks: Iterator[Chunk], options: dict[str, Any]) -> Iterator[Part]:
    from joblib import Parallel, delayed, parallel_config

    work = compute if options["backend"] == "sequential" else task
    with parallel_config(**options):
        if options["backend"] != "ray":
            run = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
            yield from run(delayed(work)(chunk) for chunk in chunks)
            return
        # Ray's backend hands over lists only: a few chunks a processor at a time.
        while some := list(islice(chunks, 2 * options["n_jobs"])):
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
            self._pool = ProcessPoolExecutor(max_workers=1)
        try:
            found: Part = self._pool.submit(task, chunk).result()
        except BrokenProcessPool:
            self._close()
            if chunk.count == 1:
                return dead(chunk, "the process that solved it died, and died again")
            half = chunk.count // 2
            halves = (replace(chunk, count=half), replace(chunk, first=chunk.first + half, count=chunk.count - half))
            return merged(chunk, [self.part(some) for some in halves])
        return found


def dead(chunk: Chunk, reason: str) -> Part:
    """Return the part of a chunk whose trials have the status `died`."""
    drawn = draw(chunk.cell.case, chunk.first, chunk.count)
    values = {name: spread(value, chunk.count) for name, value in failure(reason).items()}
    return part_of(chunk, values | truth_values(chunk.cell.case, exact_of(drawn)), drawn.seed, 0.0)


def merged(chunk: Chunk, parts: list[Part]) -> Part:
    """Return the parts of a chunk's pieces as one."""
    import pyarrow as pa

    table = pa.concat_tables([part.table for part in parts]).unify_dictionaries().combine_chunks()
    name = table.schema.get_field_index("chunk")
    key = pa.array([chunk.key] * len(table)).dictionary_encode()
    counts: dict[str, int] = {}
    for part in parts:
        for status, count in part.counts.items():
            counts[status] = counts.get(status, 0) + count
    return Part(chunk.key, table.set_column(name, table.schema.field(name), key), counts)


Begun = tuple[dict[str, Any], tuple[type[BaseException], ...]]
"""Options of joblib, and the exceptions that say that a worker died."""


@contextmanager
def _here(by: Executor) -> Iterator[Begun]:
    yield {"backend": "sequential", "n_jobs": 1}, ()


@contextmanager
def _processes(by: Executor) -> Iterator[Begun]:
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    try:
        yield {"backend": "loky", "n_jobs": by.jobs or workers(), "inner_max_num_threads": 1}, (BrokenProcessPool,)
    finally:
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
                cluster = LocalCluster(
                    n_workers=by.jobs or workers(), threads_per_worker=1, dashboard_address=None, silence_logs=50
                )
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
        yield {"backend": "dask", "client": client, "n_jobs": -1}, (KilledWorker,)


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
        yield {"backend": "ray", "n_jobs": jobs}, (ray.exceptions.RayActorError, ray.exceptions.WorkerCrashedError)
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
        ``(Executor) -> context manager`` of joblib's options and the exceptions of a dead worker.
    summary : str
        One line for listings.
    """

    begin: Callable[[Executor], AbstractContextManager[Begun]]
    summary: str


EXECUTORS: dict[str, Entry] = {
    "in-process": Entry(_here, "one after the other, without a process of their own"),
    "processes": Entry(_processes, "processes of this machine (loky); the default"),
    "dask": Entry(_dask, "a Dask cluster that exists (--scheduler), or a local one"),
    "ray": Entry(_ray, "a Ray cluster that exists (--scheduler), or a local one"),
}
"""Executors by name."""
