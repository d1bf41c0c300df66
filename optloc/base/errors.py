"""Exceptions of optloc: malformed input raises an error, but a problem without an answer does not.

If a valid problem has no trustworthy answer, the call returns a fix with a status that explains it. Only
``fix.require()`` raises :class:`NoSolution` for this status.
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

# Exceptions that input numbers can cause. They come from NumPy and SciPy, from floating-point arithmetic,
# and from solvers (`formulations.backend.SolverError`). All other exceptions are programming errors and are
# not caught.
NUMERICAL: tuple[type[Exception], ...] = (np.linalg.LinAlgError, ArithmeticError)


class OptlocError(Exception):
    """Base class of all exceptions that optloc raises on purpose."""


class InvalidProblem(OptlocError, ValueError):  # noqa: N818  (named after the input of the caller)
    """The input is not a valid problem. The message names the faulty part.

    Parameters
    ----------
    what : str
        The fault, with the invalid value: ``"latitude 95 deg is outside -90 to 90 deg"``.
    where : str, optional
        The location: a file, a file and row, a column or an argument.
    advice : str, optional
        Advice how to correct it.

    Notes
    -----
    ``str(error)`` is one sentence, ``where: what; advice.``
    """

    def __init__(self, what: str, where: str | None = None, advice: str | None = None) -> None:
        # Pickling, which returns errors from worker processes, keeps positional arguments only.
        super().__init__(what, where, advice)
        self.what = what
        self.where = where
        self.advice = advice

    def __str__(self) -> str:
        """Return the message: location, fault and advice in one sentence."""
        place = f"{_shown(self.where)}: " if self.where else ""
        advice = f"; {_shown(self.advice.strip().rstrip('.'), 4 * _SHOWN)}" if self.advice else ""
        end = "" if advice.endswith("?") else "."
        return f"{place}{_shown(self.what.strip().rstrip('.'))}{advice}{end}"


# Maximum number of characters of the location and of the fault, about three lines: a file can contain a megabyte where
# a name belongs. The advice may be longer, because it can list valid names.
_SHOWN = 300


def _shown(text: str, most: int = _SHOWN) -> str:
    """Return the text; if it is longer than `most` characters, without its middle."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


class NoSolution(OptlocError):  # noqa: N818  (a verdict about the problem)
    """`fix.require()` refused a fix: its status is not `ok` or allowed, or it has too little redundancy.

    Parameters
    ----------
    problem : Problem
        The problem of the fix.
    fix : Fix
        The refused fix. Its status, alternatives and certificate explain the refusal.
    why : str, optional
        Reason for the refusal of a fix whose status is accepted.

    Notes
    -----
    ``str(error)`` is `why`, or otherwise the sentence of ``fix.status`` with its advice. For a batch it is the sentence
    of each distinct status.
    """

    def __init__(self, problem: Any, fix: Any, why: str = "") -> None:
        # Pickling, which returns errors from worker processes, keeps positional arguments only.
        super().__init__(problem, fix, why)
        self.problem = problem
        self.fix = fix
        self.why = why

    def __str__(self) -> str:
        """Return `why`, or the sentence of the status; for a batch, one sentence for each distinct status."""
        if self.why:
            return self.why
        status = getattr(self.fix, "status", None)
        if getattr(self.fix, "shape", None) == () and hasattr(self.fix, "sentence"):
            return str(self.fix.sentence)
        if status is None:
            return "There is no fix."
        # A dictionary, unlike a set, keeps the order in which the statuses occur in the batch.
        verdicts = {Status(int(code)): None for code in np.ravel(status)}
        refused = [verdict.sentence for verdict in verdicts if verdict is not Status.OK]
        return " ".join(refused or [verdict.sentence for verdict in verdicts])


# Maximum number of names that a message lists, and that the search for similar names compares within a keystroke.
_FEW, _MANY = 20, 5000


