"""Reference bounds by their front door: every kind of range, redundant rows, batches with holes, and refusals."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from cases import STATIONS, TARGET, stations
from often import few

import optloc
from optloc import Motion, assemble, measured, simulate
from optloc.base.records import change
from optloc.problem import Bias, Prior
from optloc.problem.claims import claim
from optloc.solvers.certificates.relaxations import METHODS, reference_bound
from optloc.solvers.methods import compare_bounds
from optloc.solvers.outside import accept
from optloc.solvers.verdict.judge import judge

S = STATIONS[3][:5]
COUNT = 5


def bounded(problem, fix):
    """Return a fix with what the stage "bound" says of it."""
    return judge(problem, compare_bounds(problem, accept(problem, fix)))


def rows(kind: str, s: int = len(S)):
    """Measurements of one kind with 10 m or 5 mrad of noise."""
    first, rest = np.arange(s), np.arange(1, s)
    pairs = np.array(list(combinations(range(s), 2)))
    return {
        "tdoa": lambda: [measured("tdoa", a=rest, b=0 * rest, arrival_sigma=10.0)],
        "every pair": lambda: [measured("tdoa", a=pairs[:, 0], b=pairs[:, 1], sigma=10.0)],
        "range": lambda: [measured("range", a=first, sigma=10.0)],
        "toa": lambda: [measured("toa", a=first, sigma=10.0)],
        "range_sum": lambda: [measured("range_sum", a=rest, b=0 * rest, sigma=10.0)],
        "tdoa and range": lambda: [
            measured("tdoa", a=rest, b=0 * rest, sigma=10.0),
            measured("range", a=first[:2], sigma=30.0),
        ],
        "angles": lambda: [measured(name, a=first[:3], sigma=5e-3) for name in ("azimuth", "elevation")],
    }[kind]()


def drawn(kind: str, count: int = COUNT, seed: int = 0, **more):
    problem = assemble(S, *rows(kind), **more)
    truth = np.zeros((count, problem.layout.size))
    rng = np.random.default_rng(seed)
    truth[:, :3] = TARGET[3] + rng.normal(0.0, 4e3, (count, 3))
    return simulate(problem, truth, np.random.SeedSequence(seed + 1))


@pytest.mark.parametrize("kind", few(["every pair", "tdoa and range", "toa", "tdoa", "range", "range_sum"], 3))
def test_moments_reach_the_cost_of_every_kind_of_range(kind):
    """Redundant rows (every pair, both kinds) count with the misfit of their loops; the point is found as well."""
    problem = drawn(kind)
    fix = optloc.solve(problem)
    found = reference_bound(problem, fix, "moment")
    assert fix.answered.all()
    assert (found.scope == "global").all(), found.reason
    assert (found.bound <= fix.cost + 1e-7 * (1.0 + fix.cost)).all()
    assert found.tight(fix.cost).all(), fix.cost - found.bound
    # along the weakest axis the cost is flat: what the solver leaves is a share of sigma there, not of a metre
    sigma = np.sqrt(np.trace(fix.covariance(), axis1=1, axis2=2))
    assert (np.linalg.norm(found.point - fix.position, axis=1) < 0.2 * sigma).all()


def test_directions_reach_the_cost_of_angles():
    problem = drawn("angles")
    fix = optloc.solve(problem)
    found = reference_bound(problem, fix, "directions")
    assert (found.scope == "global").all()
    assert (found.bound <= fix.cost + 1e-7).all()
    assert found.tight(fix.cost).all()


@pytest.mark.parametrize(("kind", "method"), [("tdoa", "moment"), ("angles", "directions")])
def test_relaxation_and_branch_and_bound_agree(kind, method):
    problem = drawn(kind, 8, seed=5)
    fix = optloc.certify(problem, optloc.solve(problem))
    found = reference_bound(problem, fix, method)
    for certificate, cost, bound in zip(fix.certificate, fix.cost, found.bound, strict=True):
        assert bound <= cost + 1e-7 * (1.0 + cost)
        if certificate.proof == "global":
            # two lower bounds and a point that costs as much: neither may exceed it
            assert certificate.bound <= cost + 1e-9
            assert bound == pytest.approx(cost, abs=1e-3 * (1.0 + cost))


def test_a_wrong_minimum_is_not_certified():
    """Range rows of three stations in a plane far below: the mirror image with one more weak row costs more."""
    flat = S[:4] * np.array([1.0, 1.0, 0.02])
    problem = assemble(flat, measured("range", a=np.arange(4), sigma=20.0))
    truth = np.array([[2.5e3, 4e3, 5e3]])
    problem = simulate(problem, truth, np.random.SeedSequence(3))
    right = optloc.solve(problem)
    wrong = optloc.solve(problem, "lsr", start=right.position * np.array([1.0, 1.0, -1.0]))
    assert wrong.position[0, 2] * right.position[0, 2] < 0.0
    worst = max(right, wrong, key=lambda fix: fix.cost[0])
    best = min(right, wrong, key=lambda fix: fix.cost[0])
    assert worst.cost[0] > best.cost[0] + 0.1
    assert reference_bound(problem, worst, "moment").bound[0] <= best.cost[0] + 1e-6
    assert bounded(problem, worst).certificate[0].proof == "local"
    assert bounded(problem, best).certificate[0].proof == "global"


def test_a_batch_with_holes_leaves_the_others_untouched(monkeypatch):
    problem = drawn("tdoa")
    whole = reference_bound(problem, optloc.solve(problem), "moment")
    z, weight = problem.z.copy(), np.ones(problem.z.shape)
    z[1, 2] = np.nan
    weight[3, 3:] = 0.0
    holed = problem.with_rows(z, weight)
    fix = optloc.solve(holed)
    found = reference_bound(holed, fix, "moment")
    assert np.isnan(found.bound[[1, 3]]).all()
    assert all(found.reason[[1, 3]])
    kept = [0, 2, 4]
    np.testing.assert_allclose(found.bound[kept], whole.bound[kept], rtol=1e-6)  # of fixes made another way


def test_the_number_of_threads_changes_no_bit(monkeypatch):
    ranged, angular = drawn("tdoa"), drawn("angles")
    seen = []
    for threads in ("1", "3"):
        monkeypatch.setenv("OPTLOC_THREADS", threads)
        fixes = [optloc.solve(ranged, method, refine=False).x for method in ("sdp", "socp")]
        fixes += [optloc.solve(angular, method, refine=False).x for method in ("directions", "minimax")]
        bounds = [reference_bound(ranged, optloc.solve(ranged), "moment").bound]
        bounds += [reference_bound(angular, optloc.solve(angular), "directions").bound]
        seen.append([*fixes, *bounds])
    for one, three in zip(*seen, strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_array_equal(one, three)


def test_an_answer_does_not_depend_on_what_was_solved_before():
    problem = drawn("tdoa", 3)
    fix = optloc.solve(problem)
    forward = reference_bound(problem, fix, "moment").bound
    backward = reference_bound(problem.take(np.array([2, 1, 0])), fix[np.array([2, 1, 0])], "moment").bound
    np.testing.assert_array_equal(forward, backward[::-1])


def test_a_region_takes_the_place_of_an_enclosure():
    """Three differences enclose nothing in space; within a ball the twin is inside and the bound is that of both."""
    problem = simulate(
        assemble(S[:4], measured("tdoa", a=[1, 2, 3], b=0, sigma=10.0)), TARGET[3][None], np.random.SeedSequence(1)
    )
    fix = optloc.solve(problem)
    assert "region" in reference_bound(problem, fix, "moment").reason[0]
    found = reference_bound(problem, fix, "moment", region=20e3)
    assert found.scope[0] == "region"
    assert found.bound[0] <= fix.cost[0] + 1e-9


def test_bounds_of_other_costs_are_never_claimed():
    problem = drawn("tdoa", 2)
    fix = optloc.solve(problem)
    for method in set(METHODS) - {"moment", "directions"}:
        found = reference_bound(problem, fix, method)
        assert np.isnan(found.bound).all()
        assert all("not the likelihood" in reason for reason in found.reason)
        assert (found.scope == "").all()


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (
            {"biases": (Bias("clock", ("all",), np.array([0]), np.array([0]), np.ones(1), sigma=np.array([9.0])),)},
            "biases",
        ),
        ({"priors": (Prior("position", TARGET[3], 1e6 * np.eye(3)),)}, "priors"),
        ({"motions": (Motion(order=1),)}, "at rest"),
        ({"stations": stations(3, covariance=np.full((len(STATIONS[3]), 3, 3), 25.0))}, "station errors"),
    ],
)
def test_what_is_beyond_the_relaxation_says_so(more, word):
    problem = drawn("tdoa", 1)
    fix = optloc.solve(problem)
    found = reference_bound(replace(problem, **more), fix, "moment")
    assert np.isnan(found.bound).all()
    assert word in found.reason[0]


def test_kinds_without_ranges_and_unknown_methods():
    problem = drawn("angles", 1)
    fix = optloc.solve(problem)
    assert "not sums of ranges" in reference_bound(problem, fix, "moment").reason[0]
    with pytest.raises(optloc.InvalidProblem, match="moment"):
        reference_bound(problem, fix, "moments")
    with pytest.raises(optloc.InvalidProblem, match="after a refinement"):
        compare_bounds(problem, None)


def test_the_stage_keeps_what_is_proven_and_proves_the_rest():
    problem = drawn("tdoa", 3)
    fix = optloc.solve(problem)
    claims = change(fix.claims, lambda array, core: np.array(array))
    claims.write(0, claim(replace(fix.certificate[0], proof="global", method="another proof")))
    claims.write(1, claim(replace(fix.certificate[1], proof="unknown", method="none")))
    found = bounded(problem, replace(fix, claims=claims))
    assert found.certificate[0].method == "another proof"
    assert (found.certificate[1].proof, found.certificate[1].method) == ("global", "moment relaxation")
    assert found.certificate[1].gap < 1e-3
    assert found.stages[-1].name == "bound"
