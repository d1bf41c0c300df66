"""The frame of a network: moves that no row sees, frames of stations, planes, and how Gaussian the cost is."""

from dataclasses import replace

import numpy as np
import pytest
from sites.calibration.scenes import degenerate, distances, hall

from optloc.sites.calibration import network_of
from optloc.sites.calibration.gauge import (
    departure,
    determined,
    fixed_by,
    flat,
    frame_moves,
    in_frame,
    is_mirror_image,
    over,
    shifted,
    with_mean_clock,
)
from optloc.sites.calibration.likelihood import likelihood


def test_the_cost_is_that_of_a_gaussian_where_noise_is_small():
    far = []
    for sigma in (1e-4, 0.03):
        truth, z = hall(500096, 6, 20, sigma)
        lik = likelihood(network_of(z, sigma))
        at = lik.refine(truth)[0]
        far.append(departure(lik, at, determined(lik, at)))
    assert far[0] < 0.02
    assert far[1] > 0.3


@pytest.mark.parametrize("clocks", [False, True])
def test_no_row_sees_a_move_of_the_frame(clocks):
    truth, z = hall(2, 6, 12, 0.0, clocks=clocks)
    lik = likelihood(network_of(z, 0.1, synchronised=not clocks))
    told = determined(lik, truth)
    assert told.free.shape[1] == 6 + clocks
    assert told.open.shape[1] == 0
    moves = frame_moves(lik.network, truth)
    inside = told.free @ (told.free.T @ moves)
    np.testing.assert_allclose(inside, moves, atol=1e-7)


def test_the_covariance_is_the_inverse_of_the_information_off_the_frame():
    truth, z = hall(2, 6, 12, 0.0)
    told = determined(likelihood(network_of(z, 0.1)), truth)
    found, information = told.covariance(told.free.T), told.jacobian.T @ told.jacobian
    np.testing.assert_allclose(found, np.linalg.pinv(information, rcond=1e-9), atol=1e-9)
    np.testing.assert_allclose(found @ told.free, 0.0, atol=1e-9)


@pytest.mark.parametrize("draw", [3, 4, 5, 6])
def test_named_stations_are_at_zero_on_an_axis_and_in_a_plane(draw):
    truth, z = hall(draw, 6, 8, 0.0, clocks=True)
    net = network_of(z, 0.1, synchronised=False)
    found = in_frame(net, truth, (1, 4, 2))
    held = fixed_by(net, (1, 4, 2))
    values = np.concatenate([found.stations[0].ravel(), found.clocks[0]])
    assert held @ values == pytest.approx([0.0] * 7, abs=1e-9)
    assert found.stations[0, 4, 0] > 0.0
    height = found.stations[0, :, 2]
    assert height[np.abs(height).argmax()] > 0.0  # of two mirror images
    np.testing.assert_allclose(distances(found.pulses[0]), distances(truth.pulses[0]))
    np.testing.assert_allclose(likelihood(net).residual(found), 0.0, atol=1e-6)


def test_a_free_frame_is_at_the_centre_along_the_main_axes():
    truth, z = hall(3, 6, 8, 0.0)
    stations = in_frame(network_of(z, 0.1), truth, ()).stations[0]
    assert stations.mean(axis=0) == pytest.approx([0.0] * 3, abs=1e-9)
    moments = stations.T @ stations
    np.testing.assert_allclose(moments - np.diag(np.diag(moments)), 0.0, atol=1e-8)
    assert (np.diff(np.diag(moments)) < 0.0).all()


def test_clocks_are_told_against_their_mean_and_times_of_emission_follow():
    truth, z = hall(3, 6, 8, 0.0, clocks=True)
    net = network_of(z, 0.1, synchronised=False)
    found = with_mean_clock(net, truth)
    assert found.clocks[0].mean() == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(likelihood(net).residual(found), 0.0, atol=1e-6)


def test_a_turned_and_mirrored_network_is_laid_over_the_other(seed):
    truth, _ = hall(3, 6, 8, 0.0)
    turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    for mirror in (1.0, -1.0):
        moved = replace(truth, stations=truth.stations @ turn * mirror + 7.0, pulses=truth.pulses @ turn * mirror + 7.0)
        found = over(moved, truth)
        np.testing.assert_allclose(found.stations, truth.stations, atol=1e-9)
        np.testing.assert_allclose(found.pulses, truth.pulses, atol=1e-9)


def test_only_a_reflection_is_a_mirror_image(seed):
    truth, _ = hall(3, 6, 8, 0.0)
    turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))  # a rotation of space
    for sign, longer in ((1.0, 1.0), (-1.0, 1.0), (-1.0, 1.01)):
        maps = [sign * longer * points @ turn + 7.0 for points in (truth.stations, truth.pulses)]
        one = replace(truth, stations=maps[0], pulses=maps[1])
        assert is_mirror_image(one, truth, 1e-6) == (sign < 0.0 and longer == 1.0)


def test_moves_shift_stations_and_then_clocks():
    truth, _ = hall(3, 4, 5, 0.0, clocks=True)
    moves = np.arange(32.0).reshape(2, 16)
    found = shifted(truth, moves)
    np.testing.assert_allclose(found.stations[1] - truth.stations[0], moves[1, :12].reshape(4, 3))
    np.testing.assert_allclose(found.clocks[1] - truth.clocks[0], moves[1, 12:])
    np.testing.assert_array_equal(shifted(truth, moves[:, :12]).clocks[0], truth.clocks[0])


@pytest.mark.parametrize(("case", "words"), [("stations flat", ["The stations are in one plane"]), (None, [])])
def test_stations_in_one_plane_leave_a_side_open(case, words):
    truth, z = hall(1, 9, 20, 0.03)
    if case:
        z = degenerate(case, 1)
        truth = replace(truth, stations=truth.stations * (1.0, 1.0, 0.0))
    lik = likelihood(network_of(z, 0.03))
    at = lik.refine(truth)[0]
    told = determined(lik, at)
    found = flat(lik, at, told.covariance(told.free.T))
    assert [line.split(" within")[0] for line in found] == words
