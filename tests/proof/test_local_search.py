"""Proofs of value and uniqueness by branch and bound, against minima found from many starts."""

import numpy as np
import pytest
from proof.costs import NO_REGION, beside, combined, differences, random_case
from proof.sampling import many

from optloc.kernels.jit import enabled
from optloc.proof.local_search import BETTER, BUDGET, OPEN, OTHER, SINGULAR, STATIONARY, UNIQUE, VALUE, prove_locally
from optloc.proof.search_space import cost_of, empty_box

# As Python: fixes call other searches, so machine code of this one would be made for these tests alone.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("form")]
KAPPAS = (0.0, 9.0, 25.0)
AROUND, AWAY = 1e5, 1e9


def cases():
    """Return how many costs are drawn."""
    return many(12, 3)


def proof(case, x, kappa=0.0, others=(), region=None, budget=None, closed=False):
    """Return verdict, boxes, bound and the point found."""
    d, found = case.d, np.full(case.d, np.nan)
    low, high = (NO_REGION[:d], NO_REGION[:d]) if region is None else (np.asarray(end, float) for end in region)
    known = beside(others, d)
    eps = 1e-6 * (1.0 + case.cost(x))
    K = np.ascontiguousarray(case.K)
    cost, box = cost_of(case.kinds, case.data, K, case.w), empty_box(*K.shape)
    budget = budget or many(20_000, 300)
    answer = prove_locally(cost, box, x, known, kappa, eps, budget, np.inf, low, high, closed, found)
    return *answer, found


def gradient_in_deviations(case, x):
    gradient, hessian = case.derivatives(x)
    return np.sqrt(max(gradient @ np.linalg.solve(hessian, gradient), 0.0))


@pytest.mark.parametrize(
    ("d", "kind"), [(2, "tdoa"), (3, "tdoa"), (2, "range"), (3, "range"), (3, "sum"), (3, "prior")]
)
def test_what_is_proven_holds_against_many_starts(d, kind):
    rng = np.random.default_rng(d)
    proven = 0
    for i in range(cases()):
        case, _ = random_case(rng, d, kind=kind, outside=i % 2 == 1, sigma=(1.0, 10.0, 30.0)[i % 3])
        minima = case.minima(rng)
        if not len(minima):
            continue
        costs = case.cost(minima)
        verdict, _, bound, found = proof(case, minima[0])
        assert verdict != BETTER
        assert bound <= costs[0]
        if verdict == VALUE:
            proven += 1
            assert bound == pytest.approx(costs[0], rel=1e-5, abs=1e-5)
        for kappa in KAPPAS[1:]:
            verdict, _, _, found = proof(case, minima[0], kappa)
            gaps = costs[1:] - costs[0]
            if verdict == UNIQUE:
                assert (gaps > kappa * (1.0 - 1e-6)).all()
            if verdict == OTHER:
                assert 0.0 <= case.cost(found) - costs[0] < kappa
                assert gradient_in_deviations(case, found) < 0.1
                assert np.linalg.norm(found - minima[0]) > 1.0
    assert proven > 0.8 * cases()


@pytest.mark.parametrize("d", [2, 3])
def test_minima_that_are_not_the_least_are_refuted_or_left_open(d):
    rng = np.random.default_rng(10 + d)
    tried = refuted = 0
    for i in range(2 * cases()):
        case, _ = random_case(rng, d, m=d + 2, outside=i % 2 == 1, sigma=30.0)
        minima = case.minima(rng)
        for wrong in minima[1:]:
            # A search of a valley that has no minimum ends anywhere on its way to infinity.
            if case.cost(wrong) < case.cost(minima[0]) + 0.01 or np.linalg.norm(wrong) > AWAY:
                continue
            tried += 1
            for kappa in KAPPAS:
                verdict, _, bound, found = proof(case, wrong, kappa)
                if verdict == OPEN:
                    region = (np.full(d, -AROUND), np.full(d, AROUND))
                    verdict, _, bound, found = proof(case, wrong, kappa, region=region)
                assert verdict not in (VALUE, UNIQUE)
                assert bound <= case.cost(minima[0])
                if verdict == BETTER:
                    refuted += kappa == 0.0
                    assert case.cost(found) < case.cost(wrong)
    assert tried >= cases() // 4
    assert refuted > 0.9 * tried or not enabled()


def test_points_that_are_no_minima_are_not_certified():
    rng = np.random.default_rng(20)
    for _ in range(cases()):
        case, truth = random_case(rng, 3, sigma=10.0)
        sigma = np.linalg.inv(np.linalg.cholesky(case.derivatives(truth)[1])).T
        x = case.minimum(truth) + sigma @ rng.standard_normal(3)
        assert proof(case, x)[0] in (STATIONARY, BETTER, OPEN)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_a_mirror_twin_has_the_proven_value_and_is_found(kappa):
    """Stations in a plane: both points cost the same, so the value is proven and uniqueness never is."""
    rng = np.random.default_rng(30)
    stations = np.array([[0.0, 0.0], [9e3, 1e3], [1e3, 8e3], [-7e3, 2e3], [-1e3, -9e3], [5e3, 6e3]])
    flat = np.column_stack([stations, np.zeros(6)])
    truth = np.array([1.5e3, 2e3, 4e3])
    case = combined(flat, np.eye(6), 100.0 * np.eye(6), truth, rng)
    x = case.minimum(truth)
    twin = x * [1.0, 1.0, -1.0]
    assert case.cost(twin) == pytest.approx(case.cost(x), rel=1e-12)
    verdict, _, bound, found = proof(case, x, kappa)
    if kappa == 0.0:
        assert verdict in (VALUE, BUDGET)
        assert bound <= case.cost(x)
    else:
        assert verdict == OTHER
        assert np.linalg.norm(found - twin) < 1.0
    verdict, _, _, _ = proof(case, x, kappa, others=[twin])
    assert verdict in ((VALUE, BUDGET) if kappa == 0.0 else (UNIQUE,))


