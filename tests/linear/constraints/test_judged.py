"""Fixes under every shipped constraint against judges that share no code with the solver, and the laws of fixes."""

import numpy as np
import pytest
from linear.constraints import courses, judge
from linear.constraints.shared import PLANE, SIGMA
from often import few

from optloc import assemble, constraints, crlb, measured, solve

CASES = [(name, judge.verdict) for name in judge.ALL] + [(name, courses.verdict) for name in courses.ALL]
NAMES = [name for name, _ in CASES]
# Those of every run; the others are slow together.
OFTEN = {"keep_out_disc", "keep_out_polygon", "polyline", "any_of", "pairs_apart", "turns", "on_the_ground"}
EACH = [pytest.param(*case, id=case[0], marks=[] if case[0] in OFTEN else [pytest.mark.slow]) for case in CASES]
TARGET = np.array([400.0, 300.0])


@pytest.mark.parametrize(("name", "verdict"), EACH)
def test_a_random_problem_has_the_best_admitted_fix(name, verdict):
    assert verdict(name, 1)[0] == ""


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
    "disc": lambda k: constraints.disc(TARGET - [40.0 - k, 0.0], 40.0),
    "keep-out disc": lambda k: constraints.keep_out_disc(TARGET + [40.0 + k, 0.0], 40.0),
    "keep-out polygon": lambda k: constraints.keep_out_polygon(TARGET + [[k, -200.0], [60.0, 0.0], [k, 200.0]]),
    "polyline": lambda k: constraints.polyline(TARGET + [[-25.0 + k, -200.0], [-25.0 + k, 0.0], [-90.0, 200.0]], 25.0),
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
    "circle": constraints.annulus(TARGET - [30.0, 40.0], 50.0, 50.0),
    "far disc": constraints.disc(TARGET, 200.0),
    "far road": constraints.polyline(TARGET + [[-300.0, -300.0], [-90.0, 0.0], [300.0, 300.0]], 200.0),
}


@pytest.mark.parametrize("name", few(EQUALITIES, 1))
@pytest.mark.parametrize(("n", "within"), few([(200, 0.35), (2000, 0.1)], 1, 2))
def test_covariances_are_those_of_draws(name, n, within):
    fixes = drawn(EQUALITIES[name], n)
    errors = np.asarray(fixes.position) - TARGET
    found, stated = errors.T @ errors / n, np.asarray(fixes.covariance()).mean(0)
    assert np.trace(found) == pytest.approx(np.trace(stated), rel=within)


def test_the_bound_on_a_circle_is_that_of_its_tangent():
    z = np.linalg.norm(PLANE - TARGET, axis=1)
    rows = measured("range", z, a=range(4), sigma=SIGMA)
    bound = crlb(assemble(PLANE, rows, constraints=EQUALITIES["circle"]), TARGET)
    along = np.array([-0.8, 0.6])
    line = (TARGET - PLANE) / np.linalg.norm(TARGET - PLANE, axis=1, keepdims=True)
    expected = SIGMA**2 / (along @ line.T @ line @ along) * np.outer(along, along)
    np.testing.assert_allclose(
        np.asarray(getattr(bound, "covariance", bound)).reshape(2, 2), expected, rtol=1e-9, atol=1e-9
    )
