"""Arrivals as differences: their values and their covariance are those of the definition."""

import numpy as np
import pytest

from optloc import Motion, assemble, measured
from optloc.problem.noise import dense
from optloc.tracking.differences import differences

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0]])


def arrivals(k):
    z = np.random.default_rng(0).normal(500.0, 100.0, 4 * k)
    rows = measured("toa", z, a=np.tile(np.arange(4), k), epoch=np.repeat(np.arange(k), 4), sigma=2.0)
    return assemble(PLACES, rows, motions=(Motion(1, "run"),), times=np.arange(float(k)))


def test_differences_of_arrivals_have_no_emission_times():
    run = arrivals(3)
    found = differences(run)
    assert run.emitting
    assert not found.emitting
    assert (found.count, [rows.kind for rows in found.rows]) == (9, ["tdoa"])
    rows, z = found.rows[0], run.z.reshape(3, 4)
    assert rows.z == pytest.approx(z[rows.epoch, rows.a] - z[rows.epoch, rows.b])
    # Two differences share the error of a station that both have, with the sign that it has in each.
    signs = np.zeros((9, 3, 4))
    np.add.at(signs, (np.arange(9), rows.epoch, rows.a), 1.0)
    np.add.at(signs, (np.arange(9), rows.epoch, rows.b), -1.0)
    flat = signs.reshape(9, -1)
    assert dense(found.noise, np.arange(9)) == pytest.approx(4.0 * flat @ flat.T)
