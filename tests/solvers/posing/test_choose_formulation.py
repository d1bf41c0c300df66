"""Posed problems: KKT, duals, bounds, the method of the same name, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from solvers.posing.measures import (
    ISOLATED,
    LEAST,
    WITHOUT_POSITION,
    above_multi_start,
    apart_from_method,
    fenced,
    worst_residual,
)
from solvers.posing.scenes import METHODS, SCENES, differences, sighted

from optloc import InvalidProblem, Motion, assemble, measured, pose
from optloc.solvers import FORMULATIONS

# Problems of a full run. Registration takes a second for each program: a twentieth of the others.
MANY = 500
SLOW = {"registration_sdp": 25}
# Moments, runs and Doppler shifts take half a second or more.
LONG = ("registration_sdp", "moment_sdp", "doppler_sdp")


def marked(names):
    """Return names as parameters of a test; those that take long are marked as slow."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in names]


@pytest.mark.parametrize("formulation", marked(SCENES))
def test_residuals_at_any_scale(formulation):
    assert max(worst_residual(formulation, seed) for seed in range(4)) <= 1e-6


@pytest.mark.parametrize("formulation", ["squared_range_conic: hull", "sparse_errors", "nls"])
def test_a_dual_is_the_slope_of_the_optimum(formulation):
    found = fenced(formulation, 0)
    assert found.outcome in ("solved", "inaccurate")
    assert found.smooth
    assert found.worst <= 1e-6
    assert found.error <= 1e-4


@pytest.mark.full
@pytest.mark.parametrize("formulation", SCENES)
def test_residuals_and_duals_of_many_problems(formulation):
    """KKT to 1e-6 and duals to 1e-4, counted over all seeds."""
    wrong = []
    for seed in range(SLOW.get(formulation, MANY)):
        if not worst_residual(formulation, seed) <= 1e-6:
            wrong.append((seed, "residual"))
        if formulation in WITHOUT_POSITION:
            continue
        outcome, worst, error, smooth = fenced(formulation, seed)
        if outcome == "infeasible":
            wrong += [] if formulation in ISOLATED else [(seed, outcome)]
        elif not worst <= 1e-6 or (smooth and not error <= 1e-4):
            wrong.append((seed, worst, error))
    assert wrong == []


@pytest.mark.parametrize("formulation", marked(LEAST))
def test_no_bound_is_above_a_multi_start(formulation):
    # one part in 1e6: the tolerance of the solvers
    assert above_multi_start(formulation, 0) <= 1e-6


@pytest.mark.full
@pytest.mark.parametrize("formulation", LEAST)
def test_no_bound_of_many_is_above_a_multi_start(formulation):
    assert max(above_multi_start(formulation, seed) for seed in range(100)) <= 1e-6


@pytest.mark.parametrize("formulation", marked(METHODS))
def test_a_pose_without_changes_equals_the_method_of_its_name(formulation):
    assert apart_from_method(formulation, 1) <= 1e-6


@pytest.mark.full
@pytest.mark.parametrize("formulation", METHODS)
def test_many_poses_equal_the_method_of_their_name(formulation):
    apart = [apart_from_method(formulation, seed) for seed in range(SLOW.get(formulation, 100))]
    assert max(one for one in apart if one is not None) <= 1e-6


def test_every_formulation_is_posed_or_names_the_one_that_is():
    problem = differences(1)
    for name, entry in FORMULATIONS.items():
        if entry.pose is None:
            assert FORMULATIONS[entry.twin].pose is not None
            with pytest.raises(InvalidProblem, match=f"pose '{entry.twin}'"):
                pose(problem, name)
        else:
            assert name in SCENES or name == "nuclear_norm"


def test_words_of_methods_stand_for_the_only_formulation_that_serves():
    problem = differences(1)
    assert pose(problem, "sdp").formulation == "squared_range_conic: shor"
    assert pose(problem, "socp").formulation == "squared_range_conic: hull"
    assert pose(problem, "hull").formulation == "squared_range_conic: hull"
    assert pose(problem, "nlp").formulation == "nls"
    assert pose(sighted(1), "directions").formulation == "direction_sdp"


def test_unknown_names_get_short_advice():
    problem = differences(1)
    for name, what in (
        ("hul", "did you mean 'hull'"),
        ("lsr", "'lsr' is a stage of methods"),
        ("auto", "'auto' is a method"),
        ("gtrs", "'gtrs' means 'squared_range'"),
        ("direction_sdp", "'direction_sdp' needs azimuths of one position, and the rows here are tdoa"),
        ("minimax_cone", "'minimax_cone' needs azimuths"),
    ):
        with pytest.raises(InvalidProblem, match=what) as caught:
            pose(problem, name)
        assert len(str(caught.value)) < 200


def test_what_cannot_be_posed_is_refused_by_a_sentence():
    problem = differences(1)
    with pytest.raises(InvalidProblem, match="2 problems are a batch"):
        pose(problem.flat().take(np.array([0, 0])), "nls")
    with pytest.raises(InvalidProblem, match="str is no problem"):
        pose("problem", "nls")
    with pytest.raises(InvalidProblem, match="unknown formulation"):
        pose(problem, "hul")
    for name in (
        "direction_sdp",
        "minimax_cone",
        "registration_sdp",
        "doppler_sdp",
        "range_height_conic",
        "nuclear_norm",
    ):
        with pytest.raises(InvalidProblem):
            pose(problem, name)
    with pytest.raises(InvalidProblem, match="squared ranges need ranges"):
        pose(sighted(1), "hull")
    broken = problem.with_rows(z=np.where(np.arange(problem.count) == 0, np.nan, problem.observed))
    with pytest.raises(InvalidProblem, match="not finite"):
        pose(broken, "nls")
    known = replace(problem, motions=(Motion(known=np.zeros((1, 1, 2))),))
    with pytest.raises(InvalidProblem, match="nothing is unknown"):
        pose(known, "nls")
    two = assemble(
        np.eye(3)[:, :2], measured("range", np.ones(3), a=np.arange(3), sigma=1.0), motions=(Motion(), Motion())
    )
    with pytest.raises(InvalidProblem, match="does not cover"):
        pose(two, "squared_range_conic: shor")
