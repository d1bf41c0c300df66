import math

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.base.frames import CARTESIAN, ECEF, Frame, ecef_to_geodetic, geodetic_to_ecef

HOME = Frame.enu(lat_deg=47.4, lon_deg=8.5, height=440.0)
A, B = 6378137.0, 6356752.314245


@pytest.mark.parametrize(
    ("lat", "lon", "height", "ecef"),
    [
        (0, 0, 0, (A, 0, 0)),
        (0, 90, 10, (0, A + 10, 0)),
        (90, 0, 0, (0, 0, B)),
        (-90, 0, 5, (0, 0, -B - 5)),
        (0, 180, 0, (-A, 0, 0)),
    ],
)
def test_points_on_the_axes(lat, lon, height, ecef):
    assert geodetic_to_ecef(math.radians(lat), math.radians(lon), height) == pytest.approx(ecef, abs=1e-6)
    assert np.degrees(ecef_to_geodetic(ecef)[0]) == pytest.approx(lat, abs=1e-12)
    assert ecef_to_geodetic(ecef)[2] == pytest.approx(height, abs=1e-6)


@pytest.mark.parametrize("height", [-1e5, 0.0, 1e4, 1e6, 2e7, 4e8])
def test_geodetic_comes_back_at_every_height(height):
    # The forward formula is exact, so a round trip bounds the error of the inverse.
    rng = np.random.default_rng(1)
    lat, lon = np.arcsin(rng.uniform(-1, 1, (50, 40))), rng.uniform(-np.pi, np.pi, (50, 40))
    p = geodetic_to_ecef(lat, lon, height)
    lat2, lon2, height2 = ecef_to_geodetic(p)
    assert lat2.shape == (50, 40)
    size = A + abs(height)
    assert np.abs(lat2 - lat).max() < 1e-14
    assert np.abs(lon2 - lon).max() < 1e-14
    assert np.abs(height2 - height).max() < 1e-15 * size * 4
    assert np.abs(geodetic_to_ecef(lat2, lon2, height2) - p).max() < 1e-14 * size


@pytest.mark.parametrize("height", [-6e6, -5e6])
def test_latitudes_deep_in_the_earth(height):
    lat = np.linspace(-np.pi / 2, np.pi / 2, 501)
    assert ecef_to_geodetic(geodetic_to_ecef(lat, 0.3, height))[0] == pytest.approx(lat, abs=1e-12)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (1e-3, 0.0, 0.0), (0.0, 100.0, 0.0), (-3e4, 0.0, 0.0)])
def test_places_at_the_centre_have_a_latitude_too(place):
    lat, lon, height = ecef_to_geodetic(place)
    assert lat == 0.0
    assert geodetic_to_ecef(lat, lon, height) == pytest.approx(place, abs=1e-8)
    axes = ECEF.enu_axes(place)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,), (1, 1)])
def test_leading_axes_stay(shape):
    p = np.broadcast_to(geodetic_to_ecef(0.5, 1.0, 100.0), (*shape, 3))
    assert [v.shape for v in ecef_to_geodetic(p)] == [shape] * 3
    assert HOME.to_ecef(HOME.from_ecef(p)) == pytest.approx(p, abs=1e-8)
    assert HOME.enu_axes(HOME.from_ecef(p)).shape == (*shape, 3, 3)


def test_enu_is_a_rotation_and_a_shift():
    R, o = HOME.rotation_to_ecef(), HOME.origin_ecef()
    assert R.T @ R == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)
    p = np.array([[1e3, 2e3, 30.0], [-5.0, 0.0, 1e5]])
    assert HOME.to_ecef(p) == pytest.approx(p @ R.T + o, abs=1e-8)
    lat, lon, height = HOME.to_geodetic([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]])
    assert height == pytest.approx([440, 440, 440, 441], abs=1e-6)
    assert np.degrees([lat[0], lon[0]]) == pytest.approx([47.4, 8.5])
    assert lat[1] > lat[0]
    assert lon[2] > lon[0]


