"""Everything that the paper shows, in a quick and in a full size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.bounds import crlb
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick
from optloc.papers.satellites import figures, tables, text
from optloc.papers.satellites.scenario import HEIGHT, START, orbits, problem
from optloc.papers.satellites.trials import climbing, far, fixed, heights, moving, root_trace, wild

_FAR = (0.0, 5.0, 10.0, 20.0, 25.0)
_HEADINGS = {"north": 0.0, "north-east": 0.25 * np.pi, "east": 0.5 * np.pi, "south-east": 0.75 * np.pi}
_PANEL = 100e3


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Trials of each case.
    others : int
        Trials of each kind of height, and of each heading of moving satellites.
    widths : tuple of float
        Start errors, metres; 100 km, which a figure shows, among them.
    steps, far : int
        Steps of the filters, and of those from far starts; more than ten.
    """

    trials: int
    others: int
    widths: tuple[float, ...] = (1e3, 10e3, 30e3, 100e3, 200e3, 400e3)
    steps: int = 200
    far: int = 100


_SIZES: dict[Size, Sample] = {"quick": Sample(200, 100), "full": Sample(2000, 1000)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    begun = fixed(sample.steps, sample.trials, sequence(0))
    tick()
    starts = {}
    for width in sample.widths:
        # The same data for every width: only the start differs.
        starts[width] = wild(width, sample.far, sample.trials, sequence(1))
        tick()
    known = heights(sample.steps, sample.others, sequence(2))
    tick()
    known["climbing target, height said to be 0"] = climbing(sample.steps, sample.others, sequence(3))
    tick()
    flying = {}
    for name, heading in _HEADINGS.items():
        flying[name] = moving(orbits(sample.steps + 2, heading), sample.others, sequence(4))
        tick()
    panels = {"from the first two fixes": begun, "start wrong by 100 km": starts[_PANEL]}
    return Report(
        text.TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.others} in the tables of heights and of moving satellites",
        text.OPENING,
        text.CLOSING,
        (
            tables.fixed(*begun),
            tables.starts(starts),
            tables.pairs(starts),
            tables.heights(known),
            tables.moving(flying, begun[1]),
            _one_shot(),
        ),
        (
            Picture("filters", "The four filters", figures.filters(panels)),
            Picture(
                "heights",
                "What the height is worth: errors, and what the filter claims (dotted)",
                figures.heights(known),
            ),
        ),
    )


def _one_shot() -> Table:
    """Return the bounds of a single fix."""
    cases = {
        "50 ns each, height 500 m": problem(1, order=0),
        "50 ns each, height known": problem(1, order=0, height=None),
        "50 ns correlated, height 500 m": problem(1, order=0, correlated=True),
        "50 ns correlated, height known": problem(1, order=0, height=None, correlated=True),
        "50 ns each, height 10 m": problem(1, order=0, height=HEIGHT / 50.0),
    }
    bounds = {name: float(root_trace(crlb(case, START))) for name, case in cases.items()}
    return tables.one_shot(bounds, dict(zip(_FAR, far([np.radians(angle) for angle in _FAR]).tolist(), strict=True)))


STUDY = Study(_SIZES, lambda sample: len(sample.widths) + len(_HEADINGS) + 3, _run)
"""The reproduction of the paper."""
