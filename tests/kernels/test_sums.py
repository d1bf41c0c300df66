"""Normal equations of runs as sums over windows, against differences of plain predictions."""

import numpy as np
import pytest
from cases import CASES, dense_covariance, plain_predict, wrapped

from optloc import InvalidProblem, Motion, assemble, measured
from optloc.kernels.jit import plain
from optloc.kernels.sums import equations_at, is_run, serves, summed
from optloc.problem import Prior


@pytest.mark.parametrize("name", ["tdoa~groa-2d", "range+azimuth-3d", "tdoa+fdoa-2d"])
def test_sums_are_those_of_differences_of_plain_predictions(name):
    problem, x = CASES[name].problem, CASES[name].truth + 5.0
    with plain():
        found = summed(problem, x)
    rows = [plain_predict(problem, x + 0.01 * e) - plain_predict(problem, x - 0.01 * e) for e in np.eye(len(x))]
    jacobian, residual = (
        wrapped(problem, np.array(rows)).T / 0.02,
        wrapped(problem, problem.observed - plain_predict(problem, x)),
    )
    weight = np.linalg.pinv(dense_covariance(problem), rcond=1e-12, hermitian=True)
    np.testing.assert_allclose(found.shared, jacobian.T @ weight @ jacobian, rtol=1e-5, atol=1e-9 * found.shared.max())
    np.testing.assert_allclose(found.shared_vector, jacobian.T @ weight @ residual, rtol=1e-4, atol=1e-8)
    assert found.cost == pytest.approx(residual @ weight @ residual)


def test_a_prior_adds_its_precision_and_its_pull():
    prior = Prior("position", np.array([1.0, 2.0]), np.diag([4.0, 9.0]))
    places = np.array([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0]])
    problem = assemble(places, measured("range", [5.0, 6.0, 7.0], a=[0, 1, 2], sigma=1.0), priors=(prior,))
    x = np.array([4.0, 4.0])
    with plain():
        alone, both = summed(problem, x), equations_at(problem, x)
    np.testing.assert_allclose(both.shared - alone.shared, np.diag([1 / 4, 1 / 9]))
    np.testing.assert_allclose(both.shared_vector - alone.shared_vector, [-3 / 4, -2 / 9])
    assert both.cost - alone.cost == pytest.approx(9 / 4 + 4 / 9)


def test_a_problem_without_unknowns_is_refused():
    known = assemble(
        np.zeros((1, 2)), measured("range", [1.0], a=0, sigma=1.0), motions=(Motion(known=np.ones((1, 1, 2))),)
    )
    with pytest.raises(InvalidProblem, match="nothing is unknown"):
        summed(known, np.zeros(0))


def test_a_run_has_several_epochs_with_unknowns_of_their_own():
    rows = measured("toa", a=[0, 1, 0, 1], epoch=[0, 0, 1, 1], sigma=1.0)
    places = np.array([[0.0, 0.0], [9.0, 1.0]])
    assert is_run(assemble(places, rows))
    assert not is_run(CASES["toa-2d"].problem)
    with plain():
        assert not serves(CASES["toa-2d"].problem, 1)
