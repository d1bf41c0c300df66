"""Compilation of thin layers: put into their callers, because every array that is handed on costs time."""

from optloc.kernels.jit import inlined

__all__ = ["inlined"]
