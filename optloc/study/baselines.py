"""What studies compare with: iterations from a guess, the papers' originals, general tools, weak relaxations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.study.draws import Drawn
from optloc.study.originals import recursion, single_step


@dataclass(frozen=True, slots=True)
class Baseline:
    """Something to compare with.

    Parameters
    ----------
    run : callable
        ``(drawn, start) -> Fix``; start is an array (n, size).
    summary : str
        One line for listings.
    guess : bool
        Whether it begins at the start.
    slow : bool
        Whether it solves one by one.
    """

    run: Callable[[Drawn, Array], Fix]
    summary: str
    guess: bool = True
    slow: bool = False


def start_of(kind: str, width: float, drawn: Drawn) -> Array:
    """Return the starting vectors (n, size) of a guess: "truth", "centre" of the stations, or "box" around it.

    The centre is taken a tenth of the stations' spread off at random, lest it fall on a station, where ranges have no
    derivative.

    Parameters
    ----------
    kind : str
        Which guess.
    width : float
        Width of the box, metres.
    drawn : Drawn
        The trials; the places in the box are theirs, whatever the method.
    """
    if kind == "truth":
        return drawn.truth
    stations = drawn.problem.stations.position
    centre = stations.mean((-3, -2))
    spread = np.linalg.norm(stations - centre[..., None, None, :], axis=-1).max((-2, -1))
    place = centre + (width if kind == "box" else 0.2 * spread[..., None]) * drawn.wild
    start = np.zeros_like(drawn.truth)
    slot, _ = drawn.problem.layout.find(drawn.position)
    start[:, slot.start : slot.start + slot.size] = place
    return start


def _truth(drawn: Drawn, start: Array) -> Fix:
    from optloc.solvers import solve

    return solve(drawn.problem, "lsr", start=drawn.truth)


def _iterated(method: str) -> Callable[[Drawn, Array], Fix]:
    def run(drawn: Drawn, start: Array) -> Fix:
        from optloc.solvers import solve

        return solve(drawn.problem, method, start=start)

    return run


def _printed(drawn: Drawn, start: Array) -> Fix:
    """Return the undamped iteration with the residual's sign as the paper prints it."""
    from optloc.papers.kinematic import taylor
    from optloc.solvers.pool import given

    size = drawn.problem.dimension
    x = start.copy()
    x[:, :size] = taylor(drawn.problem, start, sign=-1.0) if start.shape[-1] == size else np.nan
    return given(drawn.problem, x)


def _original(steps: Callable[[Problem, Array], Array]) -> Callable[[Drawn, Array], Fix]:
    """Return the method of a paper; it claims whatever it arrives at."""

    def run(drawn: Drawn, start: Array) -> Fix:
        from optloc.study.originals import claimed

        return claimed(drawn.problem, start, steps(drawn.problem, start))

    return run


def _general(drawn: Drawn, start: Array) -> Fix:
    from optloc.study.originals import least_squares

    return least_squares(drawn.problem, start)


def _lifted(drawn: Drawn, start: Array) -> Fix:
    from optloc.study.originals import lifted_sdp

    return lifted_sdp(drawn.problem)


BASELINES: dict[str, Baseline] = {
    "truth": Baseline(_truth, "damped least squares from the truth: the best that any start can lead to", guess=False),
    "gauss-newton": Baseline(_iterated("lsr"), "damped least squares from a guess"),
    "taylor": Baseline(
        _iterated("taylor"), "plain undamped Taylor iteration from a guess (Foy 1976), as in the papers"
    ),
    "taylor-printed": Baseline(_printed, "the same with the sign of equations 8 and 15 of the paper `kinematic`"),
    "single-step": Baseline(
        _original(single_step), "one linearised step from a guess, as in the update of the paper `angles`"
    ),
    "recursion": Baseline(
        _original(recursion), "two undamped steps over all data at every new epoch, as in the paper `registration`"
    ),
    "ipopt": Baseline(_iterated("nlp"), "IPOPT from a guess, or another nonlinear solver", slow=True),
    "scipy": Baseline(_general, "scipy.optimize.least_squares with exact derivatives from a guess", slow=True),
    "lifted-sdp": Baseline(_lifted, "order-1 lifted ranges, unrefined: never tight for tdoa", guess=False, slow=True),
}
"""Baselines by name."""
