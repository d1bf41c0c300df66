"""The interface between the steps of the engine and the rows of a problem; `evaluated_by` fills it in.

There are two: `optloc.engine.ranges` for rows that are sums of ranges and nothing else unknown, `optloc.engine.tapes`
for rows of every kind. Each has kernels of these names. Machine code is made for each form, so that nothing is chosen
while it runs.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

from optloc.base.types import Array
from optloc.engine.memory import EngineModel, EngineWorkspace
from optloc.kernels.jit import compiled, specialise

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])


@compiled
def count_unknowns(rows: Any, d: int, size: int) -> int:
    """Return the number of unknowns that are refined together, for d coordinates and parameter vectors of a size."""
    raise NotImplementedError


@compiled
def count_lifted(rows: Any) -> int:
    """Return the number of linear rows of other kinds than ranges in a start."""
    raise NotImplementedError


@compiled
def keep(model: EngineModel, rows: Any, stations: int, d: int, size: int) -> Any:
    """Return the rows with the memory that an evaluator keeps for a block: what the kernels below take."""
    raise NotImplementedError


@compiled
def load(rows: Any, z: Array, room: EngineWorkspace, anew: bool) -> None:
    """Take measurements (N, m) of a block, whose stations are new ones or not."""
    raise NotImplementedError


@compiled
def minimise_start(model: EngineModel, rows: Any, room: EngineWorkspace, first: bool) -> None:
    """Write the minimiser of the weighed squared-range rows to `room.y`, and to SOLVABLE whether it is one."""
    raise NotImplementedError


@compiled
def scout(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Write starts that squared ranges do not give to row X, and second ones to row OTHER, see `EngineModel.start`."""
    raise NotImplementedError


@compiled
def complete(rows: Any, room: EngineWorkspace) -> None:
    """Write the start of the other unknowns, after the position, to row X."""
    raise NotImplementedError


@compiled
def equations(rows: Any, room: EngineWorkspace, shift: int) -> None:
    """Write information (lower half), right side and cost at row X, or at TRIAL with shift 1."""
    raise NotImplementedError


@compiled
def costs(rows: Any, room: EngineWorkspace) -> None:
    """Write to COST_TRIAL the cost at TRIAL, the least over the other unknowns."""
    raise NotImplementedError


@compiled
def bow_of(rows: Any, room: EngineWorkspace) -> float:
    """Return the curvature b of the rows: over a step D at range r all residuals change by up to b D^2 / r more."""
    raise NotImplementedError


@compiled
def note_nearest(rows: Any, room: EngineWorkspace, least: Array) -> None:
    """Write the range to the nearest station (W,) where the equations were written last."""
    raise NotImplementedError


@compiled
def bend(rows: Any, room: EngineWorkspace) -> None:
    """Write half the second derivatives of the cost at row X to H_TRIAL."""
    raise NotImplementedError


@compiled
def measure_infinity(rows: Any, room: EngineWorkspace) -> None:
    """Write to BEYOND what infinity costs, see `optloc.engine.memory.Answer.infinity`."""
    raise NotImplementedError


@compiled
def search_infinity(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Write the same by whatever means; row X and its information stay as they are."""
    raise NotImplementedError


@compiled
def finish(rows: Any, z: Array, room: EngineWorkspace, size: int, mark: Array, marked: bool, x: Array) -> None:
    """Write the unknowns that are not refined of the first lanes, or of those that are marked, to x (N, size)."""
    raise NotImplementedError


_INTERFACE = (
    count_unknowns,
    count_lifted,
    keep,
    load,
    minimise_start,
    scout,
    complete,
    equations,
    costs,
    bow_of,
    note_nearest,
    bend,
    measure_infinity,
    search_infinity,
    finish,
)


def evaluated_by(kernel: _Kernel, rows: ModuleType, mark: str, **constants: Any) -> _Kernel:
    """Return a kernel whose rows are evaluated by the kernels of a module, with other values of some constants.

    Parameters
    ----------
    kernel : callable
        Calls kernels of this module, at whatever depth.
    rows : module
        Has one of each name.
    mark : str
        Distinguishes the names of machine code.
    constants : object
        As of `optloc.kernels.jit.specialise`.
    """
    own = {kernel: getattr(rows, kernel.__name__) for kernel in _INTERFACE}
    return specialise(kernel, mark, own, **constants)
