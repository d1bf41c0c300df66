"""The scene of a picture: the numbers of the fix, and tracks with few points."""

import numpy as np
import pytest
from show.ranging import ranged

from optloc.show.pictures.scene import PLAN, scene_of, states_of, thinned
from optloc.show.pictures.style import xy


def test_a_long_track_keeps_its_ends():
    track = np.arange(2000.0).reshape(1000, 2)
    found = thinned(track)
    assert len(found) < 300
    assert np.array_equal(found[[0, -1]], track[[0, -1]])
    assert np.array_equal(thinned(track[:5]), track[:5])


def test_a_scene_has_the_numbers_of_the_fix():
    problem, fix = ranged()
    scene = scene_of(problem, [fix])
    assert scene.fixes.tolist() == [fix.position.tolist()]
    assert scene.covariances[0] == pytest.approx(fix.covariance())
    assert scene.clean.tolist() == [True]
    assert np.array_equal(scene.moved(lambda place: place + 1.0).stations, scene.stations + 1.0)
    ((position, _, clean),) = states_of(fix)
    assert (position.tolist(), clean.tolist()) == (scene.fixes.tolist(), [True])
    assert [v.tolist() for v in xy(scene.fixes, PLAN, 1e3)] == [[v / 1e3] for v in fix.position]
