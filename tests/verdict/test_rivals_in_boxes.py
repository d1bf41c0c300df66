"""Under inequalities only minima count as other positions: a point on a face from which the cost falls is none."""

import numpy as np
import pytest
from often import few
from scipy.optimize import minimize

import optloc
from optloc import constraints
from optloc.solvers.policy import AMBIGUOUS_GAP

SQUARE = 1e3 * np.array([[0.0, 0], [10, 0], [10, 10], [0, 10], [5, -3]])
STARTS = 12


class Scene:
    """Stations, rows, noise and a box, with the cost written here once more."""

    def __init__(self, stations, kind, sigma, lower, upper, z):
        self.stations, self.kind, self.sigma = stations, kind, sigma
        self.lower, self.upper, self.z = lower, upper, z

    def cost(self, x):
        distance = np.linalg.norm(self.stations - x, axis=1)
        model = distance if self.kind == "range" else distance[1:] - distance[0]
        return float(np.sum(((self.z - model) / self.sigma) ** 2))

    def slope(self, x):
        away = x - self.stations
        distance = np.linalg.norm(away, axis=1)
        line = away / distance[:, None]
        if self.kind == "tdoa":
            distance, line = distance[1:] - distance[0], line[1:] - line[0]
        return -2.0 * (self.z - distance) @ line / self.sigma**2

    def problem(self):
        number = np.arange(len(self.stations))
        of = {"a": number} if self.kind == "range" else {"a": number[1:], "b": 0}
        rows = optloc.measured(self.kind, self.z, sigma=self.sigma, **of)
        return optloc.assemble(self.stations, rows, constraints=constraints.box(self.lower, self.upper))

    def minima(self):
        """Return the costs of the minima that a bounded descent finds from a grid of starts."""
        unit = (np.arange(STARTS)[:, None] * [0.7548776662, 0.5698402910, 0.3247179572] + 0.5) % 1.0  # spread evenly
        span = self.upper - self.lower
        found = []
        for start in self.lower + unit[:, : len(span)] * span:
            # in units of the box, so that the same steps suit every direction
            done = minimize(
                lambda u: self.cost(self.lower + u * span),
                (start - self.lower) / span,
                jac=lambda u: self.slope(self.lower + u * span) * span,
                bounds=[(0.0, 1.0)] * len(span),
            )
            found.append((done.fun, self.lower + done.x * span))
        return sorted(found, key=lambda each: each[0])


def in_the_plane(seed):
    rng = np.random.default_rng(seed)
    target = rng.uniform(1e3, 9e3, 2)
    distance = np.linalg.norm(SQUARE - target, axis=1)
    lower, upper = target - rng.uniform(0.0, 40.0, 2), target + rng.uniform(0.0, 40.0, 2)
    return Scene(SQUARE, "tdoa", 30.0, lower, upper, distance[1:] - distance[0] + 30.0 * rng.normal(size=4))


def in_a_hall(seed):
    rng = np.random.default_rng(100 + seed)
    stations = np.column_stack([rng.uniform(0, 7, 5), rng.uniform(0, 10, 5), 2.9 + rng.uniform(-0.1, 0.1, 5)])
    target = np.array([rng.uniform(1, 6), rng.uniform(1, 9), rng.uniform(0.1, 1.9)])
    z = np.linalg.norm(stations - target, axis=1) + 0.1 * rng.normal(size=5)
    return Scene(stations, "range", 0.1, np.zeros(3), np.array([7.0, 10.0, 2.0]), z)


def falls(scene, x):
    """Return whether the cost falls from a point in a direction that the box admits, by more than a descent leaves."""
    step = 1e-4 * (scene.upper - scene.lower)
    moved = [np.clip(x + sign * e, scene.lower, scene.upper) for e in np.diag(step) for sign in (-1.0, 1.0)]
    gain = max(scene.cost(x) - scene.cost(each) for each in moved)
    return gain > 1e-6 * (1.0 + scene.cost(x))


@pytest.mark.parametrize(
    ("made", "count"), few([(in_the_plane, 5), (in_a_hall, 2), (in_the_plane, 12), (in_a_hall, 4)], 2, names=2)
)
def test_other_positions_are_minima_of_what_is_admitted(made, count):
    ambiguous = 0
    for seed in range(count):
        scene = made(seed)
        fix = optloc.solve(scene.problem())
        found = scene.minima()
        x = fix.position
        assert fix.cost <= found[0][0] + 1e-6 * (1.0 + found[0][0]), seed
        others = [place for place, gap in zip(fix.alternatives.x, fix.alternatives.gap, strict=True) if gap < np.inf]
        assert not [place for place in others if falls(scene, place[: len(x)])], seed
        apart = np.linalg.norm((np.array([place for _, place in found]) - x) / (scene.upper - scene.lower), axis=1)
        rivals = [cost for (cost, _), far in zip(found, apart, strict=True) if far > 0.01]
        is_ambiguous = bool(rivals) and min(rivals) < fix.cost + AMBIGUOUS_GAP
        assert (fix.status.label == "ambiguous") == is_ambiguous, (seed, fix.status, rivals)
        ambiguous += is_ambiguous
    assert ambiguous < count / 4


def test_a_hall_of_a_mirror_image_above_the_ceiling_has_one_position():
    """The mirror image is beyond the box, and the cost falls inwards from the ceiling below it."""
    scene = in_a_hall(3)
    fix = optloc.solve(scene.problem())
    assert fix.status.label in ("ok", "curved", "unproven")
    assert not np.isfinite(fix.alternatives.gap).any()
