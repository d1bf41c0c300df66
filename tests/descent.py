"""Levenberg's method as MINPACK has it: the checks of SciPy's newer interface take longer than small descents."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import leastsq

Array = np.ndarray
EXACT = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 300}
"""The same for SciPy's `least_squares`, where there are fewer rows than unknowns."""


class Descent(NamedTuple):
    """Where a descent ended: the point, residuals and derivatives there, and half their squared length."""

    x: Array
    fun: Array
    jac: Array
    cost: float


def levenberg(
    residual: Callable[[Array], Array],
    start: Array,
    jacobian: Callable[[Array], Array] | None = None,
    scale: Array | None = None,
    most: int = 300,
    fine: float = 1e-15,
) -> Descent:
    """Return where a descent from a start ends, to `fine`; all unknowns count alike unless scaled.

    Without derivatives MINPACK takes differences, and those of the end are central ones, a millionth apart.
    """
    start = np.asarray(start, dtype=float)
    diag = np.ones(len(start)) if scale is None else 1.0 / scale
    x, _, told, *_ = leastsq(
        residual, start, (), jacobian, full_output=True, xtol=fine, ftol=fine, gtol=fine, maxfev=most, diag=diag
    )
    jac = jacobian(x) if jacobian is not None else _slope(residual, x)
    return Descent(x, told["fvec"], jac, 0.5 * float(told["fvec"] @ told["fvec"]))


def _slope(residual: Callable[[Array], Array], x: Array) -> Array:
    steps = np.diag(1e-6 * np.maximum(np.abs(x), 1.0))
    return np.stack([(residual(x + s) - residual(x - s)) / (2.0 * s.sum()) for s in steps], axis=-1)
