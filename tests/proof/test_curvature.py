"""Second derivatives over a box, by sampling: where the cost is called convex, and where its gradient cannot vanish."""

import numpy as np
import pytest
from proof.costs import random_case
from proof.nodes.test_range import bound_box, bounded, charted, drawn_box, ways
from proof.sampling import many

from optloc.proof.box import is_empty, reset_cut
from optloc.proof.convex_boxes import set_convex
from optloc.proof.curvature import C00, SUMS, contract_to_minima, is_convex_over_box, spread_of
from optloc.proof.nodes.node import CURVE_WIDTH, RANGE
from optloc.proof.nodes.range import curve_ranges
from optloc.proof.search_space import curve_box, is_convex

BOXES, POINTS = (500, 40), 200
pytestmark = pytest.mark.usefixtures("form")


def curved(line, sense, half):
    node, curves = bounded(line, sense, half), np.empty((1, CURVE_WIDTH))
    curve_ranges(np.array([RANGE]), sense.T @ sense, half, node[None], curves)
    return node, curves[0]


def square(six):
    return six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*six.shape[:-1], 3, 3)


@pytest.mark.parametrize("d", [2, 3])
def test_gradient_and_hessian_of_a_range_change_less_than_bounded(d):
    rng = np.random.default_rng(d)
    limited, used = 0, []
    for _ in range(many(*BOXES)):
        line, sense, half = drawn_box(rng, d)
        node, curve = curved(line, sense, half)
        v = line + ways(rng, half, POINTS) @ sense.T
        r = np.linalg.norm(v, axis=1)[:, None]
        slope = v / r @ sense
        turn = np.abs(slope - node[1:4]).max(0)
        assert (turn <= curve[6:9] * (1.0 + 1e-9) + 1e-12).all()
        if np.isfinite(curve[9]):
            N = (sense.T @ sense - slope[:, :, None] * slope[:, None, :]) / r[..., None]
            change = np.linalg.norm(N - square(curve[:6]), ord=2, axis=(1, 2)).max()
            assert change <= curve[9] * (1.0 + 1e-9) + 1e-12
            limited += 1
            used.append(np.max(turn[:d] / curve[6 : 6 + d]))
    assert limited > many(*BOXES) // 3
    assert np.median(used) > 0.5


@pytest.mark.parametrize("d", [2, 3])
def test_bounds_over_part_of_a_box_shrink_at_least_in_proportion(d):
    rng = np.random.default_rng(10 + d)
    for _ in range(many(*BOXES)):
        line, sense, half = drawn_box(rng, d)
        node, curve = curved(line, sense, half)
        share = rng.uniform()
        small, bent = curved(line, sense, share * half)
        if np.isfinite(curve[9]):
            assert small[5] <= share * node[5] * (1.0 + 1e-9) + 1e-15
            assert (bent[6:10] <= share * curve[6:10] * (1.0 + 1e-9) + 1e-12).all()


def at_box(case, origin, rng, d, wide):
    cost, chart, box = charted(case, origin)
    box.at[:], box.half[:] = 0.0, 0.0
    box.at[:d] = rng.standard_normal(d) * wide
    box.half[:d] = wide * 10.0 ** rng.uniform(-2.0, 0.5, d)
    return cost, chart, box


@pytest.mark.parametrize(("d", "kind"), [(2, "tdoa"), (3, "tdoa"), (3, "range"), (3, "prior")])
def test_the_hessian_exceeds_the_margin_all_over_a_convex_box(d, kind):
    rng = np.random.default_rng(20 + d)
    seen = 0
    for i in range(many(*BOXES)):
        case, truth = random_case(rng, d, kind=kind, outside=i % 2 == 0)
        cost, chart, box = at_box(case, truth, rng, d, 10.0 ** rng.uniform(0.0, 2.0))
        margin = rng.choice([0.0, 0.3])
        if not is_convex(cost, chart, box, margin):
            continue
        x = chart.origin + (box.at + ways(rng, box.half, POINTS)) @ chart.sense.T
        T = chart.sense[:d, :d]
        H = T.T @ case.derivatives(x[:, :d])[1] @ T
        assert np.linalg.eigvalsh(H)[:, 0].min() > margin - 1e-9
        seen += 1
    assert seen > many(*BOXES) // 10


