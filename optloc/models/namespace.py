"""One place that finds the elementary functions for a number: NumPy, CasADi, a Jet or an array-API library."""

from __future__ import annotations

import sys
from typing import Any

from optloc.base.arrays import library


def namespace(value: Any) -> Any:
    """Return the module that offers ``sqrt sin cos atan2 hypot`` for a value.

    Parameters
    ----------
    value : Jet, casadi.SX, casadi.MX, casadi.DM, float or array
        Any operand of a measurement function.

    Returns
    -------
    module
        A namespace with the array-API names of the elementary functions.
    """
    own = getattr(value, "__elementary__", None)
    if own is not None:
        return own()
    if type(value).__module__.startswith("casadi"):
        return sys.modules["casadi"]
    return library(value)