def nearest(word: str, known: Iterable[str]) -> str:
    """Return advice for an unknown word: the most similar valid words, then all valid words if there are few.

    Parameters
    ----------
    word : str
        The word of the user.
    known : iterable of str
        The valid words.

    Returns
    -------
    str
        ``"did you mean 'km'? known are m, km"``.
    """
    names = list(islice(known, _MANY))
    word = str(word)[:_SHOWN]
    folded = {name.lower(): name for name in names}
    similar = [repr(folded[name]) for name in _similar_names(word.lower(), folded)]
    hint = f"did you mean {' or '.join(similar)}?" if similar else ""
    rest = f" and {len(names) - _FEW} more" if len(names) > 2 * _FEW else ""
    listed = "" if similar and len(names) > _FEW else f"known are {', '.join(names[:_FEW] if rest else names)}{rest}"
    return " ".join(part for part in (hint, listed) if part)


def check_once(names: Iterable[str], what: str, where: str) -> None:
    """Raise if a name occurs twice. `what` is the message, with "{!r}" for the name.

    `where` is the location that the message names.
    """
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InvalidProblem(what.format(twice), where, "rename one of them")


def no_station(
    name: object, where: str | None, known: Iterable[str], error: type[InvalidProblem] = InvalidProblem
) -> InvalidProblem:
    """Return an error for a station name that does not exist, with the most similar station names as advice.

    `known` are the names of the stations. `error` is the class of the error.
    """
    return error(f"there is no station {name!r}", where, nearest(str(name), known))


def _similar_names(word: str, known: Iterable[str]) -> list[str]:
    """Return up to two of the `known` names similar to a word; none for a single letter, which could mean any name."""
    names = list(known)
    if word.strip() in names:  # the word differs only by case, or by blanks at its ends
        return [word.strip()]
    with_prefix = [name for name in names if len(word) > 2 and name.startswith(word)][:2]
    # Agreement of half of the letters is chance, except for names of the same length, such as R5 and R6.
    of_same_length = [name for name in names if len(name) == len(word)]
    similar = (
        get_close_matches(word, names, n=2, cutoff=0.6)
        or with_prefix
        or get_close_matches(word, of_same_length, n=2, cutoff=0.5)
    )
    return similar if len(word) > 1 else []


def status_named(label: str) -> Status:
    """Return the status with a label such as "too few rows"; raise InvalidProblem if it does not exist."""
    wanted = label.strip().lower().replace("_", " ").replace("-", " ")
    for status in Status:
        if status.label == wanted:
            return status
    raise InvalidProblem(f"there is no status {label!r}", "status", nearest(label, [one.label for one in Status]))


# The required redundancy of a fix.


def whole_redundancy(redundancy: Any) -> int:
    """Return the required redundancy as an integer; raise InvalidProblem if it is not a whole number."""
    if isinstance(redundancy, bool) or not isinstance(redundancy, int | np.integer) or redundancy < 0:
        raise InvalidProblem(f"{redundancy!r} is not a redundancy", "redundancy", "give a whole number: 0, 1, 2, ...")
    return int(redundancy)


def too_weak(fix: Any, weak: Any, wanted: int) -> str:
    """Return a sentence about the fixes of a batch that have too little redundancy.

    `weak` (n,) are the numbers of these fixes in the batch; the sentence names the first. `wanted` is the required
    redundancy.
    """
    redundancy = int(np.ravel(fix.dof)[weak[0]])
    subject = "The fix" if fix.shape == () else f"Fix {int(weak[0])} of {fix.code.size}"
    more = f" ({len(weak)} fixes have less than {wanted})" if len(weak) > 1 else ""
    effect = "a wrong measurement would not be noticed" if redundancy <= 0 else "a wrong measurement could not be named"
    return (
        f"{subject} has a redundancy of {redundancy}, and {wanted} is required{more}: {effect}; "
        "add a row, a station or a known value, such as a height."
    )
