"""Residuals differ from exact ones by less than their rounding is bounded by, wherever the coordinates begin."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
from proof.sampling import many

from optloc.base.linalg import project_out
from optloc.kernels.jit import plain
from optloc.proof.box import bound_nodes, rounding_error
from optloc.proof.nodes.node import PHI, RANGE
from optloc.proof.search_space import chart_on, cost_of, empty_box, write_centre

_NEAREST, _FARTHEST = -3.0, 4.0  # tenth powers of standard deviations from the fix to the places that are looked at


def exact(values):
    return [Decimal(float(value)) for value in np.ravel(values)]


def true_residual(cost, chart, at):
    """Return the residual at search coordinates with forty digits."""
    x = [
        start + sum((a * s for a, s in zip(exact(row), exact(at), strict=True)), Decimal(0))
        for start, row in zip(exact(chart.origin), chart.sense, strict=True)
    ]
    ranges = [
        sum(((a - b) ** 2 for a, b in zip(x, exact(row[:3]), strict=True)), Decimal(0)).sqrt() for row in cost.data
    ]
    return [
        sum((k * r for k, r in zip(exact(row), ranges, strict=True)), -w)
        for row, w in zip(cost.K, exact(cost.w), strict=True)
    ]


def ranges_from(rng, offset, kind):
    """Return a cost of exact ranges of a network that is some kilometres wide, far from where coordinates begin."""
    count, size, sigma = int(rng.integers(4, 8)), 10.0 ** rng.uniform(2.0, 5.0), 10.0 ** rng.uniform(-6.0, 1.0)
    way = rng.standard_normal(3)
    middle = offset * way / np.linalg.norm(way)
    data, x = middle + size * rng.uniform(-1.0, 1.0, (count, 3)), middle + size * rng.uniform(-1.0, 1.0, 3)
    K = np.eye(count) / sigma
    if kind == "toa":
        K = project_out(np.ones((1, count, 1)), K[None])[0]
    return cost_of(np.full(count, RANGE), data, K, K @ np.linalg.norm(data - x, axis=1)), x


@pytest.mark.parametrize("kind", ["range", "toa"])
@pytest.mark.parametrize("offset", [0.0, 1e5, 6.4e6, 4.2e7, 1e9])
def test_residuals_are_off_by_less_than_their_rounding(offset, kind, seed):
    rng = np.random.default_rng([seed, int(offset), len(kind)])
    worst = 0.0
    with plain(), localcontext() as context:
        context.prec = 40
        for _ in range(many(300, 10)):
            cost, x = ranges_from(rng, offset, kind)
            box = empty_box(*cost.K.shape)
            chart, good = chart_on(cost, x, box, np.empty((0, 3)), np.empty(0))
            assert good
            at = rng.standard_normal(3) * 10.0 ** rng.uniform(_NEAREST, _FARTHEST) * (rng.random() < 0.8)
            write_centre(chart.origin, chart.sense, at, box.centre)
            bound_nodes(cost.kinds, cost.data, box.centre, chart.sense, chart.gram, box.half, box.line, box.nodes)
            true = true_residual(cost, chart, at)
            own = cost.K @ box.nodes[:, PHI] - cost.w
            off = float(sum(((Decimal(float(a)) - b) ** 2 for a, b in zip(own, true, strict=True)), Decimal(0)).sqrt())
            bound = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
            worst = max(worst, off / bound)
    assert 0.0 < worst < 0.1


@pytest.mark.parametrize("count", [4, 6])
def test_a_network_on_the_ground_keeps_its_digits_in_coordinates_from_the_centre_of_the_earth(count):
    """Lines to stations are differences of doubles: at a noise of a billionth of the ranges costs can be told apart."""
    rng = np.random.default_rng(count)
    middle = np.array([-5.875e6, 4.44e5, 2.46e6])
    data, x = middle + 3.7e3 * rng.uniform(-1.0, 1.0, (count, 3)), middle + 3.7e3 * rng.uniform(-1.0, 1.0, 3)
    K = np.eye(count) / 3.7e-6
    cost = cost_of(np.full(count, RANGE), data, K, K @ np.linalg.norm(data - x, axis=1))
    box = empty_box(count, count)
    with plain():
        chart, _ = chart_on(cost, x, box, np.empty((0, 3)), np.empty(0))
        noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    assert 24.0 * noise * noise < 0.25
