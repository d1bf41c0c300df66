"""Parallel work in threads, for code that releases the interpreter lock (compiled kernels, Clarabel)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from time import perf_counter
from typing import TypeVar

from optloc.base.errors import InvalidProblem

_VARIABLE = "OPTLOC_THREADS"
# Duration of a call, seconds, below which threads gain nothing, because they wait for the interpreter lock.
WORTH = 2.5e-4

# Number of threads that the current thread may use, if the work was already divided among threads.
_SHARE: ContextVar[int | None] = ContextVar("share", default=None)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def thread_count() -> int:
    """Return the number of threads for a batch: the variable OPTLOC_THREADS, or the number of available processors.

    Inside `map_in_order`, whose parts run in parallel, it is the share of the current part.

    Returns
    -------
    int
        At least one.

    Raises
    ------
    InvalidProblem
        If OPTLOC_THREADS is not a whole number of at least one.
    """
    share = _SHARE.get()
    if share is not None:
        return share
    given = os.environ.get(_VARIABLE, "").strip()
    if not given:
        return _processors()
    if not given.isdecimal() or int(given) < 1:
        raise InvalidProblem(f"{given!r} is not a number of threads", _VARIABLE, "give a whole number of at least 1")
    return int(given)


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Use at most `count` threads for batches within the block, instead of all processors."""
    token = _SHARE.set(count)
    try:
        yield
    finally:
        _SHARE.reset(token)


def map_on_threads(
    function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int | None = None, *, least: float = 0.0
) -> list[_Result]:
    """Return the results of a function for all items, in the order of the items for every number of threads.

    Parameters
    ----------
    function : callable
        Function of one item. Several threads call it at the same time, so it must not change shared state.
    items : iterable
        The items. Each should take far longer than the start of an item in a thread (20 us).
    threads : int, optional
        Maximum number of threads; default: `thread_count`. With one, the work runs in the calling thread.
    least : float
        Minimum duration of an item, seconds, for the use of threads. The faster of the first two items is compared. If
        it is shorter, all items run in the calling thread.

    Returns
    -------
    list
        The results. If calls raise, the error of the first such item is raised.
    """
    work = list(items)
    # A single item or thread runs in the calling thread: without a pool, and with simple tracebacks.
    count = min(thread_count() if threads is None else max(threads, 1), len(work))
    if count <= 1:
        return [function(item) for item in work]
    if least > 0.0:
        # Two items, because the first call may build values that the others share. The faster one counts.
        first_results, seconds = _time(function, work[:2])
        other_results = map_on_threads(function, work[2:], 1 if seconds < least else count)
        return first_results + other_results
    results: dict[int, _Result] = {}
    errors: dict[int, BaseException] = {}
    queue = iter(range(len(work)))  # shared by all threads, because one task per item costs 40 us

    def run() -> None:
        """Compute items from the queue until it is empty or an item fails."""
        for i in queue:
            try:
                results[i] = function(work[i])
            except BaseException as error:  # noqa: BLE001  # raised in the calling thread
                errors[i] = error
            if errors:
                return

    # The calling thread works too, so the pool has one thread less.
    with ThreadPoolExecutor(count - 1, thread_name_prefix="optloc") as pool:
        # The context of the caller, such as a chosen back end, also applies in the threads.
        others = [pool.submit(copy_context().run, run) for _ in range(count - 1)]
        run()
        wait(others)
    if errors:
        raise errors[min(errors)]
    return [results[i] for i in range(len(work))]


def map_in_order(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
    """Yield the results of a function for all items in their order, with several running in parallel.

    It is for large parts of a batch. Unlike `map_on_threads` it suits work in which Python takes as long as machine
    code: the Python code of one part runs while the machine code of another runs. The caller can free each result
    before the next one: at most one more result than the number of threads is stored.

    Parameters
    ----------
    function : callable
        Function of one item, as for `map_on_threads`. Its own calls of `thread_count` return its share of the threads.
    items : sequence
        The parts.
    """
    threads = thread_count()
    count = min(threads, len(items))
    if count <= 1:
        yield from map(function, items)
        return

    def run(item: _Item) -> _Result:
        _SHARE.set(threads // count)
        return function(item)

    with ThreadPoolExecutor(count, thread_name_prefix="optloc") as pool:
        waiting: deque[Future[_Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(copy_context().run, run, item))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for each in waiting:
                each.cancel()


def _time(function: Callable[[_Item], _Result], work: list[_Item]) -> tuple[list[_Result], float]:
    """Return the results of a few items, and the duration of the fastest, seconds.

    The fastest counts, because the first item may build shared values.
    """
    results, times = [], []
    for item in work:
        began = perf_counter()
        results.append(function(item))
        times.append(perf_counter() - began)
    return results, min(times)


def _processors() -> int:
    """Return the number of processors that this process may use, by os.process_cpu_count in Python 3.13 and later."""
    process_cpu_count = getattr(os, "process_cpu_count", None)
    if process_cpu_count is not None:
        return process_cpu_count() or 1
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1
