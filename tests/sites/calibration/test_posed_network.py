"""Networks as posed problems: the value of the formulation, own relations, and the network that follows."""

import cvxpy as cp
import numpy as np
import pytest
from sites.calibration.scenes import distances, hall

from optloc import InvalidProblem
from optloc.sites.calibration import network_of, pose_network


def test_the_truncated_norm_leads_to_the_network():
    truth, z = hall(3, 10, 12, 0.0)
    posed = pose_network(network_of(z, 0.01))
    found = posed.solve()
    assert found.backend.outcome in ("solved", "inaccurate")
    assert found.cost == pytest.approx(0.0, abs=1e-3)
    assert distances(found.estimate.stations[0]) == pytest.approx(distances(truth.stations[0]), abs=1e-2)


def test_a_dual_is_the_slope_in_metres():
    _, z = hall(4, 8, 12, 0.02)

    def at(e):
        posed = pose_network(network_of(z, 0.02), truncated=False)
        posed.add(posed.emission[1] - posed.emission[0] <= gap + e, name="order")
        return posed.solve(settings={"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10})

    free = pose_network(network_of(z, 0.02), truncated=False).solve()
    gap, step = free.emission[1] - free.emission[0] - 0.2, 1e-2
    found = at(0.0)
    assert found.duals["order"] == pytest.approx(-(at(step).value - at(-step).value) / (2.0 * step), rel=1e-2)
    assert found.values["order"] == pytest.approx(0.0, abs=1e-6)
    assert found.value > free.value
    assert found.bound <= found.value * (1.0 + 1e-6)


def test_an_own_objective_and_what_is_refused():
    _, z = hall(4, 8, 12, 0.02)
    posed = pose_network(network_of(z, 0.02))
    posed.minimise(cp.norm(posed.emission))
    assert np.isfinite(posed.solve().value)
    posed.add(posed.emission[0] <= 0.0, name="first")
    with pytest.raises(InvalidProblem, match="already"):
        posed.add(posed.emission[0] <= 1.0, name="first")
    z[0, 0] = np.nan
    with pytest.raises(InvalidProblem, match="none missing"):
        pose_network(network_of(z, 0.02))
    with pytest.raises(InvalidProblem, match="too few"):
        pose_network(network_of(z[1:3, :4], 0.02))
