"""What explains many misfits: noise that is stated too small, one station, late rows, or nothing."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE

from optloc import assemble, measured
from optloc.kernels.least_squares import refine
from optloc.model_checks.noise_level import common_level_at, late_signals_at

FIXES = 60


def fixed(errors):
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + errors
    problem = assemble(SQUARE, measured("range", z, a=np.arange(5), sigma=1.0)).flat()
    return problem, refine(problem, np.tile(PLACE, (len(errors), 1))).x


def test_noise_three_times_as_large_as_stated_is_the_suspect():
    problem, x = fixed(3.0 * np.random.default_rng(0).standard_normal((FIXES, 5)))
    found = common_level_at(problem, x)
    assert found.suspect
    assert found.refutes
    assert found.factor[0] == pytest.approx(3.0, rel=0.2)
    np.testing.assert_allclose(found.scale(problem).noise.blocks[0].covariance.max(), found.factor[0] ** 2)
    assert found.sentence.startswith("the noise level is the suspect")


def test_noise_as_stated_accuses_nobody():
    found = common_level_at(*fixed(np.random.default_rng(1).standard_normal((FIXES, 5))))
    assert not found.suspect
    assert found.sentence == ""


def test_one_bad_station_is_named():
    errors = np.random.default_rng(2).standard_normal((FIXES, 5))
    errors[:, 3] *= 12.0
    problem, x = fixed(errors)
    found = common_level_at(problem, x)
    assert problem.stations.names[3] in found.alone
    assert not found.suspect


def test_late_rows_are_counted_and_measured():
    rng = np.random.default_rng(3)
    errors = rng.standard_normal((FIXES, 5))
    late = np.zeros(errors.shape, dtype=bool)
    late[::2, 1] = True
    errors[late] += 30.0
    problem, x = fixed(errors)
    found = late_signals_at(problem, np.arange(FIXES), x)
    assert found.share == pytest.approx(late.mean(), abs=0.05)
    assert found.delay == pytest.approx(30.0, rel=0.3)
    assert (found.late >= late.sum(1)).all()
    assert found.late.sum() <= late.sum() + 3
    assert found.method.startswith("late(")
