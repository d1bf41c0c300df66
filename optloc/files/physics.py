"""Physical checks of the rows of a file or a table: impossible values raise errors, suspicious values give sentences.

The checks are in `optloc.model_checks.plausibility`. This module adds the places of rows and the units of the file.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from optloc.base.types import Array
from optloc.base.units import conversion
from optloc.files.measurements import RowChunk
from optloc.model_checks.plausibility import refuse_impossible, suspicious_values, wrapped_times
from optloc.problem.problem import Problem


def warnings_of(
    problem: Problem, chunks: Sequence[RowChunk], numbers: Sequence[Array], surface: str, source: str
) -> tuple[str, ...]:
    """Return sentences on suspicious values of a file; raise InvalidProblem for a negative range.

    `chunks` are the rows, and `numbers` the global number of each row (m,), for each chunk. `surface` is "file" or
    "table", for the names of options. The place of a row of a table is `source`, since its rows were rearranged.
    """

    def where(number: int) -> str:
        """Return the place of a row for messages."""
        if surface == "table":
            return source
        chunk, at = next((chunk, at.tolist()) for chunk, at in zip(chunks, numbers, strict=True) if number in at)
        return chunk.table.where("z", int(chunk.row[at.index(number)]))

    refuse_impossible(problem, where, surface)
    units = {chunk.kind: abs(float(chunk.unit.factor)) for chunk in chunks}
    speed = chunks[0].units.speed if chunks else None
    found = suspicious_values(problem, surface, units=units, speed=speed)
    return (*(f"{one.seen}; {one.advice}" for one in found), *_wraps(chunks), *_unused_sigmas(chunks))


def _unused_sigmas(chunks: Sequence[RowChunk]) -> Iterator[str]:
    """Yield a sentence for each table whose column sigma replaces the key sigma of its section."""
    replaced = dict.fromkeys(chunk.table.source for chunk in chunks if chunk.sigma_replaced)
    yield from (f"the column sigma of {source} replaces the key sigma; remove one of them" for source in replaced)


def _wraps(chunks: Sequence[RowChunk]) -> Iterator[str]:
    """Yield a sentence for each table of one target whose times start again after a known period."""
    for chunk in chunks:
        if chunk.time is None or (chunk.target is not None and len(set(chunk.target.tolist())) > 1):
            continue
        name = wrapped_times(chunk.time)
        if name is not None:
            yield f"the times of {chunk.table.source} start again after {name}; add the period to the later rows"


def warn_of_values(problem: Problem, unit: Any, timed: bool, speed: float) -> None:
    """Warn the caller of `locate` about values that are physically suspicious.

    `unit` is its argument. `timed` is whether there are times of arrival. `speed` is the wave speed, m/s.
    """
    unit_of_times = unit if unit is None or isinstance(unit, str) else unit.get("toa")
    step = conversion(unit_of_times or "s", "length", propagation_speed=speed).factor if timed else 0.0
    for one in suspicious_values(problem, "python", units={"toa": step} if timed else {}, speed=speed):
        # two levels up is the caller of `locate`
        warnings.warn(f"{one.seen}; {one.advice}", UserWarning, stacklevel=3)
