"""Convergence histories: the cost along the iterations of a method, against evaluations and against iterations.

Histories exist for two kinds of methods. An external minimizer calls the cost, and every value is recorded. Least
squares of optloc and nonlinear solvers of CasADi are run again and again, and stopped after 0, 1, 2 ... iterations.
They repeat the same arithmetic from the same start, so the ends of the short runs are the points of the long run.
Starts in closed form, proofs and machine code that does everything in one call have no history; a remark reports this.

Letters in shapes: n trials, q points of a history, m candidates. A candidate is one starting point: a method may refine
several candidates of a trial in parallel. A count is a number of evaluations or iterations.
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
from optloc.lab.study.folder import read_frame, read_manifest
from optloc.lab.study.methods import SETTINGS, StudyMethod, added
from optloc.lab.study.minimizers import baseline_of
from optloc.lab.study.networks import NetworkCase
from optloc.lab.study.problem_copies import design_of_manifest
from optloc.lab.study.profiles import check_accuracy
from optloc.lab.study.simulation import Case, DrawnCase, draw
from optloc.lab.study.summary import case_label, noise_text
from optloc.problem import Array, HasShortForm, InvalidProblem, Problem, by_epoch, nearest, separable
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
"""Counts of a history: columns of the table, and labels of axes."""

# Default methods for a problem file: the usual method, and three that need a start.
_DEFAULT_METHODS = ("gtrs+lsr", "gauss-newton", "scipy", "ipopt")
# Iterations after which a run is stopped: each of the first thirty, which is more than a well-started method needs.
# Then in steps of a tenth, so that a slow run to a limit of two hundred costs fifty runs.
_EVERY_ITERATION, _GROWTH = 30, 1.1
# Most steps, the same as in the stages `lsr` and `taylor`.
_DAMPED, _PLAIN = 100, 50


class ConvergenceTrace(NamedTuple):
    """History of a method on one trial, point by point.

    Parameters
    ----------
    cost : array (q,)
        Cost at each point; with several candidates the least of their costs.
    evaluations, iterations : array (q,)
        Counts up to the point: evaluations of all candidates together, iterations of each candidate. NaN if they are
        not counted.
    """

    cost: Array
    evaluations: Array
    iterations: Array


@dataclass(frozen=True, slots=True, repr=False)
class Trials(HasShortForm):
    """Trials and methods whose histories `histories` computes.

    Parameters
    ----------
    title : str
        Title of the trials.
    drawn : DrawnCase
        The trials (n).
    methods : tuple of StudyMethod
        The methods.
    least : array (n,)
        Least known cost of each trial.
    remarks : tuple of str
        Sentences about missing methods.
    """

    title: str
    drawn: DrawnCase
    methods: tuple[StudyMethod, ...]
    least: Array
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, repr=False)
class Histories(HasShortForm):
    """Convergence histories of methods.

    Parameters
    ----------
    title : str
        Title of the trials.
    frame : DataFrame
        Columns: method, trial, evaluations, iterations, cost, best (least so far), above (best less the least known).
    methods : tuple of str
        Methods with a history, in order.
    remarks : tuple of str
        Sentences about methods without a complete history.
    """

    title: str
    frame: pd.DataFrame
    methods: tuple[str, ...]
    remarks: tuple[str, ...]


def histories(trials: Trials) -> Histories:
    """Return the histories of methods on trials.

    Raises
    ------
    InvalidProblem
        If no method has a history, or the costs of a history cannot be compared: with constraints, or with noise
        weights that depend on the position.
    """
    import pandas as pd

    problem = trials.drawn.problem
    if problem.constraints or problem.fences:
        what = "a cost does not show whether constraints are met, and the histories leave out fences"
        raise InvalidProblem(what, trials.title, "remove the constraints and fences")
    if depends_on_place(problem):
        what = "the noise weights depend on the position, so costs of a history cannot be compared"
        raise InvalidProblem(what, trials.title, "remove the errors of the stations")
    traces, remarks = {}, list(trials.remarks)
    for method in trials.methods:
        of_method, remark = trace_of(method, trials.drawn)
        if remark:
            remarks.append(f"{method.name}: {remark}")
        if any(len(trace.cost) for trace in of_method):
            traces[method.name] = of_method
    if not traces:
        reason = remarks[0] if remarks else "there is no method"
        raise InvalidProblem(f"no method has a history ({reason})", trials.title, "name a minimizer with --method")
    # A history may reach a cost below the lowest known cost. `fmin` ignores NaN, the mark of an unknown cost.
    least = np.array(trials.least, dtype=float)
    for of_method in traces.values():
        least = np.fmin(least, [np.min(trace.cost, initial=np.inf) for trace in of_method])
    parts = [
        _table_rows(name, trial, trace, least[trial])
        for name, of_method in traces.items()
        for trial, trace in enumerate(of_method)
    ]
    return Histories(trials.title, pd.concat(parts, ignore_index=True), tuple(traces), tuple(remarks))


def _table_rows(method: str, trial: int, trace: ConvergenceTrace, least: float) -> pd.DataFrame:
    """Return the history of one trial as rows of the table of `Histories`; `least` is its least known cost."""
    import pandas as pd

    best = np.minimum.accumulate(trace.cost)
    # A negative difference is a rounding error.
    above = np.maximum(best - least, 0.0)
    counts = {"evaluations": trace.evaluations, "iterations": trace.iterations}
    return pd.DataFrame({"method": method, "trial": trial, **counts, "cost": trace.cost, "best": best, "above": above})


# Medians and quartiles of histories over the trials.


def band(found: Histories, method: str, by: str, at: Array) -> Array:
    """Return the quartiles over trials of the cost that a method has reached after given counts.

    Parameters
    ----------
    found : Histories
        The histories.
    method : str
        One of its methods.
    by : str
        A key of `COUNTS`: evaluations or iterations.
    at : array (q,)
        Counts. A history keeps its last cost after its end, and is infinite before its start.

    Returns
    -------
    array (3, q)
        First quartile, median and third quartile of the best cost so far, less the least known cost of the trial.
    """
    rows = found.frame[found.frame["method"] == method]
    costs = []
    for _, history in rows.groupby("trial", sort=True):
        reached = np.searchsorted(history[by].to_numpy(dtype=float), at, side="right")
        costs.append(np.concatenate([[np.inf], history["above"].to_numpy(dtype=float)])[reached])
    # Without interpolation, because costs before the start of a history are infinite.
    return np.asarray(np.quantile(np.stack(costs), (0.25, 0.5, 0.75), axis=0, method="inverted_cdf"))


@dataclass(frozen=True, slots=True)
class Reach:
    """Number of trials in which a method reaches an accuracy, and the work to reach it.

    Parameters
    ----------
    method : str
        The method.
    trials, reached : int
        Number of trials, and number of trials in which the cost comes within the accuracy of the least known cost.
    evaluations, iterations : tuple of float, optional
        Quartiles over all trials of the count at which the accuracy is reached. They are infinite for trials that do
        not reach it, and None if the method does not count.
    """

    method: str
    trials: int
    reached: int
    evaluations: tuple[float, ...] | None
    iterations: tuple[float, ...] | None


def reach(found: Histories, tau: float) -> list[Reach]:
    """Return for each method the number of trials within `tau` of the least known cost, and the work to get there.

    `tau` is a difference of costs.
    """
    check_accuracy(tau)
    results = []
    for name in found.methods:
        rows = found.frame[found.frame["method"] == name]
        trials = rows["trial"].nunique()
        first = rows[rows["above"] <= tau].groupby("trial")[list(COUNTS)].first()
        work = {by: np.full(trials, np.inf) for by in COUNTS}
        for by in COUNTS:
            # The other trials stay infinite. The order does not matter for quartiles.
            work[by][: len(first)] = first[by]
        quartiles = {
            by: None
            if rows[by].isna().any()
            else tuple(np.quantile(values, (0.25, 0.5, 0.75), method="inverted_cdf").tolist())
            for by, values in work.items()
        }
        results.append(Reach(name, trials, len(first), quartiles["evaluations"], quartiles["iterations"]))
    return results


# History of one method on some trials.


def trace_of(method: StudyMethod, drawn: DrawnCase) -> tuple[list[ConvergenceTrace], str]:
    """Return the history of a method on each trial, and a remark about missing parts.

    A method without a history has empty histories. The remark is empty if nothing is missing.
    """
    if method.baseline is None:
        assert method.method is not None
        return _record_stopped_runs(Pipeline.parse(method.method), drawn.problem, None, _choice(method))
    baseline = baseline_of(method.baseline)
    start = start_of(method.start, method.width, drawn)
    if not baseline.method:
        return _record_evaluations(baseline, drawn, start)
    return _record_stopped_runs(Pipeline.parse(baseline.method), drawn.problem, start, _choice(method))


def _choice(method: StudyMethod) -> Choice:
    """Return the nonlinear solver of a method, with its settings.

    IPOPT is used if the method names no solver whose iterations can be limited.
    """
    named = method.solver if method.solver and "max_iter" in SETTINGS.get(method.solver, {}) else "ipopt"
    return Choice("nonlinear", named, method.settings if named == method.solver else {})


def _record_evaluations(baseline: Baseline, drawn: DrawnCase, start: Array) -> tuple[list[ConvergenceTrace], str]:
    """Return the costs that an external minimizer evaluates, trial by trial, and a remark.

    `start` are the starting vectors (n, size) of the trials.
    """
    traces, failed = [], ""
    for i in range(len(start)):
        costs: list[float] = []
        with listening(lambda _, cost, costs=costs: costs.append(cost)), np.errstate(all="ignore"):  # type: ignore[misc]
            try:
                baseline.run(drawn.part(i, 1), start[i : i + 1])
            except (Exception, SystemExit) as error:  # noqa: BLE001  (the history ends before the error)
                failed = f"{type(error).__name__}: {error}".splitlines()[0]
        # NaN counts as worse than every number.
        cost = np.nan_to_num(np.array(costs), nan=np.inf)
        traces.append(ConvergenceTrace(cost, np.arange(1.0, len(cost) + 1.0), np.full(len(cost), np.nan)))
    if not any(len(trace.cost) for trace in traces):
        return traces, "it evaluates no cost" + (f" ({failed})" if failed else "")
    return traces, f"it ended with an error in at least one trial ({failed})" if failed else ""


class _Steps(NamedTuple):
    """Costs of m candidates after some numbers of iterations.

    `at` (q,) are the numbers of iterations, `cost` (q, m) are the costs, and `took` (m,) are the iterations of each
    candidate until its end. `counted` is True if each iteration is one evaluation of the cost.
    """

    at: Array
    cost: Array
    took: Array
    counted: bool


def _record_stopped_runs(
    method: Pipeline, problem: Problem, start: Array | None, choice: Choice
) -> tuple[list[ConvergenceTrace], str]:
    """Return the costs of runs that stop after growing numbers of iterations, trial by trial, and a remark.

    `start` are the starting vectors (n, size) of a baseline; with None, the first stage of the method makes the
    candidates. `choice` is the nonlinear solver. `problem` is a batch of n trials. Histories without points mean that
    the method has no history.
    """
    stages, n = list(method.words), problem.batch_shape[0]
    # A pool contains the candidates of all trials. `known` are the names of stages that need no start.
    pool = None if start is None else begin(problem, start)
    known = {word for formulation in FORMULATIONS.values() for word in formulation.starts}
    if pool is None and stages[0] in known:
        pool = SOLVERS[stages[0]].run(problem, None)
        stages = stages[1:]
    if pool is None:
        return [_empty_trace()] * n, f"{stages[0]} has no history"
    # Record a stage from the candidates of the stage before, then run it in full. End at a stage without a history.
    parts: list[list[ConvergenceTrace]] = []
    while stages and stages[0] in _STAGES and (steps := _STAGES[stages[0]](problem, pool, choice)) is not None:
        parts.append(_traces(n, pool, steps))
        pool = SOLVERS[stages.pop(0)].run(problem, pool)
    if not parts and start is not None:
        return [_empty_trace()] * n, f"{stages[0]} has no history for this problem"
    if not parts:  # a start in closed form
        parts.append(_traces(n, pool, _no_steps(problem, pool)))
    traces = [_joined([part[i] for part in parts]) for i in range(n)]
    rest = "+".join(stages) + (" and its fallback" if stages and method.then else "")
    if rest:
        return traces, f"shown until {rest}, which has no history"
    # In a study the same method is one call of machine code, which may choose another start.
    return traces, "shown stage by stage; machine code that runs both stages at once has no history" * shortcut(method)


def _empty_trace() -> ConvergenceTrace:
    """Return the history of a trial without points."""
    return ConvergenceTrace(*(np.zeros(0) for _ in ConvergenceTrace._fields))


def _traces(n: int, pool: Pool, steps: _Steps) -> list[ConvergenceTrace]:
    """Return the history of each of n trials: after each iteration, the least cost of the candidates of the trial.

    All candidates of a trial advance at the same time.
    """
    # `item` (m,) is the trial of each candidate.
    item, _ = pool.occupied
    traces = []
    for i in range(n):
        members = item == i
        if not members.any():
            traces.append(_empty_trace())
            continue
        longest = steps.took[members].max()
        # The points up to the first count at which all candidates of the trial have ended.
        last = int(np.searchsorted(steps.at, longest)) + 1
        at, cost = np.minimum(steps.at[:last], longest), np.nan_to_num(steps.cost[:last, members], nan=np.inf)
        # Each step is one evaluation, and so is the start of each candidate.
        evaluations = 1.0 + np.minimum(at[:, None], steps.took[members])
        traces.append(
            ConvergenceTrace(
                cost.min(1), evaluations.sum(1) if steps.counted else np.full(last, np.nan), at.astype(float)
            )
        )
    return traces


def _joined(parts: Sequence[ConvergenceTrace]) -> ConvergenceTrace:
    """Return consecutive histories of a trial as one history, with counts that continue."""
    joined = parts[0]
    for part in parts[1:]:
        last_counts = [values[-1] if len(values) else 0.0 for values in joined[1:]]
        shifted = [values + offset for values, offset in zip(part[1:], last_counts, strict=True)]
        # Costs are joined as they are; counts that are NaN stay NaN.
        joined = ConvergenceTrace(*(np.concatenate(pair) for pair in zip(joined, (part.cost, *shifted), strict=True)))
    return joined


def _counts(most: int) -> Array:
    """Return the numbers of iterations after which a run is stopped, sorted; the last number is `most`."""
    later = _EVERY_ITERATION * _GROWTH ** np.arange(
        1, 2 + max(0, int(np.log(max(most, 1) / _EVERY_ITERATION) / np.log(_GROWTH)))
    )
    found = np.union1d(np.arange(_EVERY_ITERATION + 1), later.astype(int))
    return np.append(found[found < most], most)


def _no_steps(problem: Problem, pool: Pool) -> _Steps:
    """Return the costs of candidates that no iteration moves, as one point."""
    item, slot = pool.occupied
    cost = _cost(problem.take(item), pool.x[item, slot])
    return _Steps(np.zeros(1, dtype=int), cost[None], np.zeros(len(item), dtype=int), counted=True)


def _cost(problem: Problem, x: Array) -> Array:
    """Return the costs of problems (m,) at the vectors x (m, size)."""
    with np.errstate(all="ignore"):
        return np.asarray(equations_at(problem, x).cost)


def _least_squares(problem: Problem, pool: Pool, choice: Choice, *, damped: bool, limit: int) -> _Steps:
    """Return the costs along damped or plain Gauss-Newton steps; each step is one evaluation with derivatives.

    `limit` is the greatest number of steps. `choice` is not used: all recorders of `_STAGES` have it.
    """
    # `item` (m,) is the trial of each candidate, and `slot` (m,) its place in the pool.
    item, slot = pool.occupied
    x = pool.x[item, slot]
    run = partial(refine, problem, x, item=item, damped=damped)
    end = run(limit=limit)
    at = _counts(int(end.iterations.max(initial=0)))
    cost = [_cost(problem.take(item), x), *(run(limit=int(k)).cost for k in at[1:])]
    return _Steps(at, np.stack(cost), end.iterations, counted=True)


def _nonlinear(problem: Problem, pool: Pool, choice: Choice) -> _Steps | None:
    """Return the costs along the iterations of IPOPT or of another solver of CasADi.

    One iteration may evaluate several points on a line. Return None for long runs: there the stage solves problems of
    averaged blocks, whose costs are not comparable.
    """
    item, slot = pool.occupied
    flat = problem.take(item)
    start = begin(flat, pool.x[item, slot])

    def run_until(limit: int | None) -> tuple[Array, list[int]]:
        limited = choice.settings if limit is None else {**choice.settings, "max_iter": limit}
        with using(Choice("nonlinear", choice.name, limited)), counting() as tally:
            x = SOLVERS["nlp"].run(flat, start).x[:, 0]
        # If least squares follows, the solver minimises the cost of another problem; evaluate the cost of this one.
        return _cost(flat, x), [count if name == choice.name else -1 for name, count in tally]

    # One count for each candidate, if the stage has solved one program for each. A count of -1 marks another solver.
    _, iterations = run_until(None)
    if len(iterations) != len(item) or min(iterations, default=0) < 0:
        return None
    at = _counts(max(iterations, default=0))
    cost = [_cost(flat, start.x[:, 0]), *(run_until(int(k))[0] for k in at[1:])]
    return _Steps(at, np.stack(cost), np.array(iterations), counted=False)


_Recorder = Callable[[Problem, Pool, Choice], _Steps | None]
_STAGES: dict[str, _Recorder] = {
    "lsr": partial(_least_squares, damped=True, limit=_DAMPED),
    "taylor": partial(_least_squares, damped=False, limit=_PLAIN),
    "nlp": _nonlinear,
}


# Trials of a study's folder or of a problem file.


def trials_of(
    place: Path, names: Sequence[str], count: int, case: str | None = None, noise: str | None = None
) -> Trials:
    """Return trials and methods from a study's folder, or from the epochs of a problem file.

    Parameters
    ----------
    place : Path
        Output folder of a study, or a problem file.
    names : sequence of str
        Methods as `optloc.lab.study.methods.added` takes them. They are added to the methods of a study; a problem
        file has no other methods.
    count : int
        Most trials, from the first on.
    case, noise : str, optional
        Case and noise level of a study; by default the first case and the first level.

    Raises
    ------
    InvalidProblem
        If a folder or a file cannot be read, or does not have the case.
    """
    return (
        _trials_of_study(place, names, count, case, noise) if place.is_dir() else _trials_of_file(place, names, count)
    )


def _trials_of_study(folder: Path, names: Sequence[str], count: int, case: str | None, noise: str | None) -> Trials:
    """Return trials and methods of a study for one case and noise level; arguments as `trials_of`."""
    manifest = read_manifest(folder)
    design = design_of_manifest(manifest, folder)
    if design is None:
        advice = "continue the study, which copies its problem files, or add --outside"
        raise InvalidProblem("a problem file of the study is missing or invalid", str(folder), advice)
    cells: dict[str, dict[str, Case | NetworkCase]] = {}
    for cell in design.cells:
        levels = cells.setdefault(case_label(cell.case.table.name, cell.case.sweep), {})
        levels.setdefault(noise_text(cell.case.label), cell.case)
    title = _chosen(case, cells, "case")
    level = _chosen(noise, cells[title], "noise")
    chosen = cells[title][level]
    if isinstance(chosen, NetworkCase):
        raise InvalidProblem(f"{title} has networks, which have no histories", str(folder), "choose another case")
    drawn, least = _finished_trials(folder, chosen, count)
    methods = {cell.method.name: cell.method for cell in design.cells if not cell.method.reference}
    methods |= {method.name: method for method in added(names)}
    known = {*methods, *(cell.method.name for cell in design.cells)}
    # Methods of the folder that are neither in the study file nor among `names`.
    missing = tuple(
        f"{name}: the method was added to the folder; name it with --method to include it"
        for name in dict.fromkeys(manifest.methods.values())
        if name not in known
    )
    return Trials(f"{title}, {level}", drawn, tuple(methods.values()), least, missing)


def _chosen(wanted: str | None, known: Mapping[str, object], what: str) -> str:
    """Return the name `wanted`, or the first known name if it is None; raise InvalidProblem if it is unknown.

    `what` is the option of the command that selects the name.
    """
    names = list(known)
    if wanted is None:
        return names[0]
    if wanted not in names:
        raise InvalidProblem(f"there is no {what} {wanted!r}", f"--{what}", nearest(wanted, names))
    return wanted


def _finished_trials(folder: Path, case: Case, count: int) -> tuple[DrawnCase, Array]:
    """Return the first trials of a case, at most `count`, and the least known cost (n,) of each in the study."""
    rows = read_frame(folder, "scenario sweep noise_label trial data cost cost_truth".split())
    rows = rows[
        (rows["scenario"] == case.table.name) & (rows["sweep"] == case.sweep) & (rows["noise_label"] == case.label)
    ]
    if not len(rows):
        raise InvalidProblem("this case has no finished part yet", str(folder), "run the study")
    # Cost less gap is the lowest cost of all methods, and the truth also counts.
    rows = rows.assign(least=np.fmin(rows["cost"] - rows["gap"], rows["cost_truth"]))
    by_trial = rows.groupby("trial", sort=True).agg(data=("data", "first"), least=("least", "min"))[:count]
    if list(by_trial.index) != list(range(len(by_trial))):
        raise InvalidProblem("its first trials are not all finished yet", str(folder), "wait until it is complete")
    drawn = draw(case, 0, len(by_trial))
    if drawn.digest != tuple(map(str, by_trial["data"])):
        what = "the data of the study differ from a new simulation"
        raise InvalidProblem(what, str(folder), "use the versions that its manifest names, or run it again")
    return drawn, by_trial["least"].to_numpy(dtype=float)


def _trials_of_file(file: Path, names: Sequence[str], count: int) -> Trials:
    """Return the epochs of a problem file as trials; their least known costs are the costs of their fixes."""
    loaded = read(file)
    problem = by_epoch(loaded.problem).flat() if separable(loaded.problem) else loaded.problem.flat()
    kept = np.arange(min(count, problem.batch_shape[0]))
    problem, n = problem.take(kept), len(kept)
    positions = [slot.name for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    if len(positions) != 1:
        what = f"it has {len(positions)} unknown positions"
        raise InvalidProblem(what, str(file), "give one target, static or with one motion for the whole run")
    # A fixed point near the stations' centre, for methods that need a start. The truth is unknown: NaN.
    wild = np.random.default_rng(0).uniform(-0.5, 0.5, (n, problem.dimension))
    truth = np.full((n, problem.layout.size), np.nan)
    drawn = DrawnCase(problem, truth, wild, ("",) * n, ("",) * n, np.zeros(n, dtype=int), positions[0])
    least = solve(problem).cost
    return Trials(loaded.title or file.name, drawn, tuple(added(names or _DEFAULT_METHODS)), np.asarray(least))
