"""Compilation of scalar kernels: machine code by numba, or the same functions as plain Python."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, update_wrapper
from threading import Lock
from types import FunctionType
from typing import Any, TypeVar, cast

from optloc.base.threads import held_by_forks

_Function = TypeVar("_Function", bound=Callable[..., Any])

# A context variable: one thread may run plainly while others run machine code.
_PLAIN = ContextVar("plain", default=False)
_LOCK = held_by_forks(Lock())


@cache
def _numba() -> Any:
    try:
        import numba
    except ImportError:
        return None
    # numba reads the variable NUMBA_DISABLE_JIT; its kernels would then be plain functions, without its rules of
    # division.
    settings: Any = numba.config
    return None if settings.DISABLE_JIT else numba


def enabled() -> bool:
    """Return whether kernels run as machine code: numba is installed and NUMBA_DISABLE_JIT is not set."""
    return not _PLAIN.get() and _numba() is not None


@contextmanager
def plain() -> Iterator[None]:
    """Run kernels as plain Python: a thousand times slower, but nothing has to be compiled or loaded first."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


# Machine code on disk is found by file and name of a function, and holds that of what it calls. Where a kernel that
# others call is replaced, the callers get names of their own.
_KERNELS: list[_Kernel] = []
_MARKS: list[tuple[Callable[[str], bool], str]] = []


def _marked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function, under a name of its own where its module is marked."""
    marks = [mark for callers, mark in _MARKS if callers(function.__module__)]
    if not marks:
        return function
    assert isinstance(function, FunctionType)
    own = FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__)
    own.__qualname__ = f"{function.__name__}_{marks[-1]}"
    return own


class _Kernel:
    """A function of scalars and arrays in two forms; numba takes it for the compiled one where kernels call it."""

    def __init__(self, function: Callable[..., Any], inline: str) -> None:
        self.function, self.inline, self.ready = _marked(function), inline, False
        self._machine: Any = None
        update_wrapper(self, function)
        _KERNELS.append(self)

    @property
    def machine(self) -> Any:
        """The compiled form; without an entry for C, which nobody calls, it is made a fifth faster."""
        made = self._machine  # by a name of its own: another thread may renew the kernel meanwhile
        if made is None:
            with _LOCK:  # one form for all threads: numba compiles, and looks up types, for each form anew
                made = self._machine
                if made is None:
                    options = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
                    made = self._machine = _numba().njit(**options, inline=self.inline)(self.function)
        return made

    def renew(self) -> None:
        """Forget the compiled form."""
        with _LOCK:
            self.function, self.ready, self._machine = _marked(self.function), False, None

    def __getattr__(self, name: str) -> Any:
        """Return what numba wants to know of a function that a kernel calls."""
        if name not in ("_numba_type_", "targetoptions", "py_func"):
            raise AttributeError(name)
        return getattr(self.machine, name)

    def __call__(self, *args: Any) -> Any:
        if not enabled():
            return self.function(*args)
        self.ready = True
        return self.machine(*args)


def ready(kernel: Callable[..., Any]) -> bool:
    """Return whether machine code of a kernel has been used in this process: the next call need not load it."""
    return bool(getattr(kernel, "ready", False))


def replace(kernel: Callable[..., Any], function: Callable[..., Any]) -> None:
    """Replace the function of a kernel; what calls it must be renewed (`renew`)."""
    assert isinstance(kernel, _Kernel)
    kernel.function = _marked(function)


def renew(callers: Callable[[str], bool], mark: str) -> None:
    """Let all kernels of some modules be compiled anew at their next use, because one that they call was replaced.

    Parameters
    ----------
    callers : callable
        Whether a module (its dotted name) is one of them; asked of modules that are loaded later, too.
    mark : str
        Tells their machine code on disk from what was kept before.
    """
    _MARKS.append((callers, mark))
    for kernel in _KERNELS:
        if callers(kernel.function.__module__):
            kernel.renew()


def compiled(function: _Function) -> _Function:
    """Return a function of scalars and arrays as machine code that releases the interpreter lock, kept on disk.

    Division by zero gives infinity or NaN, as in numpy; the order of operations is that of the source.
    """
    return cast(_Function, _Kernel(function, "never"))


def inlined(function: _Function) -> _Function:
    """Return a function like `compiled`, of which compiled callers take in the source: every array handed on costs."""
    return cast(_Function, _Kernel(function, "always"))


@compiled
def zero() -> int:
    """Return 0 as the start of a count: numba would compile what is handed a constant once more for a variable."""
    return int(0.0)  # not 0, which it takes for a constant again
