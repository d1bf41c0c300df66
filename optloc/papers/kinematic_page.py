"""Everything that the page shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from optloc.base.types import Array, Motion
from optloc.papers.kinematic import (
    FILTERS,
    LOST,
    ORDERS,
    PLAIN,
    Association,
    Draw,
    Scenario,
    Score,
    association,
    batch,
    bounds,
    draw,
    fixes,
    mean_error,
    scored,
    taylor,
    theory,
    tracked,
    twice_predicted,
    weighting,
)
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick, canvas
from optloc.problem.epochs import cut
from optloc.solvers import solve
from optloc.track import polynomial
from optloc.track.several_models import parallel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The numbers that the paper prints in its table 1.

ERROR = {"static": 0.982, "CV on CV": 0.591, "CV on CA": 10.618, "CA on CA": 0.781}
"""Mean position error, kilometres: static algorithm and target, and scenes 1 to 3."""

SECONDS = {"static": 0.402, "CV on CV": 0.444, "CV on CA": 0.467, "CA on CA": 0.450}
"""Computing time, milliseconds."""


# The tables of the page: printed, reproduced, bound and theory side by side.


@dataclass(frozen=True, slots=True)
class Line:
    """One line of table 1.

    Parameters
    ----------
    name : str
        Algorithm and motion.
    score : Score
        Errors.
    bound : float or None
        Bound of the mean error, metres; None where the model is wrong.
    seconds : float
        Computing time of one run of three targets, as a share of the batch.
    key : str, optional
        Which printed line it is.
    """

    name: str
    score: Score
    bound: float | None
    seconds: float
    key: str | None = None


def km(value: float) -> str:
    """Return metres as kilometres: three decimals, fewer where they are many, a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    size = 1e-3 * value
    return f"{size:.3f}" if size < 100.0 else f"{size:.3g}" if size < 1000.0 else f"{size:.0f}"


def share(value: float) -> str:
    """Return a share as per cent."""
    return f"{100.0 * value:.1f} %"


def errors(lines: Sequence[Line]) -> Table:
    """Return table 1 of the paper."""
    header = ("algorithm on motion", "printed", "reproduced", "standard error", "bound", "printed ms", "ms")
    rows = []
    for line in lines:
        known = line.key is not None
        rows.append(
            (
                line.name,
                f"{ERROR[line.key]:.3f}" if line.key is not None else "",
                km(line.score.mean),
                km(line.score.spread),
                "–" if line.bound is None else km(line.bound),
                f"{SECONDS[line.key]:.3f}" if known and line.key is not None else "",
                f"{1e3 * line.seconds:.3f}",
            )
        )
    note = (
        "Mean distance from the truth over runs, targets and steps 1 to 20, kilometres. The noise was chosen so that "
        "the first line fits, the interval so that CV on CA does; the other two lines are the test. The bound is that "
        "of the mean distance of a normal error with the covariance of Cramér and Rao. Times are of one run of three "
        "targets, of one epoch in the first line, ours as its share of the batch."
    )
    return Table("table-1", "Table 1: mean position error", header, tuple(rows), note)


def ratios(fix: Score, matched: Mapping[str, Score], steps: int) -> Table:
    """Return what is left of table 1 when its noise is divided out."""
    single = ERROR["static"]
    rows = []
    for name, score in matched.items():
        order = 1 if name == "CV" else 2
        wanted = ERROR[f"{name} on {name}"] / single
        rows.append((f"{name} / fix", f"{wanted:.3f}", f"{score.mean / fix.mean:.3f}", f"{theory(order, steps):.3f}"))
    note = (
        "A filter without process noise and with a loose prior fits a polynomial. The theory is the error of the end "
        "point of a line or a parabola through k equally good points over that of one point, averaged over "
        f"k = 2 to {steps + 1}. It knows nothing of the geometry."
    )
    return Table(
        "ratios", "Error over that of a single fix", ("", "printed", "reproduced", "theory"), tuple(rows), note
    )


