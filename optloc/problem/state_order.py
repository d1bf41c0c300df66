"""Orders of state components: optloc uses [p, v, a], other programs for instance "x vx y vy"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array

_DERIVATIVES = ("", "v", "a")


def components(dimension: int, size: int) -> list[str]:
    """Return the names of the components of a state in the order of optloc, such as x, y, vx, vy.

    Parameters
    ----------
    dimension : int
        2 or 3.
    size : int
        Length of the state: dimension times one, two or three.
    """
    return [f"{kind}{axis}" for kind in _DERIVATIVES for axis in "xyz"[:dimension]][:size]


def in_order(order: str | Sequence[str], dimension: int, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Return states and covariances with the named components in the given order.

    Parameters
    ----------
    order : str or sequence of str
        Names of components, such as "x vx y vy". Other components are omitted.
    dimension : int
        2 or 3.
    mean : array (..., n)
        States [p, v, a].
    cov : array (..., n, n)
        Covariances of the states.

    Returns
    -------
    tuple of array (..., m) and array (..., m, m)
        The m named components.

    Raises
    ------
    InvalidProblem
        For a name that the state does not have, or that occurs twice.
    """
    known = components(dimension, mean.shape[-1])
    wanted = order.replace(",", " ").split() if isinstance(order, str) else list(order)
    unknown = [name for name in wanted if name not in known]
    if unknown or len(set(wanted)) < len(wanted) or not wanted:
        problem = f"the state has no {unknown[0]!r}" if unknown else f"{order!r} is not an order of components"
        raise InvalidProblem(problem, "order", f"name some of {' '.join(known)}, each once")
    index = np.array([known.index(name) for name in wanted])
    return mean[..., index], cov[..., index[:, None], index]
