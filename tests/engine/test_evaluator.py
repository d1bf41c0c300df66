"""The interface between steps and rows: both evaluators fill it in, and agree."""

from inspect import signature

import numpy as np
import pytest
from cases import CASES, TARGET
from engine.blocks import block_of

from optloc.engine import evaluator, ranges, tapes

pytestmark = pytest.mark.usefixtures("in_python")


@pytest.mark.parametrize("module", [ranges, tapes])
def test_an_evaluator_has_every_kernel_with_as_many_arguments(module):
    for kernel in evaluator._INTERFACE:
        own = getattr(module, kernel.__name__)
        assert own is not kernel
        assert len(signature(own.function).parameters) == len(signature(kernel.function).parameters)


def test_kernels_that_are_not_filled_in_say_so():
    with pytest.raises(NotImplementedError):
        evaluator.bow_of(None, None)
    assert evaluator.evaluated_by(evaluator.bow_of, tapes, "one_by_tapes") is tapes.bow_of


@pytest.mark.parametrize("name", ["tdoa-2d", "range-3d", "range+range_sum-2d"])
def test_both_evaluators_have_the_same_equations_of_sums_of_ranges(name):
    problem, found = CASES[name].problem, []
    for module in (ranges, tapes):
        block = block_of(problem, module)
        block.put(TARGET[problem.dimension] + 40.0)
        block.run(evaluator.equations, block.rows, block.room, 0)
        found.append(block.equations())
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(one).max())
