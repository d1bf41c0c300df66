"""Arrays of any library that follows the array-API standard: what its subset leaves to be spelled out.

Index tables are numpy arrays everywhere; numbers may be arrays of numpy, JAX, PyTorch, CuPy or another library, on its
device; what serves all of them writes into no array. `Portable` ones are numpy's, and have the same bits everywhere.
"""

from __future__ import annotations

import math
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


def is_other_library(array: Any) -> bool:
    """Return whether an array belongs to another library than numpy."""
    return library(array) is not np


def as_array_like(numbers: Any, like: Any) -> Any:
    """Return numbers as an array of the library, device and float type of another array.

    Parameters
    ----------
    numbers : array
        Any shape; an array that already belongs to another library than numpy stays as it is.
    like : array
        Says where; for a numpy array the numbers stay as they are.
    """
    xp = library(like)
    if xp is np or is_other_library(numbers):
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
    return as_array_like(np.eye(n), like)


def as_number(mask: Any, like: Any) -> Any:
    """Return a mask as zeros and ones of an array's float type."""
    xp = library(mask)
    return xp.where(mask, as_array_like(np.ones(()), like), as_array_like(np.zeros(()), like))


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


def as_integers(values: Any, name: str) -> Array | None:
    """Return values as an integer array, None for None; refuse what would have to be rounded."""
    if isinstance(values, int | np.ndarray) and np.asarray(values).dtype.kind == "i":
        return np.asarray(values, dtype=np.int64)
    array = numbers(values, name)
    if array is None:
        return None
    # Written so that NaN passes for whole numbers nowhere: NaN differs from its own floor.
    bad = array != np.floor(array)
    if bad.any():
        raise InvalidProblem(f"{array[bad][0]:g} is not a whole number", name, "give indices")
    return array.astype(np.int64)


def as_deviations(values: Any, name: str, kind: str) -> Array | None:
    """Return standard deviations as a float array, None for None; refuse one that is not positive and finite."""
    array = numbers(values, name)
    if array is None:
        return None
    good = (array > 0.0) & (array < np.inf)
    if not good.all():
        place = tuple(np.argwhere(~good)[0])
        row, value = place[-1] if place else 0, array[place]
        raise InvalidProblem(f"{kind} row {row} has {value:g}", name, "give a positive number")
    return array


# Elementary functions and products that have the same bits on every processor.
#
# Addition, multiplication, division and the square root are rounded as IEEE 754 orders. Sines, logarithms and matrix
# products are not: their last bit is that of a library, of the width of the processor's registers, and of the BLAS.
# Here they are written with those four in a fixed order, to within three units in the last place: data that are drawn
# from a seed are then the same data everywhere.

# A number as the sum of two or three: the first has so few digits that small multiples of it are exact.
_HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_LOG_2 = (0.6931471804855391, 7.440617110012397e-11)
# The nearest double, and what it lacks.
_PI = (3.141592653589793, 1.2246467991473532e-16)
# Arc tangents of 0, 1/8, ..., 1, likewise.
_ARC = np.array(
    [
        (0.0, 0.0),
        (0.12435499454676144, -3.1253241424539383e-18),
        (0.24497866312686414, 1.0698755618734451e-17),
        (0.35877067027057225, -2.4623815582638635e-17),
        (0.4636476090008061, 2.2698777452961687e-17),
        (0.5585993153435624, -5.4556305485916264e-18),
        (0.6435011087932844, 1.5834785051444286e-17),
        (0.7188299996216245, -2.1478388444456983e-17),
        (0.7853981633974483, 3.061616997868383e-17),
    ]
)
# Taylor coefficients, as many as a double shows over the interval that is left: |r| < pi/4 of sine and cosine (20!),
# 1/16 of the arc tangent (its 16th power), log(2)/2 of the exponential (14!), 0.172 of the logarithm (its 24th power).
_SIN = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 10))
_COS = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(2, 11))
_ATAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(1, 8))
_EXP = tuple(1.0 / math.factorial(k) for k in range(2, 15))
_LOG = tuple(2.0 / (2 * k + 1) for k in range(1, 12))
# Angles above are left to the library: multiples of the first part of pi/2, which has 33 bits, are exact up to 2^20.
_FAR = 1.6e6


