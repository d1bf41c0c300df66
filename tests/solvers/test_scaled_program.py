"""A problem scaled to order one, with a shared program or its own."""

import numpy as np
from solvers.posing.scenes import ranged

from optloc import solve
from optloc.solvers.scaled_program import ScaledProblem


def test_shared_and_own_programs_have_one_minimum():
    problem = ranged(1).flat()
    best = solve(problem).position[0]
    shared, own = ScaledProblem(problem), ScaledProblem(problem, shared=False)
    assert ScaledProblem(problem).program is shared.program
    assert own.program is not shared.program
    for scaled in (shared, own):
        start = (best + 50.0 - scaled.centre) / scaled.unit
        found = scaled.program.solve(start, scaled.z, scaled.weight, scaled.data, prior=scaled.prior)
        assert np.abs(found.x * scaled.unit + scaled.centre - best).max() < 1e-2
        assert np.abs(start).max() < 10.0
