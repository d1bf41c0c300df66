"""`pose_placement`: the semidefinite relaxation of the choice of sites as a problem that users change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.placement import semidefinite_problem, value
from optloc.problem import InvalidProblem, PosedSolution
from optloc.sites.placement.sites import LETTER, Candidates, SiteSelection, candidates_of
from optloc.solvers import ConvexProgram, PosedProblem


@dataclass(frozen=True, slots=True, kw_only=True)
class RelaxedPlacement(PosedSolution):
    """The solution of a posed placement; duals, values and report are as in `optloc.problem.PosedSolution`.

    Parameters
    ----------
    value : float
        Objective at the weights: the criterion unless the objective is your own. It is the natural logarithm of the
        squared volume for "volume", else m^2.
    bound : float
        Lower bound of the objective for all sets that meet the rules, recomputed from a dual point; NaN without one.
    weights : mapping of str to float
        Weight of each site, 0 to 1; NaN without a solution.
    criterion : float
        The criterion at the weights, computed without the solver.
    """

    weights: Mapping[str, float]
    criterion: float


class PosedPlacement(PosedProblem):
    """The relaxation of a choice of sites, with relations such as ``posed.site("A") + posed.site("B") <= 1``.

    See `pose_placement`.

    Attributes
    ----------
    weights : cvxpy.Variable, shape (n,)
        Weights of the sites in the order of `names`.
    names : tuple of n str
        Names of the sites.
    per_place : cvxpy.Expression, shape (P,)
        The criterion at each place.
    """

    def __init__(self, candidates: Candidates) -> None:
        self._candidates, selection = candidates, candidates.selection
        self._letter = LETTER[selection.criterion]
        # sites that exist already have the weight 1, and excluded sites the weight 0
        kept, out = (np.eye(len(candidates.state))[candidates.state == state] for state in (1, 0))
        rules = np.concatenate([candidates.rules, -kept, out])
        limits = np.concatenate([candidates.limits, np.full(len(kept), -1.0), np.zeros(len(out))])
        program, self.per_place = semidefinite_problem(
            candidates.design, rules, limits, self._letter, worst=selection.worst
        )
        self.names: tuple[str, ...] = tuple(candidates.names)
        self.weights = next(one for one in program.variables() if one.name() == "weights")
        self._convex = ConvexProgram(program, example="posed.weights[0] <= 0.5", instead="use a convex expression")
        super().__init__(self._convex)

    def site(self, name: str) -> Any:
        """Return the weight of a named site as an expression; raise InvalidProblem for an unknown name."""
        if name not in self.names:
            raise InvalidProblem(f"there is no site {name!r}", "site", f"the sites are {', '.join(self.names)}")
        return self.weights[self.names.index(name)]

    def solve(self, solver: str = "CLARABEL", settings: Mapping[str, Any] | None = None) -> RelaxedPlacement:
        """Return the weights of least value, with a bound for all sets of sites, duals and the report of the back end.

        Parameters
        ----------
        solver : str
            Name of the solver in cvxpy.
        settings : mapping, optional
            Its settings.
        """
        found = self._convex.solution(solver, settings)
        solved, own = self._convex.has_solution(found.backend), self._candidates
        w = np.asarray(self.weights.value) if solved else np.full(len(self.names), np.nan)
        criterion = float(value(own.design, w, self._letter, worst=own.selection.worst)) if solved else np.nan
        weights = dict(zip(self.names, w.tolist(), strict=True))
        return RelaxedPlacement(**found.by_name(), weights=weights, criterion=criterion)


def pose_placement(selection: SiteSelection) -> PosedPlacement:
    """Return the semidefinite relaxation of a choice of sites, to read, to change and to solve.

    Parameters
    ----------
    selection : SiteSelection
        Candidates, places and rules. The loss of one site (`fail_one`) is not part of the relaxation.

    Returns
    -------
    PosedPlacement
        The problem as ``posed.problem``, weights by name, and ``add``, ``minimise`` and ``solve``.

    Raises
    ------
    InvalidProblem
        If an argument, site or place is invalid, or if the criterion is that after the loss of a site.

    References
    ----------
    S. Joshi and S. Boyd, "Sensor selection via convex optimization", IEEE Trans. Signal Process. 57 (2009).
    """
    if selection.fail_one:
        raise InvalidProblem(
            "the relaxation has no criterion after the loss of a site", "fail_one", "pose it without fail_one"
        )
    return PosedPlacement(candidates_of(selection))
