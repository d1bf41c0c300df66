"""Garbage collection in a worker of a local cluster: it rarely runs while the worker loads modules and machine code."""

import atexit
import gc
from typing import Any


def dask_setup(worker: Any) -> None:
    """Set the garbage collection of this process. Dask calls the function when a worker starts.

    Parameters
    ----------
    worker : distributed.Worker
        The worker, which is not used.
    """
    # Modules and machine code are many objects, which all stay until the end. A collection each 700 new objects, and
    # the collections at the end of a process, take a quarter of the processor time of its start and its end.
    gc.set_threshold(50_000, 20, 20)
    atexit.register(gc.freeze)