def test_other_minima_that_are_known_are_set_aside_and_the_list_is_proven():
    rng = np.random.default_rng(40)
    listed = 0
    for _ in range(2 * cases()):
        stations = np.array([[-4e3, 0.0], [0.0, 150.0], [4e3, -200.0]]) + 300.0 * rng.standard_normal((3, 2))
        truth = np.array([2e3, 3e3]) + 1e3 * rng.standard_normal(2)
        case = combined(stations, np.eye(3), 100.0**2 * np.eye(3), truth, rng)
        minima = case.minima(rng)
        gaps = case.cost(minima) - case.cost(minima[0])
        if len(gaps) < 2 or not 0.1 < gaps[1] < 9.0:
            continue
        assert proof(case, minima[0], 9.0)[0] in (OTHER, OPEN, BUDGET)
        verdict = proof(case, minima[0], 9.0, others=minima[1:])[0]
        assert verdict in (UNIQUE, BUDGET)
        listed += verdict == UNIQUE
        # A point that is no minimum is no excuse to set a box aside.
        assert proof(case, minima[0], 9.0, others=minima[1:] + 300.0)[0] != UNIQUE
    assert listed > (3 if enabled() else -1)


def test_a_region_is_searched_where_nothing_encloses_the_cost():
    rng = np.random.default_rng(50)
    done = 0
    for _ in range(cases()):
        stations = rng.uniform(-5e3, 5e3, (4, 3))
        truth = rng.uniform(-2e3, 2e3, 3)
        case = differences(stations, truth, 10.0, rng)
        region = (np.full(3, -4e3), np.full(3, 4e3))
        minima = case.minima(rng)
        inside = minima[(np.abs(minima) < 4e3).all(1)]
        if len(inside) != 1:
            continue
        assert proof(case, inside[0])[0] == OPEN
        verdict, _, bound, _ = proof(case, inside[0], region=region)
        points = rng.uniform(-4e3, 4e3, (20_000, 3))
        assert bound <= case.cost(points).min()
        if verdict == VALUE:
            done += 1
            assert case.cost(points).min() >= case.cost(inside[0]) * (1.0 - 1e-6) - 1e-6
    assert done > 0 or not enabled()


def test_a_region_whose_least_cost_is_on_its_border_is_not_proven():
    """The fix has a low cost, but the region reaches to where the cost is lower still, without a minimum inside."""
    rng = np.random.default_rng(60)
    seen = 0
    for _ in range(8 * cases()):
        case, _ = random_case(rng, 2, m=4, sigma=30.0)
        minima = case.minima(rng)
        if len(minima) < 2 or case.cost(minima[1]) > case.cost(minima[0]) + 400.0:
            continue
        best, wrong = minima[:2]
        # The border passes half a standard deviation from the best point, which stays outside.
        H = case.derivatives(best)[1]
        normal = (wrong - best) / np.linalg.norm(wrong - best)
        way = np.linalg.solve(H, normal)
        near = best + 0.2 * way / np.sqrt(normal @ way)
        if case.cost(near) >= case.cost(wrong) - 0.1:
            continue
        low, high = np.minimum(near, wrong + 1.0), np.maximum(near, wrong + 1.0)
        seen += 1
        for kappa in (0.0, 9.0):
            assert proof(case, wrong, kappa, region=(low, high))[0] not in (VALUE, UNIQUE)
    assert seen > 0 or not enabled()


def test_a_budget_that_ends_leaves_a_valid_bound():
    rng = np.random.default_rng(70)
    for _ in range(cases()):
        case, _ = random_case(rng, 3, m=6, outside=True, sigma=30.0)
        minima = case.minima(rng)
        if not len(minima):
            continue
        verdict, boxes, bound, _ = proof(case, minima[0], 0.0, budget=5)
        assert boxes <= 5
        assert bound <= case.cost(minima[0])
        if verdict == BUDGET:
            far = minima[0] + 3e3 * rng.standard_normal((5000, 3))
            assert bound <= case.cost(far).min()


def test_rows_that_do_not_determine_a_position_are_singular():
    rng = np.random.default_rng(80)
    case = combined(np.outer([1.0, 2.0, 3.0], np.ones(3)), np.eye(3), np.eye(3), np.array([9.0, 9.0, 9.0]), rng)
    # second derivatives across the line are positive at the place, so the search begins, and finds no convex box
    assert proof(case, np.array([9.0, 9.0, 9.0]))[0] in (SINGULAR, STATIONARY)


def test_not_a_number_proves_nothing():
    rng = np.random.default_rng(90)
    case, truth = random_case(rng, 3)
    case.w[1] = np.nan
    assert proof(case, truth, region=(truth - 1e3, truth + 1e3), budget=50)[0] not in (VALUE, UNIQUE, BETTER, OTHER)
    assert proof(case, truth)[0] not in (VALUE, UNIQUE, BETTER, OTHER)
