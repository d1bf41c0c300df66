"""Posed problems: KKT, duals, bounds, the method of the same name, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from monte_carlo.tables import FOLDER, code_digest, ledger
from solvers.posing.counts import HEADER, counted, failures, record, row
from solvers.posing.measures import (
    LEAST,
    above_multi_start,
    apart_from_method,
    drawn,
    fenced,
    worst_residual,
)
from solvers.posing.scenes import METHODS, SCENES, differences, sighted

from optloc import InvalidProblem, Motion, Status, assemble, measured, pose
from optloc.solvers import FORMULATIONS

# Problems of a full run. Registration takes a second for each program: a tenth of the others.
FIRST, MANY = 3000, 500
SLOW = {"registration_sdp": 50}
KEPT = FOLDER.parents[1] / "build" / "full"  # ignored by git; a run that was stopped goes on
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


@pytest.fixture(scope="module")
def book():
    facts = f"seeds from {FIRST}, scenes of any size from 1 mm to 1e9 m"
    with ledger("posed", HEADER, list(SCENES), facts, kept=KEPT) as made:
        yield made


@pytest.mark.full
@pytest.mark.parametrize("formulation", SCENES)
def test_residuals_duals_and_bounds_of_many_problems(formulation, book):
    """KKT to 1e-6, duals to 1e-4, and no bound above an independent search, counted over all seeds."""
    seeds = range(FIRST, FIRST + SLOW.get(formulation, MANY))
    records = counted(formulation, seeds, KEPT / f"posed-{code_digest()}")
    book.add(formulation, *row(records))
    assert failures(records) == []


@pytest.mark.parametrize("formulation", marked(LEAST))
def test_no_bound_is_above_a_multi_start(formulation):
    # one part in 1e6: the tolerance of the solvers
    assert above_multi_start(formulation, 0) <= 1e-6


@pytest.mark.parametrize("formulation", marked(METHODS))
def test_a_pose_without_changes_equals_the_method_of_its_name(formulation):
    assert apart_from_method(formulation, 1) <= 1e-6


@pytest.mark.full
@pytest.mark.parametrize("formulation", METHODS)
def test_many_poses_equal_the_method_of_their_name(formulation):
    apart = [apart_from_method(formulation, seed) for seed in range(SLOW.get(formulation, 100))]
    assert max(one for one in apart if one is not None) <= 1e-6


# one problem of each cause: its unit, its tolerance, a solver that stopped early, or a value above the optimum
@pytest.mark.parametrize(
    ("formulation", "seed"),
    [
        ("minimax_cone", 1244),
        ("lifted", 1169),
        ("lifted", 1060),
        ("lifted", 3316),
        ("squared_range_conic: hull", 3082),
        ("direction_sdp", 3365),
    ],
)
def test_problems_that_were_wrong(formulation, seed):
    assert failures([record(formulation, seed)]) == []


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "seed"), [("moment_sdp", 3003), ("registration_sdp", 3055)])
def test_problems_of_slow_formulations_that_were_wrong(formulation, seed):
    assert failures([record(formulation, seed)]) == []


def test_ranges_and_a_height_that_no_point_fits_have_a_sentence():
    problem = drawn("range_height_conic", 1064)
    posed = pose(problem, "range_height_conic")
    alone, fix = posed.solve(refine=False), posed.solve()
    assert alone.status == Status.INFEASIBLE
    for answer in (alone, fix):
        assert "no point of the known height fits the ranges exactly" in str(answer.reason)
    # the closed form has none either
    assert not np.isfinite(LEAST["range_height_conic"](problem.flat()))


def test_records_are_kept_and_failures_are_counted(tmp_path):
    first = counted("direction_sdp", range(2), tmp_path)
    assert counted("direction_sdp", range(2), tmp_path, seconds=0.0) == first
    assert failures(first) == []
    bad = [{"worst": float("nan")}, {"worst": 0.0, "error": 1e-3, "smooth": False}, {"worst": 0.0, "denied": 1}]
    assert failures(bad) == bad
    assert row(first)[:2] == [2, f"{max(one['worst'] for one in first):.0e}"]
    assert row(bad)[2:10] == [1, 1, 1, "1e-03", 1, 1, 1, ""]


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


@pytest.mark.parametrize("word", [None, 3])
def test_a_formulation_is_a_text(word):
    with pytest.raises(InvalidProblem, match="is not the name of a formulation"):
        pose(differences(1), word)
