"""Values that no position has are reported with their stations."""

import pytest
from model_checks.small import SQUARE

from optloc import assemble, measured
from optloc.advice.impossible import impossible_advice


def test_a_difference_longer_than_its_baseline_is_impossible():
    problem = assemble(SQUARE[:3], measured("tdoa", [1500.0, 20.0], a=[1, 2], b=0, sigma=1.0)).flat()
    (one,) = impossible_advice(problem)
    assert one.cause == "impossible"
    assert "1500 m" in one.seen
    assert "1000 m apart" in one.seen


def test_a_difference_shorter_than_its_baseline_is_possible():
    problem = assemble(SQUARE[:3], measured("tdoa", [900.0, 20.0], a=[1, 2], b=0, sigma=1.0)).flat()
    assert not list(impossible_advice(problem))


@pytest.mark.parametrize("kind", ["range", "range_sum"])
def test_a_length_less_than_any_place_has_is_impossible(kind):
    b = {"b": 0} if kind == "range_sum" else {}
    problem = assemble(SQUARE[:2], measured(kind, [-50.0], a=1, sigma=1.0, **b)).flat()
    assert [one.cause for one in impossible_advice(problem)] == ["impossible"]
