"""Starts of courses: minima that no other start leads to, images, long runs and batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear.constraints import courses
from solvers.starts import courses_judge as judge

from optloc import Motion, Status, assemble, measured, solve
from optloc.solvers.starts.course_search import _different, _some_epochs, course_search, has_course

STATIONS = np.array([[0.0, 0.0], [4000.0, 300.0], [8000.0, 0.0], [3000.0, 7000.0]])


def run(epochs, rows=None, motion=None, error=0.0):
    """Return ranges of all stations at each epoch to a target, and its state."""
    state = np.array([2500.0, 3000.0, 20.0, -8.0])
    times = np.arange(float(epochs))
    a, e = np.tile(np.arange(4), epochs), np.repeat(np.arange(epochs), 4)
    place = state[:2] + times[:, None] * state[2:]
    z = np.linalg.norm(place[e] - STATIONS[a], axis=1) + error * np.sin(1.7 * np.arange(len(a)))
    told = measured("range", z, a=a, epoch=e, sigma=5.0)
    return assemble(STATIONS, told, times=times, motions=(motion or Motion(1),)).flat(), state


def test_a_course_that_targets_at_rest_do_not_start_is_found():
    # three stations near a line: every epoch has two positions, and starts at rest lead to a cost of 835
    case = courses.top_speed(np.random.default_rng([318, sum(map(ord, "top_speed"))]))
    for problem, least in ((case.problem, 45.756483), (replace(case.problem, constraints=()), 36.776288)):
        fix = solve(problem)
        assert fix.status == Status.UNPROVEN
        np.testing.assert_allclose(case.cost(fix.x), least, rtol=1e-6)


def misses(seeds, names=judge.NAMES):
    """Return the problems with a refuted answer although a course fits, and the number of problems."""
    found, count = [], 0
    for number in seeds:
        for name in names:
            case = judge.draw(name, number)
            if case.dof < 1:
                continue
            count += 1
            fix = solve(case.problem)
            # a course through the true places costs this much, so another answer at a greater cost is not the best
            least = judge.best(case, drawn=0)[0]
            if fix.status == Status.MISFIT and judge.p_value(case, least) > 1e-4:
                found.append(f"{name} {number}: {fix.cost:.6g}, but {least:.6g} near the truth")
    return found, count


def test_no_fitting_course_is_refuted(seed):
    number = int(np.random.default_rng(seed).integers(10**6))
    found, count = misses([number], judge.NAMES[number % 5 :: 5])
    assert count > 0
    assert not found


def test_an_accelerating_course_that_was_refuted_is_found():
    case = judge.draw("range/2/2/full/square", 7)
    fix = solve(case.problem)
    assert fix.status != Status.MISFIT
    np.testing.assert_allclose(fix.cost, judge.best(case)[0], rtol=1e-6)


@pytest.mark.full
def test_no_fitting_course_is_refuted_in_full():
    found, count = misses(range(5000, 5050))
    assert count > 1000
    assert not found


def test_trial_courses_reach_the_course_of_exact_data():
    problem, state = run(6)
    x = course_search(problem)
    np.testing.assert_allclose(x[0, 0], state, atol=1e-3)


def test_a_batch_is_searched_as_each_of_its_problems():
    problem, _ = run(6)
    z = problem.z + 5.0 * np.random.default_rng(1).standard_normal((3, problem.count))
    many = problem.with_rows(z=z).flat()
    together = course_search(many)
    for i in range(3):
        alone = course_search(many.take(np.array([i])))
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-6, atol=1e-6)


def test_a_long_run_is_searched_in_some_epochs_for_minima_other_than_the_known_one():
    problem, state = run(400, error=5.0)
    assert _some_epochs(problem).epochs == 50
    known = solve(problem, "lsr", start=state).x
    np.testing.assert_allclose(course_search(problem)[0, 0], known[0], atol=5.0)
    x = course_search(problem, known)
    far = np.linalg.norm(x[0, :, :2] - state[:2], axis=-1)
    assert not (far < 500.0).any()


def test_only_one_unknown_target_with_a_state_for_the_run_has_a_course():
    assert has_course(run(6)[0])
    assert not has_course(run(6, motion=Motion(0))[0])
    assert not has_course(run(6, motion=Motion(0, span="epoch"))[0])
    assert not has_course(run(1, motion=Motion(1))[0])


def test_minima_of_equal_cost_at_different_places_are_both_kept():
    place = np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 1.001], [0.5, 0.5], [0.0, 3.0]])
    assert _different(np.array([1.0, 1.0, 1.0, 4.0, np.inf]), place) == [0, 1, 3]
