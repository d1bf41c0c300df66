"""Factors that bound the tails of errors, on means of rows whose law is known."""

import numpy as np
import pytest
from model_checks.small import means

from optloc.model_checks.overbound import tail_factors
from optloc.model_checks.variance_components import VarianceFit, tested as told


def found(made, variance):
    none = np.full(len(variance), np.nan)
    gross = np.zeros(made.of_effect.shape, dtype=bool)
    still = np.zeros(len(variance), dtype=bool)
    return VarianceFit(np.array(variance), none, none, none, still, False, gross, told(made, np.ones(())))


def test_normal_errors_of_the_stated_size_need_no_factor():
    made = means(np.random.default_rng(0).standard_normal((300, 6)))
    assert tail_factors(made, found(made, [1.0])).tolist() == [1.0]


def test_errors_twice_as_large_need_a_factor_of_about_two():
    made = means(2.0 * np.random.default_rng(1).standard_normal((300, 6)))
    assert tail_factors(made, found(made, [1.0]))[0] == pytest.approx(2.0, rel=0.15)


def test_tails_of_student_errors_widen_the_group_that_has_them():
    rng = np.random.default_rng(2)
    errors = rng.standard_normal((400, 6))
    errors[:, 3:] = rng.standard_t(3, (400, 3))
    made = means(errors, groups=[0, 0, 0, 1, 1, 1])
    calm, wild = tail_factors(made, found(made, [1.0, 1.0]))
    assert wild > 1.2 * calm
