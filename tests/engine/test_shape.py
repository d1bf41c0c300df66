"""The shape of the cost about fixes, against its definition."""

import numpy as np
import pytest
from engine.networks import around

from optloc.kernels.jit import enabled
from optloc.problem.chart import basis

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no direct way without machine code")


def departure(made, i, x, inverse):
    """kappa by its definition."""
    centre, A, f = made.place[i].mean(0), made.information(i, x), made.cost(i, x)
    r = np.sqrt(((x - centre) ** 2).sum())
    u0 = (x - centre) / r
    G = np.concatenate([r * basis(u0), -r * u0[:, None]], axis=1) if inverse else np.eye(len(x))
    values, vectors = np.linalg.eigh(G.T @ A @ G)
    t, out = (vectors / np.sqrt(values)).T, 0.0
    axes = list(t)
    for j in range(len(x)):
        for k in range(j):
            if abs(values[j] - values[k]) <= 0.05 * max(values[j], values[k]):
                axes += [(t[j] + t[k]) / np.sqrt(2.0), (t[j] - t[k]) / np.sqrt(2.0)]
    for y in (3.0 * side * axis for axis in axes for side in (1.0, -1.0)):
        share = (1e-6 - 1.0) / y[-1] if inverse and 1.0 + y[-1] < 1e-6 else 1.0
        there = centre + r * (u0 + basis(u0) @ y[:-1] * share) / (1.0 + share * y[-1]) if inverse else x + y
        ratio = (made.cost(i, there) - f) / (9.0 * share**2)
        out = max(out, abs(np.log(max(ratio, 1e-9))))
    return out


@pytest.mark.parametrize(
    ("kind", "d", "s", "far"), [("tdoa", 3, 6, (3.0, 4.5)), ("tdoa", 2, 5, (3.0, 4.5)), ("range", 3, 5, (3.0, 4.0))]
)
def test_kappa_by_its_definition(kind, d, s, far):
    made = around(kind, d, s, far, 120)
    found = made.answer()
    assert found.settled.mean() > 0.9
    poor = found.kappa[:, 0] > 0.3
    assert np.isnan(found.kappa[~poor, 1]).all()
    for i in np.flatnonzero(found.settled):
        x = found.x[i, :d]
        # the information of the reference is one of differences: six digits
        assert found.kappa[i, 0] == pytest.approx(departure(made, i, x, False), rel=1e-5, abs=1e-6)
        if poor[i]:
            assert found.kappa[i, 1] == pytest.approx(departure(made, i, x, True), rel=1e-3, abs=1e-4)
    assert kind == "range" or poor.any()
