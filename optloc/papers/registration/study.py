"""Everything that section 4 shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from optloc.papers import Plan
from optloc.papers.registration import printed, tables, text
from optloc.papers.registration.extras import minima, readings, scenes
from optloc.papers.registration.figures import against_time
from optloc.papers.registration.scenario import MOVING, NANOSECOND, PRINTED, SPATIAL, truth
from optloc.papers.registration.tables import Case
from optloc.papers.registration.trials import Course, Setting, course, one_shot, rms, score, wander
from optloc.papers.report import Picture, Report, Table, Tick, canvas
from optloc.solve import solve

_EPOCHS = 600
_GAIN = 0.03
_MOVING_FIRST = 200


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Trials of figures 1 to 3 and tables 2, 5 and 6.
    many : int
        Trials of tables 3 and 4, which count failures.
    fixed, moving : tuple of int
        Epochs at which the fixed and the moving target are looked at.
    """

    trials: int
    many: int
    fixed: tuple[int, ...]
    moving: tuple[int, ...]


SIZES = {
    "quick": Sample(20, 40, (150, 200, 300, 400, 600), (300, 400, 550, 600, 700)),
    "full": Sample(200, 500, tuple(range(150, 701, 50)), tuple(range(250, 801, 50))),
}


def plan(sample: Sample, seed: int) -> Plan:
    """Return the reproduction of section 4 of the paper.

    Parameters
    ----------
    sample : Sample
        How much is drawn; one of `SIZES`, or any other.
    seed : int
        Decides all draws.

    Raises
    ------
    InvalidProblem
        Where matplotlib is missing: before the work, not after it.
    """
    canvas(1.0, 1.0)
    courses = 4 * len(sample.fixed) + len(sample.moving) + 3
    counts = len(printed.INITIAL) + 1 + 2 * len(printed.NOISE) + 2
    return Plan(courses + counts, partial(_run, sample, seed))


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    far = Setting(PRINTED, sample.trials, seed, 1, station_sigma=5.0)
    near, moving = Setting(PRINTED, sample.trials, seed, 2), Setting(MOVING, sample.trials, seed, 3)
    fixed = {"5 m": course(far, sample.fixed, tick), "1 m": course(near, sample.fixed, tick)}
    flying = course(moving, sample.moving, tick, first=_MOVING_FIRST)
    joint = {
        name: course(Setting(PRINTED, sample.trials, seed, key, station_sigma=size, gain_sigma=_GAIN), sample.fixed, tick, plain=False)
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)), start=4)
    }
    starts = _starts(sample, seed, tick)
    noises = _noises(sample, seed, tick)
    spatial = _case(Setting(SPATIAL, sample.many, seed, 20), 20.0, 20.0, tick)
    return Report(
        text.TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.many} in tables 3 and 4 and of the spatial stations",
        text.OPENING,
        text.CLOSING,
        (
            *_tables(fixed, flying, joint),
            tables.starts(starts),
            tables.noises(noises, [rms(Setting(PRINTED, 1, seed, 0, sigma=c.sigma).bound(700)) for c in noises]),
            scenes({"printed": starts[-1], "spatial": spatial}),
            minima(),
            readings(),
        ),
        _pictures(fixed, flying, joint),
    )
