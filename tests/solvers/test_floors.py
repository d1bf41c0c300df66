"""A target on one of several floors."""

import numpy as np
import pytest

from optloc import InvalidProblem, locate
from optloc.linear import constraints
from optloc.problem.build import assemble, measured, station_array
from optloc.solvers.floors import at_height, solve_on_floors

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


def test_the_exact_height_of_a_problem_is_replaced():
    rows = measured("range", np.array(list(ranges((5.0, 5.0, 7.0)).values())), a=np.arange(4), sigma=0.05)
    bands = constraints.box([-np.inf, -np.inf, 1.0], [np.inf, np.inf, 1.0])[2:]
    problem = assemble(station_array(PLACES), rows, constraints=bands)
    with pytest.raises(InvalidProblem, match="no exact height"):
        at_height(problem, 2.0)
    named = assemble(station_array(PLACES), rows, constraints=[replace_name(bands[0])])
    fix = solve_on_floors([at_height(named, h) for h in (0.0, 7.0, 14.0)])
    assert fix.position[2] == pytest.approx(7.0)


def replace_name(band):
    """Return a band with the name of a height."""
    from dataclasses import replace

    return replace(band, name="height")
