"""Everything that section 4 shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optloc.papers.registration import printed, tables, text
from optloc.papers.registration.extras import gains, minima, readings, scenes
from optloc.papers.registration.figures import against_time
from optloc.papers.registration.minima import ghost
from optloc.papers.registration.scenario import MOVING, NANOSECOND, PRINTED, SPATIAL, truth
from optloc.papers.registration.tables import Case
from optloc.papers.registration.trials import History, Score, Setting, history, rms, score, wander
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick
from optloc.solve import solve

_GAIN = 0.03
_MOVING_FIRST = 200
_WIDEST = 20.0
_NEAR = 5e3


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
        Epochs at which the fixed and the moving target are looked at; those of the printed tables among them.
    last : int
        Epochs of tables 3 and 4.
    """

    trials: int
    many: int
    fixed: tuple[int, ...]
    moving: tuple[int, ...]
    last: int = 600


_SIZES: dict[Size, Sample] = {
    "quick": Sample(30, 60, (150, 200, 300, 400, 600), (300, 400, 550, 600, 700)),
    "full": Sample(200, 500, tuple(range(150, 701, 50)), tuple(range(250, 801, 50))),
}


def _work(sample: Sample) -> int:
    histories = 4 * len(sample.fixed) + len(sample.moving) + 3
    return histories + len(printed.INITIAL) + 2 * len(printed.NOISE) + 1


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    fixed = {
        name: history(Setting(PRINTED, sample.trials, seed, key, station_sigma=size), sample.fixed, tick)
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)))
    }
    moving = history(Setting(MOVING, sample.trials, seed, 2), sample.moving, tick, first=_MOVING_FIRST)
    joint = {
        name: history(Setting(PRINTED, sample.trials, seed, key, None, size, _GAIN), sample.fixed, tick, plain=False)
        for key, (name, size) in enumerate((("5 m", 5.0), ("1 m", 1.0)), 3)
    }
    starts = _starts(Setting(PRINTED, sample.many, seed, 5), sample.last, tick)
    noisy = [Setting(PRINTED, sample.many, seed, 6 + i, (ns - 10) * NANOSECOND) for i, ns in enumerate(printed.NOISE)]
    spatial = _case(Setting(SPATIAL, sample.many, seed, 10), sample.last, _WIDEST, tick)
    pictures, tabled = _figures(fixed, moving, joint)
    return Report(
        text.TITLE,
        f"seed {seed}, {sample.trials} trials, {sample.many} in tables 3 and 4 and for the spatial stations",
        text.OPENING,
        text.CLOSING,
        (
            *_accuracies(fixed["1 m"], moving, joint["1 m"]),
            tables.starts(starts),
            _noises(noisy, sample.last, tick),
            *tabled,
            scenes({"printed": starts[-1], "spatial": spatial}),
            minima(),
            gains(),
            readings(),
        ),
        pictures,
    )


def _case(setting: Setting, epochs: int, width: float, tick: Tick, label: float = 0.0) -> Case:
    """Return both routes on the same draw."""
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    (plain,) = wander(setting, drawn, (epochs,), (bound,), width=width)
    found = score(solve(drawn).x, truth(setting.scenario, drawn), bound)
    tick()
    sigma, image = setting.sigma or setting.scenario.sigma, _at_image(setting, epochs, plain)
    return Case(label or width, epochs, sigma, rms(bound), plain, found, image)


def _at_image(setting: Setting, epochs: int, plain: Score) -> float:
    """Return the share of trials that ended at the second minimum of the scene."""
    image = ghost(setting.scenario, epochs, sigma=setting.sigma)
    if image is None:
        return 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.linalg.norm(plain.error[:, :3] - (image.x[:3] - setting.scenario.target), axis=-1)
    return float((plain.lost & (apart < _NEAR)).mean())


def _starts(setting: Setting, epochs: int, tick: Tick) -> list[Case]:
    """Return table 3: one draw, and the recursion from starts of growing width."""
    drawn, bound = setting.draw(epochs), setting.bound(epochs)
    found = score(solve(drawn).x, truth(setting.scenario, drawn), bound)
    cases = []
    for width in printed.INITIAL:
        (plain,) = wander(setting, drawn, (epochs,), (bound,), width=float(width))
        image = _at_image(setting, epochs, plain)
        cases.append(Case(float(width), epochs, setting.scenario.sigma, rms(bound), plain, found, image))
        tick()
    return cases


def _noises(settings: Sequence[Setting], epochs: int, tick: Tick) -> Table:
    """Return table 4, whose labels are 10 ns too large; the recursion is started at the truth itself as well."""
    cases: list[Case] = []
    sure: list[Score] = []
    for setting, label in zip(settings, printed.NOISE, strict=True):
        cases.append(_case(setting, epochs, 1.0, tick, label))
        sure += wander(setting, setting.draw(epochs), (epochs,), (setting.bound(epochs),), width=0.0)
        tick()
    return tables.noises(cases, sure, [rms(setting.bound(700)) for setting in settings])


def _accuracies(fixed: History, moving: History, joint: History) -> tuple[Table, ...]:
    """Return tables 2, 5 and 6."""
    exact = [truth(c.setting.scenario, c.setting.problem(1)) for c in (fixed, moving, joint)]
    return (
        tables.biases("table-2", "Table 2: biases, fixed target", fixed, exact[0], printed.ACCURACY_FIXED),
        tables.biases("table-5", "Table 5: biases, moving target", moving, exact[1], printed.ACCURACY_MOVING),
        tables.biases("table-6", "Table 6: biases with gain ratios", joint, exact[2], printed.ACCURACY_JOINT),
    )


def _figures(
    fixed: Mapping[str, History], moving: History, joint: Mapping[str, History]
) -> tuple[tuple[Picture, ...], tuple[Table, ...]]:
    """Return figures 1 to 3 and the numbers behind them."""
    parts = (
        ("figure-1", "Figure 1: fixed target", dict(fixed), printed.FIXED, None),
        ("figure-2", "Figure 2: moving target", {"1 m": moving}, printed.MOVING, 450),
        ("figure-3", "Figure 3: fixed target, with gain ratios", dict(joint), printed.JOINT, None),
    )
    pictures, tabled = [], []
    for name, title, histories, values, zoom in parts:
        labels = [f"station error {label}" for label in histories]
        figure = against_time(list(histories.values()), labels, [values[label] for label in histories], zoom)
        pictures.append(Picture(name, title, figure))
        tabled.append(tables.errors(name, f"{title}, in numbers", histories, values))
    return tuple(pictures), tuple(tabled)


STUDY = Study(_SIZES, _work, _run)
"""The reproduction of the paper."""
