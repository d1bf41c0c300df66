"""Messages of airliners from small tables: arrivals, station biases, triplets, and the excess path through air."""

import numpy as np
import pytest
from scipy.integrate import quad

from optloc.base.frames import ECEF
from optloc.base.units import SPEED_OF_LIGHT
from optloc.lab.datasets.adsb import REFRACTIVITY, SCALE_HEIGHT, Heard, _refraction, heard, load

PLACES = np.deg2rad([[47.0, 11.0], [47.5, 11.2], [47.2, 12.0], [46.8, 11.5], [47.9, 11.9]])
STATIONS = ECEF.from_geodetic(PLACES[:, 0], PLACES[:, 1], np.array([600.0, 700.0, 500.0, 900.0, 550.0]))
FLIGHT = np.array([np.deg2rad(47.3), np.deg2rad(11.4), 10e3])


def messages(bias):
    """Return three messages whose arrivals are exact but for an emission time each and biases of the stations."""
    geodetic = FLIGHT + np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 100.0], [0.0, 0.02, -300.0]])
    r = np.linalg.norm(ECEF.from_geodetic(*geodetic.T)[:, None] - STATIONS, axis=-1)
    return Heard(np.tile(STATIONS, (3, 1, 1)), r + np.array([[7.0], [-3.0], [1e3]]) + bias, np.zeros((3, 5)), geodetic)


def test_the_bias_of_a_station_becomes_its_excess():
    bias = np.array([0.0, 40.0, 0.0, -25.0, 0.0])
    np.testing.assert_allclose(messages(bias).unbiased().excess, np.tile(bias, (3, 1)), atol=1e-6)


def test_triplets_are_all_ten_threes_of_each_message():
    data = messages(0.0)
    three = data.triplets()
    assert len({tuple(row) for row in three.arrival[:10]}) == 10
    assert {value for row in three.arrival[10:20] for value in row} == set(data.arrival[1])
    np.testing.assert_array_equal(three.truth[:10], np.tile(data.truth[0], (10, 1)))


def test_the_height_is_a_row_or_a_constraint():
    data = messages(0.0)
    counts = {given: data.problem(given).count for given in ("exactly", "row", "nothing")}
    assert counts == {"exactly": 5, "row": 6, "nothing": 5}
    assert len(data.problem("exactly").constraints) > len(data.problem("nothing").constraints)


@pytest.mark.parametrize("low", [100.0, 2500.0])
def test_air_lengthens_a_path_by_the_integral_of_its_refractivity(low):
    high, length = 11e3, 80e3
    mean = quad(lambda h: REFRACTIVITY * np.exp(-h / SCALE_HEIGHT), low, high)[0] / (high - low)
    assert _refraction(np.array(low), np.array(high), np.array(length)) == pytest.approx(mean * length, rel=1e-9)


def test_arrivals_of_a_file_are_counted_from_the_first_of_their_message(tmp_path):
    data = messages(0.0)
    lines = [",".join(map(repr, (7 + s, *map(float, place), 600.0))) for s, place in enumerate(STATIONS)]
    (tmp_path / "stations.csv").write_text("station,x_m,y_m,z_m,h_m\n" + "\n".join(lines))
    degrees = np.degrees(data.geodetic[:, :2])
    lines = [
        ",".join(map(repr, (1, k, *map(float, (*data.truth[k], *degrees[k], data.geodetic[k, 2]))))) for k in range(3)
    ]
    header = "set,msg,x_m,y_m,z_m,lat_deg,lon_deg,h_geo_m\n"
    (tmp_path / "truth.csv").write_text(header + "\n".join(lines))
    seconds = 0.5 + data.arrival / SPEED_OF_LIGHT
    lines = [f"1,{k},{7 + s},{float(seconds[k, s])!r}" for s in range(5) for k in (2, 0, 1)]  # not in their order
    (tmp_path / "measurements.csv").write_text("set,msg,station,toa_s\n" + "\n".join(lines))
    wanted = data.arrival - data.arrival.min(1, keepdims=True)
    np.testing.assert_allclose(heard(tmp_path).arrival, wanted, atol=1e-5)
    whole = load(tmp_path)
    assert whole.problem.epochs == 3
    assert whole.problem.count == 18  # five arrivals and a height each
    np.testing.assert_allclose(whole.horizontal(whole.truth[[1]] + 3.0 * ECEF.enu_axes(whole.truth[[1]])[:, 0], [1]), 3)
