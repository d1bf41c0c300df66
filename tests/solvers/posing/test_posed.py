"""What both kinds of posed problems share: names, tables, and honest statuses."""

import numpy as np
import pytest
from solvers.posing.scenes import ranged

from optloc import Fix, InvalidProblem, Status, constraints, pose, solve


@pytest.mark.parametrize("formulation", ["hull", "nls"])
def test_names_are_given_or_counted(formulation):
    posed = pose(ranged(1), formulation)
    posed.add(posed.position[0] <= 1e9)
    posed.add(constraints.box([-1e9, -1e9], [1e9, 1e9]))
    posed.add(constraints.box([-2e9, -2e9], [2e9, 2e9]), name="wide")
    fix = posed.solve()
    assert list(fix.posed.duals) == ["constraint 1", "x", "y", "wide"]
    assert len(fix.posed.duals["wide"]) == 4
    assert fix.posed.values["wide"].max() < 0.0
    assert np.abs(fix.posed.duals["wide"]).max() < 1e-6
    with pytest.raises(InvalidProblem, match="already"):
        posed.add(constraints.box([-1e9, -1e9], [1e9, 1e9]))
    with pytest.raises(InvalidProblem, match="target"):
        posed.add(constraints.half_plane([1.0, 0.0], 5.0, target=3), name="other")


@pytest.mark.parametrize("formulation", ["hull", "nls"])
def test_refinement_is_a_choice(formulation):
    problem = ranged(2)
    posed = pose(problem, formulation)
    plain, refined = posed.solve(refine=False), posed.solve()
    assert isinstance(refined, Fix)
    assert plain.status == Status.UNREFINED
    assert not plain.posed.refined
    assert "the optimum of the posed problem, not refined" in str(plain.reason)
    assert refined.posed.refined
    assert refined.status == solve(problem).status
    assert refined[()].posed is refined.posed or refined.shape == ()


@pytest.mark.parametrize("formulation", ["squared_range_conic: hull", "nls"])
def test_its_text_names_the_formulation_and_the_changes(formulation):
    posed = pose(ranged(2), formulation)
    assert repr(posed) == f"<posed problem '{formulation}'>"
    posed.add(posed.position[0] <= 1e9, name="fence")
    assert repr(posed) == f"<posed problem '{formulation}' with constraint \"fence\">"
