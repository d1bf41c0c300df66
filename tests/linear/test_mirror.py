"""Mirror images in the plane of the stations."""

from dataclasses import replace

import numpy as np
import pytest

from optloc import Motion, assemble, measured
from optloc.linear.mirror import Folded, is_of_ranges, mirror, one_position, plane_of_stations, rows_of_stations
from optloc.linear.normal import Normal

LEVEL = np.array([[0.0, 0.0, 2.0], [9.0, 1.0, 2.0], [10.0, 9.0, 2.0], [1.0, 7.0, 2.0]])


def ranges(places=LEVEL, **more):
    rows = measured("range", np.full((1, len(places)), 5.0), a=np.arange(len(places)), sigma=1.0)
    return assemble(places, rows, **more)


def test_a_point_above_level_stations_is_mirrored_below_them():
    found = mirror(ranges(), np.array([[[4.0, 5.0, 9.0]]]))
    np.testing.assert_allclose(found, [[[4.0, 5.0, -5.0]]], atol=1e-12)


def test_two_mirrors_are_none_and_ranges_to_a_plane_of_any_tilt_stay():
    rng = np.random.default_rng(1)
    places = LEVEL @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + 7.0
    point = rng.uniform(-20.0, 20.0, (1, 5, 3))
    image = mirror(ranges(places), point)
    np.testing.assert_allclose(mirror(ranges(places), image), point, atol=1e-12)
    lengths = [np.linalg.norm(each[0, :, None] - places, axis=-1) for each in (point, image)]
    np.testing.assert_allclose(*lengths, atol=1e-12)


def test_the_plane_fits_the_stations_that_rows_are_present_of():
    places = np.append(LEVEL, [[3.0, 3.0, 50.0]], axis=0)
    weight = np.array([[1.0, 1.0, 1.0, 1.0, 0.0]])
    rows = measured("range", np.ones((1, 5)), a=np.arange(5), sigma=1.0, weight=weight)
    centre, axes, off, size = plane_of_stations(assemble(places, rows))
    np.testing.assert_allclose(centre[0], LEVEL.mean(0))
    np.testing.assert_allclose(np.abs(axes[0, :, 0]), [0.0, 0.0, 1.0], atol=1e-12)
    assert off[0] == pytest.approx(0.0, abs=1e-12)
    assert size[0] == pytest.approx(np.linalg.norm(LEVEL - LEVEL.mean(0), axis=1).max())


def test_rows_belong_to_their_stations():
    rows = [measured("range", a=[1], sigma=1.0), measured("tdoa", a=[2, 3], b=[0, 1], sigma=1.0)]
    found = rows_of_stations(assemble(LEVEL, *rows))
    assert found.astype(int).tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0], [0, 0, 1]]


def test_one_position_is_a_target_at_rest():
    assert one_position(ranges())
    assert not one_position(ranges(motions=(Motion(span="epoch"),)))
    assert not one_position(ranges(motions=(Motion(known=np.zeros((1, 1, 3))),)))
    assert [kind for kind in ("tdoa", "groa", "range_sum", "azimuth", "height") if is_of_ranges(kind)] == [
        "tdoa",
        "groa",
        "range_sum",
    ]


def test_on_the_plane_no_step_leads_across_it_unless_it_is_downhill():
    folded = Folded(2, np.full(2, 1e-3))
    info = np.broadcast_to(np.diag([2.0, 4.0, 5.0]), (2, 3, 3))
    vector = np.array([[1.0, 1.0, -3.0], [1.0, 1.0, 3.0]])
    none = np.zeros((2, 1, 0, 0)), np.zeros((2, 1, 3, 0)), vector, np.zeros((2, 1, 0)), np.zeros(2)
    x = np.array([[4.0, 5.0, 1e-3], [4.0, 5.0, 1e-3]])
    move, ok = folded.step(Normal(info, *none), np.zeros(2), x)
    assert ok.all()
    np.testing.assert_allclose(move, [[0.5, 0.25, 0.0], [0.5, 0.25, 0.6]], atol=1e-12)
    held, _ = replace(folded, held=True).step(Normal(info, *none), np.zeros(2), x)
    assert held[:, 2].tolist() == [0.0, 0.0]


def test_a_step_in_the_squared_distance_ends_on_the_plane_and_not_beyond():
    folded = Folded(2, np.full(3, 1e-3))
    x, move = np.full((3, 3), 2.0), np.zeros((3, 3))
    move[:, 2] = [3.0, -0.5, -5.0]  # dq = 2 w dw: 12, -2 and -20 of q = 4
    np.testing.assert_allclose(folded.retract(x, move)[:, 2], [4.0, np.sqrt(2.0), 1e-3])
    assert (folded.retract(x, move)[:, :2] == 2.0).all()
