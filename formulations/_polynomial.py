"""Polynomials in time: a middle and a half length that keep powers of order one, and the way back."""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def span(when: Array, heard: Mask) -> tuple[Array, Array]:
    """Middle and half length of the times heard, shape (N, 1): powers of what is left are of order one."""
    first = np.min(np.where(heard, when, np.inf), axis=-1, keepdims=True)
    last = np.max(np.where(heard, when, -np.inf), axis=-1, keepdims=True)
    some = last >= first
    half = np.where(some, 0.5 * (last - first), 0.0)
    return np.where(some, 0.5 * (first + last), 0.0), np.where(half > 0.0, half, 1.0)


def uncentred(c: Array, middle: Array, spread: Array) -> Array:
    """Coefficients (N, order + 1, d) in time from those in ``(time - middle) / spread``."""
    out = np.zeros_like(c)
    for j in range(c.shape[1]):
        for i in range(j + 1):
            out[:, i] += c[:, j] * comb(j, i) * (-middle) ** (j - i) / spread**j
    return out
