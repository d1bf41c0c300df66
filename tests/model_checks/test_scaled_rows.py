"""What infinity costs where a factor of the rows is unknown: never less than zero, and as formulas of their own say."""

import numpy as np
import pytest
from cases import CASES
from waves import Scene, air, plate

from optloc import InvalidProblem, solve, with_bias
from optloc.model_checks.scaled_rows import profile_by_rows, runs_backwards
from optloc.model_checks.shape import cost_at_infinity, profile
from optloc.problem.forms import FORMS

SCENES = [
    (plate, 2, 5, 0.3),
    (plate, 2, 6, None),
    (plate, 2, 6, 0.1),
    (plate, 3, 6, 0.3),
    (plate, 3, 8, None),
    (air, 2, 6, 0.02),
    (air, 3, 7, None),
]


def at(scene):
    """Return a vector (1, size) at the truth of a scene."""
    return np.concatenate([scene.truth, [0.0, 0.0]])[None]


@pytest.mark.parametrize(("make", "d", "n", "prior"), SCENES)
def test_infinity_costs_what_plane_waves_cost(make, d, n, prior, seed):
    rng = np.random.default_rng([seed, d, n])
    for _ in range(3):
        scene = make(rng, d, n, prior)
        own = min(scene.plane_wave(), scene.paraboloid())
        assert cost_at_infinity(scene.problem.flat(), at(scene))[0] == pytest.approx(own, rel=1e-3, abs=1e-3)


def test_speed_and_distance_grow_together_above_a_plane(seed):
    """Six sensors in a plane of space: without a prior on the speed the second infinity is the cheaper one."""
    rng = np.random.default_rng(seed)
    for _ in range(4):
        scene = plate(rng, 3, 6, None, flat=True)
        assert scene.paraboloid() < scene.plane_wave()
        assert cost_at_infinity(scene.problem.flat(), at(scene))[0] == pytest.approx(
            scene.paraboloid(), rel=1e-3, abs=1e-3
        )
        known = plate(rng, 3, 6, 0.1, flat=True)
        assert cost_at_infinity(known.problem.flat(), at(known))[0] == pytest.approx(
            known.plane_wave(), rel=1e-3, abs=1e-3
        )


def with_form(problem, form, sigma):
    """Return a problem with a bias of a form, or None where its kind has no such bias."""
    needs = {"walk": {"density": 1.0}, "spline": {"knots": 4}}.get(form, {})
    try:
        return with_bias(
            problem, "error", form=form, per="station" if form in ("rotation", "time") else "kind", sigma=sigma, **needs
        )
    except InvalidProblem:
        return None


SINGLE = {
    name: case
    for name, case in CASES.items()
    if len(case.problem.motions) == 1
    and case.problem.motions[0].order == 0
    and case.problem.motions[0].known is None
    and case.problem.layout.shares("position")
}


@pytest.mark.parametrize("case", SINGLE.values(), ids=SINGLE)
def test_no_infinity_costs_less_than_nothing(case):
    """Every kind with every form of bias, with a prior and without: costs are sums of squares."""
    rng, tried = np.random.default_rng(7), 0
    for form in FORMS:
        for sigma in (0.1, None):
            problem = with_form(case.problem, form, sigma)
            if problem is None:
                continue
            flat = problem.flat()
            slot, _ = flat.layout.find("position")
            own, x = slice(slot.start, slot.start + slot.size), np.zeros((1, flat.layout.size))
            x[:, own] = case.truth[own] + 3e3 * rng.standard_normal(slot.size)
            cost = cost_at_infinity(flat, x)
            assert (cost[np.isfinite(cost)] >= 0.0).all()
            tried += 1
    if not tried:
        pytest.skip("rows that share their noise across kinds have no bias of a kind")


def test_rows_and_normal_equations_agree_near_by(seed):
    """At the size of the array both ways to eliminate the other unknowns give the same cost and slope."""
    rng = np.random.default_rng(seed)
    scene = air(rng, 2, 6, 0.3)
    problem = scene.problem.flat()
    x = np.stack([at(scene) + np.r_[rng.standard_normal(2), 0.0, 0.0] for _ in range(4)])
    for one, two in zip(profile_by_rows(problem, x, x[0], 3), profile(problem, x, x[0], 3), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-6 * np.abs(two).max())


def test_the_plate_of_the_report_is_bounded():
    """Arrivals of a plate whose speed was known to 30 %: infinity seemed to cost 378 less than nothing."""
    place = [
        [0.322001, 0.242382],
        [0.206130, 0.085740],
        [0.021572, 0.115011],
        [0.163389, 0.013583],
        [0.019503, 0.299753],
        [0.260948, 0.070353],
    ]
    times = np.array([1030.1396, 1039.3269, 1044.9120, 1053.0481, 1029.4272, 1045.5900]) * 1e-6
    scene = Scene(np.array(place), 4500.0 * times, 4500.0 * 5e-7, 0.3, np.array([0.1740, 0.2923]))
    assert cost_at_infinity(scene.problem.flat(), at(scene))[0] == pytest.approx(124.40, abs=0.01)
    fix = solve(scene.problem)
    assert fix.status.label != "unbounded"
    assert fix.cost == pytest.approx(1.580, abs=1e-3)
    np.testing.assert_allclose(fix.position, [0.1726, 0.2866], atol=1e-4)


def test_a_wave_that_runs_backwards_is_no_candidate():
    scene = plate(np.random.default_rng(0), 2, 6, None)
    x = np.concatenate([scene.truth, [-1.2, 0.0]])
    assert runs_backwards(scene.problem, x)
    assert not runs_backwards(scene.problem, np.concatenate([scene.truth, [-0.9, 0.0]]))
