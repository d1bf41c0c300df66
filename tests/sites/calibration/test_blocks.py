"""Single stations and pulses with the others held: mirror images, minima, and moves of one block."""

from dataclasses import replace

import numpy as np
import pytest
from sites.calibration.scenes import hall, reflected

from optloc import assemble, measured
from optloc.sites.calibration import network_of
from optloc.sites.calibration.blocks import (
    blocks,
    elsewhere,
    minima,
    mirrored,
    moved,
    moved_pulses,
    pulses_alone,
    settled,
    stations_alone,
)
from optloc.sites.calibration.likelihood import likelihood


@pytest.fixture(scope="module")
def network():
    truth, z = hall(3, 7, 10, 0.0, clocks=True)
    return truth, network_of(z, 0.05, synchronised=False)


def test_pulses_and_stations_alone_are_fixes_of_what_is_held(network):
    truth, net = network
    pulses = pulses_alone(net, truth)
    x, cost = minima(pulses, truth.pulses[0][:, None] + 0.2)
    assert cost.max() < 1e-6
    np.testing.assert_allclose(x[:, 0, :3], truth.pulses[0], atol=1e-5)
    np.testing.assert_allclose(x[:, 0, 3], truth.emission[0], atol=1e-5)
    stations = stations_alone(net, truth, np.array([1, 4]))
    x, cost = minima(stations, truth.stations[0, [1, 4]][:, None] + 0.2)
    assert cost.max() < 1e-6
    np.testing.assert_allclose(x[:, 0, 3], truth.clocks[0, [1, 4]], atol=1e-5)


def test_pulses_settle_where_they_fit_best(network):
    truth, net = network
    rough = replace(truth, pulses=truth.pulses + 0.3, emission=truth.emission + 1.0)
    found = settled(net, rough)
    np.testing.assert_allclose(found.pulses, truth.pulses, atol=1e-5)
    np.testing.assert_array_equal(found.stations, truth.stations)


def test_mirror_images_are_in_the_planes_of_the_partners_and_in_their_centre():
    partners = np.array([[3.0, 0, 0], [-3, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1]])
    problem = assemble(partners, measured("range", np.ones((1, 6)), a=np.arange(6), sigma=1.0)).flat()
    found = {tuple(np.round(place, 9)) for place in mirrored(problem, np.array([[1.0, 2.0, 3.0]]))[0]}
    assert found == {(-1.0, 2.0, 3.0), (1.0, -2.0, 3.0), (1.0, 2.0, -3.0), (-1.0, -2.0, -3.0)}


def test_a_pulse_that_is_moved_takes_the_time_of_emission_that_its_place_wants(network):
    truth, net = network
    lik = likelihood(net)
    found = moved_pulses(lik, truth, np.array([4]), truth.pulses[0, [4]] + 1.0)
    assert lik.residual(found)[0, 4].mean() == pytest.approx(0.0, abs=1e-9)
    assert found.pulses[0, 4] == pytest.approx(truth.pulses[0, 4] + 1.0)
    np.testing.assert_array_equal(np.delete(found.pulses, 4, axis=1), np.delete(truth.pulses, 4, axis=1))


def test_a_station_on_the_wrong_side_has_a_cheaper_place():
    truth, z = hall(3, 7, 10, 0.01)
    lik = likelihood(network_of(z, 0.01))
    wrong, i = reflected(lik.refine(truth)[0])
    at = settled(lik.network, wrong)
    found = [block for block in elsewhere(lik, at) if block.station and block.index == i]
    assert found
    assert found[0].gaps[0] < 0.0
    assert found[0].refuted
    assert lik.cost(moved(lik, at, found[0], found[0].places[0])) < lik.cost(at)


def test_blocks_of_the_right_network_are_proven_cheapest():
    truth, z = hall(3, 7, 4, 0.01)
    lik = likelihood(network_of(z, 0.01, place=truth.stations[0]))
    found = blocks(lik, settled(lik.network, truth))
    assert [block.name for block in found] == [f"pulse {j}" for j in range(4)]  # stations are known exactly
    assert all(block.cheapest and not block.refuted for block in found)
