"""Convergence histories: the cost along the way of a method, against evaluations of it and against iterations.

Two kinds of methods tell it. A minimizer of others is given the cost, and every evaluation is kept. Least squares of
optloc and nonlinear solvers of CasADi are run again and again, stopped after 0, 1, 2 ... iterations: from the same
start by the same arithmetic, so that where each run stops is where the whole one has been. Starts in closed form,
proofs and machine code that does all in one call have no cost on their way, and a sentence says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optloc.engine import depends_on_place, equations_at, refine
from optloc.files import read
from optloc.lab.study.baselines import Baseline, listening, start_of
from optloc.lab.study.folder import design_of_manifest, read_frame, read_manifest
from optloc.lab.study.methods import SETTINGS, StudyMethod, added
from optloc.lab.study.minimizers import baseline_of
from optloc.lab.study.networks import NetworkCase
from optloc.lab.study.profiles import check_accuracy
from optloc.lab.study.simulation import Case, DrawnCase, draw
from optloc.lab.study.summary import case_label, noise_text
from optloc.problem import Array, InvalidProblem, Problem, by_epoch, nearest, separable
from optloc.solvers import (
    FORMULATIONS,
    SOLVERS,
    Choice,
    Method as Pipeline,
    Pool,
    begin,
    counting,
    shortcut,
    solve,
    using,
)

if TYPE_CHECKING:
    import pandas as pd

COUNTS = {"evaluations": "evaluations of the cost", "iterations": "iterations"}
"""What a way is counted in, columns of the table, and what axes call them."""

# Methods that follow a problem file where nobody names one: the usual way in, and three that need a start.
_USUAL = ("gtrs+lsr", "gauss-newton", "scipy", "ipopt")
# Iterations after which a run is stopped: each of the first thirty, far more than a way down takes that is well begun,
# then steps of a tenth, so that one that creeps to a limit of two hundred costs fifty runs.
_EACH, _FARTHER = 30, 1.1
# Steps tried at most, those of the stages of that name.
_DAMPED, _PLAIN = 100, 50


class ConvergenceTrace(NamedTuple):
    """The way of a method on one trial, point by point.

    Parameters
    ----------
    cost : array (q,)
        Cost there; of several candidates the least.
    evaluations, iterations : array (q,)
        How many were made by then, of all candidates and of each; NaN where they are not counted.
    """

    cost: Array
    evaluations: Array
    iterations: Array


@dataclass(frozen=True, slots=True)
class Trials:
    """Trials that methods are followed on.

    Parameters
    ----------
    title : str
        Which trials.
    drawn : DrawnCase
        The trials (n).
    methods : tuple of StudyMethod
        Who is followed.
    least : array (n,)
        Least cost that is known of each trial.
    remarks : tuple of str
        Sentences about methods that are missing.
    """

    title: str
    drawn: DrawnCase
    methods: tuple[StudyMethod, ...]
    least: Array
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Histories:
    """How methods came down.

    Parameters
    ----------
    title : str
        Which trials.
    frame : DataFrame
        Columns: method, trial, evaluations, iterations, cost, best (least so far), above (that less the least known).
    methods : tuple of str
        Those that tell their way, in order.
    remarks : tuple of str
        Sentences about those that do not, or not all of it.
    """

    title: str
    frame: pd.DataFrame
    methods: tuple[str, ...]
    remarks: tuple[str, ...]


def histories(asked: Trials) -> Histories:
    """Return the histories of methods on trials.

    Raises
    ------
    InvalidProblem
        For trials whose costs along a way cannot be compared: with constraints, or weights that depend on the place;
        and where no method tells its way.
    """
    import pandas as pd

    problem = asked.drawn.problem
    if problem.constraints:
        raise InvalidProblem("a cost does not tell how constraints are met", asked.title, "leave the constraints out")
    if depends_on_place(problem):
        what = "the weights of its rows depend on the place, so costs along a way cannot be compared"
        raise InvalidProblem(what, asked.title, "leave the errors of the stations out")
    ways, remarks = {}, list(asked.remarks)
    for method in asked.methods:
        found, remark = trace_of(method, asked.drawn)
        if remark:
            remarks.append(f"{method.name}: {remark}")
        if any(len(way.cost) for way in found):
            ways[method.name] = found
    if not ways:
        why = remarks[0] if remarks else "there is none"
        raise InvalidProblem(f"no method tells its way ({why})", asked.title, "name a minimizer with --method")
    least = np.array(asked.least, dtype=float)
    for found in ways.values():
        least = np.fmin(least, [np.min(way.cost, initial=np.inf) for way in found])
    parts = [_rows(name, trial, way, least[trial]) for name, found in ways.items() for trial, way in enumerate(found)]
    return Histories(asked.title, pd.concat(parts, ignore_index=True), tuple(ways), tuple(remarks))


def _rows(method: str, trial: int, way: ConvergenceTrace, least: float) -> pd.DataFrame:
    import pandas as pd

    best = np.minimum.accumulate(way.cost)
    # Behind the least cost there is rounding alone.
    above = np.maximum(best - least, 0.0)
    counts = {"evaluations": way.evaluations, "iterations": way.iterations}
    return pd.DataFrame({"method": method, "trial": trial, **counts, "cost": way.cost, "best": best, "above": above})


# What they say: medians and quartiles over the trials.


def band(found: Histories, method: str, by: str, at: Array) -> Array:
    """Return the quartiles (3, q) over trials of the best cost so far, above the least known, after so many counts.

    Parameters
    ----------
    found : Histories
        The histories.
    method : str
        One of its methods.
    by : str
        A key of `COUNTS`.
    at : array (q,)
        Counts. A way that has ended stays where it is, one that has not begun is infinitely high.
    """
    rows = found.frame[found.frame["method"] == method]
    levels = []
    for _, way in rows.groupby("trial", sort=True):
        reached = np.searchsorted(way[by].to_numpy(dtype=float), at, side="right")
        levels.append(np.concatenate([[np.inf], way["above"].to_numpy(dtype=float)])[reached])
    # Without interpolation: between a way that has begun and one that has not there is no number.
    return np.asarray(np.quantile(np.stack(levels), (0.25, 0.5, 0.75), axis=0, method="inverted_cdf"))


@dataclass(frozen=True, slots=True)
class Reach:
    """How a method came within an accuracy.

    Parameters
    ----------
    method : str
        The method.
    trials, reached : int
        How many trials, and in how many it came within the accuracy of the least known cost.
    evaluations, iterations : tuple of float, optional
        Quartiles over all trials of how many it took; infinite where fewer trials came there, None where not counted.
    """

    method: str
    trials: int
    reached: int
    evaluations: tuple[float, ...] | None
    iterations: tuple[float, ...] | None


def reach(found: Histories, tau: float) -> list[Reach]:
    """Return how each method came within an accuracy `tau` of the least known cost."""
    check_accuracy(tau)
    out = []
    for name in found.methods:
        rows = found.frame[found.frame["method"] == name]
        trials = rows["trial"].nunique()
        first = rows[rows["above"] <= tau].groupby("trial")[list(COUNTS)].first()
        took = {by: np.full(trials, np.inf) for by in COUNTS}
        for by in COUNTS:
            took[by][: len(first)] = first[by]
        quartiles = {
            by: None
            if rows[by].isna().any()
            else tuple(np.quantile(values, (0.25, 0.5, 0.75), method="inverted_cdf").tolist())
            for by, values in took.items()
        }
        out.append(Reach(name, trials, len(first), quartiles["evaluations"], quartiles["iterations"]))
    return out


# One method on some trials.


def trace_of(method: StudyMethod, drawn: DrawnCase) -> tuple[list[ConvergenceTrace], str]:
    """Return the way of a method on each trial, empty where it tells none, and what it does not tell in words."""
    if method.baseline is None:
        assert method.method is not None
        return _by_stopping(Pipeline.parse(method.method), drawn.problem, None, _choice(method))
    baseline = baseline_of(method.baseline)
    start = start_of(method.start, method.width, drawn)
    if not baseline.method:
        return _by_listening(baseline, drawn, start)
    return _by_stopping(Pipeline.parse(baseline.method), drawn.problem, start, _choice(method))


def _choice(method: StudyMethod) -> Choice:
    """Return the nonlinear solver of a method; IPOPT is what stages take by themselves."""
    named = method.solver if method.solver and "max_iter" in SETTINGS.get(method.solver, {}) else "ipopt"
    return Choice("nonlinear", named, method.settings if named == method.solver else {})


def _by_listening(baseline: Baseline, drawn: DrawnCase, start: Array) -> tuple[list[ConvergenceTrace], str]:
    ways, failed = [], ""
    for i in range(len(start)):
        kept: list[float] = []
        with listening(lambda _, cost, kept=kept: kept.append(cost)), np.errstate(all="ignore"):  # type: ignore[misc]
            try:
                baseline.run(drawn.part(i, 1), start[i : i + 1])
            except (Exception, SystemExit) as error:  # noqa: BLE001  (what it asked for until then is its way)
                failed = f"{type(error).__name__}: {error}".splitlines()[0]
        # What is no number is above everything.
        cost = np.nan_to_num(np.array(kept), nan=np.inf)
        ways.append(ConvergenceTrace(cost, np.arange(1.0, len(cost) + 1.0), np.full(len(cost), np.nan)))
    if not any(len(way.cost) for way in ways):
        return ways, "it asks for no cost on its way" + (f" ({failed})" if failed else "")
    return ways, f"it ended with an error in some trial ({failed})" if failed else ""


class _Steps(NamedTuple):
    """Candidates (m,) on their way: cost (q, m) after counts (q,), how many each took, and whether one is one cost."""

    at: Array
    cost: Array
    took: Array
    counted: bool


def _by_stopping(
    method: Pipeline, problem: Problem, start: Array | None, choice: Choice
) -> tuple[list[ConvergenceTrace], str]:
    words, n = list(method.words), problem.batch_shape[0]
    pool = None if start is None else begin(problem, start)
    known = {word for formulation in FORMULATIONS.values() for word in formulation.starts}
    if pool is None and words[0] in known:
        pool = SOLVERS[words[0]].run(problem, None)
        words = words[1:]
    if pool is None:
        return [_nowhere()] * n, f"{words[0]} has no cost on its way"
    parts: list[list[ConvergenceTrace]] = []
    while words and words[0] in _FOLLOWED and (steps := _FOLLOWED[words[0]](problem, pool, choice)) is not None:
        parts.append(_ways(n, pool, steps))
        pool = SOLVERS[words.pop(0)].run(problem, pool)
    if not parts and start is not None:
        return [_nowhere()] * n, f"{words[0]} has no cost on its way here"
    if not parts:  # a start in closed form
        parts.append(_ways(n, pool, _stay(problem, pool)))
    ways = [_joined([part[i] for part in parts]) for i in range(n)]
    rest = "+".join(words) + (" and what takes over from it" if words and method.then else "")
    if rest:
        return ways, f"shown until {rest}, which has no cost on its way"
    # In a study the same is one call of machine code, which begins where it likes.
    return ways, "shown stage by stage; machine code that does both at once has no cost on its way" * shortcut(method)


def _nowhere() -> ConvergenceTrace:
    return ConvergenceTrace(*(np.zeros(0) for _ in ConvergenceTrace._fields))


def _ways(n: int, pool: Pool, steps: _Steps) -> list[ConvergenceTrace]:
    """Return the way of each trial: of its candidates, which go side by side, the best one at each count."""
    item, _ = pool.occupied
    out = []
    for i in range(n):
        own = item == i
        if not own.any():
            out.append(_nowhere())
            continue
        most = steps.took[own].max()
        last = int(np.searchsorted(steps.at, most)) + 1
        at, cost = np.minimum(steps.at[:last], most), np.nan_to_num(steps.cost[:last, own], nan=np.inf)
        # Each step tried is one evaluation, and so is the start of each candidate.
        made = 1.0 + np.minimum(at[:, None], steps.took[own])
        out.append(
            ConvergenceTrace(cost.min(1), made.sum(1) if steps.counted else np.full(last, np.nan), at.astype(float))
        )
    return out


def _joined(parts: Sequence[ConvergenceTrace]) -> ConvergenceTrace:
    """Return ways one behind the other as one."""
    out = parts[0]
    for more in parts[1:]:
        before = [values[-1] if len(values) else 0.0 for values in out[1:]]
        shifted = [values + last for values, last in zip(more[1:], before, strict=True)]
        out = ConvergenceTrace(*(np.concatenate(pair) for pair in zip(out, (more.cost, *shifted), strict=True)))
    return out


def _counts(most: int) -> Array:
    """Return the counts after which a run is stopped, the last one `most`."""
    farther = _EACH * _FARTHER ** np.arange(1, 2 + max(0, int(np.log(max(most, 1) / _EACH) / np.log(_FARTHER))))
    found = np.union1d(np.arange(_EACH + 1), farther.astype(int))
    return np.append(found[found < most], most)


def _stay(problem: Problem, pool: Pool) -> _Steps:
    """Return candidates that go nowhere."""
    item, slot = pool.occupied
    cost = _cost(problem.take(item), pool.x[item, slot])
    return _Steps(np.zeros(1, dtype=int), cost[None], np.zeros(len(item), dtype=int), counted=True)


def _cost(problem: Problem, x: Array) -> Array:
    with np.errstate(all="ignore"):
        return np.asarray(equations_at(problem, x).cost)


def _least_squares(problem: Problem, pool: Pool, choice: Choice, *, damped: bool, limit: int) -> _Steps:
    """Return the way of damped Gauss-Newton steps, or of plain ones: each is one evaluation with derivatives."""
    item, slot = pool.occupied
    x = pool.x[item, slot]
    run = partial(refine, problem, x, item=item, damped=damped)
    end = run(limit=limit)
    at = _counts(int(end.iterations.max(initial=0)))
    cost = [_cost(problem.take(item), x), *(run(limit=int(k)).cost for k in at[1:])]
    return _Steps(at, np.stack(cost), end.iterations, counted=True)


def _nonlinear(problem: Problem, pool: Pool, choice: Choice) -> _Steps | None:
    """Return the way of IPOPT, or of another solver of CasADi: an iteration may try several points on a line.

    Of long runs it solves averages of blocks, whose costs are others: None.
    """
    item, slot = pool.occupied
    part = problem.take(item)
    start = begin(part, pool.x[item, slot])

    def stop(limit: int | None) -> tuple[Array, list[int]]:
        limited = choice.settings if limit is None else {**choice.settings, "max_iter": limit}
        with using(Choice("nonlinear", choice.name, limited)), counting() as tally:
            x = SOLVERS["nlp"].run(part, start).x[:, 0]
        # Where least squares has the last word, costs are those of another problem until then.
        return _cost(part, x), [count if name == choice.name else -1 for name, count in tally]

    _, took = stop(None)
    if len(took) != len(item) or min(took, default=0) < 0:
        return None
    at = _counts(max(took, default=0))
    cost = [_cost(part, start.x[:, 0]), *(stop(int(k))[0] for k in at[1:])]
    return _Steps(at, np.stack(cost), np.array(took), counted=False)


_Follow = Callable[[Problem, Pool, Choice], _Steps | None]
_FOLLOWED: dict[str, _Follow] = {
    "lsr": partial(_least_squares, damped=True, limit=_DAMPED),
    "taylor": partial(_least_squares, damped=False, limit=_PLAIN),
    "nlp": _nonlinear,
}


# From a study's folder, or a problem file, to its trials.


def trials_of(
    place: Path, names: Sequence[str], count: int, case: str | None = None, noise: str | None = None
) -> Trials:
    """Return what is asked of a study's folder, or of the epochs of a problem file.

    Parameters
    ----------
    place : Path
        Output folder of a study, or a problem file.
    names : sequence of str
        Methods beside those of the study, as `optloc.lab.study.methods.added` takes them; of a file all.
    count : int
        Trials at most: the first ones.
    case, noise : str, optional
        Which trials of a study; the first case and the first noise level by default.

    Raises
    ------
    InvalidProblem
        For a folder or a file that cannot be read, and for what it does not hold.
    """
    return _of_study(place, names, count, case, noise) if place.is_dir() else _of_file(place, names, count)


def _of_study(folder: Path, names: Sequence[str], count: int, case: str | None, noise: str | None) -> Trials:
    manifest = read_manifest(folder)
    design = design_of_manifest(manifest)
    if design is None:
        raise InvalidProblem("a problem file of the study cannot be read any more", str(folder), "put it back")
    cells: dict[str, dict[str, Case | NetworkCase]] = {}
    for cell in design.cells:
        own = cells.setdefault(case_label(cell.case.table.name, cell.case.sweep), {})
        own.setdefault(noise_text(cell.case.label), cell.case)
    title = _chosen(case, cells, "case")
    level = _chosen(noise, cells[title], "noise")
    wanted = cells[title][level]
    if isinstance(wanted, NetworkCase):
        raise InvalidProblem(f"{title} is of networks, which have no histories", str(folder), "name a case of fixes")
    drawn, least = _known(folder, wanted, count)
    methods = {cell.method.name: cell.method for cell in design.cells if not cell.method.reference}
    methods |= {method.name: method for method in added(names)}
    known = {*methods, *(cell.method.name for cell in design.cells)}
    missing = tuple(
        f"{name}: it was added to the folder; name it with --method, and it is followed"
        for name in dict.fromkeys(manifest.methods.values())
        if name not in known
    )
    return Trials(f"{title}, {level}", drawn, tuple(methods.values()), least, missing)


def _chosen(word: str | None, known: Mapping[str, object], what: str) -> str:
    names = list(known)
    if word is None:
        return names[0]
    if word not in names:
        raise InvalidProblem(f"there is no {what} {word!r}", f"--{what}", nearest(word, names))
    return word


def _known(folder: Path, case: Case, count: int) -> tuple[DrawnCase, Array]:
    """Return the first trials of a case, and the least cost that the study knows of each."""
    rows = read_frame(folder, "scenario sweep noise_label trial data cost cost_truth".split())
    rows = rows[
        (rows["scenario"] == case.table.name) & (rows["sweep"] == case.sweep) & (rows["noise_label"] == case.label)
    ]
    if not len(rows):
        raise InvalidProblem("nothing of this case is finished yet", str(folder), "run the study")
    rows = rows.assign(least=np.fmin(rows["cost"] - rows["gap"], rows["cost_truth"]))
    by_trial = rows.groupby("trial", sort=True).agg(data=("data", "first"), least=("least", "min"))[:count]
    if list(by_trial.index) != list(range(len(by_trial))):
        raise InvalidProblem("its first trials are not all there yet", str(folder), "wait until it is complete")
    drawn = draw(case, 0, len(by_trial))
    if drawn.digest != tuple(map(str, by_trial["data"])):
        what = "the study holds other data than are drawn here"
        raise InvalidProblem(what, str(folder), "use the versions that its manifest names, or run it again")
    return drawn, by_trial["least"].to_numpy(dtype=float)


def _of_file(file: Path, names: Sequence[str], count: int) -> Trials:
    loaded = read(file)
    problem = by_epoch(loaded.problem).flat() if separable(loaded.problem) else loaded.problem.flat()
    kept = np.arange(min(count, problem.batch_shape[0]))
    problem, n = problem.take(kept), len(kept)
    places = [slot.name for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    if len(places) != 1:
        what = f"{len(places)} positions are sought"
        raise InvalidProblem(what, str(file), "give one target, static or of one motion for the whole run")
    # A place beside the stations' centre, always the same, where methods begin that need a start.
    wild = np.random.default_rng(0).uniform(-0.5, 0.5, (n, problem.dimension))
    nothing = np.full((n, problem.layout.size), np.nan)
    drawn = DrawnCase(problem, nothing, wild, ("",) * n, ("",) * n, np.zeros(n, dtype=int), places[0])
    least = solve(problem).cost
    return Trials(loaded.title or file.name, drawn, tuple(added(names or _USUAL)), np.asarray(least))
