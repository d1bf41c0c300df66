"""The least cost of infinity, against a search."""

import numpy as np
import pytest

from optloc import assemble, measured, simulate
from optloc.engine.plan import plan_of
from optloc.engine.shape import STRAIGHT
from optloc.kernels.jit import enabled
from optloc.model_checks.shape import cost_at_infinity

compiled = pytest.mark.skipif(not enabled(), reason="there are no plans without machine code")


@compiled
@pytest.mark.parametrize("kinds", [("azimuth", "elevation"), ("groa",), ("azimuth",), ("azimuth", "tdoa")])
def test_infinity_of_bent_fixes_is_what_a_search_finds(kinds):
    """Emitters so far away that their distance is hardly known."""
    rng = np.random.default_rng(len(kinds))
    d, count = (2 if kinds == ("azimuth",) else 3), 60
    place = rng.uniform(-5e3, 5e3, (6, d))
    a, b, sigma = np.arange(1, 6), 0, {"azimuth": 0.01, "elevation": 0.01, "groa": 0.01, "tdoa": 20.0}
    rows = [measured(k, a=a, sigma=sigma[k], **({"b": b} if k in ("groa", "tdoa") else {})) for k in kinds]
    problem = assemble(place, *rows)
    ahead = rng.standard_normal((count, d))
    truth = 10.0 ** rng.uniform(4.0, 5.5, (count, 1)) * ahead / np.sqrt((ahead**2).sum(-1, keepdims=True))
    z = np.stack([simulate(problem, one, i).z for i, one in enumerate(truth)])
    batch = problem.with_rows(z=z)
    plan = plan_of(batch)
    found = plan.run(plan.load(batch), z)[0]
    bent = np.flatnonzero(found.settled & (found.kappa[:, 0] > STRAIGHT))
    assert len(bent) > 5
    wanted = cost_at_infinity(batch.take(bent), found.x[bent])
    np.testing.assert_allclose(found.infinity[bent], wanted, rtol=2e-3, atol=1e-2)
    straight = found.settled & (found.kappa[:, 0] <= STRAIGHT)
    assert np.isnan(found.infinity[straight]).all()
    for i in bent[:5]:  # alone and in a block
        alone = plan.run(plan.load(batch), z[i : i + 1])[0]
        np.testing.assert_allclose(alone.infinity[0], found.infinity[i], rtol=1e-6)
