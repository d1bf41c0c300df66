"""Values that were read in another unit or with another sign are recognised, right ones are not accused."""

import numpy as np
import pytest
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import assemble, load, measured, solve
from optloc.advice import advise
from optloc.advice.readings import _is_speed

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


def test_a_wrong_speed_of_times_there_and_back_is_named_as_the_file_states_it(tmp_path):
    places, target = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 300.0], [0.0, 300.0], [150.0, 500.0]]), (120.0, 90.0)
    times = 2e3 * np.hypot(*(places - target).T) / 1483.0
    stations = ", ".join(f'{{ name = "T{i}", x = {x}, y = {y} }}' for i, (x, y) in enumerate(places))
    rows = ", ".join(f'{{ a = "T{i}", z = {time:.6f} }}' for i, time in enumerate(times))
    (tmp_path / "pings.toml").write_text(
        f"format = 2\npropagation_speed = 1500.0\n[stations]\nrows = [{stations}]\n"
        f'[[measurements]]\nkind = "range"\nunit = "ms"\nsigma = 0.02\ntwo_way = true\nrows = [{rows}]\n'
    )
    problem = load(tmp_path / "pings.toml")
    found = advise(problem, solve(problem))[0]
    assert found.cause == "speed"
    assert "instead of 1500 m/s" in found.seen
    assert float(found.toml.split("=")[1]) == pytest.approx(1483.0, abs=0.5)


@pytest.mark.parametrize(
    ("factor", "possible"), [(1.0, True), (1.25, True), (0.5, True), (343.0 / 1500.0, True), (1e3, False)]
)
def test_a_speed_is_that_of_a_medium(factor, possible):
    assert _is_speed(np.array([factor - 1.0])) == possible
