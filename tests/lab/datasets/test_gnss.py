"""Pseudoranges of a session made by hand: epochs, missing satellites, the mask, and the geometry of three."""

import numpy as np
import pandas as pd
import pytest

from optloc.base.errors import InvalidProblem
from optloc.lab.datasets.gnss import SIGMA, Session, conditioning, dataset, load

RECEIVER = np.array([6378e3, 0.0, 0.0])
GEODETIC = (0.0, 0.0, 0.0)


def rows():
    """Return two epochs; the satellite E02 is heard in the second one alone."""
    heard = [(0.0, "G01", 1.0), (0.0, "G05", 0.5), (0.0, "J03", 1.2), (30.0, "G01", 1.0), (30.0, "E02", np.pi / 6)]
    data = pd.DataFrame(heard, columns=["t_gps_s", "sat", "el_rad"])
    data[["sat_x_m", "sat_y_m", "sat_z_m"]] = 2e7 + 1e5 * np.arange(15.0).reshape(5, 3)
    return data.assign(prc_l1_m=2e7 + np.arange(5.0))


def test_a_satellite_that_is_not_heard_has_no_weight():
    found = Session(rows(), "prc_l1_m", RECEIVER, GEODETIC).epochs()
    assert found.systems == ("E", "G", "G", "J")
    assert found.weight.tolist() == [[0.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 0.0]]
    assert found.z[1, 0] == 2e7 + 4.0
    assert found.sigma[1, 0] == pytest.approx(2.0 * SIGMA)  # at 30 degrees
    assert np.isfinite(found.satellites).all()


def test_every_other_epoch_and_the_whole_run_have_their_rows():
    session = Session(rows(), "prc_l1_m", RECEIVER, GEODETIC)
    assert session.epochs(every=2).weight.sum() == 3.0
    assert (session.run().epochs, session.run().count) == (2, 5)


def test_differences_of_a_draw_are_those_to_its_first_satellite():
    session = Session(rows().iloc[:3], "prc_l1_m", RECEIVER, GEODETIC)
    found = session.draws(4, seed=1)
    np.testing.assert_array_equal(found.by_difference().z.reshape(4, 2), found.z[:, 1:] - found.z[:, :1])
    assert (np.sort(found.z, axis=1) == session.rows["prc_l1_m"].to_numpy()).all()


def test_the_geometry_of_three_is_that_of_their_horizontal_directions():
    directions = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    # Differences (-2, 0) and (-1, 1): the squares of the singular values are 3 ± the root of 5.
    found = conditioning(RECEIVER + 2e7 * directions[None], RECEIVER, GEODETIC)
    assert found == pytest.approx([np.sqrt(3.0 - np.sqrt(5.0))])


def test_low_satellites_and_missing_values_are_left_out(tmp_path):
    data = rows().assign(session="K", prc_if_m=1.0)
    data.loc[0, "el_rad"], data.loc[1, "prc_l1_m"] = np.deg2rad(9.0), np.nan
    data.to_csv(tmp_path / "measurements.csv")
    truth = {"session": ["K"], "x_m": [1.0], "y_m": [2.0], "z_m": [3.0], "lat_deg": [90.0], "lon_deg": [0.0]}
    pd.DataFrame(truth | {"h_m": [7.0]}).to_csv(tmp_path / "truth.csv")
    session = load(tmp_path, "K", "prc_l1_m")
    assert session.rows["sat"].tolist() == ["J03", "G01", "E02"]
    assert session.geodetic == pytest.approx((np.pi / 2.0, 0.0, 7.0))
    with pytest.raises(InvalidProblem, match="form: 'tree' is unknown; did you mean 'three'"):
        dataset(tmp_path, form="tree")
