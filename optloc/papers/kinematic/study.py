"""Everything that the page shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TypeVar

import numpy as np

from optloc.papers.kinematic import figures, tables, text
from optloc.papers.kinematic.scenario import ORDERS, Draw, Scenario, draw
from optloc.papers.kinematic.tables import Line
from optloc.papers.kinematic.trials import (
    FILTERS,
    PLAIN,
    Association,
    Score,
    association,
    batch,
    bounds,
    fixes,
    mean_error,
    scored,
    tracked,
)
from optloc.papers.kinematic.wrong import taylor, twice_predicted, weighting
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick
from optloc.solve import solve
from optloc.track import polynomial
from optloc.track.parallel import parallel
from optloc.types import Array, Motion
from optloc.windows import cut

_SHOWN = (1, 2, 3, 4, 5, 10, 20)
_HALFWAY = 10
_SAME = 1.0
_WILD = 1e6
_WORK = 11
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    trials : int
        Runs of three targets each.
    mixed : int
        Runs of the association test.
    """

    trials: int
    mixed: int


_SIZES: dict[Size, Sample] = {"quick": Sample(500, 300), "full": Sample(2000, 1000)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    scene = Scenario()

    def done(value: T) -> T:
        tick()
        return value

    drawn = {name: done(draw(scene, scene.course(i), sample.trials, (seed, i))) for name, i in ORDERS.items()}
    half = float(scene.times[_HALFWAY])
    late = done(draw(scene, scene.course(2, since=half), sample.trials, (seed, 3)))
    lines, pictures = done(_scenes(drawn))
    matched = {"CV": lines[2].score, "CA": lines[4].score}
    compared = done({f.name: [f.run(d) for d in (drawn["CV"], drawn["CA"], late)] for f in FILTERS})
    chosen = done({name: _sides(each, ORDERS[name]) for name, each in drawn.items()})
    tests = {name: done(association(scene, ORDERS[name], sample.mixed, (seed, 4 + i)))
             for i, name in enumerate(("static", "CV"))}  # fmt: skip
    made = (
        tables.errors(lines),
        tables.ratios(lines[0].score, matched, scene.steps),
        done(_efficiency(drawn)),
        tables.models(compared, ("CV", "CA", f"CV, CA from step {_HALFWAY}")),
        tables.choice({name: right for name, (right, _) in chosen.items()}, _SHOWN),
        tables.association(tests),
        done(_wrong(seed, drawn, matched, tests)),
    )
    shares = {name: mean for name, (_, mean) in chosen.items()}
    more = (
        Picture("models", "Probability of the models", figures.probabilities(shares, tuple(ORDERS))),
        Picture("association", "Tracks lost to wrong rows", figures.losses(tests["CV"].scores)),
    )
    facts = f"seed {seed}, {sample.trials} runs of three targets, {sample.mixed} of the association test"
    return Report(text.TITLE, facts, text.OPENING, text.CLOSING, made, (*pictures, *more))


def _timed(work: Callable[[], T], runs: int) -> tuple[T, float]:
    """Return what work gives, and seconds for one run."""
    before = perf_counter()
    made = work()
    return made, (perf_counter() - before) / runs


def _scenes(drawn: dict[str, Draw]) -> tuple[list[Line], tuple[Picture, ...]]:
    """Return the lines of table 1, and figures 2 to 4."""
    still = drawn["static"]
    scene, runs = still.scenario, len(still.runs.z)
    first, seconds = _timed(partial(fixes, still), runs * scene.steps)
    limit = bounds(scene, still.truth, 0)
    lines = [Line("one fix on static", first, _mean(limit[:, :1]), seconds, "static")]
    track, seconds = _timed(partial(tracked, still, PLAIN[0]), runs)
    lines.append(Line("static, 20 updates, on static", scored(still, track), _mean(limit[:, 1:]), seconds))
    pictures = []
    for number, (model, motion) in enumerate((("CV", "CV"), ("CV", "CA"), ("CA", "CA")), 2):
        own, order = drawn[motion], ORDERS[model]
        track, seconds = _timed(partial(tracked, own, PLAIN[order]), runs)
        score = scored(own, track)
        bound = bounds(scene, own.truth, order)[:, 1:] if model == motion else None
        name = f"{model} on {motion}"
        lines.append(Line(name, score, None if bound is None else _mean(bound), seconds, name))
        figure = figures.scene(own, track.position, score, bound)
        pictures.append(Picture(f"figure-{number}", f"Figure {number}: {name}", figure))
    return lines, tuple(pictures)


def _mean(cov: Array) -> float:
    return float(mean_error(cov).mean())


def _efficiency(drawn: dict[str, Draw]) -> Table:
    found = {}
    for name in ("CV", "CA"):
        own, model = drawn[name], polynomial(ORDERS[name])
        last = bounds(own.scenario, own.truth, ORDERS[name])[:, -1]
        limit = float(np.sqrt(np.trace(last, axis1=-2, axis2=-1).mean()))
        filters = [scored(own, tracked(own, model, update)) for update in ("ekf", "iekf")]
        found[name] = (filters[0], filters[1], batch(own, ORDERS[name]), limit)
    return tables.efficiency(found)


def _sides(drawn: Draw, right: int) -> tuple[Array, Array]:
    """Return how often the right model (k,) is chosen, and the mean probability of each (k, q)."""
    scene = drawn.scenario
    made = parallel(drawn.runs, drawn.fix, PLAIN, speed=scene.speed, rate=scene.rate, update="ekf")
    return (made.choice == right).mean((0, 1)), made.probability.mean((0, 1))


def _reached(found: Array, target: Array) -> float:
    """Return the share of positions that are where they should be."""
    with np.errstate(invalid="ignore", over="ignore"):
        return float((np.linalg.norm(found - target, axis=-1) < _SAME).mean())


def _wrong(seed: int, drawn: dict[str, Draw], matched: dict[str, Score], tests: dict[str, Association]) -> Table:
    scene = drawn["static"].scenario
    rows = []
    one = cut(drawn["static"].runs, 0, 1)
    target, inside = solve(one).position, np.array([1e3, 1e3])
    wild = _WILD * (2.0 * np.random.default_rng(np.random.SeedSequence((seed, 9))).random(target.shape) - 1.0)
    made = (taylor(one, inside, sign=-1.0), taylor(one, inside), taylor(one, np.asarray(wild)))
    arrived = [_reached(found, target) for found in made]
    backward, forward, far = (tables.share(value) for value in arrived)
    rows.append(("8, 15: sign of the residual", "steps from (1, 1) km that reach the fix", backward, forward))
    rows.append(("8: sign corrected", "steps from anywhere (±1000 km), and from (1, 1) km", far, forward))
    shared = scene.sigma**2 / 2.0 * (np.eye(3) + 1.0)
    epoch = cut(replace(scene.problem(), motions=(Motion(0),)), 0, 1)
    plain, best = weighting(epoch, scene.position[0], shared)
    rows.append(("5: H'H called BLUE", "error of a fix, shared reference, km", tables.km(plain), tables.km(best)))
    for name, score in matched.items():
        model = PLAIN[ORDERS[name]]
        bad = scored(drawn[name], tracked(drawn[name], model, twice_predicted(model, scene.interval, 2)))
        rows.append(
            ("29: H times the transition", f"mean error of {name}, km", tables.km(bad.mean), tables.km(score.mean))
        )
        levels = [f"{each.nees[..., -1].mean():.2f}" for each in (bad, score)]
        rows.append(("29: H times the transition", f"NEES of {name} at the last step", levels[0], levels[1]))
    paper, dropped = list(tests["static"].scores.values())[:2]
    levels = [f"{each.nees[..., -1].mean():.2f}" for each in (paper, dropped)]
    rows.append(("12: missed row := prediction", "NEES of the static filter at the last step", levels[0], levels[1]))
    return tables.wrong(rows)


STUDY = Study(_SIZES, lambda _: _WORK, _run)
"""The reproduction of the paper."""
