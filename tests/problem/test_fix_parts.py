"""Parts of a fix: probabilities of alternatives, and their choice along the axes of a batch."""

import numpy as np
import pytest

from optloc.base.records import take
from optloc.problem.fix_parts import Active, Alternatives, Stage


def test_the_doubt_of_an_alternative_is_the_ratio_of_likelihoods():
    gap = np.array([[0.0, 2.0, np.inf], [9.0, 25.0, np.inf]])
    doubt = Alternatives(np.zeros((2, 3, 2)), gap).doubt
    ratio = np.exp(-gap / 2.0)
    assert doubt == pytest.approx(ratio / (1.0 + ratio))
    assert doubt[0, 0] == 0.5
    assert (doubt[:, 2] == 0.0).all()


def test_alternatives_follow_their_fixes():
    both = Alternatives(np.arange(12.0).reshape(2, 3, 2), np.arange(6.0).reshape(2, 3))
    second = take(both, np.array([1]))
    assert second.x.tolist() == [both.x[1].tolist()]
    assert second.gap.tolist() == [both.gap[1].tolist()]


@pytest.mark.parametrize("part", [Stage("lsr", "3 steps", 0.01), Active("height upper", 2.0)])
def test_parts_do_not_change(part):
    with pytest.raises(AttributeError):
        part.name = "other"
