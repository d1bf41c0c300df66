"""Fixes under every shipped constraint against judges that share no code with the solver, and the laws of fixes."""

import numpy as np
import pytest
from linear.constraints import courses, judge
from linear.constraints.shared import PLANE, SIGMA, SPACE
from often import few

from optloc import Motion, assemble, constraints, crlb, measured, solve

CASES = [(name, judge.verdict) for name in judge.ALL] + [(name, courses.verdict) for name in courses.ALL]
NAMES = [name for name, _ in CASES]
# Those of every run; the others are slow together. IPOPT solves roads and keep-out polygons in every run, see below.
OFTEN = {"keep_out_disc", "any_of", "pairs_apart", "turns", "on_the_ground"}
EACH = [pytest.param(*case, id=case[0], marks=[] if case[0] in OFTEN else [pytest.mark.slow]) for case in CASES]
TARGET = np.array([400.0, 300.0])


@pytest.mark.parametrize(("name", "verdict"), EACH)
def test_a_random_problem_has_the_best_admitted_fix(name, verdict):
    assert verdict(name, 1)[0] == ""


@pytest.mark.parametrize("seed", few([353, 345], 1))
def test_no_alternative_falls_inwards_after_a_proof_found_the_minimum(seed):
    assert judge.verdict("polyhedron in space", seed)[0] == ""


@pytest.mark.full
@pytest.mark.parametrize(("name", "verdict"), CASES, ids=NAMES)
def test_no_optimum_of_three_hundred_is_missed(name, verdict):
    found = [verdict(name, seed) for seed in range(300)]
    assert [(seed, words) for seed, (words, _) in enumerate(found) if words] == []
    # problems whose bounds are met, and problems whose bounds change nothing
    assert sum(active for _, active in found) >= 30


@pytest.mark.parametrize("name", few(["polyline", "keep_out_polygon", "any_of", "keep_out_disc"], 2))
def test_ipopt_finds_the_same_minimum_of_a_union(name):
    assert judge.verdict(name, 2, "gtrs+nlp")[0] == ""


def drawn(limits, n, seed=0, target=TARGET):
    """Return the fixes of n draws of four ranges to a target."""
    rng = np.random.default_rng(seed)
    z = np.linalg.norm(PLANE - target, axis=1) + SIGMA * rng.standard_normal((n, 4))
    return solve(assemble(PLANE, measured("range", z, a=range(4), sigma=SIGMA), constraints=limits), "gtrs+lsr")


def deviation():
    """Return the standard deviation of the first coordinate of a fix without constraints, metres."""
    line = (TARGET - PLANE) / np.linalg.norm(TARGET - PLANE, axis=1, keepdims=True)
    return SIGMA * np.sqrt(np.linalg.inv(line.T @ line)[0, 0])


# Regions with the target k standard deviations inside their bound, which is across the first coordinate.
REGIONS = {
    "disc": lambda k: constraints.disc(TARGET - np.array([40.0 - k, 0.0]), 40.0),
    "keep-out disc": lambda k: constraints.keep_out_disc(TARGET + np.array([40.0 + k, 0.0]), 40.0),
    "keep-out polygon": lambda k: constraints.keep_out_polygon(
        TARGET + np.array([[k, -200.0], [60.0, 0.0], [k, 200.0]])
    ),
    "polyline": lambda k: constraints.polyline(
        TARGET + np.array([[-25.0 + k, -200.0], [-25.0 + k, 0.0], [-90.0, 200.0]]), 25.0
    ),
}


@pytest.mark.parametrize("name", few(REGIONS, 1))
@pytest.mark.parametrize("n", few([24, 250], 1))
def test_the_region_at_a_bent_bound_holds_the_target(name, n):
    hits = []
    for seed, inside in enumerate((0.0, 0.5, 1.0, 2.0)):
        fixes = drawn(REGIONS[name](inside * deviation()), n, seed)
        hits += [bool(np.all(fixes[i].chart.covers(TARGET[None], 0.95))) for i in range(n)]
    low, high = (0.93, 0.98) if n > 100 else (0.88, 1.0)
    assert low <= np.mean(hits) <= high


EQUALITIES = {
    "circle": constraints.annulus(TARGET - np.array([30.0, 40.0]), 50.0, 50.0),
    "far disc": constraints.disc(TARGET, 200.0),
    "far road": constraints.polyline(TARGET + np.array([[-300.0, -300.0], [-90.0, 0.0], [300.0, 300.0]]), 200.0),
}


@pytest.mark.parametrize("name", few(EQUALITIES, 1))
@pytest.mark.parametrize(("n", "within"), few([(200, 0.35), (2000, 0.1)], 1, 2))
def test_covariances_are_those_of_draws(name, n, within):
    fixes = drawn(EQUALITIES[name], n)
    errors = np.asarray(fixes.position) - TARGET
    found, stated = errors.T @ errors / n, np.asarray(fixes.covariance()).mean(0)
    assert np.trace(found) == pytest.approx(np.trace(stated), rel=within)


def tangent_bound(information, normal):
    """Return the covariance whose directions are at right angles to a normal."""
    along = np.linalg.svd(normal[None])[2][1:].T
    return along @ np.linalg.inv(along.T @ information @ along) @ along.T


def information_of(stations, place):
    line = (place - stations) / np.linalg.norm(place - stations, axis=1, keepdims=True)
    return line.T @ line / SIGMA**2


def bound_of(problem, truth):
    return np.asarray(crlb(problem, truth)).reshape(len(truth), len(truth))


def test_the_bound_on_a_circle_is_that_of_its_tangent():
    rows = measured("range", np.linalg.norm(PLANE - TARGET, axis=1), a=range(4), sigma=SIGMA)
    found = bound_of(assemble(PLANE, rows, constraints=EQUALITIES["circle"]), TARGET)
    expected = tangent_bound(information_of(PLANE, TARGET), np.array([0.6, 0.8]))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_the_bound_on_a_ground_is_that_of_its_tangent():
    x = np.linspace(0.0, 1000.0, 9)
    (ground,) = constraints.terrain(x, x, 40.0 * np.sin(x[:, None] / 200.0) + 0.1 * x, exactly=3.0)
    height, slope_x, slope_y = ground.table.at(*TARGET)
    truth = np.append(TARGET, height + 3.0)
    rows = measured("range", np.linalg.norm(SPACE - truth, axis=1), a=range(4), sigma=SIGMA)
    found = bound_of(assemble(SPACE, rows, constraints=(ground,)), truth)
    expected = tangent_bound(information_of(SPACE, truth), np.array([-slope_x, -slope_y, 1.0]))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_the_bound_of_two_targets_at_a_known_distance_is_that_of_its_tangent():
    truth = np.concatenate([TARGET, TARGET + np.array([30.0, 40.0])])
    z = np.concatenate([np.linalg.norm(PLANE - place, axis=1) for place in truth.reshape(2, 2)])
    rows = measured("range", z, a=[0, 1, 2, 3] * 2, target=[0] * 4 + [1] * 4, sigma=SIGMA)
    limits = constraints.separation(0, 1, 50.0, 50.0)
    found = bound_of(assemble(PLANE, rows, motions=(Motion(), Motion()), constraints=limits), truth)
    free = np.zeros((4, 4))
    free[:2, :2], free[2:, 2:] = (information_of(PLANE, place) for place in truth.reshape(2, 2))
    np.testing.assert_allclose(found, tangent_bound(free, np.array([-0.6, -0.8, 0.6, 0.8])), rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [13, 29])
def test_bounds_that_do_not_meet_give_no_alternatives(seed):
    assert judge.verdict("keep_out_and_box", seed)[0] == ""
