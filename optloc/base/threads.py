"""Work spread over plain threads: for code that releases the interpreter lock (compiled kernels, Clarabel)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from threading import Lock as LockType
from time import perf_counter
from typing import TypeVar

from optloc.base.errors import InvalidProblem

_VARIABLE = "OPTLOC_THREADS"
# Seconds of a call below which threads that pass the interpreter lock to and fro gain nothing.
WORTH = 2.5e-4

# How many threads what runs in a thread may use itself, where the work was shared out before.
_SHARE: ContextVar[int | None] = ContextVar("share", default=None)

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def thread_count() -> int:
    """Return how many threads a batch may use: the variable OPTLOC_THREADS, else the processors of this process.

    Within a part of a batch whose parts are worked on side by side (`flow`) it is the share of that part.

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
        raise InvalidProblem(f"{given!r} is no number of threads", _VARIABLE, "give a whole number of at least 1")
    return int(given)


def held_by_forks(lock: LockType, begin: Callable[[], None] = lambda: None) -> LockType:
    """Return a lock that nobody else holds while the process forks, so that the child finds it open.

    Parameters
    ----------
    lock : threading.Lock
        A lock that lives as long as the process.
    begin : callable
        What is done first in the child.
    """

    def child() -> None:
        lock.release()
        begin()

    if hasattr(os, "register_at_fork"):  # not where processes do not fork
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=child)
    return lock


def map_on_threads(
    function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int | None = None, *, least: float = 0.0
) -> list[_Result]:
    """Return the function of every item, in the order of the items whatever the number of threads.

    Parameters
    ----------
    function : callable
        Called once for each item, from several threads at a time; state that it changes must be its thread's own.
    items : iterable
        The work; each item should take far longer than a thread takes to pick it up (20 us).
    threads : int, optional
        At most so many at a time; `thread_count` if absent. One runs in the calling thread.
    least : float
        Seconds that an item must take to be worth a thread, by the quicker of the first two; all run in the calling
        thread where it takes less.

    Returns
    -------
    list
        The results. If a call raises, the error of the earliest such item is raised.
    """
    work = list(items)
    # A single item, or a single thread, runs where it is called: no pool, plain tracebacks.
    count = min(thread_count() if threads is None else max(threads, 1), len(work))
    if count <= 1:
        return [function(item) for item in work]
    if least > 0.0:
        # Two, because the first call may build what the others share; the quicker one tells.
        begun, seconds = _time(function, work[:2])
        some = map_on_threads(function, work[2:], 1 if seconds < least else count)
        return begun + some
    results: dict[int, _Result] = {}
    errors: dict[int, BaseException] = {}
    queue = iter(range(len(work)))  # drawn from by all threads: a task of its own for each item costs 40 us

    def run() -> None:
        for i in queue:
            try:
                results[i] = function(work[i])
            except BaseException as error:  # noqa: BLE001  # raised in the calling thread
                errors[i] = error
            if errors:
                return

    # The calling thread is one of them: no processor has two to serve, and one less is begun.
    with ThreadPoolExecutor(count - 1, thread_name_prefix="optloc") as pool:
        # What holds for the caller, such as a chosen back end, holds for its threads.
        others = [pool.submit(copy_context().run, run) for _ in range(count - 1)]
        run()
        wait(others)
    if errors:
        raise errors[min(errors)]
    return [results[i] for i in range(len(work))]


def map_in_order(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
    """Yield the function of every item in their order, several worked on side by side: for large parts of a batch.

    Unlike `mapped` it serves work whose Python takes as long as its machine code, since one part's is done while the
    other's runs; and what is yielded may be forgotten: one part more is held than there are threads, at most.

    Parameters
    ----------
    function : callable
        As of `mapped`; the threads that it asks for itself are its share of all.
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
    """Return the results of a few items, and the time of the quickest: the first may build what others share."""
    results, times = [], []
    for item in work:
        began = perf_counter()
        results.append(function(item))
        times.append(perf_counter() - began)
    return results, min(times)


def _processors() -> int:
    """Return the processors this process may use; os.process_cpu_count where Python has it (3.13)."""
    own = getattr(os, "process_cpu_count", None)
    if own is not None:
        return own() or 1
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1
