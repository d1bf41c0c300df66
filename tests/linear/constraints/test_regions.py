"""Statements of regions: what they return, and that fixes obey them."""

import numpy as np
import pytest
from linear.constraints.shared import PLANE, ranges_to

from optloc import assemble, constraints, measured, solve
from optloc.base.types import AnyOf, Band, Polygon
from optloc.models.terrain import Terrain

TARGET = np.array([400.0, 300.0])


def test_normals_have_length_one_and_limits_follow():
    (plane,) = constraints.half_plane([3.0, 4.0], "10 km")
    assert (plane.coefficients.tolist(), float(plane.upper)) == ([0.6, 0.8], 2000.0)
    (slab,) = constraints.band([0.0, -2.0], -4.0, 8.0)
    assert (float(slab.lower), float(slab.upper)) == (-2.0, 4.0)
    walls = constraints.polyhedron([[2.0, 0.0], [0.0, 5.0]], [2.0, 10.0])
    assert [float(wall.upper) for wall in walls] == [1.0, 2.0]


def test_names_and_targets_are_those_of_the_caller():
    for limits in (
        constraints.disc([0, 0], 5, name="yard", target=1),
        constraints.annulus([0, 0], 4, 5, name="yard", target=1),
        constraints.keep_out_disc([0, 0], 5, name="yard", target=1),
        constraints.ball([0, 0, 0], 5, name="yard", target=1),
        constraints.keep_out_ball([0, 0, 0], 5, name="yard", target=1),
        constraints.polygon(np.eye(3)[:, :2], name="yard", target=1),
        constraints.keep_out_polygon(np.eye(3)[:, :2], name="yard", target=1),
        constraints.polyline([[0, 0], [1, 1], [2, 0]], 5, name="yard", target=1),
        constraints.terrain([0, 1], [0, 1], np.eye(2), exactly=0, name="yard", target=1),
        constraints.quantity("distance", 0, 5, [0, 0], name="yard", target=1),
    ):
        assert [(one.name, one.target) for one in limits] == [("yard", 1)]


def test_a_road_of_one_part_is_a_region_and_of_several_a_union():
    assert isinstance(constraints.polyline([[0, 0], [9, 0]], 5)[0], Band)
    assert isinstance(constraints.polyline([[0, 0], [9, 0], [9, 9]], 5)[0], AnyOf)
    assert isinstance(constraints.keep_out_polygon(np.eye(3)[:, :2])[0], Polygon)


def test_a_ground_is_a_table_of_its_band():
    (ground,) = constraints.terrain([0, 1], [0, 1], [[0, 1], [2, 3]], lower=2.0)
    assert ground.table == Terrain([0, 1], [0, 1], [[0, 1], [2, 3]])


@pytest.mark.parametrize(
    ("limits", "distance"),
    [
        (constraints.disc(TARGET + np.array([0.0, 50.0]), 30.0), 20.0),
        (constraints.keep_out_disc(TARGET + np.array([0.0, 20.0]), 30.0), 10.0),
        (constraints.annulus(TARGET + np.array([0.0, 50.0]), 30.0, 30.0), 20.0),
        (constraints.polyline(TARGET + np.array([[-90.0, 40.0], [0.0, 40.0], [90.0, 40.0]]), 15.0), 25.0),
        (constraints.keep_out_polygon(TARGET + np.array([[-90, -9], [90, -9], [90, 90], [-90, 90]])), 9.0),
    ],
)
def test_a_fix_without_noise_is_near_the_nearest_admitted_point(limits, distance):
    fix = solve(ranges_to(TARGET, limits))
    assert np.hypot(*(fix.position - TARGET)) == pytest.approx(distance, rel=0.1)
    assert fix.active[()]


def test_a_bound_that_changes_nothing_leaves_the_fix_and_its_status():
    free = solve(ranges_to(TARGET))
    for limits in (
        constraints.keep_out_disc(TARGET + np.array([300.0, 0.0]), 50.0),
        constraints.polyline(TARGET + np.array([[-300.0, -300.0], [0.0, 10.0], [300.0, 300.0]]), 200.0),
        constraints.keep_out_polygon(TARGET + np.array([[200.0, 0.0], [300.0, 0.0], [300.0, 90.0]])),
        constraints.disc([0.0, 0.0], 1e12),
        constraints.keep_out_disc([-1.5e12, 0.0], 1e12),
        constraints.polyline([[0.0, 0.0], [100.0, 0.0]], 1e9),
    ):
        fix = solve(ranges_to(TARGET, limits))
        assert (str(fix.status), fix.active[()]) == ("ok", ())
        assert fix.position == pytest.approx(free.position, abs=1e-5)


def test_a_batch_has_one_answer_for_each_problem():
    rng = np.random.default_rng(3)
    z = np.linalg.norm(PLANE - TARGET, axis=1) + 10.0 * rng.standard_normal((3, 4))
    limits = constraints.polyline(TARGET + np.array([[-90.0, 40.0], [0.0, 10.0], [90.0, 40.0]]), 8.0)
    together = solve(assemble(PLANE, measured("range", z, a=range(4), sigma=10.0), constraints=limits))
    for i in range(3):
        alone = solve(ranges_to(TARGET, limits, z=z[i]))
        np.testing.assert_allclose(together.position[i], alone.position, atol=1e-5)
