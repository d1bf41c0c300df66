"""Running clusters of Dask and Ray, or local ones that end with the program."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import Any

from optloc.base.errors import InvalidProblem

CONNECT = 10.0
"""Seconds to wait for a scheduler: one on the same network replies in less than one second."""

# Settings of Dask for a local cluster, whose tasks take seconds and release their memory themselves.
_LOCAL_CLUSTER = {
    # With a threshold of trimming, glibc returns each array of 128 KiB or more to the system at once. Fixes then take
    # 1.3 times as long, because the system clears the pages of the next array again.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    # The profile looks at a worker 100 times a second. Other looks occur 2 to 50 times a second in each process. All
    # together they took an eighth of the time of fixes.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "1s",
}


@contextmanager
def dask_client(address: str | None, jobs: int) -> Iterator[Any]:
    """Yield a client of a Dask cluster.

    Parameters
    ----------
    address : str, optional
        Address of a scheduler; by default a local cluster is started.
    jobs : int
        Number of processes of a local cluster.

    Raises
    ------
    InvalidProblem
        If Dask is not installed, the scheduler cannot be reached, or it has no workers; also if it ends in the block.
    """
    try:
        from distributed import CancelledError, Client
        from distributed.comm import CommClosedError
    except ImportError:
        raise InvalidProblem("Dask is not installed", "--executor", "pip install 'optloc[dask]'") from None
    with ExitStack() as stack:
        try:
            with _block_ctrl_c():
                place: Any = stack.enter_context(_local_dask(jobs)) if address is None else address
                client = stack.enter_context(Client(place, timeout=CONNECT))
                count = sum(client.ncores().values())
        except (OSError, TimeoutError, ValueError) as error:
            raise _unreachable(address or "dask", error) from None
        if not count:
            advice = "start one: dask worker ADDRESS --nthreads 1"
            raise InvalidProblem("the scheduler has no workers", address or "dask", advice)
        try:
            yield client
        except (CancelledError, CommClosedError):
            advice = "start it again, and run the same command: finished parts are kept"
            raise InvalidProblem("the scheduler has ended", address or "dask", advice) from None


@contextmanager
def _local_dask(jobs: int) -> Iterator[Any]:
    """Yield a Dask cluster of `jobs` processes with one thread each, which ends with the block."""
    import dask
    from distributed import LocalCluster

    # Without a page of statistics, and without warnings about workers that end with the cluster.
    options = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
    preload = [*dask.config.get("distributed.worker.preload", []), "optloc.partitions.worker_start"]
    # The settings stay until the cluster ends: a worker that replaces a lost worker reads them when it starts.
    with dask.config.set(_LOCAL_CLUSTER), LocalCluster(n_workers=jobs, preload=preload, **options) as cluster:
        yield cluster


@contextmanager
def _block_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C in all processes that start inside this context: only this process should receive Ctrl-C."""
    if not hasattr(signal, "pthread_sigmask"):  # a system where Ctrl-C does not reach child processes
        yield
        return
    resource_tracker.ensure_running()  # otherwise it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def ray_cluster(address: str | None, jobs: int) -> Iterator[Any]:
    """Yield the module ray, connected to a Ray cluster; arguments and errors as `dask_client`."""
    try:
        import ray
    except ImportError:
        raise InvalidProblem("Ray is not installed", "--executor", "pip install 'optloc[ray]'") from None
    try:
        ray.init(
            address=address,
            num_cpus=jobs if address is None else None,
            include_dashboard=False if address is None else None,
            log_to_driver=False,
            logging_level="error",
        )
    except (OSError, ConnectionError, RuntimeError, ValueError) as error:
        raise _unreachable(address or "ray", error) from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _unreachable(place: str, error: BaseException) -> InvalidProblem:
    """Return the error for a scheduler that does not reply, with the first line of `error`."""
    first = (str(error) or type(error).__name__).splitlines()[0]
    what = f"the scheduler cannot be reached ({first})"
    return InvalidProblem(what, place, "start it, or check the address; finished parts are kept")
