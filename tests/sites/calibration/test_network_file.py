"""Files of networks: places, kinds and units as numbers, bad files as a sentence, and what is found as a file."""

import numpy as np
import pytest
from sites.calibration.scenes import hall

from optloc import Status
from optloc.base.errors import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files import read
from optloc.sites.calibration import network_of
from optloc.sites.calibration.calibrated import Calibration
from optloc.sites.calibration.network_file import read_network, write_calibrated

TEXT = """
format = 1
[stations]
sigma = "2 cm"
rows = [
  { name = "A", x = 1.0, y = 2.0, z = 3.0, sigma = 0.0 },
  { name = "B", x = 4.0 },
  { name = "C" },
]
[[measurements]]
kind = "toa"
unit = "ns"
sigma = "1 ns"
rows = [{ epoch = "p", a = "A", z = 10.0 }, { epoch = "p", a = "B", z = 20.0 }, { epoch = "q", a = "C", z = 30.0 }]
[[measurements]]
kind = "station_range"
sigma = "1 cm"
rows = [{ a = "A", b = "C", z = 7.0 }]
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "network.toml"


def test_places_and_measurements_are_metres(path):
    path.write_text(TEXT)
    net = read_network(path)
    assert (net.names, net.labels) == (("A", "B", "C"), ("p", "q"))
    assert net.place_sigma.tolist() == [[0.0] * 3, [0.02, np.inf, np.inf], [np.inf] * 3]
    nanosecond = 1e-9 * SPEED_OF_LIGHT
    np.testing.assert_allclose(net.z[net.given], np.array([10.0, 20.0, 30.0]) * nanosecond)
    np.testing.assert_allclose(net.sigma[net.given], nanosecond)
    assert net.given.tolist() == [[True, True, False], [False, False, True]]
    assert (net.between.tolist(), net.distance.tolist(), net.distance_sigma.tolist()) == ([[0, 2]], [7.0], [0.01])


def test_a_pulse_that_one_station_measures_twice_has_two_columns(path):
    path.write_text(TEXT.replace('a = "B", z = 20.0', 'a = "A", z = 20.0'))
    net = read_network(path)
    assert [(slot.kind, slot.a) for slot in net.slots] == [("toa", 0), ("toa", 0), ("toa", 2)]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('a = "B", z = 20.0', 'a = "D", z = 20.0', "there is no station 'D'"),
        ('kind = "toa"', 'kind = "azimuth"', "networks have no rows of kind 'azimuth'"),
        ('b = "C", z = 7.0', 'b = "A", z = 7.0', "names station 'A' twice"),
        ('sigma = "1 ns"\n', "", "the rows have no standard deviation"),
        ('{ epoch = "p", a = "A", z = 10.0 }', '{ a = "A", z = 10.0 }', "epoch"),
        ("format = 1", "format = 1\ntarget = {}", "the key 'target' belongs to a problem with known stations"),
    ],
)
def test_bad_files_are_one_sentence(path, old, new, said):
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(InvalidProblem, match=said):
        read_network(path)


def test_what_is_found_is_a_problem_file_whose_clocks_are_taken_off(path, tmp_path):
    truth, z = hall(1, 5, 6, 0.0, clocks=True)
    net, none = network_of(z, 0.1, synchronised=False), np.zeros(0)
    found = Calibration(
        net, truth.stations[0], truth.clocks[0], truth.pulses[0], truth.emission[0], 0.01 * np.eye(20), "known places",
        Status.OK, (), "blockwise", 0.0, 1, 1.0, 3, 8, (), none,
    )  # fmt: skip
    write_calibrated(found, "Hall", out := tmp_path / "found.toml", path)
    problem = read(out).problem
    np.testing.assert_allclose(problem.stations.position[0], truth.stations[0])
    apart = np.linalg.norm(truth.pulses[0][:, None] - truth.stations[0], axis=-1)
    np.testing.assert_allclose(problem.observed.reshape(6, 5), apart + truth.emission[0][:, None], atol=1e-9)
    with pytest.raises(InvalidProblem, match=r"its name must end in \.toml"):
        write_calibrated(found, "Hall", tmp_path / "found.csv", path)


WAYS = """
format = 1
propagation_speed = "1500 m/s"
[stations]
rows = [{ name = "A" }, { name = "B" }]
[[measurements]]
kind = "range"
unit = "ms"
sigma = "0.2 ms"
two_way = true
turn_around = "15 ms"
rows = [{ epoch = "p", a = "A", z = 55.0 }, { epoch = "p", a = "B", z = 35.0 }]
"""


def test_two_way_times_are_halved_without_the_turn_around(path):
    path.write_text(WAYS)
    net = read_network(path)
    assert net.z.tolist() == [[pytest.approx(30.0), pytest.approx(15.0)]]
    assert net.sigma.tolist() == [[pytest.approx(0.15), pytest.approx(0.15)]]
    path.write_text(WAYS.replace('two_way = true\nturn_around = "15 ms"\n', ""))
    same = read_network(path, two_way=True, turn_around="15 ms")
    assert np.allclose(same.z, net.z)
    made = network_of(
        [[0.055, 0.035]], 2e-4, kind="range", wave_speed=1500.0, two_way=True, turn_around="15 ms", dimension=2
    )
    assert np.allclose(made.z, net.z)
    assert np.allclose(made.sigma, net.sigma)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "range"', 'kind = "toa"', "has no way back"),
        ('"15 ms"', '"-2 ms"', "negative"),
        ('unit = "ms"\nsigma = "0.2 ms"', 'unit = "m"\nsigma = "0.2 m"', "two-way ranges are times"),
    ],
)
def test_wrong_two_way_times_are_named(path, old, new, said):
    path.write_text(WAYS.replace(old, new))
    with pytest.raises(InvalidProblem, match=said):
        read_network(path)


def test_two_way_options_need_ranges_that_are_times(path):
    path.write_text(TEXT)
    with pytest.raises(InvalidProblem, match="the file has no ranges"):
        read_network(path, two_way=True)
    with pytest.raises(InvalidProblem, match="need a wave speed"):
        network_of([[1.0, 2.0]], 0.1, kind="range", two_way=True, dimension=2)
    with pytest.raises(InvalidProblem, match="toa has no way back"):
        network_of([[1.0, 2.0]], 0.1, turn_around="2 ms", wave_speed=1500.0, dimension=2)
