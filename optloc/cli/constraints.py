"""Constraints that options of ``optloc fix`` add to those of the file."""

from __future__ import annotations

from math import isnan, nan

from optloc.errors import InvalidProblem
from optloc.files.schema import ConstraintTable


def demanded(height: str | None, above_ground: bool, box: str | None) -> dict[str, ConstraintTable]:
    """Return the constraints of options, each behind the name of its option.

    Parameters
    ----------
    height : str, optional
        Known height: a number of metres, or a number and a unit.
    above_ground : bool
        Whether the height is at least zero.
    box : str, optional
        Least and greatest coordinates, metres: ``0,0,-inf:5000,5000,inf``.
    """
    found = {}
    if height is not None:
        found["--height"] = ConstraintTable(kind="height", exactly=height)
    if above_ground:
        found["--above-ground"] = ConstraintTable(kind="above-ground")
    if box is not None:
        low, found_both, high = box.partition(":")
        if not found_both:
            raise InvalidProblem(f"{box!r} has one corner", "--box", "write both, such as 0,0:5000,4000")
        found["--box"] = ConstraintTable(kind="box", min=_corner(low), max=_corner(high))
    return found


def _corner(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [nan]
    if any(map(isnan, values)):
        raise InvalidProblem(f"{text!r} is no list of numbers", "--box", "write a corner as 1200,800 or 1200,800,50")
    return values
