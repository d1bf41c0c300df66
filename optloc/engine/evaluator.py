"""The interface between the steps of the engine and the rows of a problem.

Each function of this module is a placeholder for a kernel of the same name in a module of rows, an *evaluator*:
`optloc.engine.ranges` for rows that are sums of ranges without other unknowns, `optloc.engine.tapes` for rows of every
kind. `evaluated_by` replaces the placeholders and compiles a kernel for one evaluator, so that the choice costs no time
while the machine code runs.

A block has W problems, one in each lane. `rows` are the rows of the evaluator; the function `keep` adds their memory.
`room` is the workspace of the block; names in capitals, such as X or SOLVABLE, are rows of its arrays, see
`optloc.engine.memory.EngineWorkspace`.
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
    """Return the number of unknowns that are refined together.

    `d` is the number of coordinates, `size` the length of a parameter vector.
    """
    raise NotImplementedError


@compiled
def count_lifted(rows: Any) -> int:
    """Return the number of linear rows of other kinds than ranges in a start."""
    raise NotImplementedError


@compiled
def keep(model: EngineModel, rows: Any, stations: int, d: int, size: int) -> Any:
    """Return the rows together with the memory that the evaluator needs for a block of problems.

    `stations` and `d` are the numbers of stations and coordinates, `size` is the length of a parameter vector.
    """
    raise NotImplementedError


@compiled
def load(rows: Any, z: Array, room: EngineWorkspace, anew: bool) -> None:
    """Load the measurements z (N, m) of a block; `anew` is True if the positions of its stations have changed.

    `room.item` contains the number of the problem of each lane.
    """
    raise NotImplementedError


@compiled
def minimise_start(model: EngineModel, rows: Any, room: EngineWorkspace, first: bool) -> None:
    """Write the minimiser of the weighted squared-range rows to `room.y`, and to SOLVABLE whether it is unique.

    `first` is True in the first of two passes, before ranges are known for the weights.
    """
    raise NotImplementedError


@compiled
def scout(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Write starts that do not come from squared ranges to row X, and second starts to row OTHER.

    See `EngineModel.start`.
    """
    raise NotImplementedError


@compiled
def complete(rows: Any, room: EngineWorkspace) -> None:
    """Write starts of the unknowns other than the position to row X."""
    raise NotImplementedError


@compiled
def equations(rows: Any, room: EngineWorkspace, shift: int) -> None:
    """Write information (lower half), right side and cost at row X, or at TRIAL if `shift` is 1."""
    raise NotImplementedError


@compiled
def costs(rows: Any, room: EngineWorkspace) -> None:
    """Write the cost at the position TRIAL, minimised over the other unknowns, to COST_TRIAL."""
    raise NotImplementedError


@compiled
def bow_of(rows: Any, room: EngineWorkspace) -> float:
    """Return a bound b of the curvature of the rows, 1/metres.

    After a step of length D at range r, all residuals together differ from their linear prediction by at most
    ``b D^2 / r``.
    """
    raise NotImplementedError


@compiled
def note_nearest(rows: Any, room: EngineWorkspace, least: Array) -> None:
    """Write the range (W,) to the nearest station, metres, at the position of the last `equations`."""
    raise NotImplementedError


@compiled
def bend(rows: Any, room: EngineWorkspace) -> None:
    """Write half the second derivatives of the cost at row X to H_TRIAL."""
    raise NotImplementedError


@compiled
def measure_infinity(rows: Any, room: EngineWorkspace) -> None:
    """Write the least cost at infinity to BEYOND, see `optloc.engine.memory.Answer.infinity`."""
    raise NotImplementedError


@compiled
def search_infinity(model: EngineModel, rows: Any, room: EngineWorkspace) -> None:
    """Write the least cost at infinity to BEYOND, if necessary by a search; row X and its information do not change."""
    raise NotImplementedError


@compiled
def finish(rows: Any, z: Array, room: EngineWorkspace, size: int, mark: Array, marked: bool, x: Array) -> None:
    """Write the unknowns that are not refined to x (N, size), for the first `size` lanes.

    If `marked` is True, only the lanes with a nonzero `mark` are written.
    """
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
    """Return a kernel that evaluates rows with the kernels of a module, and with other values of some constants.

    Parameters
    ----------
    kernel : callable
        Kernel that calls kernels of this module, directly or through other kernels.
    rows : module
        Evaluator: it defines a kernel for each name in `_INTERFACE`.
    mark : str
        Suffix that distinguishes the names of the machine code.
    constants : object
        Constants to replace, as for `optloc.kernels.jit.specialise`.
    """
    own = {kernel: getattr(rows, kernel.__name__) for kernel in _INTERFACE}
    return specialise(kernel, mark, own, **constants)
