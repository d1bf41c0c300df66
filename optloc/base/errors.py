"""Exceptions of optloc: malformed input is an error, a problem without an answer is data.

A well-posed call that finds no trustworthy answer returns a fix whose status says so; only
``fix.require()`` turns that status into :class:`NoSolution`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from typing import Any

import numpy as np

from optloc.base.types import Status

__all__ = ["NUMERICAL", "InvalidProblem", "NoSolution", "OptlocError", "nearest"]

# What arithmetic raises where numbers are at fault and not the program: those of numpy and scipy, of floating point and
# of solvers (`formulations.backend.SolverError`). All else is a programming error, and surfaces.
NUMERICAL: tuple[type[Exception], ...] = (np.linalg.LinAlgError, ArithmeticError)


class OptlocError(Exception):
    """Base class of every exception that optloc raises on purpose."""


class InvalidProblem(OptlocError, ValueError):  # noqa: N818  (named for what the caller handed over)
    """The input cannot be read as a problem; the message names the culprit.

    Parameters
    ----------
    what : str
        What is wrong, with the offending value: ``"latitude 95 deg is outside -90 to 90 deg"``.
    where : str, optional
        The place: a file, a file and row, a column or an argument.
    advice : str, optional
        What to do about it.

    Notes
    -----
    ``str(error)`` is one sentence, ``where: what; advice.``
    """

    def __init__(self, what: str, where: str | None = None, advice: str | None = None) -> None:
        # Only positional arguments survive pickling on their way back from a worker process.
        super().__init__(what, where, advice)
        self.what = what
        self.where = where
        self.advice = advice

    def __str__(self) -> str:
        """Return the sentence."""
        place = f"{_shown(self.where)}: " if self.where else ""
        advice = f"; {_shown(self.advice.strip().rstrip('.'), 4 * _SHOWN)}" if self.advice else ""
        return f"{place}{_shown(self.what.strip().rstrip('.'))}{advice}."


# Characters of a place and of what is wrong there, some three lines: a file may put a megabyte where a name belongs.
# Advice may list what is known.
_SHOWN = 300


def _shown(text: str, most: int = _SHOWN) -> str:
    """Return a text without what is in its middle, where it is long."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


class NoSolution(OptlocError):  # noqa: N818  (a verdict about the problem)
    """A fix was required but its status is not a clean one, or it has too little redundancy.

    Parameters
    ----------
    problem : Problem
        The problem that was to be solved.
    fix : Fix
        The fix that was refused; its status, alternatives and certificate say why.
    why : str, optional
        Why a fix with a clean status was refused.

    Notes
    -----
    ``str(error)`` is `why`, or else the sentence of ``fix.status``, with its advice; a batch gives each distinct one
    once.
    """

    def __init__(self, problem: Any, fix: Any, why: str = "") -> None:
        # Only positional arguments survive pickling on their way back from a worker process.
        super().__init__(problem, fix, why)
        self.problem = problem
        self.fix = fix
        self.why = why

    def __str__(self) -> str:
        """Return why, or the sentence of the status; of a batch, one sentence a distinct status."""
        if self.why:
            return self.why
        status = getattr(self.fix, "status", None)
        if status is None:
            return "There is no fix."
        # A dictionary instead of a set keeps the order in which the verdicts occur in the batch.
        verdicts = {Status(int(code)): None for code in np.ravel(status)}
        refused = [verdict.sentence for verdict in verdicts if verdict is not Status.OK]
        return " ".join(refused or [verdict.sentence for verdict in verdicts])


# So many names are still read, and so many are looked through in the time of a keystroke.
_FEW, _MANY = 20, 5000


def nearest(word: str, known: Iterable[str]) -> str:
    """Return advice for an unknown word: the nearest known ones, then all of them where they are few.

    Parameters
    ----------
    word : str
        What the user wrote.
    known : iterable of str
        What would have been understood.

    Returns
    -------
    str
        ``"did you mean 'km'? known are m, km"``.
    """
    names = list(islice(known, _MANY))
    word = str(word)[:_SHOWN]
    folded = {name.lower(): name for name in names}
    close = [repr(folded[name]) for name in _alike(word.lower(), folded)]
    hint = f"did you mean {' or '.join(close)}?" if close else ""
    more = f" and {len(names) - _FEW} more" if len(names) > 2 * _FEW else ""
    listed = "" if close and len(names) > _FEW else f"known are {', '.join(names[:_FEW] if more else names)}{more}"
    return " ".join(part for part in (hint, listed) if part)


def check_once(names: Iterable[str], what: str, where: str) -> None:
    """Refuse names of which one is there twice; `what` says so of "{!r}"."""
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InvalidProblem(what.format(twice), where, "rename one of them")


def no_station(
    name: object, where: str | None, known: Iterable[str], error: type[InvalidProblem] = InvalidProblem
) -> InvalidProblem:
    """Return the error of a name that no station has, with the nearest that there are."""
    return error(f"there is no station {name!r}", where, nearest(str(name), known))


def _alike(word: str, known: Iterable[str]) -> list[str]:
    """Return up to two names that a word was perhaps meant to be; none for a single letter, which may be anything."""
    names = list(known)
    if word.strip() in names:  # it differs by case, or by blanks at its ends
        return [word.strip()]
    begun = [name for name in names if len(word) > 2 and name.startswith(word)][:2]
    # Half of the letters alike is chance, but for names of one length, such as R5 and R6.
    same = [name for name in names if len(name) == len(word)]
    found = get_close_matches(word, names, n=2, cutoff=0.6) or begun or get_close_matches(word, same, n=2, cutoff=0.5)
    return found if len(word) > 1 else []


def status_named(label: str) -> Status:
    """Return the status of a label such as "too few rows"; raise InvalidProblem for one that there is not."""
    wanted = label.strip().lower().replace("_", " ").replace("-", " ")
    for status in Status:
        if status.label == wanted:
            return status
    raise InvalidProblem(f"there is no status {label!r}", "status", nearest(label, [one.label for one in Status]))


# The redundancy that a fix must have.


def whole_redundancy(redundancy: Any) -> int:
    """Return a redundancy that is asked for; raise InvalidProblem where it is no whole number."""
    if isinstance(redundancy, bool) or not isinstance(redundancy, int | np.integer) or redundancy < 0:
        raise InvalidProblem(f"{redundancy!r} is no redundancy", "redundancy", "give a whole number: 0, 1, 2, ...")
    return int(redundancy)


def too_weak(fix: Any, weak: Any, wanted: int) -> str:
    """Return the sentence on fixes of a batch, by their numbers, that have too little redundancy."""
    found = int(np.ravel(fix.dof)[weak[0]])
    which = "The fix" if fix.shape == () else f"Fix {int(weak[0])} of {fix.code.size}"
    more = f" ({len(weak)} fixes have less than {wanted})" if len(weak) > 1 else ""
    means = "a wrong measurement would not be noticed" if found <= 0 else "a wrong measurement could not be named"
    return (
        f"{which} has a redundancy of {found}, and {wanted} is required{more}: {means}; "
        "add a station, a measurement or a known height."
    )
