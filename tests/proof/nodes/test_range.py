"""Bounds over a box, by sampling: remainders of ranges, lengths of residuals, what a clipped box may lose."""

import numpy as np
import pytest
from proof.costs import WIDTH, random_case

from optloc.kernels.jit import enabled
from optloc.proof.box import bound_nodes, contract_box, cut_out, least_residual, linearise_rows
from optloc.proof.nodes.node import NODE_WIDTH, RANGE, largest_quadratic
from optloc.proof.nodes.range import bound_ranges
from optloc.proof.search_space import chart_at, cost_of, empty_box, write_centre

pytestmark = pytest.mark.usefixtures("form")

BOXES, POINTS = (600, 250) if enabled() else (60, 250)


def drawn_box(rng, d):
    """Return a line, a sensitivity and half-widths: small and large boxes, some with the station inside."""
    line, sense, half = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    line[:d] = rng.standard_normal(d)
    sense[:d, :d] = rng.standard_normal((d, d))
    half[:d] = 10.0 ** rng.uniform(-3.0, 0.5, d)
    return line, sense, half


def bounded(line, sense, half):
    """Return the row of the range to the origin at the point `line`."""
    nodes, data = np.empty((1, NODE_WIDTH)), np.zeros((1, WIDTH))
    bound_ranges(np.array([RANGE]), data, line, sense, sense.T @ sense, half, nodes)
    return nodes[0]


