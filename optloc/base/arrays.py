"""Arrays of every library that follows the array-API standard, and elementary functions with reproducible bits.

Index tables are always NumPy arrays. Numbers can be arrays of NumPy, JAX, PyTorch, CuPy or another library, on its
device. Code for all libraries never writes into an array, because some libraries do not allow it. The functions `sin`,
`cos`, `atan2`, `hypot`, `log`, `exp` and `product`, and the class `Portable`, give the same bits on every processor.
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
    """Return the array module of an array: NumPy for numbers and NumPy arrays."""
    if isinstance(array, np.ndarray):
        return np
    # PyTorch arrays have no `__array_namespace__`, but the module `torch` follows the standard well enough.
    if type(array).__module__ == "torch":
        return sys.modules["torch"]
    get_module = getattr(array, "__array_namespace__", None)
    return np if get_module is None else get_module()


def is_other_library(array: Any) -> bool:
    """Return whether an array belongs to a library other than NumPy."""
    return library(array) is not np


def as_array_like(numbers: Any, like: Any) -> Any:
    """Return numbers as an array of the library, device and float type of the array `like`.

    Parameters
    ----------
    numbers : array
        An array of any shape. If it already belongs to a library other than NumPy, it is returned unchanged.
    like : array
        The array that determines library, device and type. If it is a NumPy array, `numbers` is returned unchanged.
    """
    xp = library(like)
    if xp is np or is_other_library(numbers):
        return numbers
    values = np.array(numbers, dtype=np.float64)  # a copy, because some libraries refuse read-only arrays
    if type(like).__module__.startswith("jax"):  # traced arrays have no device; JAX places arrays itself
        return xp.asarray(values, dtype=like.dtype)
    return xp.asarray(values, dtype=like.dtype, device=like.device)


def gather(array: Any, index: Array, axis: int = -1) -> Any:
    """Return the entries of an array at an index table along one axis. The axes of the table replace this axis.

    For an array (5, n) and a table (3, 2), the result is (5, 3, 2).

    Parameters
    ----------
    array : array (..., n, ...)
        An array of any library.
    index : int array, any shape
        Indices from 0.
    axis : int
        Negative axis number, counted from the end.
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
    # In the standard, `take` accepts one-dimensional index tables only.
    place = array.ndim + axis
    return xp.reshape(flat, (*array.shape[:place], *index.shape, *array.shape[place + 1 :]))


def eye(n: int, like: Any) -> Any:
    """Return the unit matrix (n, n) in the library of the array `like`."""
    return as_array_like(np.eye(n), like)


def as_number(mask: Any, like: Any) -> Any:
    """Return a mask as zeros and ones, in the library and the float type of the array `like`."""
    xp = library(mask)
    return xp.where(mask, as_array_like(np.ones(()), like), as_array_like(np.zeros(()), like))


# Convert arguments of any type to arrays of numbers, or raise an error that names the argument.


def numbers(values: Any, name: str) -> Array | None:
    """Return values as a float array; None for None.

    Parameters
    ----------
    values : array_like or None
        Any value.
    name : str
        Name of the argument for messages.

    Raises
    ------
    InvalidProblem
        If the values are not numbers, or if the list is ragged.
    """
    if values is None:
        return None
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InvalidProblem(f"{short(values)} is not an array of numbers", name, "give numbers of one shape") from None


def as_integers(values: Any, name: str) -> Array | None:
    """Return values as an integer array, None for None; raise if a value is not a whole number."""
    if isinstance(values, int | np.ndarray) and np.asarray(values).dtype.kind == "i":
        return np.asarray(values, dtype=np.int64)
    array = numbers(values, name)
    if array is None:
        return None
    # This comparison also rejects NaN, because NaN != floor(NaN).
    bad = array != np.floor(array)
    if bad.any():
        raise InvalidProblem(f"{array[bad][0]:g} is not a whole number", name, "give indices")
    return array.astype(np.int64)


def as_deviations(values: Any, name: str, kind: str) -> Array | None:
    """Return standard deviations as a float array, None for None; raise if one is not positive and finite.

    `name` is the argument and `kind` the measurement kind that the message names.
    """
    array = numbers(values, name)
    if array is None:
        return None
    good = (array > 0.0) & (array < np.inf)
    if not good.all():
        place = tuple(np.argwhere(~good)[0])
        row, value = place[-1] if place else 0, array[place]
        raise InvalidProblem(f"{kind} row {row} has {value:g}", name, "give a positive number")
    return array


# Elementary functions and products that give the same bits on every processor.
#
# IEEE 754 defines the rounding of addition, multiplication, division and square root. The last bit of sines, logarithms
# and matrix products depends on the library, on the width of the processor's registers, and on the BLAS. The functions
# here use only the four defined operations in a fixed order. Their error is within three units in the last place, and
# random data from a seed are the same everywhere.

