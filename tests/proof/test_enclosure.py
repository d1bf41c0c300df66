"""Enclosures of all points below a level: never too small, by sampling far and near."""

import numpy as np
import pytest
from proof.costs import WIDTH, random_case
from proof.nodes.test_range import charted
from proof.sampling import many

from optloc.proof.curvature import sum_up
from optloc.proof.enclosure import around_node, around_rays, enclose
from optloc.proof.nodes.node import AZIMUTH, ELEVATION, RANGE, RATIO
from optloc.proof.search_space import value_at

CASES, RAYS = (18, 6), (500, 200)
pytestmark = pytest.mark.usefixtures("form")


def enclosed(case, x, rho):
    """Return search coordinates around x, and corners of the enclosure of |residual| <= rho (or None)."""
    cost, chart, box = charted(case, x)
    value_at(cost, chart, box)
    box.curves[:] = 0.0
    sum_up(cost.K, cost.w, cost.weight, 0.0, box.nodes, box.curves, box.sums)
    low, high = np.empty(3), np.empty(3)
    return chart, (low, high) if enclose(cost, chart, box, rho, low, high) else None


def points_below(case, x, rho, rng, d, chart):
    """Return points with |residual| <= rho: as far as possible along rays from x, and anywhere."""
    rays = many(*RAYS)
    way = rng.standard_normal((rays, d)) @ chart.sense[:d, :d].T
    reach = np.full(rays, 1e-3)
    for _ in range(36):  # double until outside, then keep the last point inside
        out = case.cost(x + reach[:, None] * way) > rho**2
        reach = np.where(out, reach, 2.0 * reach)
    inside, outside = 0.5 * reach, reach
    for _ in range(20):
        middle = 0.5 * (inside + outside)
        out = case.cost(x + middle[:, None] * way) > rho**2
        inside, outside = np.where(out, inside, middle), np.where(out, middle, outside)
    near = x + inside[:, None] * way
    far = case.stations.mean(0) + rng.standard_normal((rays, d)) * 10.0 ** rng.uniform(3.0, 5.0, (rays, 1))
    both = np.concatenate([near[np.isfinite(near).all(1)], far, case.minima(rng, 6)])
    return both[case.cost(both) <= rho**2]


@pytest.mark.parametrize(
    ("d", "kind"), [(2, "tdoa"), (3, "tdoa"), (2, "range"), (3, "range"), (2, "sum"), (3, "sum"), (3, "prior")]
)
def test_all_points_below_the_level_are_enclosed(d, kind):
    rng = np.random.default_rng(1)
    made = checked = 0
    for i in range(many(*CASES)):
        case, truth = random_case(rng, d, kind=kind, outside=i % 2 == 0, sigma=(1.0, 10.0, 30.0)[i % 3])
        x = case.minimum(truth)
        if np.linalg.norm(x - truth) > 1e5:
            continue
        rho = np.sqrt(case.cost(x) + (0.0, 9.0, 25.0)[i % 3])
        chart, corners = enclosed(case, x, rho * (1.0 + 1e-9))
        if corners is None:
            continue
        below = points_below(case, x, rho, rng, d, chart)
        s = (below - x) @ chart.back[:d, :d].T
        assert (s >= corners[0][:d]).all()
        assert (s <= corners[1][:d]).all()
        made, checked = made + 1, checked + len(s)
    assert made > 0.6 * many(*CASES)
    assert checked > made * 100


def test_ranges_frozen_at_the_fix_would_lose_points():
    """The squared rows contain the unknown's own ranges: with those of the fix instead, points fall outside."""
    rng = np.random.default_rng(2)
    lost = kept = 0
    for _ in range(6):
        case, truth = random_case(rng, 3, m=6, sigma=30.0, outside=True)
        x = case.minimum(truth)
        if np.linalg.norm(x - truth) > 1e5:
            continue
        rho = np.sqrt(case.cost(x) + 25.0)
        chart, corners = enclosed(case, x, rho)
        if corners is None:
            continue
        s = (points_below(case, x, rho, rng, 3, chart) - x) @ chart.back.T
        r = np.linalg.norm(x - case.stations, axis=1)
        R = 900.0 * (np.eye(5) + 1.0)
        e = np.linalg.cholesky(R) @ case.residual(x)
        z = r[1:] - r[0] - e
        G = np.hstack([2.0 * (case.stations[1:] - case.stations[0]), 2.0 * z[:, None]])
        W = np.linalg.inv(2.0 * r[1:, None] * R * 2.0 * r[1:])
        gamma = chart.back @ (np.linalg.solve(G.T @ W @ G, G.T @ W))[:3]
        middle = gamma @ (e * (2.0 * r[1:] - e))
        weighted = gamma * (2.0 * r[1:])
        reach = rho * np.sqrt(((weighted @ R) * weighted).sum(1)) + rho**2 * np.abs(gamma) @ np.diag(R)
        lost += (np.abs(s - middle) > reach).any(1).sum()
        kept += ((s >= corners[0]) & (s <= corners[1])).all(1).sum()
        assert ((s >= corners[0]) & (s <= corners[1])).all()
    assert lost > 0
    assert kept > 500


