"""A target on one of several floors."""

import numpy as np
import pytest

from optloc import InvalidProblem, locate
from optloc.linear import constraints
from optloc.problem.build import assemble, measured, station_array
from optloc.solvers.floors import height_of, on_floors, prepare_on_floors, solve_on_floors

ANCHORS = {"A": (0.0, 0.0, 4.0), "B": (20.0, 0.0, 4.0), "C": (20.0, 12.0, 4.0), "D": (0.0, 12.0, 4.0)}
PLACES = np.array(list(ANCHORS.values()))


def ranges(target):
    """Return exact ranges of a target by anchor."""
    return dict(zip(ANCHORS, np.linalg.norm(PLACES - np.array(target), axis=1).tolist(), strict=True))


def test_the_floor_of_the_target_is_found():
    fix = locate(ANCHORS, ranges=ranges((5.0, 5.0, 1.0)), sigma=0.05, height={1.0, "10.5 m"})
    assert fix.status.label == "ok"
    assert fix.position == pytest.approx([5.0, 5.0, 1.0], abs=1e-6)
    assert fix.certificate.proof == "global"


def test_a_floor_that_fits_as_well_is_listed():
    # 1 m and 7 m have the same distance from the plane of the anchors
    fix = locate(ANCHORS, ranges=ranges((5.0, 5.0, 1.0)), sigma=0.05, height=[1.0, 7.0, 10.0])
    assert fix.status.label == "ambiguous"
    assert "another of the stated heights" in str(fix.reason)
    both = sorted([fix.position[2], fix.alternatives.x[0, 2]])
    assert both == pytest.approx([1.0, 7.0])
    assert fix.alternatives.gap[0] == pytest.approx(0.0, abs=1e-9)
    assert "except the one listed" in fix.certificate.reason


def test_each_fix_of_a_batch_has_its_own_floor():
    targets = [(5.0, 5.0, 1.0), (9.0, 3.0, 10.5), (7.0, 6.0, 1.0)]
    z = {name: [ranges(target)[name] for target in targets] for name in ANCHORS}
    fix = locate(ANCHORS, ranges=z, sigma=0.05, height={1.0, 10.5})
    assert fix.shape == (3,)
    assert fix.position == pytest.approx(np.array(targets), abs=1e-6)
    assert [status.label for status in fix.statuses] == ["ok"] * 3


def test_two_heights_of_a_list_stay_a_band():
    fix = locate(ANCHORS, ranges=ranges((5.0, 5.0, 1.0)), sigma=0.05, height=[0.0, 3.0])
    assert fix.position == pytest.approx([5.0, 5.0, 1.0], abs=1e-3)
    with pytest.raises(InvalidProblem, match="there are no heights"):
        locate(ANCHORS, ranges=ranges((5.0, 5.0, 1.0)), sigma=0.05, height=set())


def hall(low, high, **more):
    """Return a problem with ranges from a target at (5, 5, 7), between two heights."""
    rows = measured("range", np.array(list(ranges((5.0, 5.0, 7.0)).values())), a=np.arange(4), sigma=0.05)
    bands = constraints.box([-np.inf, -np.inf, low], [np.inf, np.inf, high])[2:]
    return assemble(station_array(PLACES), rows, constraints=bands, **more)


def test_the_height_of_a_problem_is_replaced():
    for problem in (hall(1.0, 1.0), hall(0.0, 14.0)):
        fix = solve_on_floors(on_floors(problem, (0.0, 7.0, 14.0)))
        assert fix.position[2] == pytest.approx(7.0)
    assert height_of(on_floors(hall(0.0, 14.0), (7.0,))[0]) == 7.0
    assert np.isnan(height_of(hall(0.0, 14.0)))


def test_floors_outside_the_band_are_left_out():
    assert len(on_floors(hall(0.0, 8.0), (0.0, 7.0, 14.0))) == 2
    with pytest.raises(InvalidProblem, match="other constraints exclude the heights 9, 14 m"):
        on_floors(hall(0.0, 8.0), (9.0, 14.0))
    bare = assemble(station_array(PLACES), measured("range", np.ones(4), a=np.arange(4), sigma=0.05))
    with pytest.raises(InvalidProblem, match="has no height"):
        on_floors(bare, (2.0, 3.0))


def test_prepared_floors_fix_new_measurements():
    ready = prepare_on_floors(hall(0.0, 10.5), (1.0, 10.5), "auto")
    z = np.array([list(ranges(target).values()) for target in ((5.0, 5.0, 1.0), (9.0, 3.0, 10.5))])
    fix = ready(z)
    assert fix.position == pytest.approx(np.array([(5.0, 5.0, 1.0), (9.0, 3.0, 10.5)]), abs=1e-6)
    assert [status.label for status in fix.statuses] == ["ok"] * 2
    assert prepare_on_floors(hall(1.0, 1.0), (), "auto").problem.count == 4
