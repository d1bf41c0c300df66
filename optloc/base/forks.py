"""Locks and imports of threads when the process forks: a forked child has no other threads to wait for."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from threading import Lock as LockType
from time import monotonic


def held_by_forks(lock: LockType, begin: Callable[[], None] = lambda: None) -> LockType:
    """Register a lock so that it is free in a forked child, and return it. A fork first acquires the lock.

    Without it, a child that forks while another thread holds the lock could wait without end.

    Parameters
    ----------
    lock : threading.Lock
        A lock that lives as long as the process.
    begin : callable
        Function that the child calls first.
    """
    _HELD.append((lock, begin))
    return lock


# Locks that a fork acquires, and the functions that the child calls first.
_HELD: list[tuple[LockType, Callable[[], None]]] = []
# The locks of the fork that runs now, in the order of their acquisition.
_ACQUIRED: list[tuple[LockType, Callable[[], None]]] = []

# Packages that solving threads import at their first use.
_IMPORTED = frozenset(
    "optloc formulations numpy scipy cvxpy clarabel casadi numba llvmlite pydantic pymap3d pandas pyarrow".split()
)
# Seconds that a fork waits for imports: numba takes two seconds on a slow machine.
_IMPORTS = 30.0


def _finish_imports() -> None:
    """Wait until other threads have imported the packages that solving needs.

    A forked child has no such thread, but it has the lock of the module that the thread imports. Without the wait, the
    child would wait without end when it imports the module.
    """
    end = monotonic() + _IMPORTS
    while monotonic() < end:
        begun = [
            name
            for name, module in tuple(sys.modules.items())
            if name.partition(".")[0] in _IMPORTED
            and getattr(getattr(module, "__spec__", None), "_initializing", False)
        ]
        if not begun:
            return
        with suppress(Exception):  # the thread that imports the module gets its error
            import_module(begun[-1])


def _before_fork() -> None:
    """Acquire all locks, the latest first, because locks of higher layers are registered later."""
    _finish_imports()
    # A copy, because threads may register more locks meanwhile.
    for held in reversed(tuple(_HELD)):
        held[0].acquire()
        _ACQUIRED.append(held)


def _after_fork() -> None:
    """Release all locks that the fork acquired."""
    while _ACQUIRED:
        _ACQUIRED.pop()[0].release()


def _begin_child() -> None:
    """Release all locks in a forked child, and repair the values that they protect."""
    held = tuple(_ACQUIRED)
    _after_fork()
    for _, begin in held:
        begin()


if hasattr(os, "register_at_fork"):  # not where processes do not fork
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_begin_child)
