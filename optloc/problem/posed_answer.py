"""The part of a fix that comes from a posed problem: values, duals, bound, and the report of the back end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from optloc.base.types import Array


@dataclass(frozen=True, slots=True)
class PosedSolution:
    """The solution of a posed optimisation problem.

    Parameters
    ----------
    duals : mapping of str to float or array
        Multiplier of each named constraint, in units of the objective per SI unit of the right-hand side. It is at
        least zero for ``<=`` and for ``>=``. For ``left == right``, the gradient of the objective plus the multiplier
        times the gradient of ``left - right`` is zero.
    values : mapping of str to float or array
        Left side minus right side of each named constraint in SI units; the smaller side of ``<=`` is the left one.
    backend : formulations.solver_report.SolverReport
        Status, residuals, relative gap, iterations and time, as the back end reports them.
    value : float
        Objective at the solution; NaN without one.
    bound : float
        Lower bound of the objective of a convex problem, recomputed from a dual point; NaN without a bound.
    """

    duals: Mapping[str, float | Array]
    values: Mapping[str, float | Array]
    backend: Any
    value: float
    bound: float

    def by_name(self) -> dict[str, Any]:
        """Return these fields by name, to build a solution with more of them."""
        return {one.name: getattr(self, one.name) for one in fields(PosedSolution)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PosedAnswer(PosedSolution):
    """The solution of a posed problem of `optloc.pose`; duals, values and report are as in `PosedSolution`.

    Parameters
    ----------
    value : float
        Objective at the solution: chi-square, unless you or the formulation replace it. For "minimax_cone" it is minus
        the radius of a ball inside the cones, metres.
    bound : float
        Lower bound of the objective of the convex problem, recomputed from a dual point; NaN without a bound. It bounds
        the cost of maximum likelihood for "moment_sdp" (in its box) and "lifted" only. "direction_sdp" minimises chords
        instead of angles, the other formulations for instance squared ranges. Their bounds may exceed that cost.
    formulation : str
        Name of the formulation.
    rank_ratio : float
        Second over first eigenvalue of a lifted matrix, or distance from the relaxed surface; NaN if nothing is lifted.
        A value near zero means that the relaxation is exact.
    refined : bool
        Whether the position of the fix was refined by least squares from this solution.
    variables : mapping of str to array
        Values of the variables of the posed problem, in its scaled units; a start for the next solve.
    """

    formulation: str
    rank_ratio: float
    refined: bool
    variables: Mapping[str, Array]