def test_enu_agrees_with_the_library():
    from pymap3d import geodetic2enu

    lat, lon, height = np.radians([47.0, 48.1]), np.radians([8.0, 9.2]), np.array([0.0, 9e3])
    library = geodetic2enu(lat, lon, height, *HOME.origin, deg=False)
    assert HOME.from_geodetic(lat, lon, height) == pytest.approx(np.stack(library, -1), abs=1e-7)


def test_ecef_is_its_own_reference():
    assert np.array_equal(ECEF.rotation_to_ecef(), np.eye(3))
    assert np.array_equal(ECEF.origin_ecef(), np.zeros(3))


def test_axes_point_east_north_and_up():
    lat, lon, height = 0.7, -1.2, 300.0
    step = 1e-7
    p = geodetic_to_ecef(lat, lon, height)
    moved = [geodetic_to_ecef(lat, lon + step, height), geodetic_to_ecef(lat + step, lon, height)]
    moved.append(geodetic_to_ecef(lat, lon, height + 1))
    directions = np.stack([(q - p) / np.linalg.norm(q - p) for q in moved])
    assert ECEF.enu_axes(p) == pytest.approx(directions, abs=1e-6)
    # The same axes, expressed in another frame.
    assert HOME.enu_axes(HOME.from_ecef(p)) @ HOME.rotation_to_ecef().T == pytest.approx(ECEF.enu_axes(p), abs=1e-14)
    assert HOME.enu_axes(np.zeros(3)) == pytest.approx(np.eye(3), abs=1e-14)


def test_axes_without_an_earth_are_the_frame_s_own():
    assert np.array_equal(CARTESIAN.enu_axes(np.ones((4, 3))), np.broadcast_to(np.eye(3), (4, 3, 3)))
    assert np.array_equal(HOME.enu_axes(np.ones((4, 2))), np.broadcast_to(np.eye(2), (4, 2, 2)))


def test_a_planar_enu_point_lies_at_up_zero():
    assert HOME.to_ecef([30.0, 40.0]) == pytest.approx(HOME.to_ecef([30.0, 40.0, 0.0]))


def test_frames_are_values():
    assert Frame.enu(lat_deg=47.4, lon_deg=8.5, height=440.0) == HOME
    assert len({HOME, ECEF, CARTESIAN, Frame("ecef")}) == 3
    assert [frame.geodetic for frame in (CARTESIAN, ECEF, HOME)] == [False, True, True]


def test_a_right_angle_is_a_latitude():
    assert ECEF.from_geodetic(math.radians(90.0), math.radians(-180.0), 0.0) == pytest.approx([0, 0, B], abs=1e-6)


WRONG = [
    (lambda: Frame("ned"), "unknown frame 'ned'"),
    (lambda: Frame("enu"), "'enu' needs an origin"),
    (lambda: Frame("ecef", (0, 0, 0)), "'ecef' has no origin"),
    (lambda: Frame.enu(lat_deg=95, lon_deg=0), "origin of the ENU frame: the latitude 95 deg"),
    (lambda: Frame.enu(lat_deg=9, lon_deg=0, height=math.nan), "the height nan"),
    (CARTESIAN.rotation_to_ecef, "no place on Earth; use the frame 'ecef'"),
    (CARTESIAN.origin_ecef, "no place on Earth"),
    (lambda: CARTESIAN.to_geodetic(np.zeros(3)), "no place on Earth"),
    (lambda: ECEF.to_ecef(np.zeros(2)), r"of shape \(2,\)"),
    (
        lambda: ECEF.from_geodetic([0, 2.0], [0, 0], [0, 0], where="s.csv", first_row=2),
        "s.csv, row 3: the latitude 114",
    ),
    (lambda: ECEF.from_geodetic([0, 0.1], [7, 0], [0, 0]), "position, row 0: the longitude 401"),
    (lambda: ECEF.from_geodetic([0, math.nan], [0, 0], [0, 0]), "row 1: the latitude nan"),
    (lambda: ECEF.from_geodetic([0, 0], [0, 0], [math.inf, 0]), "row 0: the height inf"),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_errors_name_the_culprit(call, message):
    with pytest.raises(InvalidProblem, match=message):
        call()