def efficiency(found: Mapping[str, tuple[Score, Score, Score, float]]) -> Table:
    """Return last-step errors of filter, iterated filter and batch beside the bound."""
    header = ("model on its own motion", "EKF", "IEKF", "batch ML", "bound", "EKF / bound", "NEES of the EKF")
    rows = []
    for name, (plain, iterated, whole, bound) in found.items():
        lengths = (km(plain.last), km(iterated.last), km(whole.last), km(bound))
        rows.append((name, *lengths, f"{plain.last / bound:.3f}", f"{plain.nees[..., -1].mean():.2f}"))
    note = (
        "Root mean square error at the last step, kilometres, and the posterior Cramér-Rao bound. A NEES of 2 means "
        "that the covariance is right. Nothing is left here for a smoother or a particle filter."
    )
    return Table("efficiency", "How good the filters are at the last step", header, tuple(rows), note)


def models(found: Mapping[str, Sequence[Score]], motions: Sequence[str]) -> Table:
    """Return mean errors of filters on several motions."""
    header = ("filter", *motions)
    rows = tuple((name, *(km(score.mean) for score in scores)) for name, scores in found.items())
    note = (
        "Mean error, kilometres. In the last column targets fly straight and begin to accelerate half way: models "
        "side by side then hold on to the past, models that interact do not."
    )
    return Table("models", "Right and wrong models", header, rows, note)


def choice(found: Mapping[str, Array], steps: Sequence[int]) -> Table:
    """Return how often the likelihood prefers the right model."""
    header = ("motion", *(f"step {step}" for step in steps))
    rows = tuple((name, *(f"{100.0 * shares[step - 1]:.1f}" for step in steps)) for name, shares in found.items())
    note = "Per cent of runs in which the right one of static, CV and CA has the largest likelihood so far."
    return Table("choice", "Choice of the model by likelihood", header, rows, note)


def association_table(found: Mapping[str, Association]) -> Table:
    """Return the association test."""
    header = ("motion", "rule", "mean error", "median NEES", "mean NEES", "lost")
    rows = []
    for motion, test in found.items():
        for rule, score in test.scores.items():
            last = score.nees[..., -1]
            mean = float(last.mean())
            rows.append(
                (
                    motion,
                    rule,
                    km(score.mean),
                    _size(float(np.median(last))),
                    _size(mean),
                    share(score.lost),
                )
            )
    note = (
        "Kilometres; NEES at the last step, 2 on average where the covariance is right (its median is then 1.39). A "
        "row is seen with probability 0.7 and there are 2 false ones in every channel and epoch. *Lost* ends more than "
        "10 km from the truth."
    )
    return Table("association", "Rows without names", header, tuple(rows), note)


