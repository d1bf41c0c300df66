"""What a ground below the target, or its known height, adds to the fix of one epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.constraints import box
from optloc.papers.bistatic.scenario import RANGE, place, problem
from optloc.papers.report import Table, Tick
from optloc.simulate import simulate
from optloc.solve import solve
from optloc.types import Array

CASES = {
    "target of the paper, 10 km high": (1.446, 0.123),
    "the same, 0.2 km high": (1.446, float(np.arcsin(200.0 / RANGE))),
    "azimuth 0.3, elevation 0.5": (0.3, 0.5),
}
"""Azimuth and elevation of each case, radians."""


def spread(azimuth: float, elevation: float, trials: int, sequence: np.random.SeedSequence) -> dict[str, Array]:
    """Return root mean square errors (range, height, in space) of fixes of one epoch, metres, by what is known.

    Parameters
    ----------
    azimuth, elevation : float
        Direction of the target, radians.
    trials : int
        Independent draws.
    sequence : SeedSequence
        Decides the draw.
    """
    at = place(azimuth=azimuth, elevation=elevation)
    drawn = simulate(problem(1), at, sequence, trials)
    open_ = np.full(3, np.inf)
    floor, level = np.array([-np.inf, -np.inf, 0.0]), np.array([np.inf, np.inf, at[2]])
    regions = {
        "free": (),
        "above ground": box(floor.tolist(), open_.tolist()),
        "known height": box((-level * [1, 1, -1]).tolist(), level.tolist()),
    }
    out = {}
    for name, region in regions.items():
        found = solve(replace(drawn, constraints=region)).position
        error = found - at
        away = np.linalg.norm(found, axis=-1) - RANGE
        out[name] = np.sqrt(np.mean([away**2, error[:, 2] ** 2, (error**2).sum(-1)], axis=1))
    return out


def table(trials: int, sequence: np.random.SeedSequence, tick: Tick) -> Table:
    """Return the table of all `CASES`."""
    lines = []
    for (name, direction), child in zip(CASES.items(), sequence.spawn(len(CASES)), strict=True):
        found = spread(*direction, trials, child)
        lines += [(name, how, *(f"{value / 1e3:.3f}" for value in errors)) for how, errors in found.items()]
        tick()
    header = ("case", "known", "range, km", "height, km", "in space, km")
    note = "A ground or a height repairs the height only: the error in range is that of the azimuth."
    return Table("ground", "One epoch above ground, and at a known height", header, tuple(lines), note)
