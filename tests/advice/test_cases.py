"""A case has the sampled epochs of a run, their fixes and the numbers of their rows."""

import numpy as np
from advice.cases import range_case

from optloc.advice.cases import case_of


def test_the_epochs_of_a_run_are_a_batch_with_the_numbers_of_their_rows():
    case, problem = range_case(epochs=4)
    assert case.x.shape == (4, 2)
    assert case.number.tolist() == np.arange(28).reshape(4, 7).tolist()
    np.testing.assert_array_equal(case.base.z, problem.z.reshape(4, 7))
    assert case.dof.tolist() == [5] * 4


def test_a_problem_without_redundancy_has_no_case():
    _, problem = range_case()
    few = problem.flat().with_rows(weight=(np.arange(7) < 2) * np.ones((1, 7)))
    assert case_of(few, np.full((1, 2), np.nan)) is None
