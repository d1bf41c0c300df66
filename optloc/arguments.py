"""Arguments of any type become arrays of numbers, or a sentence that says which of them cannot."""

from __future__ import annotations

from reprlib import repr as short
from typing import Any

import numpy as np

from optloc.errors import InvalidProblem
from optloc.types import Array


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