# A number as a sum of two or three parts. The first part has few digits, so small multiples of it are exact.
_HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_LOG_2 = (0.6931471804855391, 7.440617110012397e-11)
# The nearest double, and the remainder.
_PI = (3.141592653589793, 1.2246467991473532e-16)
# Arc tangents of 0, 1/8, ..., 1, as nearest double and remainder.
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
# Taylor coefficients up to double precision on the reduced interval: |r| < pi/4 for sine and cosine (20!), 1/16 for the
# arc tangent (its 16th power), log(2)/2 for the exponential (14!), 0.172 for the logarithm (its 24th power).
_SIN = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 10))
_COS = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(2, 11))
_ATAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(1, 8))
_EXP = tuple(1.0 / math.factorial(k) for k in range(2, 15))
_LOG = tuple(2.0 / (2 * k + 1) for k in range(1, 12))
# Larger angles use NumPy's functions: multiples of the first part of pi/2, which has 33 bits, are exact up to 2^20.
_FAR = 1.6e6


def _polynomial(x: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the values of a polynomial at x (...); the coefficients are in the order of increasing powers."""
    total = np.full(np.shape(x), coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _sin_cos(angle: Array) -> tuple[Array, Array, Array]:
    """Return sine and cosine of angles minus whole quarter turns, and the number of quarter turns modulo 4, each (...).

    `angle` is in radians. Angles beyond `_FAR` count as zero, because the callers replace their results.
    """
    usable = np.abs(angle) < _FAR
    angle = np.where(usable, angle, 0.0)
    turns = np.rint(angle * (2.0 / math.pi))
    rest = ((angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    square = rest * rest
    half = 0.5 * square
    one_minus_half = 1.0 - half
    # Add the rounding error of the subtraction from one.
    cosine = one_minus_half + (((1.0 - one_minus_half) - half) + square * square * _polynomial(square, _COS))
    return rest + rest * (square * _polynomial(square, _SIN)), cosine, turns.astype(np.int64) % 4


def sin(angle: Array) -> Array:
    """Return the sines of angles (...) in radians. Beyond 1.6e6 it uses NumPy's function."""
    sine, cosine, quarter = _sin_cos(angle)
    value = np.where(quarter % 2 == 0, sine, cosine) * np.where(quarter < 2, 1.0, -1.0)
    return np.where(np.abs(angle) < _FAR, value, np.sin(angle))


def cos(angle: Array) -> Array:
    """Return the cosines of angles (...) in radians. Beyond 1.6e6 it uses NumPy's function."""
    sine, cosine, quarter = _sin_cos(angle)
    value = np.where(quarter % 2 == 0, cosine, sine) * np.where((quarter == 1) | (quarter == 2), -1.0, 1.0)
    return np.where(np.abs(angle) < _FAR, value, np.cos(angle))


def atan2(y: Array, x: Array) -> Array:
    """Return the angles (...) of vectors (x, y), radians from -pi to pi."""
    rise, run = np.abs(y), np.abs(x)
    large = np.maximum(rise, run)
    with np.errstate(invalid="ignore"):
        # Two infinite components give the angle of the diagonal, two zeros the angle of the axis.
        slope = np.where(np.isinf(rise) & np.isinf(run), 1.0, np.minimum(rise, run) / np.where(large > 0.0, large, 1.0))
    # arctan(s) = arctan(e) + arctan((s - e) / (1 + s e)), where e is the eighth nearest to s. Reflections at the
    # diagonal, the second axis and the first axis then give the angle of the vector.
    eighth = np.rint(8.0 * np.where(np.isnan(slope), 0.0, slope))
    arc = _ARC[eighth.astype(np.int64)]
    rest = (slope - eighth / 8.0) / (1.0 + slope * (eighth / 8.0))
    square = rest * rest
    angle = arc[..., 0] + (rest + (rest * (square * _polynomial(square, _ATAN)) + arc[..., 1]))
    angle = np.where(rise > run, 0.5 * _PI[0] - (angle - 0.5 * _PI[1]), angle)
    angle = np.where(np.signbit(x), _PI[0] - (angle - _PI[1]), angle)
    return np.copysign(np.where(np.isnan(x), x, angle), y)


def hypot(x: Array, y: Array) -> Array:
    """Return ``sqrt(x^2 + y^2)`` without overflow."""
    # A division by a power of two is exact, and the squares of the quotients do not overflow.
    _, exponent = np.frexp(np.maximum(np.abs(x), np.abs(y)))
    u, v = np.ldexp(x, -exponent), np.ldexp(y, -exponent)
    return np.asarray(np.ldexp(np.sqrt(u * u + v * v), exponent))


def log(x: Array) -> Array:
    """Return the natural logarithms of x."""
    usable = (x > 0.0) & np.isfinite(x)
    mantissa, exponent = np.frexp(np.where(usable, x, 1.0))
    # x = (1 + excess) 2^exponent, with 1 + excess between sqrt(1/2) and sqrt(2).
    is_low = mantissa < math.sqrt(0.5)
    excess, exponent = np.where(is_low, 2.0 * mantissa, mantissa) - 1.0, exponent - is_low
    ratio = excess / (2.0 + excess)
    square, half = ratio * ratio, 0.5 * excess * excess
    series = square * _polynomial(square, _LOG)
    small = half - (ratio * (half + series) + exponent * _LOG_2[1])
    # Results for zero, infinity and invalid values are the same in every library.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(usable, exponent * _LOG_2[0] - (small - excess), np.log(np.where(usable, 1.0, x)))


def exp(x: Array) -> Array:
    """Return the exponentials of x."""
    # Outside these limits doubles overflow, or underflow to zero.
    bounded = np.where(np.isnan(x), 0.0, np.clip(x, -750.0, 710.0))
    power = np.rint(bounded / math.log(2.0))
    rest = (bounded - power * _LOG_2[0]) - power * _LOG_2[1]
    value = 1.0 + (rest + rest * rest * _polynomial(rest, _EXP))
    return np.where(np.isnan(x), x, np.ldexp(value, power.astype(np.int64)))


def product(vector: Array, matrix: Array) -> Array:
    """Return ``sum_k vector[..., k] * matrix[..., k, :]``, an array (..., q), summed in the order of k.

    The fixed order gives the same bits on every processor, unlike the matrix product of NumPy.

    Parameters
    ----------
    vector : array (..., r)
        Vectors of length r.
    matrix : array (..., r, q)
        Matrices. The leading axes of vectors and matrices broadcast.
    """
    if not matrix.shape[-2]:
        return np.zeros((*np.broadcast_shapes(vector.shape[:-1], matrix.shape[:-2]), matrix.shape[-1]))
    total = np.asarray(vector[..., 0, None] * matrix[..., 0, :])
    for k in range(1, matrix.shape[-2]):
        total += vector[..., k, None] * matrix[..., k, :]
    return total


# Arrays for which NumPy calls use the functions above, in any code that receives them.

_FUNCTIONS: dict[Any, Any] = {np.sin: sin, np.cos: cos, np.arctan2: atan2, np.hypot: hypot, np.log: log, np.exp: exp}


class Portable(np.ndarray):
    """Numbers for which NumPy's sin, cos, arctan2, hypot, log and exp use the functions of this module.

    Results of computations with them are of this class too. ``np.asarray(a).view(Portable)`` makes such an array, and
    ``.view(np.ndarray)`` converts it back.
    """

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        """Return the result of `ufunc`, computed by the function of this module if there is one, else by NumPy.

        NumPy calls this method for every function with an argument of this class. Results have this class too.
        """
        plain = [_plain(value) for value in inputs]
        function = _FUNCTIONS.get(ufunc) if method == "__call__" and out is None and not options else None
        if function is not None:
            return np.asarray(function(*(np.asarray(value, dtype=float) for value in plain))).view(Portable)
        if out is not None:
            options["out"] = tuple(_plain(value) for value in out)
        result = getattr(ufunc, method)(*plain, **options)
        if isinstance(result, tuple):
            return tuple(np.asarray(value).view(Portable) for value in result)
        return result if result is None else np.asarray(result).view(Portable)


def _plain(value: Any) -> Any:
    """Return the value as a plain NumPy array if it is a `Portable`, otherwise unchanged."""
    return value.view(np.ndarray) if isinstance(value, Portable) else value


# Find equal rows of tables.


def first_rows(*numbers: Array) -> tuple[Array, Array]:
    """Return the index of the first row (n,) of each group of equal rows, and the group of each row (m,).

    Groups are numbered in the order of their first rows. m is the number of rows, and n the number of groups.

    Parameters
    ----------
    *numbers : int array (m,)
        Columns of the table: integers from 0 to the number of rows.
    """
    code = np.zeros(len(numbers[0]), dtype=np.int64)
    for column in numbers:
        # Codes stay below the square of the number of rows, which fits into 64 bits.
        code = np.unique(code * (int(column.max(initial=0)) + 1) + column, return_inverse=True)[1].ravel()
    _, first, inverse = np.unique(code, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return first[order], number[inverse.ravel()]
