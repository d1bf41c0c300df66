"""Tables and figures of the paper in Missiles and Space Vehicles 2024/5: printed, reproduced, bound, theory.

`optloc.lab.papers.kinematic` defines the letters in shapes. NEES is the normalised estimation error squared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from optloc.lab.papers.kinematic import (
    FILTERS,
    LOST,
    ORDERS,
    PLAIN,
    Association,
    KinematicDraw,
    KinematicScenario,
    KinematicScore,
    association,
    batch,
    bounds,
    draw,
    fixes,
    mean_error,
    predict_twice,
    score_track,
    taylor,
    theory,
    track_all,
    weighting,
)
from optloc.lab.papers.report import Ink, Report, Size, Study, Tick, canvas, explain, label, percent, tabulate, typeset
from optloc.problem import Array, Motion, cut
from optloc.show import ABSENT, TextTable
from optloc.solvers import solve
from optloc.tracking import parallel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Values printed in table 1 of the paper.

ERROR = {"static": 0.982, "CV on CV": 0.591, "CV on CA": 10.618, "CA on CA": 0.781}
"""Mean position error, kilometres: static algorithm and target, and scenes 1 to 3."""

SECONDS = {"static": 0.402, "CV on CV": 0.444, "CV on CA": 0.467, "CA on CA": 0.450}
"""Computing time, milliseconds."""


# The tables.


@dataclass(frozen=True, slots=True)
class TableLine:
    """One line of table 1.

    Parameters
    ----------
    name : str
        Algorithm and motion.
    score : KinematicScore
        Errors.
    bound : float or None
        Bound of the mean error, metres; None if the model is wrong.
    seconds : float
        Computing time of one run of three targets, as a share of the batch.
    key : str, optional
        Key of the printed line in `ERROR` and `SECONDS`; None for a line that is not printed.
    """

    name: str
    score: KinematicScore
    bound: float | None
    seconds: float
    key: str | None = None


def km(value: float) -> str:
    """Return metres as kilometres with three decimals, or fewer for large numbers; a dash if not finite."""
    if not np.isfinite(value):
        return ABSENT
    size = 1e-3 * value
    return f"{size:.3f}" if size < 100.0 else f"{size:.3g}" if size < 1000.0 else f"{size:.0f}"


def table_errors(lines: Sequence[TableLine]) -> TextTable:
    """Return table 1 of the paper: errors, bounds and computing times by algorithm and motion."""
    header = ("algorithm on motion", "printed", "reproduced", "standard error", "bound", "printed ms", "ms")
    rows = []
    for line in lines:
        printed = ("", "") if line.key is None else (f"{ERROR[line.key]:.3f}", f"{SECONDS[line.key]:.3f}")
        bound = ABSENT if line.bound is None else km(line.bound)
        lengths = (km(line.score.mean), km(line.score.spread), bound)
        rows.append((line.name, printed[0], *lengths, printed[1], f"{1e3 * line.seconds:.3f}"))
    return tabulate("table-1", header, rows)


def table_ratios(fix: KinematicScore, matched: Mapping[str, KinematicScore], steps: int) -> TextTable:
    """Return a table of the ratios of filter errors to the error of a single fix, which do not depend on the noise.

    `fix` are the errors of single fixes. `matched` are the errors of each filter on the motion of its model, by model.
    `steps` is the number of updates.
    """
    rows = []
    for name, score in matched.items():
        ratios = (ERROR[f"{name} on {name}"] / ERROR["static"], score.mean / fix.mean, theory(ORDERS[name], steps))
        rows.append((f"{name} / fix", *(f"{ratio:.3f}" for ratio in ratios)))
    return tabulate("ratios", ("", "printed", "reproduced", "theory"), rows)


def table_efficiency(drawn: Mapping[str, KinematicDraw]) -> TextTable:
    """Return a table of the rms errors at the last step of filter, iterated filter and batch, with the bound."""
    rows = []
    for name in ("CV", "CA"):
        data, order = drawn[name], ORDERS[name]
        last_bounds = bounds(data.scenario, data.truth, order)[:, -1]
        bound = float(np.sqrt(np.trace(last_bounds, axis1=-2, axis2=-1).mean()))
        filtered, iterated = (score_track(data, track_all(data, PLAIN[order], update)) for update in ("ekf", "iekf"))
        lengths = (filtered.last, iterated.last, batch(data, order).last, bound)
        rows.append((name, *map(km, lengths), f"{filtered.last / bound:.3f}", f"{filtered.level:.2f}"))
    header = ("model on its own motion", "EKF", "IEKF", "batch ML", "bound", "EKF / bound", "NEES of the EKF")
    return tabulate("efficiency", header, rows)


def table_models(found: Mapping[str, Sequence[KinematicScore]]) -> TextTable:
    """Return a table of mean errors; `found` has the scores on CV, CA and the changing motion, by filter."""
    header = ("filter", "CV", "CA", f"CV, CA from step {_HALFWAY}")
    return tabulate("models", header, [(name, *(km(each.mean) for each in scores)) for name, scores in found.items()])


def table_choice(found: Mapping[str, Array]) -> TextTable:
    """Return a table of the shares of runs that choose the right model, by motion and step; `found` has arrays (k,)."""
    rows = [(name, *(f"{100.0 * shares[step - 1]:.1f}" for step in _STEPS)) for name, shares in found.items()]
    return tabulate("choice", ("motion", *(f"step {step}" for step in _STEPS)), rows)


def table_association(found: Mapping[str, Association]) -> TextTable:
    """Return a table of the errors and lost tracks of the rules of association, by motion."""
    rows = []
    for motion, test in found.items():
        for rule, score in test.scores.items():
            median = float(np.median(score.nees[..., -1]))
            rows.append(
                (motion, rule, km(score.mean), _three_digits(median), _three_digits(score.level), percent(score.lost))
            )
    return tabulate("association", ("motion", "rule", "mean error", "median NEES", "mean NEES", "lost"), rows)


def _three_digits(value: float) -> str:
    """Return a number as text, with an exponent from 100 on."""
    return f"{value:.2f}" if abs(value) < 100.0 else f"{value:.2g}".replace("e+0", "e").replace("e+", "e")


def table_equations(
    seed: int,
    drawn: Mapping[str, KinematicDraw],
    matched: Mapping[str, KinematicScore],
    tests: Mapping[str, Association],
) -> TextTable:
    """Return a table of the effects of the printed equations and of their corrected form.

    A matched filter has the model of the target's motion: static, CV (constant velocity) or CA (constant acceleration).
    `drawn` and `matched` are the draws and the errors of the matched filters, by motion. `tests` are the association
    tests.
    """
    # One row for each equation in the list of the page that can be run.
    rows: list[tuple[str, ...]] = [*_steps_of_a_fix(seed, drawn["static"])]
    scene = drawn["static"].scenario
    # Differences share the reference station: each of the two arrivals has half the variance.
    shared = scene.sigma**2 / 2.0 * (np.eye(3) + 1.0)
    epoch = cut(replace(scene.problem(), motions=(Motion(0),)), 0, 1)
    costs = weighting(epoch, scene.position[0], shared)
    rows.append(("5: H'H called BLUE", "error of a fix, shared reference, km", *map(km, costs)))
    for name, score in matched.items():
        model = PLAIN[ORDERS[name]]
        printed = score_track(drawn[name], track_all(drawn[name], model, predict_twice(model, scene.interval, 2)))
        what = "29: H times the transition"
        rows.append((what, f"mean error of {name}, km", km(printed.mean), km(score.mean)))
        rows.append((what, f"NEES of {name} at the last step", f"{printed.level:.2f}", f"{score.level:.2f}"))
    # The first two rules of the test differ only in the treatment of a missed row.
    levels = [f"{score.level:.2f}" for score in list(tests["static"].scores.values())[:2]]
    rows.append(("12: missed row := prediction", "NEES of the static filter at the last step", *levels))
    return tabulate("equations", ("equation", "measured", "as printed", "corrected"), rows)


def _steps_of_a_fix(seed: int, drawn: KinematicDraw) -> Iterator[tuple[str, str, str, str]]:
    """Yield the rows of the table of equations for the linearised fix: shares of runs that converge.

    The sign of the residual is the printed one (backward) or the right one (forward).
    """
    first_epoch = cut(drawn.runs, 0, 1)
    fix, near = solve(first_epoch).position, np.array([1e3, 1e3])
    rng = np.random.default_rng(np.random.SeedSequence((seed, 9)))
    random_starts = _RANDOM_WIDTH * (2.0 * rng.random(fix.shape) - 1.0)
    results = (
        taylor(first_epoch, near, sign=-1.0),
        taylor(first_epoch, near),
        taylor(first_epoch, np.asarray(random_starts)),
    )
    with np.errstate(invalid="ignore", over="ignore"):
        shares = [percent(float((np.linalg.norm(result - fix, axis=-1) < _SAME).mean())) for result in results]
    backward, forward, far = shares
    yield "8, 15: sign of the residual", "steps from (1, 1) km that reach the fix", backward, forward
    yield "8: sign corrected", "steps from anywhere (±1000 km), and from (1, 1) km", far, forward


# The figures: tracks and errors of the three scenes, models, association.

_COLOURS = (Ink.BLUE, Ink.RED, Ink.GREEN, Ink.PINK)


def figure_scene(drawn: KinematicDraw, position: Array, score: KinematicScore, bound: Array | None) -> Figure:
    """Return a figure of one run in the plane, and the mean error of each target against the step.

    Parameters
    ----------
    drawn : KinematicDraw
        The truth.
    position : array (n, t, k, 2)
        Estimates, metres.
    score : KinematicScore
        Their errors.
    bound : array (t, k, 2, 2), optional
        Covariance bound at the same steps.
    """
    figure = canvas(11.0, 4.8)
    plane, ax = figure.subplots(1, 2)
    steps = np.arange(1, score.error.shape[-1] + 1)
    for target in range(len(drawn.truth)):
        colour = _COLOURS[target]
        true_track, estimates = 1e-3 * drawn.truth[target, :, :2], 1e-3 * position[0, target]
        plane.plot(*true_track.T, color=colour, lw=1.2)
        plane.plot(*estimates.T, "o", color=colour, mfc="none", ms=4, label=f"target {target + 1}")
        plane.plot(*true_track[0], "s", color=colour, ms=6)
        ax.plot(
            steps, 1e-3 * score.error[:, target].mean(0), "o-", color=colour, ms=4, lw=0.8, label=f"target {target + 1}"
        )
        if bound is not None:
            name = "bound" if target == len(bound) - 1 else None
            ax.plot(steps, 1e-3 * mean_error(bound[target]), color=Ink.BLACK, lw=0.8, ls="--", label=name)
    plane.set_title("one run: line and square the truth, circles the filter")
    label(plane, "x, km", "y, km")
    plane.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"mean error of {len(score.error)} runs")
    _steps(ax, "mean position error, km")
    for each in (plane, ax):
        each.legend(frameon=False)
    return figure


def figure_models(found: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """Return a figure of the mean probability of each model against the step, one panel for each motion.

    `found` has arrays (k, q) by motion, `names` are the q models.
    """
    figure = canvas(4.0 * len(found), 3.8)
    panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for ax, (motion, shares) in zip(panels, found.items(), strict=True):
        for i, name in enumerate(names):
            style = ("o-", "s-", "^-")[i % 3]
            ax.plot(np.arange(1, len(shares) + 1), shares[:, i], style, color=_COLOURS[i], ms=4, lw=1, label=name)
        ax.set_title(f"truth: {motion}")
        _steps(ax, "mean probability of the model" if ax is panels[0] else "")
    explain(figure)
    return figure


def figure_losses(found: Mapping[str, KinematicScore]) -> Figure:
    """Return a figure of the share of lost tracks against the step; `found` is by rule."""
    figure = canvas(7.0, 4.6)
    ax = figure.subplots()
    for i, (rule, score) in enumerate(found.items()):
        lost = 100.0 * (score.error > LOST).mean((0, 1))
        style = ("o-", "s--", "^-", "x-")[i % 4]
        ax.plot(np.arange(1, len(lost) + 1), lost, style, color=_COLOURS[i % 4], ms=4, lw=1, label=rule)
    _steps(ax, "tracks more than 10 km off, %")
    explain(figure, 2)
    return figure


def _steps(ax: Axes, up: str) -> None:
    """Label a panel whose x axis is the step; `up` is the label of the y axis."""
    label(ax, "step", up)
    ax.set_xticks(range(0, 21, 5))


# All results of the paper, in a quick and in a full size.

_STEPS = (1, 2, 3, 4, 5, 10, 20)  # the model is chosen in the first five steps
_HALFWAY = 10  # step from which the targets of the last column of `table_models` accelerate
_SAME = 1.0  # metres within which steps have reached the fix, whose error is a kilometre
_RANDOM_WIDTH = 1e6  # metres around the origin for random starts: twice the distance of the targets
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class KinematicSample:
    """Numbers of trials.

    Parameters
    ----------
    trials : int
        Runs of three targets each.
    mixed : int
        Runs of the association test.
    """

    trials: int
    mixed: int


# Both give the mean errors to one per cent or better; the paper has 100 runs. Association takes most of the time.
_SIZES: dict[Size, KinematicSample] = {"quick": KinematicSample(500, 300), "full": KinematicSample(2000, 1000)}
_WORK = 11  # calls of `tick` below


def _run(sample: KinematicSample, seed: int, tick: Tick) -> Report:
    """Return the report of all simulations with the sizes `sample`; call `tick` after each simulation."""
    scene = KinematicScenario()

    def done(value: T) -> T:
        tick()
        return value

    # Motions: static, CV (constant velocity), CA (constant acceleration), with the order 0, 1 or 2.
    drawn = {name: done(draw(scene, scene.course(i), sample.trials, (seed, i))) for name, i in ORDERS.items()}
    # Keys 0 to 2 draw the motions, 3 the changing motion, 4 and 5 the association test, 9 the random starts.
    half = float(scene.times[_HALFWAY])
    late = done(draw(scene, scene.course(2, since=half), sample.trials, (seed, 3)))
    lines, scenes = done(_scenes(drawn))
    matched = {"CV": lines[2].score, "CA": lines[4].score}
    compared = done({f.name: [f.run(d) for d in (drawn["CV"], drawn["CA"], late)] for f in FILTERS})
    chosen = done({name: _chosen_models(each, ORDERS[name]) for name, each in drawn.items()})
    tests = {
        name: done(association(scene, ORDERS[name], sample.mixed, (seed, 4 + i)))
        for i, name in enumerate(("static", "CV"))
    }
    tables = (
        table_errors(lines),
        table_ratios(lines[0].score, matched, scene.steps),
        done(table_efficiency(drawn)),
        table_models(compared),
        table_choice({name: right for name, (right, _) in chosen.items()}),
        table_association(tests),
        done(table_equations(seed, drawn, matched, tests)),
    )
    shares = {name: mean for name, (_, mean) in chosen.items()}
    more = {"models": figure_models(shares, tuple(ORDERS)), "association": figure_losses(tests["CV"].scores)}
    return typeset("kinematic", sample, seed, tables, {**scenes, **more})


def _timed(work: Callable[[], T], runs: int) -> tuple[T, float]:
    """Return the result of `work`, and the seconds for one of its `runs` runs."""
    began = perf_counter()
    result = work()
    return result, (perf_counter() - began) / runs


def _scenes(drawn: Mapping[str, KinematicDraw]) -> tuple[list[TableLine], dict[str, Figure]]:
    """Return the lines of table 1, and figures 2 to 4 by file name; `drawn` are the draws by motion."""
    # Times are shares of a batch: the cost of one run among many, without the overhead of calls.
    static = drawn["static"]
    scene, runs = static.scenario, len(static.runs.z)
    fix_score, seconds = _timed(partial(fixes, static), runs * scene.steps)
    static_bounds = bounds(scene, static.truth, 0)
    lines = [TableLine("one fix on static", fix_score, _mean_of_bounds(static_bounds[:, :1]), seconds, "static")]
    track, seconds = _timed(partial(track_all, static, PLAIN[0]), runs)
    lines.append(
        TableLine(
            "static, 20 updates, on static", score_track(static, track), _mean_of_bounds(static_bounds[:, 1:]), seconds
        )
    )
    figures = {}
    for number, (model, motion) in enumerate((("CV", "CV"), ("CV", "CA"), ("CA", "CA")), 2):
        data, order = drawn[motion], ORDERS[model]
        track, seconds = _timed(partial(track_all, data, PLAIN[order]), runs)
        score = score_track(data, track)
        bound = bounds(scene, data.truth, order)[:, 1:] if model == motion else None
        name = f"{model} on {motion}"
        lines.append(TableLine(name, score, None if bound is None else _mean_of_bounds(bound), seconds, name))
        figures[f"figure-{number}"] = figure_scene(data, track.position, score, bound)
    return lines, figures


def _mean_of_bounds(cov: Array) -> float:
    """Return the mean error in the plane, averaged over covariances (..., 2, 2) in m^2, metres."""
    return float(mean_error(cov).mean())


def _chosen_models(drawn: KinematicDraw, right: int) -> tuple[Array, Array]:
    """Return the share of runs that choose the right model (k,), and the mean probability of each model (k, q).

    The model with the largest likelihood is chosen at each step. The filters of the q models of `PLAIN` run in
    parallel. `right` is the index of the right model.
    """
    scene = drawn.scenario
    models = parallel(drawn.runs, drawn.fix, PLAIN, speed=scene.speed, rate=scene.rate, update="ekf")
    return (models.choice == right).mean((0, 1)), models.probability.mean((0, 1))


STUDY = Study(_SIZES, lambda _: _WORK, _run)
"""The reproduction of the paper."""
