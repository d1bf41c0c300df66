"""Solutions of posed problems: the fields that all of them have."""

import numpy as np

from optloc.problem import PosedAnswer, PosedSolution


def test_a_solution_becomes_one_with_more_fields():
    found = PosedSolution({"fence": 1.0}, {"fence": 0.0}, None, 3.0, np.nan)
    answer = PosedAnswer(**found.by_name(), formulation="nls", rank_ratio=np.nan, refined=True, variables={})
    assert answer.duals == {"fence": 1.0}
    assert answer.value == 3.0
    assert set(answer.by_name()) == {"duals", "values", "backend", "value", "bound"}
