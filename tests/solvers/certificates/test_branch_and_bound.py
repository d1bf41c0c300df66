"""Certificates: what is proven, repaired, listed, or said to be unknown and why."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, ENU, STATIONS, TARGET, pairs
from proof.layouts import BY_NAME
from proof.plain import cost_of

import optloc
from optloc import Fix, InvalidProblem, Status, assemble, certify, measured, simulate, solve, with_bias
from optloc.kernels.jit import enabled
from optloc.linear.constraints import box, height
from optloc.solvers.certificates import branch_and_bound

machine_code = pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
SQUARE = 1e3 * np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0], [0, 2, 0], [1, -3, 0]])


def drawn(name: str, trials: int):
    return BY_NAME[name].drawn(trials)[0]


def at(problem, position) -> Fix:
    """Return the fix of one problem that refines to the minimum next to a position, whatever else there is."""
    flat = problem.flat()
    return optloc.solve(flat, "lsr", start=np.atleast_2d(position)).reshape(problem.batch_shape)


@pytest.mark.parametrize("name", ["tdoa-3d", "range-2d", "toa-3d", "range_sum-3d", "toa+tdoa-2d", "range+range_sum-3d"])
def test_a_clear_fix_is_proven_to_be_the_only_one(name):
    problem = CASES[name].problem
    fix = solve(problem)
    proof = fix.certificate
    assert (proof.proof, proof.unique, proof.margin) == ("global", True, 25.0)
    assert 0.0 <= float(fix.cost) - proof.bound == proof.gap <= 1.1e-6 * (1.0 + float(fix.cost))
    assert proof.boxes >= 0
    assert proof.region is None
    assert proof.reason == "proven best; any other solution raises chi-square by at least 25"


def test_a_plain_method_is_not_proven_and_certify_proves_it():
    problem = CASES["tdoa-3d"].problem
    fix = solve(problem, "gtrs+lsr")
    assert fix.certificate.proof == "local"
    proven = certify(problem, fix)
    assert proven.certificate.proof == "global"
    np.testing.assert_array_equal(proven.x, fix.x)
    assert proven.stages[-1].name == "certify"


@machine_code
def test_the_value_alone_is_a_smaller_claim():
    problem = drawn("TDOA, 6 stations, outside, 10 m", 8)
    fix = solve(problem, "gtrs+lsr")
    whole, value = certify(problem, fix), certify(problem, fix, margin=0.0)
    for one, other in zip(whole.certificate, value.certificate, strict=True):
        assert one.proof == other.proof == "global"
        assert (other.unique, other.margin) == (False, 0.0)
        assert "searched for, not excluded" in other.reason
    assert sum(c.boxes for c in value.certificate) < sum(c.boxes for c in whole.certificate)
    staged = solve(problem, "gtrs+lsr+value")
    assert [c.margin for c in staged.certificate] == [0.0] * 8


@pytest.fixture(scope="module")
def twofold():
    """Return problems with a second minimum at a cost that matters, and their fixes."""
    problem = drawn("TDOA, 5 stations, inside, 30 m", 150)
    fix = certify(problem, solve(problem))
    gap = fix.alternatives.gap[:, 0]
    items = np.flatnonzero((gap > 1e-2) & (gap < 20.0) & [c.margin == 25.0 for c in fix.certificate])
    assert len(items) >= 5
    return problem.take(items), fix[items]


@machine_code
def test_a_better_position_takes_the_place_of_a_wrong_one(twofold):
    problem, best = twofold
    wrong = optloc.solve(problem, "lsr", start=best.alternatives.x[:, 0])
    assert np.all(wrong.cost > best.cost + 1e-3)
    fix = certify(problem, wrong)
    np.testing.assert_allclose(fix.cost, best.cost, rtol=1e-6, atol=1e-6)
    assert {c.proof for c in fix.certificate} == {"global"}
    np.testing.assert_allclose(fix.alternatives.gap[:, 0], wrong.cost - fix.cost, rtol=1e-4, atol=1e-4)
    assert f"{len(best)} fixes replaced by better ones" in fix.stages[-1].detail


@machine_code
def test_other_minima_are_found_and_the_list_is_complete(twofold):
    problem, best = twofold
    alone = optloc.solve(problem, "lsr", start=best.x)
    assert alone.alternatives.gap.shape[1] == 0
    fix = certify(problem, alone)
    # whether a proof meets the other minimum within its budget hangs on rounding in one of ten: then it claims nothing
    claimed = np.array([c.unique for c in fix.certificate])
    assert claimed.sum() >= len(claimed) - 1
    found, expected = np.isfinite(fix.alternatives.gap).sum(1), np.isfinite(best.alternatives.gap).sum(1)
    np.testing.assert_array_equal(found[claimed], expected[claimed])
    gap = fix.alternatives.gap[claimed, 0]
    np.testing.assert_allclose(gap, best.alternatives.gap[claimed, 0], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(fix.code == Status.AMBIGUOUS, fix.alternatives.gap[:, 0] < 9.0)


@machine_code
def test_a_mirror_image_is_a_second_minimum_not_a_worse_one():
    a, b = np.arange(1, 6), np.zeros(5, dtype=int)
    problem = simulate(assemble(SQUARE, measured("tdoa", a=a, b=b, arrival_sigma=5.0)), [1e3, 2e3, 3e3], 3)
    fix = certify(problem, at(problem, [1e3, 2e3, 3e3]))
    assert fix.status == Status.AMBIGUOUS
    np.testing.assert_allclose(fix.alternatives.x[0], fix.x * [1.0, 1.0, -1.0], atol=1e-3)
    proof = fix.certificate
    assert (proof.proof, proof.unique) == ("global", True)
    assert "any other solution except the one listed raises" in proof.reason


@machine_code
def test_a_region_limits_the_claim_and_is_named():
    a, b = np.arange(1, 6), np.zeros(5, dtype=int)
    problem = simulate(assemble(SQUARE, measured("tdoa", a=a, b=b, arrival_sigma=5.0)), [1e3, 2e3, 3e3], 3)
    start = at(problem, [1e3, 2e3, 3e3])
    fix = certify(problem, start, (np.array([-9e3, -9e3, 0.5e3]), np.array([9e3, 9e3, 9e3])))
    proof = fix.certificate
    assert proof.proof == "region"
    assert proof.region == ((-9e3, -9e3, 500.0), (9e3, 9e3, 9e3))
    assert "(-9000, -9000, 500)" in proof.reason
    assert fix.status == Status.OK  # the mirror image is outside


@pytest.mark.parametrize(
    ("region", "margin", "word"),
    [
        (([0.0, 0.0], [1.0, 1.0]), 25.0, "region"),
        (([0.0, 0.0, 0.0], [1.0, 1.0, -1.0]), 25.0, "region"),
        (([0.0, 0.0, 0.0], [1.0, np.nan, 1.0]), 25.0, "region"),
        (None, -1.0, "margin"),
        (None, np.nan, "margin"),
    ],
)
def test_a_bad_region_or_margin_is_named(region, margin, word):
    problem = CASES["tdoa-3d"].problem
    with pytest.raises(InvalidProblem, match=word):
        certify(problem, solve(problem, "gtrs+lsr"), region, margin=margin)


def test_a_fix_of_another_problem_is_refused():
    with pytest.raises(InvalidProblem, match="shape"):
        certify(CASES["tdoa-3d"].problem, solve(drawn("TDOA, 6 stations, inside, 10 m", 2), "gtrs+lsr"))


def test_a_spent_budget_says_so_and_changes_nothing(monkeypatch):
    problem = drawn("TDOA, 5 stations, outside, 30 m", 6)
    fix = solve(problem, "gtrs+lsr")
    monkeypatch.setattr(branch_and_bound, "enabled", lambda: True)
    monkeypatch.setattr(branch_and_bound, "_BUDGET", 0)
    poor = certify(problem, fix)
    open_ones = [c for c in poor.certificate if c.boxes or c.proof != "global"]
    assert open_ones
    assert all(c.proof == "unknown" and "budget" in c.reason for c in open_ones)
    np.testing.assert_array_equal(poor.x, fix.x)
    np.testing.assert_array_equal(poor.code, fix.code)


@pytest.mark.parametrize(
    ("problem", "word"),
    [
        (lambda: replace(CASES["tdoa+fdoa-3d"].problem, constraints=box([-9e4] * 3, [9e4] * 3)), "constraints"),
        (
            lambda: with_bias(CASES["range-3d"].problem, "scale", per="station", form="scale", sigma=1e-3),
            "several scales",
        ),
    ],
)
def test_what_the_proof_does_not_cover_is_unknown_and_named(problem, word):
    fix = solve(problem())
    assert fix.status == Status.UNPROVEN
    assert fix.certificate.proof == "unknown"
    assert word in fix.certificate.reason


def test_one_bad_item_leaves_the_others_alone():
    problem = drawn("TDOA, 6 stations, inside, 10 m", 5)
    z = problem.z.copy()
    z[2, 1] = np.nan
    z[4] = 1e30
    mixed, clean = solve(problem.with_rows(z=z)), solve(problem)
    assert mixed.code[2] == Status.REJECTED
    assert mixed.certificate[2].proof == "unknown"
    for i in (0, 1, 3):
        np.testing.assert_array_equal(mixed.x[i], clean.x[i])
        one, other = mixed.certificate[i], clean.certificate[i]
        assert (one.proof, one.margin) == (other.proof, other.margin)
        assert one.bound == pytest.approx(other.bound, rel=1e-9)


def test_stations_on_a_line_in_a_batch_leave_the_others_alone():
    problem = drawn("TDOA, 6 stations, inside, 10 m", 3)
    place = problem.stations.position.copy()
    place[1] = np.linspace(0.0, 1.0, 6)[:, None] * [3e3, 2e3, 1e3]
    fix = solve(replace(problem, stations=replace(problem.stations, position=place)))
    assert not fix[1].answered
    assert [c.proof for c in fix.certificate[[0, 2]]] == ["global", "global"]


@machine_code
def test_a_known_height_is_proven_on_its_surface():
    a, b = pairs(3)
    rows = measured("tdoa", a=a[:3], b=b[:3], arrival_sigma=5.0)
    template = assemble(STATIONS[3], rows, frame=ENU)
    truth = np.array([3.1e3, 6.2e3, 2.4e3])
    high = float(ENU.to_geodetic(truth)[2])
    problem = replace(simulate(template, truth, 4), constraints=height(exactly=high))
    fix = solve(problem)
    proof = fix.certificate
    assert proof.proof in ("global", "region")
    flat = np.stack(np.meshgrid(*[np.linspace(-60e3, 60e3, 300)] * 2), axis=-1).reshape(-1, 2)
    on = np.column_stack([flat, np.full(len(flat), truth[2])])
    for _ in range(4):  # onto the surface of that height
        on[:, 2] += high - ENU.to_geodetic(on)[2]
    assert cost_of(replace(problem, constraints=()), on).min() >= proof.bound


def test_a_fix_at_a_bound_is_proven_as_one_that_no_bound_holds():
    problem = CASES["tdoa-3d"].problem
    free = replace(problem, constraints=box((-1e5,) * 3, (1e5,) * 3))
    fix = solve(free)
    assert fix.certificate.proof == "global"
    tight = replace(problem, constraints=box((-1e5,) * 3, (*(fix.position - 0.5 * fix.sigma())[:2], 1e5)))
    held = solve(tight)
    assert [one.name for one in held.active[()]] == ["x upper", "y upper"]
    assert held.status == Status.OK
    assert held.certificate.proof == "global"


def test_what_no_closed_form_starts_is_searched_box_by_box_and_ok_when_it_is_proven():
    problem = CASES["elevation-3d"].problem
    assert not solve(problem, "gtrs+lsr").answered
    searched, fix = solve(problem, "searched"), solve(problem)
    assert searched.status == Status.UNPROVEN
    assert searched.cost == pytest.approx(fix.cost.item())
    proof = fix.certificate
    assert fix.status == (Status.OK if proof.proof == "global" and proof.unique else Status.UNPROVEN)


def test_epochs_that_share_nothing_are_certified_one_by_one():
    a, b = pairs(3)
    rows = measured("tdoa", a=np.tile(a, 3), b=np.tile(b, 3), epoch=np.repeat(np.arange(3), 6), arrival_sigma=5.0)
    template = assemble(STATIONS[3], rows, times=range(3), motions=(optloc.Motion(span="epoch"),))
    problem = simulate(template, np.tile(TARGET[3], 3), 4)
    fix = certify(problem, solve(problem, "gtrs+lsr"))
    assert fix.shape == (3,)
    assert {c.proof for c in fix.certificate} == {"global"}


@machine_code
def test_auto_takes_the_long_way_only_where_the_short_one_leaves_something_open():
    clear = solve(CASES["tdoa-3d"].problem)
    assert [stage.name for stage in clear.stages] == ["gtrs", "lsr", "certify"]
    problem = drawn("TDOA, 5 stations, outside, 30 m", 40)
    fix = solve(problem)
    names = [stage.name for stage in fix.stages]
    assert names[:3] == ["gtrs", "lsr", "certify"]
    assert names[3:5] == ["roots", "lsr"]
    assert names[-1] == "certify"
