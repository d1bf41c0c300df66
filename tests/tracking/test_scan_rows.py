"""Scans for machine code: stations of rows, determinants of covariances, and which scans share one structure."""

import numpy as np
import pytest

from optloc import Motion, assemble, measured
from optloc.base import linalg
from optloc.tracking.scan_rows import _group_by_structure, _is_plain, owned, size_of, touched

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0]])


def run(*rows):
    return assemble(PLACES, *rows, motions=(Motion(1, "run"),), times=np.arange(3.0))


def test_each_station_has_an_error_for_each_kind():
    rows = measured("tdoa", a=[1, 2], b=0, sigma=1.0), measured("azimuth", a=[2], sigma=0.1)
    station, sign = touched(assemble(PLACES, *rows))
    # Kinds in the order of their names: errors 0 to 2 are those of azimuths.
    assert station.tolist() == [[4, 3], [5, 3], [2, -1]]
    assert sign.tolist() == [-1.0, -1.0, 0.0]


@pytest.mark.parametrize("rank", [3, 2])
def test_the_size_of_a_covariance_is_its_rank_and_determinant(rank):
    A = np.random.default_rng(0).standard_normal((3, rank))
    A /= np.linalg.norm(A, axis=-1, keepdims=True)
    R = 4.0 * A @ A.T
    found, logdet = size_of(linalg.whitening(R))
    values = np.linalg.eigvalsh(R)[3 - rank :]
    assert found == rank
    assert logdet == pytest.approx(rank * np.log(2.0 * np.pi) + np.log(values).sum(), rel=1e-6)


def test_epochs_with_the_same_rows_are_alike():
    rows = measured("range", a=[0, 1, 0, 2, 0, 1], epoch=[0, 0, 1, 1, 2, 2], sigma=1.0)
    found = {tuple(epochs.tolist()): index.tolist() for epochs, index in _group_by_structure(run(rows))}
    assert found == {(0, 2): [[0, 1], [4, 5]], (1,): [[2, 3]]}


def test_errors_of_station_positions_take_the_general_form():
    plain = run(measured("range", a=[0, 1, 2], epoch=[0, 1, 2], sigma=1.0))
    assert _is_plain(plain)
    assert not _is_plain(run(measured("toa", a=[0, 1, 2], epoch=[0, 0, 0], sigma=1.0)))


def test_values_that_machine_code_takes_are_not_copied():
    values = np.arange(6.0).reshape(2, 3)
    assert owned(values) is values
    turned = owned(values.T)
    assert turned.flags.carray
    assert np.array_equal(turned, values.T)
