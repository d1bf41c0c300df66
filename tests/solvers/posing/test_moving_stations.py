"""Posed runs and Doppler shifts: expressions in SI units of the layout."""

import numpy as np
import pytest
from solvers.posing.scenes import differences, registered, shifted

from optloc import InvalidProblem, constraints, pose, solve
from optloc.solvers.posing.moving_stations import pose_doppler, pose_registration


def test_a_run_has_biases_residuals_and_a_price():
    problem = registered(2)
    posed = pose(problem, "registration_sdp")
    fix = posed.solve()
    shared = posed.of("position").value
    assert np.linalg.norm(shared - fix.position) < 3.0 * posed.unit
    assert posed.clock.value.shape == (3,)
    assert "price" in [one.name() for one in posed.problem.parameters()]
    assert fix.status == solve(problem).status
    posed.add(constraints.half_plane([1.0, 0.0], fix.position[0] - 1.0), name="fence")
    assert posed.solve().position[0] == pytest.approx(fix.position[0] - 1.0, abs=1e-6)


def test_a_source_has_a_position_and_residuals():
    problem = shifted(2)
    posed = pose(problem, "doppler_sdp")
    fix = posed.solve()
    assert fix.posed.value == pytest.approx(0.0, abs=1e-6)
    assert posed.residual.value == pytest.approx(np.zeros(problem.count), abs=1e-3)
    assert np.isfinite(fix.position).all()


def test_other_rows_are_refused():
    with pytest.raises(InvalidProblem, match="range rate"):
        pose_doppler(differences(1).flat(), solve)
    with pytest.raises(InvalidProblem):
        pose_registration(shifted(1).flat(), solve)
