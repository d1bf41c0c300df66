"""Networks as numbers: counts of rows and unknowns, and selections of pulses."""

import numpy as np
from sites.calibration.scenes import hall

from optloc.sites.calibration import network_of


def test_rows_and_unknowns_are_counted():
    _, z = hall(1, 5, 7, 0.0)
    z[0, 0] = np.nan
    place_sigma = np.full((5, 3), np.inf)
    place_sigma[0], place_sigma[1] = 0.0, 0.5
    net = network_of(z, 0.1, place=np.zeros((5, 3)), place_sigma=place_sigma, distances=[(0, 1, 3.0, 0.1)])
    assert (net.stations, net.pulses, net.dimension) == (5, 7, 3)
    assert net.rows == 34 + 1 + 3  # arrivals, the distance, and what is known of a place
    assert net.unknowns == 4 * 3 + 7 * 4
    assert network_of(z, 0.1, synchronised=False).unknowns == 5 * 3 + 5 + 7 * 4
    assert not net.given[0, 0]


def test_ranges_have_no_time_of_emission():
    _, z = hall(1, 5, 7, 0.0)
    assert network_of(z, 0.1).emission.all()
    assert not network_of(abs(z), 0.1, kind="range").emission.any()
    assert not network_of(z[:, :2], 0.1, kind="tdoa", pairs=[(1, 0), (2, 0)]).emission.any()


def test_some_pulses_keep_their_rows_and_labels():
    _, z = hall(1, 5, 4, 0.0)
    net = network_of(z, 0.1, labels=list("pqrs")).take(np.array([3, 1]))
    assert net.labels == ("s", "q")
    np.testing.assert_array_equal(net.z, z[[3, 1]])