@pytest.mark.parametrize("interval", [(0.2, 0.5), (0.0, 0.9), (1.5, 2.5), (3.0, 9.0)])
def test_points_of_a_gain_ratio_lie_in_the_ball_of_apollonius(interval):
    rng = np.random.default_rng(3)
    data = np.zeros(WIDTH)
    data[0:3], data[3:6] = rng.uniform(-5.0, 5.0, 3), rng.uniform(-5.0, 5.0, 3)
    origin, back = rng.uniform(-1.0, 1.0, 3), rng.standard_normal((3, 3))
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    around_node(RATIO, data, *interval, origin, back, low, high)
    x = rng.standard_normal((200_000, 3)) * 10.0 ** rng.uniform(-1.0, 2.0, (200_000, 1))
    ratio = np.linalg.norm(x - data[:3], axis=1) / np.linalg.norm(x - data[3:6], axis=1)
    s = (x[(interval[0] <= ratio) & (ratio <= interval[1])] - origin) @ back.T
    assert len(s) > 100
    assert (s >= low).all()
    assert (s <= high).all()
    assert (high - low <= 20.0 * np.ptp(s, axis=0)).all()


def test_a_ratio_that_may_be_one_bounds_nothing():
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    data = np.arange(WIDTH, dtype=float)
    around_node(RATIO, data, 0.9, 1.1, np.zeros(3), np.eye(3), low, high)
    assert np.isinf(low).all()
    assert np.isinf(high).all()


def test_the_box_of_one_range_is_that_of_its_ball():
    data = np.zeros(WIDTH)
    data[:3] = (1.0, 2.0, 3.0)
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    around_node(RANGE, data, 0.0, 5.0, np.zeros(3), np.eye(3), low, high)
    assert low == pytest.approx([-4.0, -3.0, -2.0], abs=1e-7)
    assert high == pytest.approx([6.0, 7.0, 8.0], abs=1e-7)


def test_too_few_differences_have_no_enclosure():
    rng = np.random.default_rng(4)
    case, truth = random_case(rng, 3, m=4)
    assert enclosed(case, truth, 3.0)[1] is None


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("swing", [0.01, 0.1])
def test_points_seen_in_nearly_the_same_directions_are_enclosed(d, swing):
    rng = np.random.default_rng(5)
    made = held = 0
    for _ in range(many(*CASES)):
        stations, x = rng.uniform(-5.0, 5.0, (4, d)), rng.uniform(-4.0, 4.0, d)
        axes = np.stack([np.linalg.qr(rng.standard_normal((d, d)))[0] for _ in range(4)])
        kinds = np.array([AZIMUTH] * 4 + [ELEVATION] * (4 if d == 3 else 0), dtype=np.int64)
        data = np.zeros((len(kinds), WIDTH))
        for j in range(len(kinds)):
            data[j, :d] = stations[j % 4]
            padded = np.zeros((3, 3))
            padded[:d, :d] = axes[j % 4]
            data[j, 6:15] = padded.ravel()

        def angles(points, stations=stations, axes=axes):
            own = np.einsum("sij,...sj->...si", axes, points[..., None, :] - stations)
            azimuth = np.arctan2(own[..., 1], own[..., 0])
            return azimuth if d == 2 else np.concatenate([azimuth, np.arcsin(own[..., 2] / norm(own))], axis=-1)

        def norm(own):
            return np.linalg.norm(own, axis=-1)

        back, low, high = np.zeros((3, 3)), np.full(3, -np.inf), np.full(3, np.inf)
        back[:d, :d] = rng.standard_normal((d, d))
        origin = np.zeros(3)
        origin[:d] = x
        around_rays(kinds, data, origin, back, np.full(len(kinds), swing), low, high)
        if not np.isfinite(high[:d]).all():
            continue
        made += 1
        points = x + rng.standard_normal((20_000, d)) * 10.0 ** rng.uniform(-3.0, 1.0, (20_000, 1))
        off = angles(points) - angles(x)
        seen = (np.abs((off + np.pi) % (2.0 * np.pi) - np.pi) <= swing).all(1)
        s = (points[seen] - x) @ back[:d, :d].T
        assert (s >= low[:d]).all()
        assert (s <= high[:d]).all()
        held += len(s)
    assert made > many(*CASES) // 2
    assert held > made * 20