def _size(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 100.0 else f"{value:.2g}".replace("e+0", "e").replace("e+", "e")


def wrong(rows: Sequence[tuple[str, str, str, str]]) -> Table:
    """Return what the printed equations do beside their corrected form."""
    header = ("equation", "measured", "as printed", "corrected")
    return Table("equations", "What the printed equations do", header, tuple(rows))


# What the page says around its tables: how the paper was read, and what is wrong in it.

TITLE = "TDOA location of targets that stand, fly on or accelerate"

OPENING = """\
Four stations measure three range differences of each of three distant targets in the plane. The paper (W. Li, J. Liu,
H. Li, *A method of TDOA location in LOS environment based on target movement pattern*, Missiles and Space Vehicles
2024/5, doi:10.7654/j.issn.2097-1974.20240501) fixes each target once and goes on with a Kalman filter whose model is
static, of constant velocity (CV) or of constant acceleration (CA). Its section 3 is made again here with
`optloc.track`, on one measurement model and with the equations put right.

- The **fix** of the first epoch is `optloc.solve`, without a guess. It is the best linear unbiased estimate of the
  paper when its steps have converged.
- The **static** filter is the recursion of the fix; **CV** and **CA** are `optloc.track.followed` with
  `polynomial(1)` and `polynomial(2)` and the update `ekf`.
- The paper proposes to run several models side by side and to judge them afterwards: `parallel` of
  `optloc.track.several_models` does, by likelihood. `imm` of `optloc.track.several_models` lets the models interact.
- Rows that do not say whose they are go through `associated` of `optloc.track.several_targets`, with a rule of
  `optloc.track.associate`: the nearest row of each channel, whole sets of rows for each target, or for all together.

## How the paper was read

Given are the targets, (300, 400), (350, 450) and (250, 350) km, their speeds of 1, −1 and 1 km/s along y, their
accelerations of −0.1, 0.1 and 0.1 km/s², 20 steps and 100 runs. Stations, noise, interval, priors and the definition of
the mean error are not given. Chosen were:

| what | value | why |
| --- | --- | --- |
| stations | the reference at the origin, three others 100 km out at 90, 210 and 330 degrees | the usual Y |
| noise | 80 ns for each difference, independent | a single fix is then 0.96 km off; printed are 0.98 km |
| interval | 2.25 s | the CV filter on accelerated targets is then 10.3 km off; printed are 10.6 km |
| direction of acceleration | along y, as the speed | the literal reading |
| priors | 2 km/s and 1 km/s² about zero | loose |
| mean error | distance, averaged over runs, targets and steps 1 to 20 | |
| "static" line | fixes of single epochs | with 20 updates it would be far better than the CV line, not worse |

Noise and interval are fitted to two lines of table 1, so those prove nothing. The other two do: see *ratios*."""

CLOSING = """\
## What is wrong in the paper

1. Equations 2, 8 and 15 take r0 − ri where 1, 3, 11 and 21 take ri − r0: the steps go away from the target, and none
   of them arrives (table *equations*).
2. Equation 5 calls the fix with equal weights the best linear unbiased one. It is, if the differences are independent.
   They share the reference station; with R = σ²/2 (I + 11') equal weights cost 13 %.
3. Equations 7 and 28 have four rows; there are three differences.
4. The gate of equation 12 compares with a threshold μ that is never defined, and uses a distance that is not either.
   Read as the innovation in its own standard deviations, five of them, it can be built.
5. A missed difference is set to its prediction, and the covariance is updated as if it had been measured. The filter
   then trusts itself too much. The row has to be left out.
6. Equation 18 has a driving noise; equation 26 has lost its covariance Q. The gain goes to zero, and a wrong model is
   never forgiven.
7. Equation 22 subtracts a station from the whole state instead of the position.
8. Equation 29 multiplies the columns of velocity and acceleration by the interval and half its square. They are zero:
   the transition has been applied already. Table 1 cannot have come from the printed form.
9. The CV filter is described as the CA filter with a = 0. Acceleration has to leave P and H as well.
10. The printed times of 0.40 to 0.47 ms hardly depend on the size of the state, so they are mostly overhead of calls.

## What helps

- **Wrong model.** Process noise for the acceleration that may come costs a quarter of the accuracy where the model was
  right, and a factor of ten is won where it was not. Models side by side cost nothing and are right from the fifth
  step on, but only as long as the target keeps its motion; models that interact follow when it does not.
- **Rows without names.** The targets lie in nearly one direction and their differences are close together. While the
  velocity is unknown the gate of a single channel is as wide as the gaps between them, and the nearest row is often
  the neighbour's. Whole sets of rows, scored with their joint covariance, lose few tracks; sets of all targets
  together, no row used twice, fewer still."""


# The figures of the page: tracks and errors of the three scenes, models, association.

_BLACK = "#000000"
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def scene_figure(drawn: Draw, position: Array, score: Score, bound: Array | None) -> Figure:
    """Return one run in the plane, and the mean error of each target against the step.

    Parameters
    ----------
    drawn : Draw
        The truth.
    position : array (n, t, k, 2)
        Estimates.
    score : Score
        Their errors.
    bound : array (t, k, 2, 2), optional
        Covariance bound at the same steps.
    """
    figure = canvas(11.0, 4.8)
    plan, ax = figure.subplots(1, 2)
    steps = np.arange(1, score.error.shape[-1] + 1)
    for target in range(len(drawn.truth)):
        colour = _COLOURS[target]
        true, found = 1e-3 * drawn.truth[target, :, :2], 1e-3 * position[0, target]
        plan.plot(*true.T, color=colour, lw=1.2)
        plan.plot(*found.T, "o", color=colour, mfc="none", ms=4, label=f"target {target + 1}")
        plan.plot(*true[0], "s", color=colour, ms=6)
        ax.plot(
            steps, 1e-3 * score.error[:, target].mean(0), "o-", color=colour, ms=4, lw=0.8, label=f"target {target + 1}"
        )
        if bound is not None:
            label = "bound" if target == len(bound) - 1 else None
            ax.plot(steps, 1e-3 * mean_error(bound[target]), color=_BLACK, lw=0.8, ls="--", label=label)
    plan.set_title("one run: line and square the truth, circles the filter")
    plan.set_xlabel("x, km")
    plan.set_ylabel("y, km")
    plan.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"mean error of {len(score.error)} runs")
    _steps(ax, "mean position error, km")
    for each in (plan, ax):
        each.legend(frameon=False)
        each.grid(visible=True, alpha=0.25)
    return figure


