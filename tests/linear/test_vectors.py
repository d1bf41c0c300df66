"""Parameter vectors of problems of one position."""

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET

from optloc import Motion, assemble, measured, with_bias
from optloc.engine import predict
from optloc.linear.vectors import complete, emission_columns, problem_at_rest, vectors, without_biases
from optloc.problem import Prior

Z = np.linspace(3e3, 8e3, 6)


def ranges(**more):
    return assemble(STATIONS[2], measured("range", Z[None], a=np.arange(6), sigma=5.0), **more)


def test_other_unknowns_take_their_prior_mean_or_zero():
    problem = with_bias(ranges(motions=(Motion(1),)), "clock", mean=7.0, sigma=2.0)
    problem = with_bias(problem, "gain", form="scale", per="kind")
    found = vectors(problem, TARGET[2][None, None])
    assert found.shape == (1, 1, problem.layout.size)
    assert problem.layout.take(found, "position")[0, 0].tolist() == TARGET[2].tolist()
    assert problem.layout.take(found, "velocity").tolist() == [[[0.0, 0.0]]]
    assert (problem.layout.take(found, "clock") == 7.0).all()
    assert (problem.layout.take(found, "gain") == 0.0).all()


def test_a_prior_on_a_named_unknown_gives_its_mean():
    prior = Prior("velocity", np.array([3.0, -4.0]), np.eye(2))
    problem = ranges(motions=(Motion(1),), priors=(prior,))
    assert problem.layout.take(vectors(problem, None), "velocity").tolist() == [[3.0, -4.0]]


@pytest.mark.parametrize("fill", [vectors, complete])
def test_emission_times_fit_their_position_best(fill):
    case = CASES["toa-2d"]
    problem = case.problem.take(np.zeros(1, dtype=int)) if case.problem.batch_shape else case.problem.flat()
    found = fill(problem, TARGET[2][None, None])[0, 0]
    left = problem.observed[0] - np.linalg.norm(STATIONS[2] - TARGET[2], axis=1)
    assert found[emission_columns(problem)] == pytest.approx([left.mean()])


def test_a_vector_that_is_not_known_stays_unknown():
    shared = np.array([[[1.0, 2.0], [np.nan, 2.0]]])
    found = complete(CASES["toa-2d"].problem.flat(), shared)
    assert np.isnan(found).all(-1).tolist() == [[False, True]]


def test_known_biases_leave_the_rows_and_free_ones_count_as_zero():
    problem = with_bias(ranges(), "clock", mean=7.0, sigma=2.0)
    problem = with_bias(problem, "gain", form="scale", per="kind", mean=0.01, sigma=0.1)
    problem = with_bias(problem, "free", members=["S1"])
    plain = without_biases(problem)
    assert plain.layout.size == 2
    x = vectors(problem, TARGET[2][None, None])[:, 0]
    gain = 1.01
    np.testing.assert_allclose(gain * (plain.z - predict(plain, TARGET[2])), problem.z - predict(problem, x), atol=1e-9)


def test_a_target_that_is_held_still_has_no_velocity():
    assert [slot.name for slot in problem_at_rest(ranges(motions=(Motion(1),))).layout.shared] == ["position"]
