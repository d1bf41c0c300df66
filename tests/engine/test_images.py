"""Mirror images of fixes in the plane of the stations, against a minimiser from there."""

import numpy as np
import pytest
from engine.networks import flat
from scipy.optimize import least_squares

from optloc.kernels.jit import enabled

machine_code = pytest.mark.skipif(not enabled(), reason="there is no direct way without machine code")


def mirrored(made, i, x):
    """The minimum that the mirror image leads to, by SciPy."""
    centre = made.place[i].mean(0)
    normal = np.linalg.svd(made.place[i] - centre)[2][-1]
    start = x - 2.0 * ((x - centre) @ normal) * normal
    done = least_squares(lambda at: made.residuals(i, at), start, x_scale="jac", xtol=1e-12, ftol=1e-12, max_nfev=400)
    return done.x, 2.0 * done.cost


@machine_code
@pytest.mark.parametrize(("kind", "s", "height"), [("tdoa", 5, 30), ("tdoa", 6, 30), ("range", 4, 100)])
def test_rivals_are_where_scipy_finds_them(kind, s, height):
    made = flat(kind, s, height, 150)
    found, agreed = made.answer(), 0
    for i in np.flatnonzero(found.settled):
        x = found.x[i, :3]
        other, cost = mirrored(made, i, x)
        assert cost > found.cost[i] - 1e-6 or np.sqrt(((other - x) ** 2).sum()) > 1e5
        rival = found.rival_cost[i]
        if np.isfinite(rival):
            # listed ones are true minima
            assert made.cost(i, found.rival[i, :3]) == pytest.approx(rival, rel=1e-8, abs=1e-8)
            assert rival >= found.cost[i]
        # runs to infinity and arcs are no rivals: SciPy stops somewhere on them
        if cost < found.cost[i] + 9.0 and np.sqrt((other**2).sum()) < 1e5:
            apart = other - x
            if apart @ made.information(i, x) @ apart > 1.0:
                agreed += 1 if np.isclose(rival, cost, rtol=1e-4, atol=1e-4) else 0
                assert rival <= cost + 1e-4 or found.kappa[i, 0] > 0.3
    assert agreed > 3
