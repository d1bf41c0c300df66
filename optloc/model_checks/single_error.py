"""The single systematic error that explains most of the misfit of a run, by score tests.

A parameter vector has `size` numbers: first the unknowns that all epochs share, then the local unknowns of each epoch.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias
from optloc.model_checks.score import Candidate, Explained, explain_misfit
from optloc.problem.bias import family
from optloc.problem.epochs import by_epoch, has_correlated_epochs, separable, some_epochs
from optloc.problem.fix import Fix
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem

# Largest number of rows of a run that are tested: lasting errors are visible in them, and tests of all channels of more
# rows take seconds.
_MAX_ROWS = 2000


def explained(problem: Problem, fix: Fix) -> Problem | None:
    """Return a problem with one more unknown: the systematic error that explains most of the misfit of its fix.

    The given problem does not change. Solve the larger problem and compare. An error that exists is estimated together
    with the other unknowns. Without an error, a test reports one in a thousand runs.

    Parameters
    ----------
    problem : Problem
        One problem or run.
    fix : Fix
        Its fix, or the fixes (k,) of a run whose epochs share nothing.

    Returns
    -------
    Problem or None
        The error is its last bias. The name of the bias states its form and its channel, such as "drift of R2". None if
        no single error explains the misfit.

    Raises
    ------
    InvalidProblem
        If the fix is not a fix of this problem, or if the problem is a batch.

    References
    ----------
    C. R. Rao, Math. Proc. Cambridge Philos. Soc. 44 (1948): the score test; see
    `optloc.model_checks.score.explain_misfit`.
    """
    return explained_at(problem, fix.x)


def explained_at(problem: Problem, x: Array) -> Problem | None:
    """Return the result of `explained` at `x`: a fix (size,), or fixes (k, size of an epoch) of separate epochs."""
    if problem.batch_shape:
        raise InvalidProblem("a batch of problems was given", "explained", "call it for each problem")
    part, x = _shortened(*without_unknown(problem.flat(), joined_vector(problem, np.asarray(x))))
    explanations = explain_misfit(part, x)
    if not explanations:
        return None
    return replace(problem, biases=(*problem.biases, _bias_of_run(problem, explanations[0].candidate)))


def misfit_of(problem: Problem, x: Array) -> str:
    """Return a sentence about the error that explains most of the misfit of a run at its fix `x` (size,).

    `problem` is a flat batch of one run. If no error of one station explains the misfit, the sentence states this.
    """
    part, x = _shortened(*without_unknown(problem, x[None]))
    explanations = explain_misfit(part, x)
    if not explanations:
        return "no error of a single station explains the misfit"
    (value, unit), one = _size(part, explanations[0]), explanations[0]
    article = _noun(one.candidate).split()[0]
    return f"{article} {one.candidate.name}, {value} {unit}, would explain it (p = {one.p_after:.2g})"


def _bias_of_run(problem: Problem, candidate: Candidate) -> Bias:
    """Return the bias of a candidate over all rows of a run; the test used only some of the rows.

    A step or burst affects only the rows between its start and its end. A step has the end NaN, which no time reaches.
    """
    members = (candidate.bias.members[0],) if candidate.per == "station" else None
    rows, names, kind = problem.rows, problem.stations.names, candidate.kind or None
    bias = family(rows, names, candidate.name, per=candidate.per, form=candidate.bias.form, kind=kind, members=members)
    if not np.isfinite(candidate.since):
        return bias
    when = problem.times[problem.epoch[bias.row]]
    inside = (when >= candidate.since) & ~(when >= candidate.until)
    return replace(bias, row=bias.row[inside], member=bias.member[inside], coefficient=bias.coefficient[inside])


def joined_vector(problem: Problem, x: Array) -> Array:
    """Return the parameter vector (1, size) of a problem at `x`.

    `x` is (size,) or (1, size). If the epochs of the problem share nothing, `x` may also hold k separate fixes
    (k, size of an epoch). The function joins these fixes.
    """
    layout = problem.layout
    if x.size == layout.size and x.ndim < 3 and not (separable(problem) and len(x) == problem.epochs > 1):
        return x.reshape(1, -1)
    if not separable(problem) or x.shape != (problem.epochs, by_epoch(problem).layout.size):
        raise InvalidProblem(
            f"a fix of shape {x.shape} does not belong to this problem", "fix", "give the fix of this problem"
        )
    epoch_layout = by_epoch(problem).layout
    parts = [epoch_layout.take(x, slot.name).reshape(problem.epochs, -1) for slot in layout.local]
    return np.concatenate(parts, axis=1).reshape(1, -1)


def _shortened(problem: Problem, x: Array) -> tuple[Problem, Array]:
    """Return a problem with at most about `_MAX_ROWS` rows, and its vector, to limit the time of the tests.

    The epochs that remain are spread evenly over the run. Errors can grow with the run: the first epochs alone would
    not show a slow drift or an error that starts late. `x` (1, size) belongs to the whole run.
    """
    if problem.count <= _MAX_ROWS or problem.epochs == 1 or has_correlated_epochs(problem):
        return problem, x
    kept = max(2, int(problem.epochs * _MAX_ROWS / problem.count))
    chosen = np.unique(np.linspace(0, problem.epochs - 1, kept).round().astype(int))
    # omit epochs without rows
    chosen = chosen[np.isin(chosen, problem.epoch)]
    n, length = problem.layout.n_shared, problem.layout.n_local
    local = x[:, n:].reshape(len(x), problem.epochs, length)[:, chosen]
    return some_epochs(problem, chosen), np.concatenate([x[:, :n], local.reshape(len(x), -1)], axis=1)


def without_unknown(problem: Problem, x: Array) -> tuple[Problem, Array]:
    """Return the problem without values that are not finite and without epochs that have no fix, and a finite vector.

    These rows stay in the arrays with weight zero. In the vector (1, size), an epoch without a fix gets the mean of the
    local unknowns of the other epochs. `x` (1, size) is the vector before.
    """
    weight = np.where(np.isfinite(problem.z), problem.weight, 0.0)
    n, length = problem.layout.n_shared, problem.layout.n_local
    if problem.epochs > 1 and length and np.isfinite(x[:, :n]).all():
        own = x[:, n:].reshape(-1, length)
        unfixed = np.asarray(~np.isfinite(own).all(-1))
        if unfixed.any() and not unfixed.all():
            weight = np.where(unfixed[problem.epoch], 0.0, weight)
            own = np.where(unfixed[:, None], np.mean(own[~unfixed], axis=0), own)
            x = np.concatenate([x[:, :n], own.reshape(1, -1)], axis=1)
    # an absent value may have any size, but the arithmetic must not meet NaN
    rows = problem.with_rows(z=np.where(np.isfinite(problem.z), problem.z, 0.0), weight=weight)
    return rows, x


# Sentences about the result of a score test.


def _noun(candidate: Candidate) -> str:
    """Return the noun of a candidate with its article, for instance "a drift"."""
    return {"step": "a step", "burst": "a burst of errors"}.get(candidate.form) or form_of(candidate.bias).noun


def _size(problem: Problem, explanation: Explained) -> tuple[str, str]:
    """Return the estimate of an error with its standard deviation as text, and its unit.

    Angles are in degrees and scales in percent; all other errors are in SI units.
    """
    si_unit = _unit(problem, explanation)
    unit, scale = (si_unit.replace("rad", "deg"), np.degrees(1.0)) if "rad" in si_unit else (si_unit, 1.0)
    if form_of(explanation.candidate.bias).enters == "scales":
        unit, scale = "%", 100.0
    pairs = [f"{scale * v:+.4g} ± {scale * s:.2g}" for v, s in zip(explanation.value, explanation.sigma, strict=True)]
    return ", ".join(pairs), unit


def _unit(problem: Problem, explanation: Explained) -> str:
    """Return the SI unit of a systematic error."""
    larger = replace(problem, biases=(*problem.biases, explanation.candidate.bias))
    return larger.layout.find(explanation.candidate.bias.name)[0].unit
