"""Joint moves of a network: they end in minima, the one found among them, and none where a motion is open."""

import numpy as np
import pytest
from sites.calibration.scenes import degenerate, hall

from optloc.sites.calibration import network_of
from optloc.sites.calibration.likelihood import likelihood
from optloc.sites.calibration.motions import bent


def test_bent_networks_end_in_minima_none_below_a_well_determined_one():
    truth, z = hall(3, 7, 12, 0.01)
    lik = likelihood(network_of(z, 0.01))
    at, cost = lik.refine(truth)
    ends, costs = bent(lik, at)
    assert ends.count == 12  # three directions, two lengths, both sides
    assert costs.min() == pytest.approx(cost[0], abs=1e-3)
    again = lik.refine(ends)[1]
    assert again == pytest.approx(costs, abs=1e-3)


def test_a_network_that_rows_leave_open_is_not_bent():
    truth, _ = hall(1, 9, 20, 0.0)
    lik = likelihood(network_of(degenerate("few", 1), 0.03))
    few = type(truth)(truth.stations[:, :5], truth.clocks[:, :5], truth.pulses[:, :6], truth.emission[:, :6])
    assert np.isfinite(lik.cost(few)).all()
    assert bent(lik, few) is None
