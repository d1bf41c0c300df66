"""Arguments that are numbers accept text with a unit."""

import numpy as np
import pytest

import optloc
from optloc.base.units import SPEED_OF_LIGHT, in_si

RING = 1e3 * np.array([[0.0, 0, 0], [10, 0, 1], [0, 10, 2], [-9, 1, 0.5], [1, -8, 3]])
FOOT = 0.3048


@pytest.mark.parametrize(
    ("value", "quantity", "found"),
    [
        ("2 km", "length", 2000.0),
        ("20 ns", "length", 20e-9 * SPEED_OF_LIGHT),
        ("90 deg", "angle", np.pi / 2),
        ("36 km/h", "speed", 10.0),
        (["1 m", 2.0, "3 cm"], "length", [1.0, 2.0, 0.03]),
        (np.array(["1 km", "2 km"]), "length", [1000.0, 2000.0]),
    ],
)
def test_text_with_a_unit_becomes_si(value, quantity, found):
    np.testing.assert_allclose(in_si(value, quantity, "here"), found, rtol=1e-15)


def test_values_without_text_are_returned_as_they_are():
    values = [1.0, 2.0]
    assert in_si(values, "length", "here") is values
    assert in_si(None, "length", "here") is None


@pytest.mark.parametrize(
    ("value", "words"), [("12", "has no unit"), ("much", "is no amount"), ("3 parsec", "parsec"), ("3 deg", "deg")]
)
def test_text_that_is_no_length_is_refused(value, words):
    with pytest.raises(optloc.InvalidProblem, match=f"here.*{words}"):
        in_si(value, "length", "here")


def test_noise_and_values_of_rows_accept_units():
    text = optloc.measured("range", ["1 km", "2 km"], a=[0, 1], sigma="5 m", correction="30 cm")
    plain = optloc.measured("range", [1000.0, 2000.0], a=[0, 1], sigma=5.0, correction=0.3)
    np.testing.assert_array_equal(text.rows.z, plain.rows.z)
    np.testing.assert_array_equal(text.variance, plain.variance)
    np.testing.assert_array_equal(text.rows.correction, plain.rows.correction)


def test_constraints_accept_units():
    (height,) = optloc.constraints.height("1000 ft", "2000 ft")
    assert (float(height.lower), float(height.upper)) == (1000 * FOOT, 2000 * FOOT)
    (speed,) = optloc.constraints.speed("72 km/h")
    assert float(speed.upper) == pytest.approx(20.0)
    (low, _) = optloc.constraints.box(["-1 km", 0.0], ["1 km", "5 m"])
    assert float(low.lower) == -1000.0
    (sight,) = optloc.constraints.visible([[7e6, 0.0, 0.0]], elevation="30 deg")
    assert float(sight.lower) == pytest.approx(0.5)


def test_frames_stations_and_times_accept_units():
    assert optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0, height="1 km").origin[2] == 1000.0
    assert optloc.station_array([["1 km", 0.0], [0.0, "1 km"]]).position[0].tolist() == [[1e3, 0.0], [0.0, 1e3]]
    rows = optloc.measured("range", a=[0, 1], epoch=[0, 1], sigma=1.0)
    assert optloc.assemble(RING, rows, times=["0 s", "1500 ms"]).times.tolist() == [0.0, 1.5]


def test_a_bias_takes_the_unit_of_its_rows_or_of_its_form():
    problem = optloc.assemble(RING, optloc.measured("toa", a=np.arange(5), sigma=1.0))
    clock = optloc.with_bias(problem, "clock", members=["S1", "S2"], mean="10 ns", sigma="20 ns").biases[-1]
    np.testing.assert_allclose(clock.mean, 10e-9 * SPEED_OF_LIGHT)
    np.testing.assert_allclose(clock.sigma, 20e-9 * SPEED_OF_LIGHT)
    turned = optloc.assemble(RING, optloc.measured("azimuth", a=np.arange(5), sigma="1 deg"))
    north = optloc.with_bias(turned, "north", per="station", kind="azimuth", sigma="2 deg").biases[-1]
    np.testing.assert_allclose(north.sigma, np.radians(2.0))


