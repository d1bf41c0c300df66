"""`pose`: the optimisation problem of a formulation, from a `Problem`."""

from __future__ import annotations

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.problem import Problem
from optloc.solvers.formulations import FORMULATIONS
from optloc.solvers.posing.convex_statement import ConicStatement
from optloc.solvers.posing.nonlinear import PosedProgram
from optloc.solvers.posing.posed import Posed
from optloc.solvers.posing.posed_conic import PosedConic
from optloc.solvers.solution import solve


def pose(problem: Problem, formulation: str) -> Posed:
    """Return the optimisation problem that a formulation poses, to read, to change and to solve.

    Parameters
    ----------
    problem : Problem
        One problem with finite numbers, without batch axes.
    formulation : str
        Name as in ``optloc list formulations``, for instance "squared_range_conic: hull" or "nls", or a word of a
        method, such as "sdp", that belongs to one formulation for this problem.

    Returns
    -------
    Posed
        The problem as ``posed.problem``, its parts in SI units, and ``add``, ``minimise`` and ``solve``.

    Raises
    ------
    InvalidProblem
        For a batch, an unknown or closed-form formulation, or rows that the formulation does not cover.
    """
    one = _single(problem)
    name = _named(one, formulation)
    entry = FORMULATIONS[name]
    if entry.pose is None:
        twin = entry.twin or "nls"
        known = f"{formulation!r} means {name!r}, which" if formulation != name else f"{name!r}"
        raise InvalidProblem(f"{known} is a closed form and no optimisation problem", "formulation", f"pose {twin!r}")
    if not entry.serves(one) and entry.starts:
        raise InvalidProblem(
            f"{name!r} does not cover this problem: it supports {entry.kinds}", "formulation", "use 'nls'"
        )
    statement = entry.pose(one, lambda part: solve(part).flat())
    if isinstance(statement, ConicStatement):
        return PosedConic(one, name, statement)
    return PosedProgram(one, name, statement)


def _single(problem: Problem) -> Problem:
    """Return a problem as a flat batch of one; raise InvalidProblem for a batch, or for numbers that are not finite."""
    if not isinstance(problem, Problem):
        raise InvalidProblem(
            f"{type(problem).__name__} is no problem", "problem", "make one by optloc.assemble or load"
        )
    if problem.layout.size == 0:
        raise InvalidProblem("nothing is unknown: the motion of every target is known", "motions", "give a bias")
    if separable(problem):
        problem = by_epoch(problem)
    flat = problem.flat()
    count = flat.batch_shape[0]
    if count != 1:
        raise InvalidProblem(
            f"{count} problems are a batch", "problem", "pose one of them, for instance problem.flat().take([0])"
        )
    measured = np.isfinite(flat.observed) | (flat.weight == 0.0)
    if not (np.isfinite(flat.stations.position).all() and measured.all()):
        raise InvalidProblem("a number is not finite", "problem", "remove the row or give it weight zero")
    return flat


def _named(problem: Problem, text: str) -> str:
    """Return the full name of a formulation; raise InvalidProblem for an unknown or ambiguous one."""
    if not isinstance(text, str):
        raise InvalidProblem(f"{text!r} is not the name of a formulation", "formulation", "give a text such as 'nls'")
    if text in FORMULATIONS:
        return text
    entries = {name: FORMULATIONS[name] for name in FORMULATIONS}
    by_word = [name for name, one in entries.items() if text in one.starts or text in one.words]
    found = [name for name in by_word if entries[name].pose is not None and entries[name].serves(problem)]
    # a formulation that serves fewer problems is more specific, and the general one does not cover them
    if len(found) == 1:
        return found[0]
    if len(found) > 1:
        raise InvalidProblem(
            f"{text!r} is the name of several formulations", "formulation", f"use {' or '.join(map(repr, found))}"
        )
    parts = [name for name in entries if name.partition(": ")[2] == text]
    if len(parts) == 1:
        return parts[0]
    if by_word:
        return by_word[0]
    raise InvalidProblem(f"unknown formulation {text!r}", "formulation", _advice(text, list(entries)))


def _advice(text: str, names: list[str]) -> str:
    """Return advice for an unknown word: what it is in a method, or the most similar names of formulations."""
    from optloc.solvers.methods import METHODS, SOLVERS

    if text in METHODS or text in SOLVERS:
        what = "method" if text in METHODS else "stage of methods"
        return f"{text!r} is a {what} of optloc.solve; use 'nls', or see 'optloc list formulations'"
    # the second half of a name, such as "hull", is a name too
    hint = nearest(text, [*names, *(short for name in names if (short := name.partition(": ")[2]))])
    # eighteen names are too many to read: the table lists them with a line each
    similar, mark, _ = hint.partition("?")
    listing = "see 'optloc list formulations'"
    return f"{similar}? {listing}" if mark else listing