def _polynomial(x: Array, coefficients: tuple[float, ...]) -> Array:
    total = np.full(np.shape(x), coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _sin_cos(angle: Array) -> tuple[Array, Array, Array]:
    """Return sine and cosine of what is left of angles less whole quarter turns, and how many of those, modulo 4."""
    usable = np.abs(angle) < _FAR
    angle = np.where(usable, angle, 0.0)
    turns = np.rint(angle * (2.0 / math.pi))
    left = ((angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    square = left * left
    half = 0.5 * square
    near = 1.0 - half
    # What the difference from one loses by rounding is added again.
    cosine = near + (((1.0 - near) - half) + square * square * _polynomial(square, _COS))
    return left + left * (square * _polynomial(square, _SIN)), cosine, turns.astype(np.int64) % 4


def sin(angle: Array) -> Array:
    """Return sines of angles in radians; beyond 1.6e6 those of the library."""
    sine, cosine, quarter = _sin_cos(angle)
    value = np.where(quarter % 2 == 0, sine, cosine) * np.where(quarter < 2, 1.0, -1.0)
    return np.where(np.abs(angle) < _FAR, value, np.sin(angle))


def cos(angle: Array) -> Array:
    """Return cosines of angles in radians; beyond 1.6e6 those of the library."""
    sine, cosine, quarter = _sin_cos(angle)
    value = np.where(quarter % 2 == 0, cosine, sine) * np.where((quarter == 1) | (quarter == 2), -1.0, 1.0)
    return np.where(np.abs(angle) < _FAR, value, np.cos(angle))


def atan2(y: Array, x: Array) -> Array:
    """Return the angles of vectors (x, y), radians from -pi to pi."""
    rise, run = np.abs(y), np.abs(x)
    large = np.maximum(rise, run)
    with np.errstate(invalid="ignore"):
        # Two infinities are the angle of the diagonal, two zeros that of the axis.
        slope = np.where(np.isinf(rise) & np.isinf(run), 1.0, np.minimum(rise, run) / np.where(large > 0.0, large, 1.0))
    eighth = np.rint(8.0 * np.where(np.isnan(slope), 0.0, slope))
    arc = _ARC[eighth.astype(np.int64)]
    left = (slope - eighth / 8.0) / (1.0 + slope * (eighth / 8.0))
    square = left * left
    angle = arc[..., 0] + (left + (left * (square * _polynomial(square, _ATAN)) + arc[..., 1]))
    angle = np.where(rise > run, 0.5 * _PI[0] - (angle - 0.5 * _PI[1]), angle)
    angle = np.where(np.signbit(x), _PI[0] - (angle - _PI[1]), angle)
    return np.copysign(np.where(np.isnan(x), x, angle), y)


def hypot(x: Array, y: Array) -> Array:
    """Return ``sqrt(x^2 + y^2)`` without overflow."""
    _, exponent = np.frexp(np.maximum(np.abs(x), np.abs(y)))
    u, v = np.ldexp(x, -exponent), np.ldexp(y, -exponent)
    return np.asarray(np.ldexp(np.sqrt(u * u + v * v), exponent))


def log(x: Array) -> Array:
    """Return natural logarithms."""
    usable = (x > 0.0) & np.isfinite(x)
    part, exponent = np.frexp(np.where(usable, x, 1.0))
    low = part < math.sqrt(0.5)
    more, exponent = np.where(low, 2.0 * part, part) - 1.0, exponent - low
    ratio = more / (2.0 + more)
    square, half = ratio * ratio, 0.5 * more * more
    series = square * _polynomial(square, _LOG)
    small = half - (ratio * (half + series) + exponent * _LOG_2[1])
    # Zero, infinity and what has no logarithm are the same in every library.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(usable, exponent * _LOG_2[0] - (small - more), np.log(np.where(usable, 1.0, x)))


def exp(x: Array) -> Array:
    """Return exponentials."""
    # Beyond, doubles overflow, or underflow to zero.
    bounded = np.where(np.isnan(x), 0.0, np.clip(x, -750.0, 710.0))
    times = np.rint(bounded / math.log(2.0))
    left = (bounded - times * _LOG_2[0]) - times * _LOG_2[1]
    value = 1.0 + (left + left * left * _polynomial(left, _EXP))
    return np.where(np.isnan(x), x, np.ldexp(value, times.astype(np.int64)))


def product(vector: Array, matrix: Array) -> Array:
    """Return ``sum_k vector[..., k] * matrix[..., k, :]``, added up from the first to the last.

    Parameters
    ----------
    vector : array (..., r)
        Rows.
    matrix : array (..., r, q)
        Leading axes fit those of the rows.
    """
    if not matrix.shape[-2]:
        return np.zeros((*np.broadcast_shapes(vector.shape[:-1], matrix.shape[:-2]), matrix.shape[-1]))
    total = np.asarray(vector[..., 0, None] * matrix[..., 0, :])
    for k in range(1, matrix.shape[-2]):
        total += vector[..., k, None] * matrix[..., k, :]
    return total


# Arrays that use these functions in whatever code they are handed to.

_OWN: dict[Any, Any] = {np.sin: sin, np.cos: cos, np.arctan2: atan2, np.hypot: hypot, np.log: log, np.exp: exp}


class Portable(np.ndarray):
    """Numbers whose sines, cosines, angles, lengths, logarithms and exponentials are those of this file.

    What is computed with them is such an array again. ``np.asarray(a).view(Portable)`` makes one, ``.view(np.ndarray)``
    ends it.
    """

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        """Return what numpy's function does, or ours of the same name."""
        plain = [_plain(value) for value in inputs]
        own = _OWN.get(ufunc) if method == "__call__" and out is None and not options else None
        if own is not None:
            return np.asarray(own(*(np.asarray(value, dtype=float) for value in plain))).view(Portable)
        if out is not None:
            options["out"] = tuple(_plain(value) for value in out)
        found = getattr(ufunc, method)(*plain, **options)
        if isinstance(found, tuple):
            return tuple(np.asarray(value).view(Portable) for value in found)
        return found if found is None else np.asarray(found).view(Portable)


def _plain(value: Any) -> Any:
    return value.view(np.ndarray) if isinstance(value, Portable) else value


# Equal rows of tables.


def first_rows(*numbers: Array) -> tuple[Array, Array]:
    """Return the first rows (n,) of all groups of rows with equal numbers, and the group of each row (m,).

    Parameters
    ----------
    *numbers : int array (m,)
        Numbers that are not negative, and not more than there are rows.
    """
    code = np.zeros(len(numbers[0]), dtype=np.int64)
    for own in numbers:
        # Codes stay below the square of the number of rows, which 64 bits hold.
        code = np.unique(code * (int(own.max(initial=0)) + 1) + own, return_inverse=True)[1].ravel()
    _, first, inverse = np.unique(code, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return first[order], place[inverse.ravel()]
