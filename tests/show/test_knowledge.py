"""Directions of fixes without a position: in words, and as wedges on the Earth that hold the true direction."""

import numpy as np
from show.ranging import ENU, ranged, unbounded

from optloc import Status
from optloc.show.knowledge import has_place, is_shown, known_features, known_rows, reach_of


def test_a_fix_with_a_place_has_no_directions():
    _, fix = ranged()
    assert has_place(fix)
    assert not is_shown(fix)
    assert known_rows(fix) == []
    assert known_features(fix, ENU) == []


def test_a_far_target_has_a_bearing_and_a_least_range():
    fix = unbounded()
    assert fix.status == Status.UNBOUNDED
    rows = dict(known_rows(fix))
    # 30 degrees from east towards north are a bearing of 60.
    assert rows["95 % direction"].startswith("bearing 60.00 ")
    assert rows["95 % range"].endswith("or more, to infinity")


def test_the_wedge_on_the_earth_holds_the_true_direction():
    fix = unbounded()
    (wedge, about), (ray, _) = known_features(fix, ENU)
    low, high = about["bearing_interval_deg"]
    assert low < 60.0 < high
    assert (wedge["type"], about["cut"]) == ("Polygon", True)
    (one,) = fix.determined.directions
    end = np.array(ray["coordinates"][0][-1])
    place = ENU.from_geodetic(np.radians(end[1]), np.radians(end[0]), end[2])
    assert abs(np.linalg.norm(place) / reach_of(fix, one) - 1.0) < 1e-3
    assert abs(np.degrees(np.arctan2(place[1], place[0])) - 30.0) < 0.1
