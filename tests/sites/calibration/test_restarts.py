"""Starts of networks: arrivals from differences, random places, and networks laid over what is known."""

import numpy as np
import pytest
from sites.calibration.scenes import distances, hall

from optloc.sites.calibration import network_of
from optloc.sites.calibration.likelihood import likelihood, together
from optloc.sites.calibration.restarts import RoundEnds, arrivals, joined, laid, starts_of


def test_random_places_lead_to_the_minimum():
    truth, z = hall(3, 12, 20, 0.03)
    lik = likelihood(network_of(z, 0.03))
    cost = lik.refine(starts_of(lik, 0).random(8))[1]
    assert cost.min() == pytest.approx(lik.refine(truth)[1][0], abs=0.01)


def test_differences_become_arrivals_up_to_a_number():
    _, z = hall(1, 5, 4, 0.0)
    pairs = [(1, 0), (2, 0), (3, 2), (4, 1)]
    differences = np.stack([z[:, a] - z[:, b] for a, b in pairs], axis=1)
    found, weight, emission = arrivals(network_of(differences, 0.5, kind="tdoa", pairs=pairs))
    np.testing.assert_allclose(np.diff(found, axis=1), np.diff(z, axis=1), atol=1e-9)
    assert (weight > 0.0).all()
    assert emission.all()


def test_ranges_are_arrivals_without_a_time_of_emission():
    truth, z = hall(1, 5, 4, 0.0)
    ranges = z - truth.emission[0][:, None]
    ranges[2, 3] = np.nan
    found, weight, emission = arrivals(network_of(ranges, 0.25, kind="range"))
    assert not emission.any()
    assert weight[2, 3] == 0.0
    assert (weight[weight > 0.0] == 4.0).all()
    np.testing.assert_allclose(found[weight > 0.0], ranges[np.isfinite(ranges)])


def test_emission_times_of_random_networks_fit_their_places():
    _, z = hall(3, 6, 9, 0.0)
    found = starts_of(likelihood(network_of(z, 0.1)), 1).random(4)
    apart = np.linalg.norm(found.pulses[:, :, None] - found.stations[:, None], axis=-1)
    np.testing.assert_allclose((z - apart - found.emission[..., None]).mean(axis=-1), 0.0, atol=1e-9)


def test_a_turned_network_is_laid_over_known_places_in_both_ways(seed):
    truth, z = hall(seed + 4, 6, 9, 0.0)
    net = network_of(z, 0.1, place=truth.stations[0])
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    moved = type(truth)(truth.stations @ turn + 5.0, truth.clocks, truth.pulses @ turn + 5.0, truth.emission)
    found = laid(moved, net, rng)
    assert found.count == 2
    off = [np.abs(distances(one) - distances(truth.pulses[0])).max() for one in found.pulses]
    assert max(off) < 1e-9  # turned and mirrored, not bent
    near = [np.linalg.norm(one - truth.pulses[0], axis=1).max() for one in found.pulses]
    assert min(near) < 1e-6


def test_ends_of_one_start_count_once():
    truth = hall(1, 4, 3, 0.0)[0]
    one = RoundEnds(together(truth, truth, truth), np.array([1.0, 1.0, 2.0]), np.array([7, 7, 8]))
    assert one.counted(np.array([True, True, True])) == 2
    assert one.counted(one.cost < 2.0) == 1
    both = joined([one, one.take(np.array([2]))])
    assert both.start.tolist() == [7, 7, 8, 8]
    assert both.at.count == 4