def probabilities(found: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """Return the mean probability of each model against the step, one panel for each motion.

    Parameters
    ----------
    found : mapping of str to array (k, q)
        By motion.
    names : sequence of q str
        Models.
    """
    figure = canvas(4.0 * len(found), 3.8)
    panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for ax, (motion, shares) in zip(panels, found.items(), strict=True):
        for i, name in enumerate(names):
            style = ("o-", "s-", "^-")[i % 3]
            ax.plot(np.arange(1, len(shares) + 1), shares[:, i], style, color=_COLOURS[i], ms=4, lw=1, label=name)
        ax.set_title(f"truth: {motion}")
        _steps(ax, "mean probability of the model" if ax is panels[0] else "")
        ax.grid(visible=True, alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def losses(found: Mapping[str, Score]) -> Figure:
    """Return the share of tracks that are far from the truth against the step.

    Parameters
    ----------
    found : mapping of str to Score
        By rule.
    """
    figure = canvas(7.0, 4.6)
    ax = figure.subplots()
    for i, (rule, score) in enumerate(found.items()):
        far = 100.0 * (score.error > LOST).mean((0, 1))
        style = ("o-", "s--", "^-", "x-")[i % 4]
        ax.plot(np.arange(1, len(far) + 1), far, style, color=_COLOURS[i % 4], ms=4, lw=1, label=rule)
    _steps(ax, "tracks more than 10 km off, %")
    ax.grid(visible=True, alpha=0.25)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _steps(ax: Axes, label: str) -> None:
    ax.set_xlabel("step")
    ax.set_ylabel(label)
    ax.set_xticks(range(0, 21, 5))


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
        errors(lines),
        ratios(lines[0].score, matched, scene.steps),
        done(_efficiency(drawn)),
        models(compared, ("CV", "CA", f"CV, CA from step {_HALFWAY}")),
        choice({name: right for name, (right, _) in chosen.items()}, _SHOWN),
        association_table(tests),
        done(_wrong(seed, drawn, matched, tests)),
    )
    shares = {name: mean for name, (_, mean) in chosen.items()}
    more = (
        Picture("models", "Probability of the models", probabilities(shares, tuple(ORDERS))),
        Picture("association", "Tracks lost to wrong rows", losses(tests["CV"].scores)),
    )
    facts = f"seed {seed}, {sample.trials} runs of three targets, {sample.mixed} of the association test"
    return Report(TITLE, facts, OPENING, CLOSING, made, (*pictures, *more))


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
        figure = scene_figure(own, track.position, score, bound)
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
    return efficiency(found)


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
    backward, forward, far = (share(value) for value in arrived)
    rows.append(("8, 15: sign of the residual", "steps from (1, 1) km that reach the fix", backward, forward))
    rows.append(("8: sign corrected", "steps from anywhere (±1000 km), and from (1, 1) km", far, forward))
    shared = scene.sigma**2 / 2.0 * (np.eye(3) + 1.0)
    epoch = cut(replace(scene.problem(), motions=(Motion(0),)), 0, 1)
    plain, best = weighting(epoch, scene.position[0], shared)
    rows.append(("5: H'H called BLUE", "error of a fix, shared reference, km", km(plain), km(best)))
    for name, score in matched.items():
        model = PLAIN[ORDERS[name]]
        bad = scored(drawn[name], tracked(drawn[name], model, twice_predicted(model, scene.interval, 2)))
        rows.append(("29: H times the transition", f"mean error of {name}, km", km(bad.mean), km(score.mean)))
        levels = [f"{each.nees[..., -1].mean():.2f}" for each in (bad, score)]
        rows.append(("29: H times the transition", f"NEES of {name} at the last step", levels[0], levels[1]))
    paper, dropped = list(tests["static"].scores.values())[:2]
    levels = [f"{each.nees[..., -1].mean():.2f}" for each in (paper, dropped)]
    rows.append(("12: missed row := prediction", "NEES of the static filter at the last step", levels[0], levels[1]))
    return wrong(rows)


STUDY = Study(_SIZES, lambda _: _WORK, _run)
"""The reproduction of the paper."""
