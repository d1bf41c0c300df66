"""The search of a network: who agrees, when costs fit the data, and blocks on the wrong side."""

import numpy as np
import pytest
from sites.calibration.scenes import hall, reflected

from optloc.sites.calibration import network_of
from optloc.sites.calibration.blocks import settled
from optloc.sites.calibration.likelihood import likelihood, together
from optloc.sites.calibration.multi_start import (
    AGREEING,
    NetworkSearchResult,
    _add_round,
    _cost_key,
    _fits,
    _sweep_block_moves,
    frame_size,
    search,
)
from optloc.sites.calibration.restarts import RoundEnds


def test_the_frame_has_six_unknowns_in_space_three_in_the_plane_and_one_more_with_clocks():
    _, z = hall(1, 5, 6, 0.0)
    assert frame_size(network_of(z, 0.1)) == 6
    assert frame_size(network_of(z, 0.1, dimension=2)) == 3
    assert frame_size(network_of(z, 0.1, synchronised=False)) == 7
    place = np.full((5, 3), np.nan)
    place[0] = 0.0
    assert frame_size(network_of(z, 0.1, place=place)) == 3
    assert frame_size(network_of(z, 0.1, place=np.zeros((5, 3)) + np.arange(5.0)[:, None])) == 0


def ends(*costs):
    at = hall(1, 4, 3, 0.0)[0]
    return RoundEnds(together(*[at] * len(costs)), np.array(costs), np.arange(len(costs)))


def test_starts_agree_that_end_at_the_least_cost_or_lead_there():
    found = _add_round(None, ends(5.0, 5.0 + 1e-4, 9.0), 8)
    assert (found.cost, found.agreeing) == (5.0, 2)
    found.onward[_cost_key(9.0)] = 5.0
    assert found.agreeing == 3
    cheaper = _add_round(found, ends(4.0), 16)
    assert (cheaper.cost, cheaper.agreeing, cheaper.made) == (4.0, 1, 16)
    assert isinstance(cheaper, NetworkSearchResult)


def test_a_cost_far_above_the_degrees_of_freedom_does_not_fit():
    _, z = hall(1, 8, 12, 0.0)
    net = network_of(z, 0.1)
    dof = net.rows - net.unknowns + frame_size(net)
    assert _fits(net, float(dof))
    assert not _fits(net, dof + 10.0 * np.sqrt(2.0 * dof))


def test_a_sweep_puts_a_station_back_on_its_side():
    truth, z = hall(3, 7, 10, 0.01)
    lik = likelihood(network_of(z, 0.01))
    least = lik.refine(truth)[1][0]
    wrong = settled(lik.network, reflected(lik.refine(truth)[0])[0])
    cost = _sweep_block_moves(lik, wrong, float(lik.cost(wrong)[0]))[1]
    assert cost == pytest.approx(least, abs=0.01)


def test_a_search_ends_when_three_starts_agree():
    truth, z = hall(3, 12, 20, 0.01)
    net, told = network_of(z, 0.01), []
    found = search(net, 0, None, told.append)
    assert found.agreeing >= AGREEING
    assert found.cost == pytest.approx(likelihood(net).refine(truth)[1][0], abs=0.01)
    assert "at the least cost" in told[-1]
