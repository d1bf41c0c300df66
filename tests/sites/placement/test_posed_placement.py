"""Placement as a posed problem: a bound of all sets, own rules with their duals, and an own objective."""

import numpy as np
import pytest
from sites.placement.scenes import every_set, hall

from formulations.placement import value
from optloc import InvalidProblem
from optloc.sites.placement import SiteSelection, pose_placement
from optloc.sites.placement.sites import LETTER, candidates_of


@pytest.fixture(scope="module")
def selection():
    problem, places = hall(n=7, places=3)
    return SiteSelection(problem, places, choose=4, gap=1e-6)


def test_its_value_is_below_every_set_and_its_bound_below_its_value(selection):
    found = pose_placement(selection).solve()
    sets = every_set(7, 4)
    best = value(candidates_of(selection).design, sets, LETTER["rms"]).min()
    assert found.backend.outcome == "solved"
    assert found.backend.worst < 1e-6
    assert found.bound <= found.value * (1.0 + 1e-9)
    assert found.value <= best * (1.0 + 1e-6)
    assert found.criterion == pytest.approx(found.value, rel=1e-4)


def test_a_rule_of_ones_own_has_a_dual_that_is_the_slope_of_the_optimum(selection):
    def at(limit):
        posed = pose_placement(selection)
        first, second = posed.names[:2]
        posed.add(posed.site(first) + posed.site(second) <= limit, name="either")
        return posed.solve("CLARABEL", {"tol_gap_rel": 1e-10, "tol_gap_abs": 1e-10, "tol_feas": 1e-10})

    whole = pose_placement(selection).solve()
    limit = 0.5 * sum(list(whole.weights.values())[:2])
    found, step = at(limit), 1e-3
    slope = -(at(limit + step).value - at(limit - step).value) / (2 * step)
    assert found.duals["either"] == pytest.approx(slope, rel=1e-3)
    assert found.duals["either"] > 0.0
    assert found.values["either"] == pytest.approx(0.0, abs=1e-6)


def test_an_objective_of_ones_own_and_what_is_refused(selection):
    import cvxpy as cp

    posed = pose_placement(selection)
    posed.minimise(cp.max(posed.per_place) if hasattr(posed.per_place, "shape") else posed.per_place)
    assert posed.solve().value > 0.0
    with pytest.raises(InvalidProblem, match="no site"):
        posed.site("nowhere")
    with pytest.raises(InvalidProblem, match="not convex"):
        posed.add(cp.sum_squares(posed.weights) >= 1)
    posed.add(posed.weights[0] <= 0.5, name="half")
    with pytest.raises(InvalidProblem, match="already"):
        posed.add(posed.weights[1] <= 0.5, name="half")
    posed.add(cp.sum(posed.weights) >= 10.0, name="more")
    none = posed.solve()
    assert none.backend.outcome == "infeasible"
    assert np.isnan(none.value)
