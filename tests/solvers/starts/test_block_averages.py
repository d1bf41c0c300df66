"""Block averages of a run: the line through the values of each block, taken in its middle."""

import numpy as np
import pytest

from optloc import Motion, assemble, measured
from optloc.solvers.starts.block_averages import _line_coefficients, average_blocks

STATIONS = np.array([[0.0, 0.0], [1000.0, 0.0], [500.0, 900.0]])
EPOCHS, SIGMA = 20, 2.0
TIMES = np.arange(EPOCHS) * 1.0
A, EPOCH = np.tile(np.arange(3), EPOCHS), np.repeat(np.arange(EPOCHS), 3)


def run(z, kind="range", times=TIMES, **more):
    rows = measured(kind, z, a=A, epoch=EPOCH, sigma=SIGMA, **more)
    return assemble(STATIONS, rows, times=times, motions=(Motion(1),)).flat()


def test_a_block_has_the_value_of_its_line_in_the_middle_and_the_noise_of_a_mean():
    z = np.random.default_rng(0).uniform(100.0, 900.0, len(A))
    blocks = average_blocks(run(z), 4)
    np.testing.assert_allclose(blocks.times, [2.0, 7.0, 12.0, 17.0])
    assert blocks.count == 12
    for k in range(4):
        for a in range(3):
            inside = (EPOCH // 5 == k) & (A == a)
            line = np.polyfit(TIMES[EPOCH[inside]], z[inside], 1)
            row = (blocks.rows[0].a == a) & (blocks.rows[0].epoch == k)
            assert blocks.z[0, row][0] == pytest.approx(np.polyval(line, blocks.times[k]))
    # five values at equal steps: the line is the mean in the middle
    np.testing.assert_allclose(blocks.noise.blocks[0].covariance.max(), SIGMA**2 / 5.0)


def test_angles_are_averaged_across_the_cut():
    z = np.where(EPOCH % 2 == 0, np.pi - 0.01, -np.pi + 0.01)
    blocks = average_blocks(run(z, "azimuth"), 4)
    assert np.abs(np.abs(blocks.z) - np.pi).max() < 0.011


def test_a_block_with_a_gap_is_left_out_and_short_runs_stay():
    times = np.where(np.arange(EPOCHS) > 7, TIMES + 100.0, TIMES)
    assert len(average_blocks(run(np.full(len(A), 500.0), times=times), 4).times) == 3
    assert average_blocks(run(np.full(len(A), 500.0)), 20).count == len(A)


def test_coefficients_of_the_middle_give_back_every_line():
    since, row = np.array([-2.0, 0.5, 1.0, -1.0, 3.0]), np.array([0, 0, 0, 1, 1])
    coefficient = _line_coefficients(since, row)
    for line in (np.ones(5), since):
        at_zero = np.bincount(row, coefficient * line)
        np.testing.assert_allclose(at_zero, [line[0] if line is not since else 0.0] * 2, atol=1e-12)
