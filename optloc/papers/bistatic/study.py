"""Everything that the paper shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from optloc.papers.bistatic import figures, ground, tables, text
from optloc.papers.bistatic.scenario import ANGLE, EPOCHS, PATH
from optloc.papers.bistatic.trials import (
    TRACKERS,
    Errors,
    batches,
    bound_moving,
    bound_single,
    bound_still,
    moving,
    printed_angles,
    still,
)
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick

_COUNTS = (1, 10, 50, 200)
_EARLY = 50
_AZIMUTHS = (0.05, 0.2, 0.5, 1.0, 1.446, 2.0, 2.6, 3.1)
_SHOWN = ("single fix", "simplified, no restart", "restart every 50", "gain floor 0.05", "Cartesian EKF", "line fit")
_RUN = ("single fix", "simplified, no restart", "restart every 50", "line fit")


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    still, slow : int
        Trials of the target that stays, and of the slow one.
    ground : int
        Trials of each case with a ground.
    epochs : int
        Length of the records, more than 50.
    """

    still: int
    slow: int
    ground: int
    epochs: int = EPOCHS


_SIZES: dict[Size, Sample] = {"quick": Sample(1000, 150, 200), "full": Sample(2000, 1000, 2000)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    stays = still(sample.epochs, sample.still, sequence(0))
    tick()
    tracks = moving(sample.epochs, sample.slow, sequence(1), tick)
    fits = {}
    for count in (_EARLY, sample.epochs):
        fits[count] = batches(count, sample.slow, sequence(1), whole=sample.epochs)
        tick()
    bounds = {count: bound_moving(np.array([count]))[0] for count in (_EARLY, sample.epochs)}
    made = (
        tables.still(stays, {count: bound_still(np.array([count]))[0] for count in _COUNTS if count <= sample.epochs}),
        tables.claims(stays),
        tables.slow(tracks, fits, bounds),
        _short(sample.slow, sequence, tick),
        tables.directions({azimuth: bound_single(azimuth) for azimuth in _AZIMUTHS}),
        ground.table(sample.ground, sequence(4), tick),
        tables.printed(printed_angles(sample.epochs, sample.still, sequence(5)), ANGLE),
    )
    facts = f"seed {seed}, {sample.still} trials of the target that stays, {sample.slow} of the slow one"
    return Report(text.TITLE, facts, text.OPENING, text.CLOSING, made, _pictures(stays, tracks, fits))


def _short(trials: int, sequence: Callable[[int], np.random.SeedSequence], tick: Tick) -> Table:
    """Return batch fits of ten epochs, with the noise of the paper and with ten times that of the path."""
    rows = {}
    for key, (name, path) in enumerate({"20 ns": PATH, "200 ns": 10.0 * PATH}.items(), 2):
        errors = batches(10, trials, sequence(key), path=path)["batch maximum likelihood"]
        rows[name] = (errors, bound_moving(np.array([10]), path)[0])
        tick()
    return tables.short(rows)


def _pictures(
    stays: Mapping[str, Errors], tracks: Mapping[str, Errors], fits: Mapping[int, Mapping[str, Errors]]
) -> tuple[Picture, ...]:
    counts = np.unique(np.geomspace(1, max(fits), 40).astype(int))
    # Two epochs determine a course, but so badly that its bound is off the scale.
    later = counts[counts >= 5]
    shown = {name: tracks[name] for name in _SHOWN}
    batch = "batch maximum likelihood"
    points = {
        batch: Errors(np.array(sorted(fits)), np.concatenate([fits[k][batch].error for k in sorted(fits)], axis=1))
    }
    return (
        Picture("still", "Target that stays", figures.against_time(stays, (counts, bound_still(counts)), {})),
        Picture("slow", "Slow target", figures.against_time(shown, (later, bound_moving(later)), points)),
        Picture("run", "One run of the slow target", figures.one_run({name: tracks[name] for name in _RUN})),
    )


STUDY = Study(_SIZES, lambda _: len(TRACKERS) + len(ground.CASES) + 5, _run)
"""The reproduction of the paper."""
