"""Parts of a fix: the probability of another position."""

import numpy as np
import pytest

from optloc.problem.fix_parts import Alternatives


def test_the_probability_of_an_alternative_is_its_share_of_both_likelihoods():
    gap = np.array([[0.0, 2.0, 1e4, np.inf]])
    doubt = Alternatives(np.zeros((1, 4, 2)), gap).doubt
    one = np.exp(-gap / 2.0)
    assert doubt == pytest.approx(one / (1.0 + one), abs=1e-15)
    assert doubt[0, 0] == 0.5
    assert doubt[0, 3] == 0.0
