"""Values that were read in another unit or with another sign are recognised, right ones are not accused."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured, solve
from optloc.model_checks.advice import advise
from optloc.model_checks.unit_mistakes import advise_on_values

NOISE = np.array([0.6, -0.4, 0.9, -0.7, 0.2])


def test_ranges_in_feet_are_recognised():
    problem = ranges_to(PLACE, 1.0, NOISE)
    in_feet = problem.with_rows(z=problem.z / 0.3048)
    found = list(advise_on_values(in_feet, np.full((1, 2), np.nan)))
    assert (found[0].cause, found[0].toml) == ("unit", 'unit = "ft"\n')


def test_right_values_are_not_accused():
    assert not list(advise_on_values(ranges_to(PLACE, 1.0, NOISE), PLACE[None]))


def test_a_difference_longer_than_its_baseline_is_impossible():
    problem = assemble(SQUARE[:3], measured("tdoa", [1500.0, 20.0], a=[1, 2], b=0, sigma=1.0)).flat()
    (one,) = advise_on_values(problem, np.full((1, 2), np.nan))
    assert one.cause == "impossible"
    assert "1500 m" in one.seen
    assert "1000 m apart" in one.seen


def test_a_difference_shorter_than_its_baseline_is_possible():
    problem = assemble(SQUARE[:3], measured("tdoa", [900.0, 20.0], a=[1, 2], b=0, sigma=1.0)).flat()
    assert not list(advise_on_values(problem, np.full((1, 2), np.nan)))


@pytest.mark.parametrize("kind", ["range", "range_sum"])
def test_a_length_less_than_any_place_has_is_impossible(kind):
    b = {"b": 0} if kind == "range_sum" else {}
    problem = assemble(SQUARE[:2], measured(kind, [-50.0], a=1, sigma=1.0, **b)).flat()
    assert [one.cause for one in advise_on_values(problem, np.full((1, 2), np.nan))] == ["impossible"]


def test_counters_that_count_down_are_recognised():
    """Four microphones round a target of 0.225 m whose timers count down, from the freETarget project."""
    microphones = {"N": (0.0, 0.1125), "E": (0.1125, 0.0), "S": (0.0, -0.1125), "W": (-0.1125, 0.0)}
    shot = np.array([0.02, -0.035])
    places = np.array(list(microphones.values()))
    down = -np.linalg.norm(places - shot, axis=1)
    rows = measured("toa", down - down.min(), a=np.arange(4), sigma=1e-4)
    problem = assemble(places, rows)
    found = [one for one in advise(problem, solve(problem)) if one.cause == "sign"]
    assert [one.seen.split(" (p")[0] for one in found] == [
        "the toa values fit with the opposite sign: the counters count down to zero"
    ]
