"""Physical checks of networks: negative ranges, wrong units against known distances, and times without a speed."""

import re
from dataclasses import replace

import numpy as np
import pytest
from sites.calibration.scenes import hall

from optloc import InvalidProblem
from optloc.sites.calibration import network_of
from optloc.sites.calibration.network_checks import refuse_negative, require_speed, suspicious_network


def known(kind="toa", factor=1.0, **more):
    """Return a network with known stations, and the values of pulses multiplied by a factor."""
    truth, z = hall(3, 6, 12, 0.02)
    if kind == "range":
        z = np.linalg.norm(truth.pulses[0][:, None] - truth.stations[0], axis=-1)
    made = network_of(z, 0.05, kind=kind, place=truth.stations[0], place_sigma=0.1, **more)
    return replace(made, z=factor * made.z)


def between(factor=1.0):
    """Return a network of ranges with unknown stations and two measured distances."""
    truth, _ = hall(3, 6, 12, 0.02)
    s = truth.stations[0]
    z = np.linalg.norm(truth.pulses[0][:, None] - s, axis=-1)
    apart = [(0, j, float(np.linalg.norm(s[0] - s[j])), 0.05) for j in (1, 2, 3)]
    made = network_of(z, 0.05, kind="range", distances=apart)
    return replace(made, z=factor * made.z)


@pytest.mark.parametrize("made", [known(), known("range"), between()])
def test_right_values_cause_no_sentence(made):
    assert suspicious_network(made) == ()


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("factor", [1e3, 1e-3, 100.0])
def test_a_wrong_unit_of_ranges_is_recognised_from_known_distances(factor, synchronised):
    size = {1e3: "1000 times too large", 1e-3: "1000 times too small", 100.0: "100 times too large"}[factor]
    for made in (known("range", factor, synchronised=synchronised), between(factor)):
        (sentence,) = suspicious_network(made)
        assert size in sentence
        assert "state their unit" in sentence
        assert len(sentence) <= 200


def test_a_wrong_unit_of_arrivals_needs_a_common_clock():
    (sentence,) = suspicious_network(known(factor=1e3))
    assert "1000 times too large" in sentence
    assert suspicious_network(known(factor=1e3, synchronised=False)) == ()


def test_differences_of_known_pairs_are_compared():
    truth, z = hall(3, 4, 12, 0.02)
    made = network_of(
        1e3 * (z[:, 1:] - z[:, :1]), 0.05, kind="tdoa", pairs=[(1, 0), (2, 0), (3, 0)], place=truth.stations[0] + np.nan
    )
    assert suspicious_network(made) == ()
    with pytest.warns(UserWarning, match="1000 times too large"):
        network_of(
            1e3 * (z[:, 1:] - z[:, :1]), 0.05, kind="tdoa", pairs=[(1, 0), (0, 2), (3, 0)], place=truth.stations[0]
        )


def test_negative_ranges_are_refused():
    z = np.array([[3.0, 4.0, 5.0], [2.0, -3.0, 4.0]])
    with pytest.raises(InvalidProblem, match=re.escape("z: the range of pulse 1 at A2 is -3 m, and no distance")):
        network_of(z, 0.1, kind="range", dimension=2)
    network_of(z, 1.0, kind="range", dimension=2)  # within its noise
    network_of(z, 0.1, dimension=2)  # arrivals may be negative
    refuse_negative(z[0], np.full(3, 0.1), str, str, "remove the row")


def test_times_of_sound_need_a_stated_speed():
    light = 299_792_458.0 / 343.0
    for made in (known(factor=light), between(light)):
        with pytest.raises(InvalidProblem, match="no wave speed is stated; state it, such as --wave-speed air:20C"):
            require_speed(made, "hall.toml", "--wave-speed air:20C")
    require_speed(known(), "hall.toml", "--wave-speed air:20C")
    require_speed(known(factor=light, synchronised=False), "hall.toml", "")  # clocks have any offset


def test_without_a_known_distance_the_earth_is_the_limit():
    _, z = hall(3, 6, 12, 0.02)
    free = network_of(z, 0.05)
    assert suspicious_network(free) == ()
    require_speed(free, "hall.toml", "")
    with pytest.raises(InvalidProblem, match="no wave speed"):
        require_speed(replace(free, z=1e6 * free.z), "hall.toml", "")
