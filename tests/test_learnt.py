"""Biases that were learnt and are taken as known: the rows say the same without them."""

import numpy as np
import pytest
from runs import run

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Motion

PLACES = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 5.0], [0.0, 40.0, 2.0]])
TARGET = np.array([12.0, 17.0, 9.0])


def problem(kind, dimension=3, **options):
    a, epoch = np.tile(np.arange(3), 4), np.repeat(np.arange(4), 3)
    rows = optloc.measured(kind, a=a, b=None, epoch=epoch, sigma=0.1)
    made = optloc.assemble(PLACES[:, :dimension], rows, times=np.arange(4.0), motions=(Motion(reference=1.0),))
    return optloc.with_bias(made, "unit", **options)


@pytest.mark.parametrize(
    ("kind", "dimension", "options", "values"),
    [
        ("range", 3, {"form": "offset"}, [1.0, -2.0, 0.5]),
        ("range", 3, {"form": "scale", "per": "kind"}, [0.07]),
        ("range", 3, {"form": "drift", "per": "station"}, [0.3, -0.1, 0.2]),
        ("azimuth", 2, {"form": "rotation"}, [0.02, -0.1, 0.3]),
        ("elevation", 3, {"form": "rotation"}, [[0.02, -0.1, 0.3], [0.0, 0.2, 0.0], [0.1, 0.1, -0.1]]),
    ],
)
def test_a_known_bias_is_the_bias(kind, dimension, options, values):
    whole = problem(kind, dimension, **options)
    x = np.concatenate([TARGET[:dimension], np.ravel(values)])
    z = optloc.engine.predict(whole, x)
    rest = optloc.problem.with_known_bias(whole.with_rows(z=z), "unit", values)
    assert rest.biases == ()
    np.testing.assert_allclose(optloc.engine.predict(rest, x[:dimension]), rest.observed, atol=1e-12)


def test_members_by_name_and_differences():
    made = optloc.problem.with_known_bias(run(3), "delay", {"S3": 7.0})
    amount = made.rows[0].correction.reshape(3, 4)
    np.testing.assert_array_equal(amount, np.tile([0.0, 7.0, 0.0, 0.0], (3, 1)))


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("delays", [0.0] * 4, "there is no bias 'delays'"),
        ("delay", [0.0] * 3, "there are 3 values"),
        ("delay", {"S9": 1.0}, "'S9' is no member"),
        ("delay", [0.0, np.nan, 0.0, 0.0], "not finite"),
    ],
)
def test_what_does_not_fit_is_refused(name, values, words):
    with pytest.raises(InvalidProblem, match=words):
        optloc.problem.with_known_bias(run(3), name, values)
