"""Relaxations and nonlinear programs are a full way to the fix: the minimum of `auto` in the problems of the papers."""

import numpy as np
import pytest

from optloc import simulate, solve
from optloc.lab.papers import angles, bistatic, kinematic, registration, satellites
from optloc.problem import by_epoch

METHODS = ("sdp+lsr", "socp+lsr", "gtrs+nlp+lsr")
TRIALS = {"registration": 1, "registration, prior": 1}


def scenes():
    """Return the problems of one fix of each paper, and one run of registration, with their truths."""
    one = satellites.problem(1, order=0, height=None)
    measured = satellites.problem(1, order=0, height=satellites.HEIGHT)
    run = registration.problem(registration.PRINTED, 8)
    plain = registration.problem(registration.PRINTED, 8, prior=10.0, station_sigma=0.0)
    return {
        "satellites, exact height": (one, satellites.START),
        "satellites, measured height": (measured, satellites.START),
        "bistatic": (bistatic.problem(1), bistatic.truth(1)[0]),
        "angles, two stations": (angles.fixed_target(2, 1e-3), angles.PLACE),
        "angles, four stations": (angles.fixed_target(4, 1e-3), angles.PLACE),
        "registration": (run, registration.truth(registration.PRINTED, run)),
        "registration, prior": (plain, registration.truth(registration.PRINTED, plain)),
    }


SCENES = scenes()


@pytest.mark.parametrize("name", SCENES)
def test_every_way_ends_at_the_minimum_of_auto(name):
    problem, truth = SCENES[name]
    drawn = simulate(problem, truth, 11, trials=TRIALS.get(name, 3))
    best = solve(drawn, "auto")
    assert best.answered.all()
    for method in METHODS:
        fix = solve(drawn, method)
        np.testing.assert_allclose(fix.cost, best.cost, rtol=1e-6, atol=1e-6, err_msg=method)
        sigma = np.sqrt(np.trace(best.covariance(), axis1=-2, axis2=-1))
        assert (np.sqrt(((fix.position - best.position) ** 2).sum(-1)) < 0.01 * sigma).all(), method


def test_every_way_ends_at_the_minimum_of_auto_along_a_course():
    """The kinematic paper: a target that stands anew at each epoch."""
    scene = kinematic.KinematicScenario()
    drawn = by_epoch(kinematic.draw(scene, scene.course(1), 1, (5,)).runs).flat().take(np.arange(0, 60, 15))
    best = solve(drawn, "auto")
    for method in METHODS:
        np.testing.assert_allclose(solve(drawn, method).cost, best.cost, rtol=1e-6, atol=1e-6, err_msg=method)
