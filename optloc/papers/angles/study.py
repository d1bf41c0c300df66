"""The paper made again: simulations 1 to 3, their bounds, and what their starts and their model decide."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.papers.angles import figures, filters, fits, tables, text
from optloc.papers.angles.scenario import REPAIRED, STRAIGHT, WINDING
from optloc.papers.angles.trials import draw
from optloc.papers.report import Picture, Report, Size, Study, Tick

_TICKS = 31


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Trials of simulations 1 and 2 and of fixes.
    many : int
        Trials of the table of lost tracks.
    circles : int
        Trials of the repaired simulation 3.
    readings : int
        Trials of simulation 3 as printed, 3000 s each.
    """

    trials: int
    many: int
    circles: int
    readings: int


_SIZES: dict[Size, Sample] = {"quick": Sample(200, 200, 60, 10), "full": Sample(1000, 1000, 400, 100)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    one = draw(STRAIGHT, sample.trials, seed, 0)
    straight = filters.straight(one, tick)
    wholes = fits.wholes(one, tick)
    winding = filters.winding(draw(WINDING, sample.trials, seed, 1), tick)
    circles, snapshot = filters.circles(draw(REPAIRED, sample.circles, seed, 2), tick), filters.snapshot()
    many = draw(STRAIGHT, sample.many, seed, 3)
    starts, clamps, ends = filters.starts(many, tick), filters.clamps(many, tick), filters.ends(many, tick)
    rays = fits.rays(sample.trials, seed, 4, tick)
    readings = filters.readings(sample.readings, seed, 8, tick)
    return Report(
        text.TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.many} of the starts, {sample.circles} of simulation 3 repaired "
        f"and {sample.readings} as printed",
        text.OPENING,
        text.CLOSING,
        (
            tables.straight(straight),
            tables.wholes(wholes, fits.whole_track_bound()),
            tables.starts(starts),
            tables.clamps(clamps),
            tables.winding(winding),
            tables.circles(circles, snapshot),
            tables.readings(readings),
            tables.rays(rays),
        ),
        (
            Picture("figure-1-3", "Figures 1 to 3: simulation 1", figures.straight(straight)),
            Picture("starts", "Starts on the line through both stations", figures.starts(ends)),
            Picture("figure-4-6", "Figures 4 to 6: simulation 2", figures.winding(winding)),
            Picture("figure-7", "Figure 7: simulation 3, repaired", figures.circles(circles, snapshot)),
        ),
    )


STUDY = Study(_SIZES, lambda _: _TICKS, _run)
"""The reproduction of the paper."""
