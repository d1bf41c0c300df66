"""Values that were read in another unit or with another sign are recognised, right ones are not accused."""

import numpy as np
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, measured, solve
from optloc.advice import advise

NOISE = np.array([0.6, -0.4, 0.9, -0.7, 0.2])


def first(problem):
    """Return the first advice on a flat batch of one problem."""
    (found,) = advise(problem, solve(problem))
    return found[0]


def test_ranges_in_feet_are_recognised():
    problem = ranges_to(PLACE, 1.0, NOISE)
    one = first(problem.with_rows(z=problem.z / 0.3048))
    assert (one.cause, one.toml) == ("unit", 'unit = "ft"\n')


def test_right_values_are_not_accused():
    problem = ranges_to(PLACE, 1.0, NOISE)
    assert advise(problem, solve(problem))[0] == ()


def test_degrees_that_were_read_as_radians_are_no_turns_of_a_larger_unit():
    toward = np.arctan2(*(PLACE - SQUARE).T[::-1])
    right = assemble(SQUARE, measured("azimuth", toward, a=np.arange(5), sigma=0.01))
    wrong = right.with_rows(z=toward + 0.6 * (np.arange(5) == 2))
    found = advise(wrong, solve(wrong))
    assert (found[0].cause, found[0].station) == ("offset", (right.stations.names[2],))


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
