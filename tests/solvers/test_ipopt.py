"""Nonlinear programs: the least-squares point, and a batch whose problems have stations of their own."""

import numpy as np
import pytest
from cases import STATIONS, TARGET
from model_checks.small import PLACE, SQUARE, ranges_to
from scipy.optimize import least_squares

from optloc import InvalidProblem, assemble, measured, simulate, solve
from optloc.lab.papers.registration import SPATIAL, RegistrationSetting
from optloc.solvers.ipopt import nlp
from optloc.solvers.pool import begin


@pytest.mark.parametrize("count", [1, 3])
def test_each_problem_has_its_own_stations(count):
    rng = np.random.default_rng(1)
    places = STATIONS[3] + rng.normal(0.0, 500.0, (count, 1, *STATIONS[3].shape))
    a = np.arange(1, len(STATIONS[3]))
    exact = assemble(places, measured("tdoa", a=a, b=np.zeros_like(a), arrival_sigma=5.0))
    problem = simulate(exact, np.broadcast_to(TARGET[3], (count, 3)), np.random.SeedSequence(2))
    found, expected = solve(problem, "gtrs+nlp"), solve(problem, "gtrs+lsr")
    sigma = np.sqrt(np.diagonal(expected.cov, axis1=-2, axis2=-1))
    assert found.answered.all()
    assert (np.abs(found.position - expected.position) <= 1e-4 * sigma).all()


@pytest.mark.slow
def test_a_long_run_ends_refined_on_all_its_epochs():
    """IPOPT sees block averages of it, whose minimum is another: least squares ends at that of all rows."""
    setting = RegistrationSetting(SPATIAL, 2, 1, 0)
    drawn = setting.draw(150)
    found, expected = solve(drawn, "roots+nlp"), solve(drawn, "roots+lsr")
    assert found.answered.all()
    sigma = np.sqrt(np.diagonal(expected.cov, axis1=-2, axis2=-1))
    assert (np.abs(found.x - expected.x) <= 1e-4 * sigma).all()
    assert [stage.name for stage in found.stages] == ["roots", "nlp", "lsr"]


def test_a_program_ends_at_the_least_squares_point_and_needs_a_start():
    error = np.array([0.5, -1.0, 2.0, -0.5, 1.0])
    problem, r = ranges_to(PLACE, 2.0, error), np.linalg.norm(PLACE - SQUARE, axis=1)
    pool = nlp(problem, begin(problem, PLACE[None] + 20.0))
    best = least_squares(lambda x: (np.linalg.norm(x - SQUARE, axis=1) - r - error) / 2.0, PLACE, xtol=1e-15)
    np.testing.assert_allclose(pool.x[0, 0], best.x, atol=1e-3)
    assert pool.cost[0, 0] == pytest.approx(2.0 * best.cost, rel=1e-6)
    with pytest.raises(InvalidProblem, match="needs a start"):
        nlp(problem, None)
