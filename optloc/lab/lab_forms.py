"""Short forms of studies and of their results; see `optloc.problem.ShortForm`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.lab.report.sheets import duration, number, percent
from optloc.problem import ShortForm

if TYPE_CHECKING:
    from optloc.lab.study.design import StudyDesign
    from optloc.lab.study.folder import Progress, StudyManifest
    from optloc.lab.study.histories import Histories, Trials
    from optloc.lab.study.paired import Pair
    from optloc.lab.study.profiles import Profiles
    from optloc.lab.study.summary import Difference

Rows = list[tuple[str, str]]

# Methods with their own row; a short form has at most 12 rows.
_METHODS = 9


def _listed(names: Sequence[str], most: int = 3) -> str:
    """Return names as text; of many names, the first names and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _methods(rows: Rows) -> Rows:
    """Return rows of methods, at most `_METHODS` of them, with a row that counts the other methods."""
    others = len(rows) - _METHODS
    return [*rows[:_METHODS], *([("...", f"{others} more method{'s' if others > 1 else ''}")] if others > 0 else [])]


def _design(design: StudyDesign) -> ShortForm:
    """Return the short form of a design: cases, methods, trials and seed."""
    cases = dict.fromkeys(cell.case.key for cell in design.cells)
    methods = list(dict.fromkeys(cell.method.name for cell in design.cells))
    trials = sorted({cell.case.trials for cell in design.cells})
    rows: Rows = [
        ("cases", f"{len(cases)}, each with {' or '.join(map(str, trials))} trials"),
        ("methods", _listed(methods)),
        ("rows", f"{design.rows} in the finished table"),
        ("seed", str(design.study.seed)),
        ("data", design.data[:16]),
    ]
    return ShortForm(
        f"Study: {design.study.title or design.study.name}",
        tuple(rows),
        "optloc.lab.study.execute.run_design(design, folder), design.cells",
    )


def _manifest(manifest: StudyManifest) -> ShortForm:
    """Return the short form of the description of an output folder."""
    rows: Rows = [
        ("methods", _listed(list(dict.fromkeys(manifest.methods.values())))),
        ("rows", f"{manifest.rows} in the finished table"),
        ("seed", str(manifest.seed)),
        ("begun", f"{manifest.created}, optloc {manifest.version}"),
        ("machine", manifest.machine),
    ]
    title = f"Folder of the study: {manifest.title or manifest.name}"
    return ShortForm(title, tuple(rows), "optloc.lab.study.folder.progress(folder), read_frame(folder)")


def _progress(found: Progress) -> ShortForm:
    """Return the short form of the progress of a study: finished rows, and the statuses of each method."""
    state = "complete" if found.complete else f"{found.done} of {found.chunks} parts"
    rows: Rows = [("state", f"{state}, {found.rows} of {found.manifest.rows} rows")]
    by_method: dict[str, Counter[str]] = {}
    for (method, status), count in found.methods.items():
        by_method.setdefault(method, Counter())[status] += count
    texts = [
        (method, ", ".join(f"{count} {status}" for status, count in counts.most_common()))
        for method, counts in by_method.items()
    ]
    rows += _methods(texts)
    title = f"Progress of the study: {found.manifest.title or found.manifest.name}"
    return ShortForm(title, tuple(rows), "progress.counts, progress.failures")


def _profiles(found: Profiles) -> ShortForm:
    """Return the short form of profiles: the share of trials that each method solves, and its median work."""
    count = found.spent.shape[1]
    shown = duration if found.work == "processor" else number
    texts: Rows = []
    for method, spent, solved in zip(found.methods, found.spent, found.solved, strict=True):
        work = spent[solved & np.isfinite(spent)]
        median = f", median {shown(float(np.median(work)))}" if len(work) else ""
        texts.append((method, f"{percent(float(solved.mean()))} % solved{median}"))
    rows: Rows = [("solved", f"cost at most {found.tau:g} above the least known"), ("work", found.work)]
    rows += _methods(texts)
    rows += [("without a count", _listed(found.silent))] if found.silent else []
    title = f"Profiles: {len(found.methods)} methods, {count} of {found.total} trials"
    return ShortForm(title, tuple(rows), "profiles.data(budgets), profiles.performance(ratios)")


def _histories(found: Histories) -> ShortForm:
    """Return the short form of convergence histories: the last height above the least cost for each method."""
    last = found.frame.groupby(["method", "trial"], sort=False, observed=True)["above"].last()
    texts: Rows = []
    for method in found.methods:
        above = last[method].to_numpy(dtype=float)
        median = number(float(np.median(above)))
        texts.append((method, f"{len(above)} trials, ends at a median of {median} above the least cost"))
    rows = _methods(texts)
    rows += [("remark", remark) for remark in found.remarks[:2]]
    following = "optloc.lab.study.histories.reach(histories, tau), histories.frame"
    return ShortForm(f"Convergence histories: {found.title}", tuple(rows), following)


def _trials(found: Trials) -> ShortForm:
    """Return the short form of the trials of histories."""
    rows: Rows = [("methods", _listed([method.name for method in found.methods])), ("trials", str(len(found.least)))]
    rows += [("remark", remark) for remark in found.remarks[:2]]
    return ShortForm(f"Trials: {found.title}", tuple(rows), "optloc.lab.study.histories.histories(trials)")


def _pair(pair: Pair) -> ShortForm:
    """Return the short form of a comparison of two methods on the same trials."""
    error, time = pair.error, pair.time
    rows: Rows = [
        ("case", f"{pair.case}, {pair.noise}"),
        ("trials", str(pair.trials)),
        ("only it right", f"{pair.alone}; only the other right: {pair.other_alone}; p = {pair.p:.2g}"),
        ("error difference", f"{error.value:.2g} m, 95 % interval {error.low:.2g} to {error.high:.2g} m"),
        ("time ratio", f"{time.value:.2g}, 95 % interval {time.low:.2g} to {time.high:.2g}"),
    ]
    return ShortForm(f"Pair: {pair.method} against {pair.against}", tuple(rows))


def _difference(found: Difference) -> ShortForm:
    """Return the short form of the difference of two studies in one cell."""
    one, two = found.one, found.two
    values = "identical" if found.identical else "same data" if found.same_data else "other data"
    rows: Rows = [
        ("answers", f"{percent(one.answered)} and {percent(two.answered)} %, z = {number(found.z)}"),
        ("RMSE", f"{number(one.rmse)} and {number(two.rmse)} m"),
        ("median time", f"{duration(one.seconds)} and {duration(two.seconds)}"),
        ("values", values),
    ]
    return ShortForm(f"Difference of two studies: {', '.join(found.cell)}", tuple(rows))


FORMS: dict[str, Callable[[Any], ShortForm]] = {
    "StudyDesign": _design,
    "StudyManifest": _manifest,
    "Progress": _progress,
    "Profiles": _profiles,
    "Histories": _histories,
    "Trials": _trials,
    "Pair": _pair,
    "Difference": _difference,
}
"""Short forms of the values of this folder, by the name of the class."""
