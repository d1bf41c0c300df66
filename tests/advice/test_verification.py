"""A suggestion is solved without the result of the comparison."""

import numpy as np
from advice.cases import at, range_case

from optloc.advice.causes import causes_of
from optloc.advice.verification import solved_cost, verified


def test_a_solution_has_the_promised_cost():
    case, _ = range_case(at(3, 90.0), epochs=2)
    (one,) = causes_of(case)
    assert np.isclose(solved_cost(one), one.cost, rtol=1e-3)
    assert verified((one,))[0].cost <= one.cost