def test_locate_accepts_a_height_and_a_speed_with_units():
    anchors = {
        "A": (0.0, 0.0, 2.0),
        "B": (8.0, 0.0, 3.0),
        "C": (0.0, 6.0, 2.5),
        "D": (8.0, 6.0, 2.0),
        "E": (4.0, 3.0, 3.0),
    }
    truth = np.array([3.0, 2.0, 0.3048])
    ranges = {name: float(np.linalg.norm(truth - place)) for name, place in anchors.items()}
    text = optloc.locate(anchors, ranges=ranges, sigma="1 cm", height="1 ft")
    plain = optloc.locate(anchors, ranges=ranges, sigma=0.01, height=FOOT)
    np.testing.assert_array_equal(text.x, plain.x)
    np.testing.assert_allclose(text.position, truth, atol=1e-6)
    late = {name: value / 343.0 for name, value in ranges.items()}
    slow = optloc.locate(anchors, toa=late, sigma="20 us", wave_speed="343 m/s")
    np.testing.assert_allclose(slow.position, truth, atol=1e-3)
    guessed = optloc.locate(anchors, toa=late, sigma="20 us", wave_speed=("340 m/s", "5 m/s"))
    np.testing.assert_allclose(guessed.position, truth, atol=0.1)


def test_a_height_that_is_no_length_names_the_unit():
    with pytest.raises(optloc.InvalidProblem, match=r"height.*furlong"):
        optloc.locate(
            {"A": (0.0, 0, 0), "B": (8.0, 0, 1), "C": (0.0, 6, 2)}, ranges=[5, 5, 5], sigma=1, height="3 furlong"
        )


def test_fixes_keep_the_index_of_a_data_frame():
    import pandas as pd

    anchors = {"A": (0.0, 0.0), "B": (8.0, 0.0), "C": (0.0, 6.0), "D": (8.0, 6.0)}
    index = pd.Index(["first", "second", "third"])
    table = pd.DataFrame(
        [[5.0, 5.0, 5.0, 5.0], [5.1, 4.9, 5.1, 4.9], [5.2, 4.8, 5.1, 4.8]], index=index, columns=list("ABCD")
    )
    fix = optloc.locate(anchors, ranges=table, sigma=0.1)
    assert fix.to_dataframe().index.equals(index)
    assert fix[[2, 0]].to_dataframe().index.tolist() == ["third", "first"]
    long = table.stack().rename_axis(["epoch", "station"]).rename("value").reset_index()
    assert optloc.locate(anchors, ranges=long, sigma=0.1).to_dataframe().index.tolist() == index.tolist()


def test_the_state_of_a_moving_target_comes_in_any_order():
    rows = optloc.measured("range", a=np.tile(np.arange(4), 6), epoch=np.repeat(np.arange(6), 4), sigma=1.0)
    run = optloc.assemble(RING[:4, :2], rows, motions=(optloc.Motion(1),))
    fix = optloc.solve(optloc.simulate(run, np.array([2e3, 3e3, 20.0, -10.0]), 1))
    mean, cov = fix.state("x vx y vy")
    assert mean.tolist() == [fix.position[0], fix.velocity[0], fix.position[1], fix.velocity[1]]
    np.testing.assert_array_equal(cov[:2, :2], fix.cov[np.ix_([0, 2], [0, 2])])
    np.testing.assert_array_equal(fix.state()[0], np.concatenate([fix.position, fix.velocity]))


@pytest.mark.parametrize(
    "stated",
    [
        lambda: optloc.constraints.box(["1 km"], ["2 s"]),
        lambda: optloc.constraints.height("10 ms"),
        lambda: optloc.station_array([["1 km", 0.0], ["3 us", 0.0]]),
        lambda: optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0, height="1 ns"),
    ],
)
def test_a_time_is_no_coordinate(stated):
    with pytest.raises(optloc.InvalidProblem, match="is a time"):
        stated()


def test_decibels_are_no_deviation_of_a_ratio_of_unknown_size():
    with pytest.raises(optloc.InvalidProblem, match="dB has no fixed size"):
        optloc.measured("groa", a=[0, 1], b=[1, 0], sigma="1 dB")


def test_text_in_rows_of_different_lengths_is_refused():
    with pytest.raises(optloc.InvalidProblem, match="stations: the numbers do not form an array"):
        optloc.station_array([["1 km", 0.0], ["2 km"]])


def test_packages_of_neighbours_are_attributes():
    assert callable(optloc.sites.calibration.network_of)
    assert callable(optloc.lab.datasets.available)
