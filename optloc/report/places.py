"""Maps of the scenarios of a study whose stations stand still."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.errors import InvalidProblem
from optloc.maps import BoundMap, bound_map, extent, plan_of
from optloc.study.cases import Case
from optloc.study.draws import draw
from optloc.study.parts import Manifest
from optloc.study.plan import Plan, planned
from optloc.study.summary import case_label, noise_text
from optloc.types import Array

if TYPE_CHECKING:
    import pandas as pd

_POINTS = 64
_MOST = 8
_REACH = 400


@dataclass(frozen=True, slots=True)
class Place:
    """The map of a case.

    Parameters
    ----------
    title : str
        Case and noise level.
    found : BoundMap
        Its bound.
    truths : array (n, 2)
        True places of trials, as x and y of the map.
    off : bool array (n,)
        Where a method other than a bare program claimed an answer that is not the best known.
    """

    title: str
    found: BoundMap
    truths: Array
    off: Array


def plan_again(manifest: Manifest) -> Plan | None:
    """Return the plan of a study from its manifest, None where a problem file cannot be read any more."""
    try:
        return planned(manifest.text, manifest.name, Path(manifest.folder or "."), seed=manifest.seed)
    except InvalidProblem:
        return None


def references(plan: Plan | None) -> set[str]:
    """Return the names of the methods that begin at the truth, with which nobody competes."""
    if plan is None:
        return {"truth"}
    found = {cell.method.name: cell.method for cell in plan.cells}
    return {name for name, method in found.items() if method.baseline == "truth" or method.start == "truth"}


def scenario_maps(plan: Plan, frame: pd.DataFrame) -> Iterator[Place]:
    """Yield the map of every case whose stations are the same in all trials, at its first noise level.

    Cases that have no map are left out.
    """
    first: dict[str, Case] = {}
    for cell in plan.cells:
        first.setdefault(case_label(cell.case.table.name, cell.case.sweep), cell.case)
    for title, case in list(first.items())[:_MOST]:
        layout = case.table.layout
        if layout is not None and (layout.placement == "random" or layout.survey is not None):
            continue
        rows = frame[(frame["case"] == title) & (frame["noise_label"] == case.label)]
        try:
            yield _place(title, case, rows)
        except InvalidProblem:
            continue


def _place(title: str, case: Case, rows: pd.DataFrame) -> Place:
    one = draw(case, 0, 1)
    problem, d = one.problem.take(np.zeros(1, dtype=int)), one.problem.dimension
    per_trial = rows.groupby("trial", sort=True).agg(
        off=("wrong", "any"), x=("truth_x", "first"), y=("truth_y", "first"), z=("truth_z", "first")
    )
    position = per_trial[["x", "y", "z"]].to_numpy(dtype=float)[:_REACH, :d]
    earth = problem.frame.geodetic and d == 3
    plain = plan_of(problem.frame, position, earth)
    height = float(np.round(np.median(plain[:, 2]))) if d == 3 and len(plain) else 0.0
    west, east, south, north = extent(problem, position, widen=0.2)
    found = bound_map(
        problem, one.truth[0], np.linspace(west, east, _POINTS), np.linspace(south, north, _POINTS), height
    )
    off = per_trial["off"].to_numpy(dtype=bool)[:_REACH]
    return Place(f"{title}, {noise_text(case.label)}", found, plain[:, :2], off)
