"""Block averages: the middle of each block, its covariance, and what they leave out."""

import numpy as np
import pytest
from runs import drawn, run, truth

import optloc
from optloc.kernels.least_squares import refine
from optloc.linear.normal import with_station_noise
from optloc.problem.noise import dense
from optloc.solvers.starts.block_averages import average_blocks


def test_blocks_of_one_epoch_are_the_run():
    problem = run(20)
    blocks = average_blocks(problem, 30)
    assert blocks.epochs == 20
    np.testing.assert_allclose(
        dense(blocks.noise, np.arange(8)), dense(with_station_noise(problem).noise, np.arange(8))
    )


@pytest.mark.parametrize(("epochs", "blocks", "length"), [(600, 30, 20), (700, 30, 23), (200, 33, 6), (95, 31, 3)])
def test_blocks_are_equally_long_and_their_noise_is_averaged(epochs, blocks, length):
    problem = average_blocks(run(epochs), 30)
    assert problem.epochs == blocks
    np.testing.assert_allclose(np.diff(problem.times), length)
    np.testing.assert_allclose(dense(problem.noise, np.arange(4)), 10.0 / length * (np.eye(4) + 1.0), rtol=1e-9)


def test_averages_are_means_where_nothing_is_missing():
    problem = drawn(run(60), 1, 2)
    blocks = average_blocks(problem, 30)
    np.testing.assert_allclose(blocks.z.reshape(2, 30, 4), problem.z.reshape(2, 30, 2, 4).mean(2), rtol=1e-12)
    position = problem.stations.position.reshape(30, 2, 5, 3).mean(1)
    np.testing.assert_allclose(blocks.stations.position, position, rtol=1e-12)


def test_missing_rows_do_not_shift_the_middle():
    """Without noise the line through what is left of a block meets the full average to the curvature of the path."""
    problem = run(300)
    exact = optloc.engine.predict(problem, truth(problem))
    weight = np.ones(problem.count)
    weight[np.random.default_rng(1).random(problem.count) < 0.3] = 0.0
    full = average_blocks(problem.with_rows(z=exact), 30)
    holed = average_blocks(problem.with_rows(z=np.where(weight > 0.0, exact, np.nan), weight=weight), 30)
    key = holed.rows[0].epoch * 10 + holed.rows[0].a
    place = np.searchsorted(full.rows[0].epoch * 10 + full.rows[0].a, key)
    assert holed.count > 110
    np.testing.assert_allclose(holed.z, full.z[place], atol=5.0)
    assert np.abs(exact[4:] - exact[:-4]).min() > 1.0  # against metres from one epoch to the next


def test_angles_are_averaged_on_the_circle():
    epoch = np.arange(60)
    z = np.pi + 0.002 * np.sin(epoch)
    rows = optloc.measured("azimuth", np.arctan2(np.sin(z), np.cos(z)), a=0, epoch=epoch, sigma=0.01)
    problem = optloc.assemble([[0.0, 0.0], [1.0, 1.0]], rows, times=epoch.astype(float))
    blocks = average_blocks(problem, 30)
    assert np.abs(np.cos(blocks.z) + 1.0).max() < 1e-5


def test_a_gap_in_time_makes_no_block():
    times = np.concatenate([np.arange(95.0), 1000.0 + np.arange(88.0)])
    rows = optloc.measured("range", np.zeros(183), a=0, epoch=np.arange(183), sigma=1.0)
    blocks = average_blocks(optloc.assemble([[0.0, 0.0]], rows, times=times), 10)
    assert blocks.epochs == 9
    assert not ((blocks.times > 95.0) & (blocks.times < 1000.0)).any()


def test_the_answer_of_the_blocks_is_near_that_of_the_run():
    problem = drawn(run(600), 3, 20)
    blocks, x = average_blocks(problem, 30), np.broadcast_to(truth(problem), (20, 7))
    apart = refine(blocks, x).x - refine(problem, x).x
    sigma = np.sqrt(np.diagonal(optloc.crlb(run(600), truth(problem))))
    assert np.abs(apart[:, :3] / sigma[:3]).max() < 5.0
    assert np.abs(apart[:, :3]).max() < 200.0
