"""S waves of layers as straight rays for starts."""

import numpy as np

from optloc.base.types import Rows
from optloc.models.phase_layers import PhaseLayers
from optloc.problem.straight_phases import straight_s_rows

GROUND = PhaseLayers((0.0,), (6000.0,), "constant", 0.0, None, (3000.0,))


def rows(kind, z, a, weight=1.0):
    """Return rows of one epoch and one target."""
    n = len(z)
    zeros, none = np.zeros(n, dtype=int), np.full(n, -1)
    return Rows(kind, np.array(z), np.array(a), none, zeros, zeros, np.full(n, weight), np.zeros(n))


def test_s_minus_p_of_a_station_is_a_range():
    r, e = np.array([5e3, 8e3]), 700.0
    p, s = rows("toa", r + e, [0, 1]), rows("s_toa", 2.0 * np.array([5e3, 8e3, 9e3]) + e, [0, 1, 2])
    made = straight_s_rows(s, [p], GROUND)
    assert made.kind == "range"
    assert np.allclose(made.z[:2], r)
    assert made.weight.tolist() == [1.0, 1.0, 0.0]
    assert straight_s_rows(s, [rows("toa", r + e, [0, 1], 0.0)], GROUND).weight.tolist() == [0.0, 0.0, 0.0]


def test_s_alone_are_arrival_times():
    made = straight_s_rows(rows("s_toa", [20e3, 30e3], [0, 1]), [], GROUND)
    assert made.kind == "toa"
    assert np.allclose(made.z, [10e3, 15e3])
