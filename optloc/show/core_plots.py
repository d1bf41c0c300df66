"""Drawing functions of the values of the core, by the name of the class; see `optloc.base.plots`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from optloc.show.pictures.fix_axes import fix_axes, problem_axes
from optloc.show.pictures.track_axes import track_axes

PLOTS: dict[str, Callable[..., Any]] = {"Fix": fix_axes, "Problem": problem_axes, "Track": track_axes}
"""Functions that draw a value in one axes."""
