"""Models of motion by name: each has its order and its noise, and an unknown name is refused."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.tracking.dynamics import polynomial
from optloc.tracking.named_models import MOTIONS, motion_named


@pytest.mark.parametrize("name", MOTIONS)
def test_a_model_has_the_order_of_its_name(name):
    assert motion_named(name).order == {"static": 0, "cv": 1}.get(name, 2)


def test_a_stated_noise_replaces_that_of_the_table():
    usual, larger = (motion_named("cv", noise).step(2.0, np.zeros(4), 2)[1] for noise in (None, 3.0))
    assert usual == pytest.approx(polynomial(1, MOTIONS["cv"].noise).step(2.0, np.zeros(4), 2)[1])
    assert larger == pytest.approx(9.0 * usual)


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(InvalidProblem, match="did you mean 'singer'") as refused:
        motion_named("singr", where="--model")
    assert refused.value.where == "--model"
