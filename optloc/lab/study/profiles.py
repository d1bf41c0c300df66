"""Data and performance profiles of a study's methods: shares of trials solved to an accuracy within a given work.

A data profile is a share of trials against work. A performance profile is a share of trials against work divided by the
least work of any method on the same trial.

Moré and Wild require a share of the descent from a start that all solvers have in common. Methods without a start have
no descent. But the cost of a fix has a unit: one is the square of a standard deviation. So here a trial is solved if
the cost exceeds the least known by at most tau. The point is then within sqrt(tau) standard deviations of the minimum.

Sources: J. J. Moré and S. M. Wild, "Benchmarking derivative-free optimization algorithms", SIAM J. Optim. 20 (2009),
for data profiles; E. D. Dolan and J. J. Moré, "Benchmarking optimization software with performance profiles",
Math. Program. 91 (2002).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.lab.study.summary import above_least, instances, performance_profile
from optloc.problem import Array, HasShortForm, InvalidProblem, nearest

if TYPE_CHECKING:
    import pandas as pd


TAU = 1e-3
"""A trial is solved if its cost exceeds the least known by at most this: the square of 0.03 standard deviations."""

RATIOS = (1.0, 2.0, 10.0)
"""Multiples of the least work of any method; tables give the share that is solved within each."""

WORK = {"processor": "processor time of a fix (s)", "evaluations": "evaluations of the cost"}
"""Units of work: columns of a study's table, and labels of axes."""

# Clocks resolve nanoseconds at best, so a time of zero is less.
_LEAST = 1e-9
# Points of a curve in files: more than a picture resolves.
_POINTS = 200


@dataclass(frozen=True, slots=True, repr=False)
class Profiles(HasShortForm):
    """Trials that methods solve, and their work.

    Parameters
    ----------
    tau : float
        A trial is solved if its cost exceeds the least known by at most this value.
    work : str
        A key of `WORK`, which states the unit.
    methods : tuple of str
        Methods; the method with the most solved trials is first, then the method with the least work.
    silent : tuple of str
        Methods that do not count this work.
    spent : array (methods, n)
        Work on each trial, in the unit of `work`; infinite if unknown.
    solved : bool array (methods, n)
        Whether the trial is solved.
    total : int
        Number of all trials, also of those that some method did not run.
    """

    tau: float
    work: str
    methods: tuple[str, ...]
    silent: tuple[str, ...]
    spent: Array
    solved: Array
    total: int

    @property
    def budgets(self) -> Array:
        """Return the amounts of work (q,) at which the data profile of some method rises, sorted.

        At most 200 of them are returned, with the least and the largest.
        """
        work = np.unique(self.spent[self.solved])
        chosen = np.unique(np.linspace(0, len(work) - 1, min(_POINTS, len(work))).astype(int))
        return np.asarray(work[chosen])

    def data(self, budgets: Array) -> Array:
        """Return the share (methods, q) of the trials that each method solves with at most the work `budgets` (q,)."""
        return data_profile(self.spent, self.solved, budgets)

    def performance(self, ratios: Array) -> Array:
        """Return the share (methods, q) of the trials that each method solves within multiples of the least work.

        `ratios` (q,) are the multiples of the least work of any method on the trial.
        """
        return performance_profile(self.spent, self.solved, ratios)


@dataclass(frozen=True, slots=True)
class SolvedShare:
    """Solved trials of one method.

    Parameters
    ----------
    method : str
        The method.
    trials, solved : int
        Number of trials, and number of solved ones.
    within : dict of float to float
        Share solved within multiples of the least work on each trial, by multiple.
    median : float
        Median work on a solved trial.
    """

    method: str
    trials: int
    solved: int
    within: dict[float, float]
    median: float


def profiles(frame: pd.DataFrame, *, tau: float = TAU, work: str = "processor", out: Collection[str] = ()) -> Profiles:
    """Return the profiles of a study's methods over the trials that all of them ran.

    Parameters
    ----------
    frame : DataFrame
        Rows with the columns `optloc.lab.study.summary.COLUMNS` and `gap`.
    tau : float
        A trial is solved at this cost above the least known, of all methods and of the truth, or less. The status does
        not matter.
    work : str
        A key of `WORK`.
    out : collection of str
        Methods to leave out, because they know the truth.

    Raises
    ------
    InvalidProblem
        If the accuracy is not positive, the work is unknown, or no method counts it.
    """
    check_accuracy(tau)
    if work not in WORK:
        raise InvalidProblem(f"there is no work {work!r}", "--work", nearest(work, list(WORK)))
    rivals = frame[~frame["method"].astype(str).isin(out)]
    if not len(rivals):
        raise InvalidProblem("all methods know the truth", "profiles", "add a method that does not know the truth")
    above, rounding = above_least(rivals)
    with np.errstate(invalid="ignore"):
        rows = rivals.assign(solved=above <= tau + rounding, work=rivals[work].clip(lower=_LEAST))
    known = rows.groupby(rows["method"].astype(str))["work"].count()
    methods = [str(name) for name in known.index[known > 0]]
    if not methods:
        raise InvalidProblem(f"no method of the study counts {work}", "--work", "use --work processor")
    # The work of a failed trial is unknown; the trial counts as not solved.
    counted = rows[rows["method"].astype(str).isin(methods)].fillna({"work": np.inf})
    spent, solved, total = instances(counted, methods, "work", "solved")
    solved &= np.isfinite(spent)
    # Most solved trials first; then the least median work; then the name.
    order = sorted(range(len(methods)), key=lambda i: (-int(solved[i].sum()), _median(spent[i][solved[i]]), methods[i]))
    silent = tuple(str(name) for name in known.index[known == 0])
    return Profiles(tau, work, tuple(methods[i] for i in order), silent, spent[order], solved[order], total)


def check_accuracy(tau: float) -> None:
    """Raise InvalidProblem for an accuracy that is not positive and finite."""
    if not 0.0 < tau < np.inf:
        raise InvalidProblem(f"the accuracy {tau:g} is not positive and finite", "--tau", "give a cost such as 1e-3")


def data_profile(spent: Array, solved: Array, budgets: Array) -> Array:
    """Return the share of problems that each method solves within budgets of work: equation 2.8 of Moré and Wild.

    Parameters
    ----------
    spent : array (methods, n)
        Work on each problem.
    solved : bool array (methods, n)
        Whether the method solved the problem; otherwise its work does not matter.
    budgets : array (q,)
        Work, in the unit of `spent`.

    Returns
    -------
    array (methods, q)
        Shares of all n problems, including those that no method solves; NaN for n = 0.
    """
    if not spent.shape[-1]:
        return np.full((len(spent), len(budgets)), np.nan)
    needed = np.sort(np.where(solved, spent, np.inf), axis=-1)
    return np.stack([np.searchsorted(row, budgets, side="right") / len(row) for row in needed])


def shares(profile: Profiles) -> list[SolvedShare]:
    """Return the solved trials of each method, and the shares that it solves within the multiples `RATIOS`."""
    within = profile.performance(np.array(RATIOS))
    return [
        SolvedShare(
            name,
            profile.spent.shape[1],
            int(profile.solved[i].sum()),
            dict(zip(RATIOS, within[i].tolist(), strict=True)),
            _median(profile.spent[i][profile.solved[i]]),
        )
        for i, name in enumerate(profile.methods)
    ]


def _median(values: Array) -> float:
    """Return the median of values, infinite without values."""
    return float(np.median(values)) if len(values) else float("inf")
