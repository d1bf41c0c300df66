"""Compilation of thin layers: put into their callers, because every array that is handed on costs time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from optloc.kernels.jit import enabled

_Function = TypeVar("_Function", bound=Callable[..., Any])


def inlined(function: _Function) -> _Function:
    """Return a function that compiled callers take in as source; otherwise as `optloc.kernels.jit.compiled`."""
    if not enabled():
        return function
    import numba

    kernel: _Function = numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function)
    return kernel