@pytest.mark.parametrize("d", [2, 3])
def test_entries_of_the_hessian_change_less_than_bounded(d):
    rng = np.random.default_rng(30 + d)
    seen = 0
    for i in range(many(*BOXES)):
        case, truth = random_case(rng, d, outside=i % 2 == 0)
        cost, chart, box = at_box(case, truth, rng, d, 10.0 ** rng.uniform(0.0, 2.0))
        is_convex(cost, chart, box, 0.0)
        ball = spread_of(cost.A, box.half, box.nodes, box.curves, box.sums)
        if not np.isfinite(ball):
            continue
        x = chart.origin + (box.at + ways(rng, box.half, POINTS)) @ chart.sense.T
        T = chart.sense[:d, :d]
        H = T.T @ case.derivatives(x[:, :d])[1] @ T
        centre, wide = square(box.sums[:6])[:d, :d], square(box.sums[C00:SUMS])[:d, :d]
        assert np.allclose(centre, T.T @ case.derivatives(box.centre[:d])[1] @ T, rtol=1e-6, atol=1e-9)
        assert (np.abs(H - centre) <= wide + ball + 1e-9).all()
        seen += 1
    assert seen > many(*BOXES) // 3


def stationary_points(case, rng):
    """Return zeros of the gradient, saddles too, by Newton's method from many starts."""
    x = case.stations.mean(0) + 15e3 * rng.standard_normal((60, case.d))
    with np.errstate(all="ignore"):
        for _ in range(60):
            gradient, hessian = case.derivatives(x)
            step = np.linalg.solve(hessian + 1e-12 * np.eye(case.d), gradient[..., None])[..., 0]
            long = np.maximum(np.linalg.norm(step, axis=1, keepdims=True) / 2e3, 1.0)
            x = x - step / long
    return x[(np.linalg.norm(step, axis=1) < 1e-6) & (np.abs(x) < 1e6).all(1)]


@pytest.mark.parametrize("d", [2, 3])
def test_no_box_around_a_stationary_point_is_excluded(d):
    rng = np.random.default_rng(40 + d)
    around = excluded = 0
    for i in range(many(*BOXES) // 5):
        case, truth = random_case(rng, d, m=d + 2, outside=i % 2 == 0, sigma=30.0)
        cost, chart, box = charted(case, truth)
        for point in stationary_points(case, rng):
            at = chart.back[:d, :d] @ (point - truth)
            wide = 10.0 ** rng.uniform(-1.0, 1.5)
            for inside in (True, False):
                box.half[:d] = wide * rng.uniform(0.2, 1.0, d)
                box.at[:d] = at + box.half[:d] * (rng.uniform(-1.0, 1.0, d) if inside else 5.0)
                bound_box(cost, chart, box)
                curve_box(cost, chart, box)
                reset_cut(box.half, box.cut)
                contract_to_minima(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
                none = is_empty(box.cut)
                assert not (inside and none)
                around += inside
                excluded += none
    assert around > many(BOXES[0] // 8, 0)
    assert excluded > 0.05 * around


def test_a_convex_box_around_a_minimum_reaches_no_farther_than_convexity():
    rng = np.random.default_rng(50)
    widths = []
    for _ in range(20):
        case, truth = random_case(rng, 3, sigma=10.0)
        x = case.minimum(truth)
        if np.linalg.norm(x - truth) > 500.0:
            continue
        cost, chart, box = charted(case, x)
        assert set_convex(cost, chart, box, np.full(3, 1e4), 0.0)
        best = box.half.copy()
        assert is_convex(cost, chart, box, 0.0)
        x = chart.origin + ways(rng, best, 2000) @ chart.sense.T
        H = chart.sense.T @ case.derivatives(x)[1] @ chart.sense
        assert np.linalg.eigvalsh(H)[:, 0].min() > 0.0
        widths.append(best.min())
    assert np.median(widths) > 1.0


def test_a_saddle_is_not_called_convex():
    rng = np.random.default_rng(60)
    saddles = 0
    for _ in range(12):
        case, truth = random_case(rng, 3, m=5, sigma=30.0)
        cost, chart, box = charted(case, truth)
        for point in stationary_points(case, rng):
            if np.linalg.eigvalsh(case.derivatives(point)[1])[0] >= 0.0:
                continue
            saddles += 1
            box.at[:], box.half[:] = chart.back @ (point - truth), 0.0
            assert not is_convex(cost, chart, box, 0.0)
            assert not is_convex_over_box(cost.kinds, cost.A, box.half, box.nodes, box.curves, box.sums, 0.0)
    assert saddles > 3
