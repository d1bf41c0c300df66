"""Targets near the plane of all stations, against a least-squares search of its own in the plane and q = w^2."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest
from model_checks.small import SQUARE, ranges_to
from scipy.optimize import least_squares

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.model_checks.coplanar import Across, is_coplanar

JOINED = 3.8414588206941236  # chi-square of one degree of freedom, 95 %


@dataclass(frozen=True)
class Scene:
    """A planar array, a target, and its ranges; late: all of them by one unknown amount."""

    stations: Array
    target: Array
    measured: Array
    sigma: float
    late: bool

    def fix(self, *, height: tuple[float, float] | None = None, turn: Array | None = None) -> optloc.Fix:
        return optloc.solve(self.problem(height, turn))

    def problem(self, height: tuple[float, float] | None = None, turn: Array | None = None) -> optloc.Problem:
        places = self.stations if turn is None else self.stations @ turn.T
        kind, every = "toa" if self.late else "range", np.arange(len(places))
        held = () if height is None else optloc.constraints.box((-9, -9, height[0]), (9, 9, height[1]))
        return optloc.assemble(
            places, optloc.measured(kind, self.measured, a=every, sigma=self.sigma), constraints=held
        )

    def residual(self, y: Array, q: float) -> Array:
        ranges = np.sqrt(((self.stations[:, :2] - y[:2]) ** 2).sum(1) + q)
        return (ranges + (y[2] if self.late else 0.0) - self.measured) / self.sigma

    def profile(self, q: float) -> float:
        """Return the least cost at a squared distance from the plane, by another method from three places."""
        starts = [np.r_[share * self.target[:2], [0.0] * self.late] for share in (1.0, 0.5, 1.5)]
        return 2.0 * min(least_squares(self.residual, y, args=(q,), x_scale=0.1).cost for y in starts)

    def least(self) -> float:
        """Return the least cost of all places, by another method."""
        starts = [
            np.r_[share * self.target[:2], [0.0] * self.late, w] for share in (1.0, 0.6) for w in (0.02, 0.3, 1.0, 5.0)
        ]
        free = [least_squares(lambda v: self.residual(v[:-1], v[-1] ** 2), v, x_scale=0.1).cost for v in starts]
        return min(2.0 * min(free), self.profile(0.0))


def draw(seed: int, *, late: bool, far: float) -> Scene:
    rng = np.random.default_rng([seed, late, int(100 * far)])
    n = int(rng.integers(5, 9))
    stations = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.zeros(n)])
    target = np.r_[rng.uniform(-0.7, 0.7, 2), far * rng.uniform(0.5, 1.0)]
    sigma = 10.0 ** rng.uniform(-3.5, -2.0)
    ranges = np.linalg.norm(stations - target, axis=1) + sigma * rng.standard_normal(n)
    return Scene(stations, target, ranges, sigma, late)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("far", [0.0, 0.1, 0.5, 5.0])
def test_both_sides_are_two_answers_only_where_the_plane_between_them_costs_more(late: bool, far: float) -> None:
    told: Counter[str] = Counter()
    for seed in range(5):
        scene = draw(seed, late=late, far=far)
        turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
        fix, least, on_plane = scene.fix(turn=turn), scene.least(), scene.profile(0.0)
        assert fix.cost == pytest.approx(least, abs=1e-4 * (1.0 + least))
        told[fix.status.label] += 1
        if fix.status.label in {"ambiguous", "curved"}:
            assert (fix.status.label == "ambiguous") == (on_plane - least > JOINED)
    assert not told["stalled"] + told["max iterations"] + told["singular geometry"]


@pytest.mark.parametrize("late", [False, True])
def test_the_interval_of_the_distance_ends_where_the_profile_of_the_cost_is_higher(late: bool) -> None:
    for seed in range(6):
        scene = draw(seed, late=late, far=0.4 if seed % 2 else 0.0)
        problem = scene.problem()
        fix = optloc.solve(problem)
        low, high = optloc.model_checks.distance_from_plane(problem, fix)
        least = scene.least()
        assert low == 0.0 or scene.profile(low**2) - least == pytest.approx(JOINED, abs=0.1)
        assert scene.profile(high**2) - least == pytest.approx(JOINED, abs=0.1)
        assert (scene.profile(0.0) - least <= JOINED) == (low == 0.0)


def test_a_fix_in_the_plane_is_proven_and_says_that_it_may_be_on_either_side() -> None:
    names = {"m1": (2.85, 0.49, 0), "m2": (4.82, 0.49, 0), "m3": (5.8, 0.49, 0)}
    names |= {"m4": (2.85, 2.65, 0), "m5": (4.82, 2.65, 0), "m6": (5.8, 2.65, 0)}
    far = np.linalg.norm(np.array(list(names.values())) - (1, 1, 0), axis=1)
    times = far / 343.0 + 1e-5 * np.random.default_rng(0).standard_normal(6)
    fix = optloc.locate(names, toa=dict(zip(names, times, strict=True)), sigma=1e-5, wave_speed=343.0)
    assert fix.status.label == "curved"
    assert fix.certificate.proof == "global"
    np.testing.assert_allclose(fix.position, (1.002, 1.001, 0.0), atol=1e-3)
    assert fix.cost == pytest.approx(0.759, abs=1e-3)
    assert "both sides of the plane" in str(fix.reason)
    # the profile of the cost is 3.84 higher at 0.27 m
    assert 1.96 * fix.sigma()[2] == pytest.approx(0.28, abs=0.02)


@pytest.mark.parametrize("late", [False, True])
def test_a_bound_in_the_plane_of_the_stations_makes_no_second_answer_of_it(late: bool) -> None:
    for seed, far in enumerate((0.0, 0.05, 0.4)):
        scene = draw(seed, late=late, far=far)
        fix = scene.fix(height=(0.0, 3.0))
        least = scene.least()
        assert fix.cost == pytest.approx(least, abs=1e-4 * (1.0 + least))
        assert fix.position[2] >= -1e-9
        assert fix.status.label in {"ok", "curved", "unproven"}


def test_stations_off_the_plane_by_less_than_the_noise_shows_count_as_coplanar() -> None:
    scene = draw(3, late=False, far=0.0)
    off = 1e-4 * scene.sigma * np.random.default_rng(0).standard_normal(len(scene.stations))
    fix = replace(scene, stations=scene.stations + off[:, None] * (0, 0, 1)).fix()
    assert fix.status.label == "curved"
    assert fix.cost == pytest.approx(scene.least(), abs=1e-3)


def test_stations_in_space_have_no_distance_from_a_plane() -> None:
    scene = draw(0, late=False, far=0.5)
    heights = np.arange(len(scene.stations)) ** 2.0
    problem = replace(scene, stations=scene.stations + heights[:, None] * (0, 0, 1)).problem()
    with pytest.raises(InvalidProblem, match="no plane of symmetry"):
        optloc.model_checks.distance_from_plane(problem, optloc.solve(problem))


@pytest.mark.full
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("far", [0.0, 0.1, 1.0, 10.0])
def test_the_interval_of_the_distance_holds_the_truth(late: bool, far: float) -> None:
    inside, total, told = 0, 125, Counter[str]()
    for seed in range(total):
        scene = draw(1000 + seed, late=late, far=far)
        problem = scene.problem()
        fix = optloc.solve(problem)
        told[fix.status.label] += 1
        low, high = optloc.model_checks.distance_from_plane(problem, fix)
        inside += low <= scene.target[2] <= high
    assert not told["stalled"] + told["max iterations"]
    # a count that is less is one in ten thousand under the promise of 95 %
    assert inside >= 108, (inside, told)


def test_a_place_is_turned_to_its_distance_from_the_plane_and_back():
    floor = np.column_stack([SQUARE, np.full(5, 70.0)])
    problem, x = ranges_to([300.0, 650.0, 100.0], 1.0, stations=floor), np.array([[300.0, 650.0, 100.0]])
    assert is_coplanar(problem).tolist() == [True]
    assert is_coplanar(ranges_to([300.0, 650.0, 100.0], 1.0, stations=floor * [1.0, 1.0, 0.0])).tolist() == [True]
    lifted = floor + np.outer(np.arange(5.0), [0.0, 0.0, 90.0])
    assert is_coplanar(ranges_to([300.0, 650.0, 100.0], 1.0, stations=lifted)).tolist() == [False]
    across = Across.of(problem)
    flat = across.to_plane(x)
    assert flat[0, 2] == pytest.approx(30.0)
    images = [across.to_space(flat, np.array([side]))[0] for side in (1.0, -1.0)]
    assert sorted(image[2] for image in images) == pytest.approx([40.0, 100.0])
    end, cost, _ = across.refine(flat + np.array([20.0, -10.0, 5.0]), held=False)
    np.testing.assert_allclose(end, flat, atol=1e-3)
    assert cost[0] == pytest.approx(0.0, abs=1e-6)
