"""Squared ranges as posed problems: Shor's semidefinite relaxation, and the second-order cone.

The rows have the last weights of `optloc.solvers.starts.squared_range`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.linear.least_squares_ranges import ranges
from optloc.linear.mirror import one_position
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_statement import ConicStatement, Locate, set_parameters, variable
from optloc.solvers.starts.squared_range import Pick, Squared, hull as pick_hull, last_weighting, shor as pick_shor

_NO_RANGE = "the last unknown is the square of the distance, and no range is an unknown"


@dataclass(frozen=True, slots=True)
class _Weighted:
    """The rows (m, n) and right sides (m,) of one problem, in the coordinates of `squared`.

    `change` (n, n + 1) maps (w, 1) to the coordinates y. The unknowns w of the programs are in standard deviations.
    So the value of a program is accurate even if the noise is small compared with the distances.
    """

    squared: Squared
    rows: Array
    right: Array
    change: Array

    def triangle(self) -> tuple[Array, float]:
        """Return the triangular factor (n + 1, n + 1) of the rows in the unknowns w, and its unit."""
        from formulations.squared_range_conic import triangle

        slope, centre = self.change[:, :-1], self.change[:, -1]
        return triangle(self.rows @ slope, self.right - self.rows @ centre)

    def y(self, w: Any) -> Any:
        """Return y (n,) from w (n,), an array or an expression."""
        return self.change[:, :-1] @ w + self.change[:, -1]


def pose_shor(problem: Problem, locate: Locate) -> ConicStatement:
    """Return Shor's relaxation of a flat batch of one problem of one position; `locate` is not used."""
    from formulations.conic import rank_ratio, tight
    from formulations.squared_range_conic import TOLERANCE, mixed_points, shor_problem

    given = _rows(problem, pick_shor)
    quadric, n = given.squared.quadric, given.squared.quadric.size
    program, (factor, scale) = shor_problem(quadric, given.change), given.triangle()
    set_parameters(program, {"gram": factor.T @ factor})
    lift = variable(program, "lift")

    def points() -> Array:
        whole = np.vstack([given.change, np.eye(n + 1)[n]])
        plain = whole @ lift.value @ whole.T
        return np.concatenate([plain[None, :n, n], mixed_points(plain, quadric)])

    return _statement(
        problem,
        given,
        program,
        lift[:n, n],
        scale,
        points,
        lambda: rank_ratio(lift.value),
        tight("CLARABEL", TOLERANCE),
    )


def pose_hull(problem: Problem, locate: Locate) -> ConicStatement:
    """Return the second-order cone relaxation of a flat batch of one problem of one position; `locate` is not used."""
    from formulations.conic import tight
    from formulations.squared_range_conic import TOLERANCE, crossings, hull_problem

    given = _rows(problem, pick_hull)
    quadric = given.squared.quadric
    program, (factor, scale) = hull_problem(quadric, given.change), given.triangle()
    set_parameters(program, {"factor": factor})
    w = variable(program, "y")

    def points() -> Array:
        y = given.y(w.value)
        return np.concatenate([y[None], crossings(given.rows, y, quadric)])

    def off() -> float:
        y = given.y(w.value)
        return float(abs(quadric.value(y)) / (1.0 + np.sum(y**2)))

    return _statement(problem, given, program, w, scale, points, off, tight("CLARABEL", TOLERANCE))


def _rows(problem: Problem, pick: Pick) -> _Weighted:
    """Return the squared rows of the last weighting; raise InvalidProblem if the rows have no ranges."""
    from formulations.squared_range_conic import in_deviations

    if not one_position(problem):
        raise InvalidProblem(
            "squared ranges serve one target at one position",
            "formulation",
            'use "nls", or "registration_sdp" for runs',
        )
    alone = problem_at_rest(problem.straightened())
    squared, rows, right = last_weighting(alone, ranges(alone), pick)
    if squared.quadric.shape == "paraboloid" and not rows[0, :, -1].any():
        kinds = " and ".join(dict.fromkeys(block.kind for block in problem.rows))
        raise InvalidProblem(
            f"squared ranges need ranges, and these rows are {kinds}", "formulation", 'use "direction_sdp" or "nls"'
        )
    if not (np.isfinite(rows).all() and np.isfinite(right).all()):
        raise InvalidProblem("the rows contain a number that is not finite", "problem", "give such rows weight zero")
    return _Weighted(squared, rows[0], right[0], in_deviations(rows[0], right[0]))


def _statement(
    problem: Problem, given: _Weighted, program: Any, w: Any, scale: float, points: Any, ratio: Any, settings: Any
) -> ConicStatement:
    """Return the statement of a relaxation whose first moments are the expression w (n,), in standard deviations.

    `scale` is the unit of the residuals of the program. `points` returns points y (q, n), and `ratio` returns the rank
    ratio. `settings` are the settings of Clarabel.
    """
    squared, y = given.squared, given.y(w)
    origin, unit, d = squared.origin[0], float(squared.scale[0]), problem.dimension
    parts = {"position": origin + unit * y[:d]}
    if squared.quadric.shape == "cone":
        parts["range"] = unit * y[d]

    def read() -> Array:
        return np.asarray(vectors(problem, (origin + unit * points()[:, :d])[None])[0])

    return ConicStatement(
        program=program,
        size=scale**2,
        origin=origin,
        unit=unit,
        parts=parts,
        residual=(given.rows @ given.change[:, :-1]) @ w - (given.right - given.rows @ given.change[:, -1]),
        missing={"range": _NO_RANGE},
        read=read,
        rank_ratio=ratio,
        settings=settings,
    )