def ways(rng, half, points):
    """Return points of a box: corners, faces and inside."""
    s = rng.uniform(-1.0, 1.0, (points, 3))
    s[: points // 2] = np.clip(3.0 * s[: points // 2], -1.0, 1.0)
    return s * half


@pytest.mark.parametrize("d", [2, 3])
def test_remainder_of_a_range_is_enclosed_and_not_wide(d):
    rng = np.random.default_rng(d)
    used = []
    for _ in range(BOXES):
        line, sense, half = drawn_box(rng, d)
        node = bounded(line, sense, half)
        s = ways(rng, half, POINTS)
        q = np.linalg.norm(line + s @ sense.T, axis=1) - node[0] - s @ node[1:4]
        slack = 1e-13 * (1.0 + np.linalg.norm(line) + np.abs(sense) @ half).max()
        assert node[4] - slack <= q.min()
        assert q.max() <= node[5] + slack
        used.append(q.max() / node[5])
    assert np.median(used) > 0.5


def test_quadratic_form_is_greatest_at_a_corner():
    rng = np.random.default_rng(1)
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    for _ in range(200):
        root, h = rng.standard_normal((3, 3)), rng.uniform(0.0, 2.0, 3)
        M = root.T @ root
        s = corners * h
        exact = ((s @ M) * s).sum(1).max()
        M *= h[:, None] * h
        own = largest_quadratic(M[0, 0], M[0, 1], M[0, 2], M[1, 1], M[1, 2], M[2, 2])
        assert own == pytest.approx(exact, rel=1e-12)


def test_the_quotient_with_a_negative_denominator_is_no_bound():
    """B^2 / (2 A) for A <= 0, which looks like a bound of the remainder, lies below it; ours does not."""
    rng = np.random.default_rng(2)
    broken = tried = 0
    for _ in range(BOXES):
        line, sense, half = drawn_box(rng, 3)
        node = bounded(line, sense, half)
        least = node[0] - np.abs(node[1:4]) @ half
        if least > 0.0:
            continue
        s = ways(rng, half, POINTS)
        q = (np.linalg.norm(line + s @ sense.T, axis=1) - node[0] - s @ node[1:4]).max()
        P = sense.T @ sense - np.outer(node[1:4], node[1:4])
        tried += 1
        broken += (half @ np.abs(P) @ half) / (2.0 * least) < q
        assert q <= node[5] * (1.0 + 1e-12)
    assert tried > BOXES // 20
    assert broken == tried


def test_the_diagonal_alone_is_no_bound_of_a_quadratic_form():
    rng = np.random.default_rng(3)
    broken = 0
    for _ in range(BOXES):
        line, sense, half = drawn_box(rng, 3)
        node = bounded(line, sense, half)
        least = node[0] - np.abs(node[1:4]) @ half
        if least <= 0.0:
            continue
        P = sense.T @ sense - np.outer(node[1:4], node[1:4])
        shortcut = np.sqrt(least**2 + np.diag(P) @ half**2) - least
        s = ways(rng, half, POINTS)
        broken += (np.linalg.norm(line + s @ sense.T, axis=1) - node[0] - s @ node[1:4]).max() > shortcut
    assert broken > BOXES // 100


def charted(case, x):
    cost = cost_of(case.kinds, case.data, np.ascontiguousarray(case.K), case.w)
    box = empty_box(*case.K.shape)
    chart, good = chart_at(cost, x, box)
    assert good
    return cost, chart, box


def bound_box(cost, chart, box):
    """Fill the first tables of a box; return the bound of its residuals."""
    write_centre(chart.origin, chart.sense, box.at, box.centre)
    bound_nodes(*cost[:2], box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    return least_residual(cost.K, cost.weight, chart.floor, box.half, box.nodes, box.rows)


def place_box(box, d, rng, most=4.0):
    box.at[:], box.half[:] = 0.0, 0.0
    box.at[:d] = rng.standard_normal(d) * 10.0 ** rng.uniform(0.0, 3.0)
    box.half[:d] = 10.0 ** rng.uniform(-1.0, most, d)


@pytest.mark.parametrize(("d", "kind"), [(2, "tdoa"), (3, "tdoa"), (3, "range"), (2, "sum"), (3, "prior")])
def test_residuals_are_no_shorter_than_the_bound(d, kind):
    rng = np.random.default_rng(4)
    told = 0
    for i in range(BOXES // 2):
        case, truth = random_case(rng, d, kind=kind, outside=i % 2 == 0)
        cost, chart, box = charted(case, truth)
        place_box(box, d, rng, most=2.0)
        low = bound_box(cost, chart, box)
        s = box.at + ways(rng, box.half, POINTS)
        x = chart.origin + s @ chart.sense.T
        least = np.sqrt(case.cost(x[:, :d])).min()
        assert low <= least
        told += low > 0.5 * least
    assert told > 0.3 * (BOXES // 2)


@pytest.mark.parametrize("d", [2, 3])
def test_a_clipped_box_loses_no_short_residual(d):
    rng = np.random.default_rng(5)
    clipped, held = 0, 0
    for i in range(BOXES // 2):
        case, truth = random_case(rng, d, outside=i % 2 == 0)
        cost, chart, box = charted(case, truth)
        place_box(box, d, rng, most=2.0)
        bound_box(cost, chart, box)
        s = ways(rng, box.half, POINTS)
        length = np.sqrt(case.cost((chart.origin + (box.at + s) @ chart.sense.T)[:, :d]))
        rho = np.quantile(length, 0.2)
        box.cut[:3], box.cut[3:] = -box.half, box.half
        contract_box(cost.K, cost.weight, rho, box.half, d == 2, box.nodes, box.rows, box.cut, box.solve)
        inside = s[length <= rho]
        assert (inside >= box.cut[:3]).all()
        assert (inside <= box.cut[3:]).all()
        held += len(inside)
        at, half = box.at.copy(), box.half.copy()
        share = cut_out(box.cut, box.at, box.half)
        clipped += share < 0.9
        kept = np.abs(at + inside - box.at) <= box.half * (1.0 + 1e-12) + 1e-12
        assert kept.all()
        assert (box.half <= half).all()
    assert held > BOXES * 10
    assert clipped > 0.05 * BOXES


def test_comparing_a_length_with_a_cost_would_drop_the_minimum():
    """Below a cost of 1 a residual is longer than its square: low >= f^ drops the box with the minimum inside."""
    rng = np.random.default_rng(6)
    dropped = 0
    for _ in range(60):
        case, truth = random_case(rng, 3, m=5)
        x = case.minimum(truth)
        least = case.cost(x)
        if least >= 0.8:
            continue
        cost, chart, box = charted(case, x)
        box.half[:] = 1e-3
        low = bound_box(cost, chart, box)
        dropped += low >= least
        assert not (low > 0.0 and low * low >= least + 1e-9)
    assert dropped > 10
