"""Arrays of any library that follows the array-API standard: what its subset leaves to be spelled out.

Index tables are numpy arrays everywhere; numbers may be arrays of numpy, JAX, PyTorch, CuPy or another library, on its
device. Nothing here writes into an array.
"""

from __future__ import annotations

import sys
from reprlib import repr as short
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array


def library(array: Any) -> Any:
    """Return the module of an array's library: numpy for numbers and numpy arrays."""
    if isinstance(array, np.ndarray):
        return np
    # PyTorch's arrays do not offer `__array_namespace__`, and its module follows the standard well enough.
    if type(array).__module__ == "torch":
        return sys.modules["torch"]
    own = getattr(array, "__array_namespace__", None)
    return np if own is None else own()


def foreign(array: Any) -> bool:
    """Return whether an array belongs to another library than numpy."""
    return library(array) is not np


def placed(numbers: Any, like: Any) -> Any:
    """Return numbers as an array of the library, device and float type of another array.

    Parameters
    ----------
    numbers : array
        Any shape; an array that already belongs to another library than numpy stays as it is.
    like : array
        Says where; for a numpy array the numbers stay as they are.
    """
    xp = library(like)
    if xp is np or foreign(numbers):
        return numbers
    values = np.array(numbers, dtype=np.float64)  # a copy: some libraries refuse arrays that cannot be written
    if type(like).__module__.startswith("jax"):  # what JAX traces has no device; it places arrays itself
        return xp.asarray(values, dtype=like.dtype)
    return xp.asarray(values, dtype=like.dtype, device=like.device)


def gather(array: Any, index: Array, axis: int = -1) -> Any:
    """Return the entries of an array at an index table along one axis; the table's axes take the place of that axis.

    Parameters
    ----------
    array : array (..., n, ...)
        Of any library.
    index : int array, any shape
        Nonnegative.
    axis : int
        Negative: counts from the end.
    """
    xp = library(array)
    if xp is np:
        return np.take(array, index, axis=axis)
    if xp.__name__ == "torch":
        flat = xp.index_select(array, axis, xp.asarray(index.reshape(-1), device=array.device))
    elif type(array).__module__.startswith("jax"):
        flat = xp.take(array, index.reshape(-1), axis=axis)
    else:
        flat = xp.take(array, xp.asarray(index.reshape(-1), device=array.device), axis=axis)
    # The standard takes along a flat index table only.
    place = array.ndim + axis
    return xp.reshape(flat, (*array.shape[:place], *index.shape, *array.shape[place + 1 :]))


def eye(n: int, like: Any) -> Any:
    """Return the unit matrix (n, n) in the library of an array."""
    return placed(np.eye(n), like)


def as_number(mask: Any, like: Any) -> Any:
    """Return a mask as zeros and ones of an array's float type."""
    xp = library(mask)
    return xp.where(mask, placed(np.ones(()), like), placed(np.zeros(()), like))


# Arguments of any type become arrays of numbers, or a sentence that says which of them cannot.


def numbers(values: Any, name: str) -> Array | None:
    """Return values as a float array, None for None.

    Parameters
    ----------
    values : array_like or None
        Anything.
    name : str
        How the caller calls it.

    Raises
    ------
    InvalidProblem
        Where they are no numbers, or a ragged list.
    """
    if values is None:
        return None
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InvalidProblem(f"{short(values)} is not an array of numbers", name, "give numbers of one shape") from None


def whole(values: Any, name: str) -> Array | None:
    """Return values as an integer array, None for None; refuse what would have to be rounded."""
    array = numbers(values, name)
    if array is None:
        return None
    # Written so that NaN passes for whole numbers nowhere: NaN differs from its own floor.
    bad = array != np.floor(array)
    if bad.any():
        raise InvalidProblem(f"{array[bad][0]:g} is not a whole number", name, "give indices")
    return array.astype(np.int64)


def positive(values: Any, name: str, kind: str) -> Array | None:
    """Return standard deviations as a float array, None for None; refuse one that is not positive and finite."""
    array = numbers(values, name)
    if array is None:
        return None
    bad = np.argwhere(~((array > 0.0) & np.isfinite(array)))
    if len(bad):
        place, value = tuple(bad[0]), array[tuple(bad[0])]
        row = place[-1] if place else 0
        raise InvalidProblem(f"{kind} row {row} has {value:g}", name, "give a positive number")
    return array
