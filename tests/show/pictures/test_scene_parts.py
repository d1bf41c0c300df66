"""The surroundings of fixes: their side follows the largest ellipse, and their centre is the origin."""

import numpy as np
import pytest
from show.ranging import ranged

from optloc.show.pictures.scene import scene_of
from optloc.show.pictures.scene_parts import centred, half_side


def test_the_surroundings_are_a_little_wider_than_the_ellipse():
    problem, fix = ranged()
    scene = scene_of(problem, [fix])
    largest = np.sqrt(5.991464547 * np.linalg.eigvalsh(fix.covariance()[:2, :2]).max())
    assert half_side(scene, np.ones(1, dtype=bool), fix.position[:2]) == pytest.approx(1.6 * largest)


def test_a_centred_scene_has_its_fix_at_the_origin():
    problem, fix = ranged()
    moved = centred(scene_of(problem, [fix]), fix.position[:2])
    assert moved.fixes[0, :2] == pytest.approx(np.zeros(2))
    assert moved.stations - problem.stations.position.reshape(moved.stations.shape) == pytest.approx(
        np.tile(-np.pad(fix.position[:2], (0, problem.dimension - 2)), (len(moved.stations), 1))
    )
