"""Compilation of scalar kernels: numba where it is there, plain Python where it is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _numba() -> Any:
    try:
        import numba
    except ImportError:
        return None
    settings: Any = numba.config
    return None if settings.DISABLE_JIT else numba


def enabled() -> bool:
    """Return whether kernels run as machine code: numba is installed and NUMBA_DISABLE_JIT is not set."""
    return _numba() is not None


def compiled(function: _Function) -> _Function:
    """Return a function of scalars and arrays as machine code that releases the interpreter lock, kept on disk.

    Division by zero gives infinity or NaN, as in numpy; the order of operations is that of the source.
    """
    numba = _numba()
    if numba is None:
        return function
    kernel: _Function = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return kernel
