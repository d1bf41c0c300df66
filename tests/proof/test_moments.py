"""Proofs of targets of unknown velocity at one epoch: bounds, clipping and convexity over boxes, and whole fixes."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from descent import levenberg
from optloc.compute.jit import enabled
from proof.sampling import many
from proof.scaled.test_reduction import Look

from optloc import Motion, Stations, assemble, measured, solve, with_bias
from optloc.linear.constraints import speed
from optloc.problem import Prior
from optloc.proof.box import least_residual, linearise_rows
from optloc.proof.scaled.joint_curvature import clip_stationary, is_convex_scaled
from optloc.proof.scaled.reduction import HERE, bound_factors, bound_rows, clip_rows
from optloc.proof.scaled.scaled_proof import costs_at_scaled, largest_rate, velocity_costs
from optloc.proof.scaled.scaled_search import rest_of
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates.position_cost import matches_problem_cost

PAIRS, ARRIVALS, RANGES = (("tdoa", "fdoa"), ("toa", "range_rate"), ("range", "range_rate"))
# Dimension, stations, kinds of rows, standard deviation of a prior on the velocity.
KINDS = [(2, 5, PAIRS, None), (3, 7, PAIRS, None), (3, 6, ARRIVALS, None), (2, 4, PAIRS, 80.0)]
COUNT = many(60, 3)


@dataclass(frozen=True)
class Flight:
    """Stations (n, d) with velocities, a target, and what each station measures of ranges and rates, with its noise."""

    kinds: tuple[str, str]
    place: np.ndarray
    speed: np.ndarray
    truth: np.ndarray
    velocity: np.ndarray
    ranges: np.ndarray
    rates: np.ndarray
    sigma: tuple[float, float]
    prior: float | None

    @classmethod
    def drawn(cls, rng, d, n, kinds, prior, noise=1.0):
        """Return a scene of ten kilometres with a target inside or outside."""
        place, speed = rng.uniform(-1e4, 1e4, (n, d)), rng.normal(0.0, 80.0, (n, d))
        truth, velocity = rng.uniform(-1.5e4, 1.5e4, d), rng.normal(0.0, 60.0, d)
        sigma = noise * 6.0 * 10 ** rng.uniform(-0.5, 0.7), noise * 0.2 * 10 ** rng.uniform(-0.7, 0.7)
        line = truth - place
        r = np.linalg.norm(line, axis=1)
        ranges, rates = r + rng.normal(0.0, sigma[0], n), ((velocity - speed) * line).sum(1) / r
        return cls(kinds, place, speed, truth, velocity, ranges, rates + rng.normal(0.0, sigma[1], n), sigma, prior)

    @cached_property
    def problem(self):
        (n, d), rows = self.place.shape, []
        for kind, z, sigma in zip(self.kinds, (self.ranges, self.rates), self.sigma, strict=True):
            if kind in PAIRS:
                rows.append(measured(kind, z[1:] - z[0], a=np.arange(1, n), b=0, arrival_sigma=sigma))
            else:
                rows.append(measured(kind, z, a=np.arange(n), sigma=sigma))
        stations = Stations(self.place[None], tuple("ABCDEFGHI"[:n]), velocity=self.speed[None])
        prior = () if self.prior is None else (Prior("velocity", np.zeros(d), self.prior**2 * np.eye(d)),)
        return assemble(stations, *rows, motions=(Motion(order=1),), priors=prior)

    def alike(self, kind, rows):
        """Return rows without their mean where one arrival time or frequency is unknown."""
        return rows - rows.mean(0) if kind in (*PAIRS, "toa") else rows

    def system(self, x):
        """Return residuals of ranges (n,), and rows (m, d) and right sides of the velocity, at a place."""
        line = x - self.place
        r = np.linalg.norm(line, axis=1)
        u = line / r[:, None]
        far = self.alike(self.kinds[0], (r - self.ranges) / self.sigma[0])
        A, b = u / self.sigma[1], (self.rates + (u * self.speed).sum(1)) / self.sigma[1]
        A, b = self.alike(self.kinds[1], A), self.alike(self.kinds[1], b)
        if self.prior is not None:
            A, b = np.concatenate([A, np.eye(len(x)) / self.prior]), np.append(b, np.zeros(len(x)))
        return far, A, b

    def profiled(self, places):
        """Return the least costs (n,) at places (n, d), and the velocities (n, d) there."""
        costs, best = [], []
        for x in places:
            far, A, b = self.system(x)
            v, *_ = np.linalg.lstsq(A, b)
            costs.append((far**2).sum() + ((A @ v - b) ** 2).sum())
            best.append(v)
        return np.array(costs), np.array(best)

    def residual(self, state):
        d = len(self.truth)
        far, A, b = self.system(state[:d])
        return np.append(far, A @ state[d:] - b)

    def minima(self, rng, count):
        """Return costs and states of minima from random starts, the least first."""
        d, found = len(self.truth), []
        way = rng.standard_normal((count, d))
        near = 10.0 ** rng.uniform(3.0, 5.0, (count, 1)) * way / np.linalg.norm(way, axis=1)[:, None]
        for x in np.concatenate([self.truth[None], near, rng.uniform(-2e4, 2e4, (count, d))]):
            start = np.append(x, self.profiled(x[None])[1][0])
            end = levenberg(self.residual, start, scale=np.repeat([1e3, 10.0], d))
            slope = end.jac.T @ end.fun
            with np.errstate(all="ignore"):
                step, *_ = np.linalg.lstsq(end.jac, end.fun)
            if slope @ step < 1e-6 and np.abs(end.x[:d]).max() < 1e6:
                found.append((2.0 * end.cost, end.x))
        return sorted(found, key=lambda one: one[0])


def scenes(d, n, kinds, prior, seed):
    rng = np.random.default_rng([seed, d, n, len(kinds[0])])
    return rng, [Flight.drawn(rng, d, n, kinds, prior, 10.0 ** rng.uniform(0.0, 1.5)) for _ in range(many(3, 1))]


@pytest.mark.parametrize(("d", "n", "kinds", "prior"), KINDS)
def test_no_point_of_a_box_is_below_its_bound(d, n, kinds, prior, seed):
    """Bounds, ranges of the velocity and clipped boxes hold at random points and corners."""
    rng, flights = scenes(d, n, kinds, prior, seed)
    by_factors = by_rest = 0
    for flight in flights:
        look = Look(flight, velocity_costs)
        rest = rest_of(look.scaled)
        for _ in range(COUNT):
            piece, at, half = look.draw(rng)
            box, sheet = look.fill(piece, at, half), look.tables.sheet
            inside = half * np.concatenate([rng.uniform(-1, 1, (8, 3)), rng.choice([-1.0, 1.0], (8, 3)), [[0, 0, 0]]])
            cost, v = flight.profiled(look.places(piece, at, inside))
            v = v / largest_rate(flight.problem.flat())  # factors are in this unit
            if not np.isfinite(cost).all():
                continue
            assert sheet.span[HERE] == pytest.approx(cost[-1], rel=1e-6, abs=1e-6)
            level = cost.min() + 10.0 ** rng.uniform(-1.0, 2.0)
            assert bound_factors(look.scaled, np.sqrt(level), box, sheet)
            low, slack = cost < level, 1e-9 * (1.0 + np.abs(v[cost < level]))
            assert (v[low] >= sheet.least - slack).all()
            assert (v[low] <= sheet.most + slack).all()
            bound = bound_rows(look.scaled, box, sheet)
            assert max(bound, 0.0) ** 2 <= cost.min() * (1.0 + 1e-9) + 1e-9
            by_factors += bound > 0.0
            clip_rows(look.scaled, np.sqrt(level), box, sheet)
            kept = ((inside >= box.cut[:3] - 1e-12) & (inside <= box.cut[3:] + 1e-12)).all(1)
            assert kept[low].all()
            rows = box.rows[: len(rest.w)]
            linearise_rows(rest.K, rest.w, box.nodes, rows)
            bound = least_residual(rest.K, rest.weight, look.floor, box.half, box.nodes, rows)
            assert max(bound, 0.0) ** 2 <= cost.min() * (1.0 + 1e-9) + 1e-9
            by_rest += bound > 0.0
    assert min(by_factors, by_rest) > COUNT // 3 or not enabled()


@pytest.mark.parametrize(("d", "n", "kinds", "prior"), KINDS)
def test_minima_are_never_clipped_and_convex_boxes_are_convex(d, n, kinds, prior, seed):
    """A minimum stays in the rest of a box; in convex boxes midpoints cost no more than the mean of the ends."""
    rng, flights = scenes(d, n, kinds, prior, seed + 1)
    convex = clipped = 0
    for flight in flights:
        look, fix = Look(flight, velocity_costs), solve(flight.problem)
        if not (fix.answered and look.set_minimum(fix.position, float(fix.cost) + 25.0)):
            continue
        for _ in range(COUNT):
            at, half = np.zeros(3), np.zeros(3)
            half[:d] = 10.0 ** rng.uniform(-3.0, 1.5, d)  # standard deviations
            at[:d] = rng.uniform(-0.999, 0.999, d) * half[:d]
            rho = np.sqrt(float(fix.cost) + 25.0)
            box, sheet = look.fill(2 * d + 1, at, half), look.tables.sheet
            assert bound_factors(look.scaled, rho, box, sheet)
            assert clip_stationary(look.scaled, box, sheet)
            slack = 1e-9 * half[:d] + 1e-3
            assert (-at[:d] >= box.cut[:d] - slack).all()
            assert (-at[:d] <= box.cut[3 : 3 + d] + slack).all()
            clipped += (box.cut[3 : 3 + d] - box.cut[:d] < 1.9 * half[:d]).any()
            box = look.fill(2 * d + 1, at, half)
            bound_factors(look.scaled, rho, box, sheet)
            if is_convex_scaled(look.scaled, 0.0, box, sheet):
                convex += 1
                _check_midpoints(flight, look, at, half, rho**2, rng)
    assert min(convex, clipped) > COUNT // 3 or not enabled()


def _check_midpoints(flight, look, at, half, level, rng):
    """Check that the cost is convex in offsets and velocity."""
    piece = 2 * look.d + 1
    if look.atlas.minima.home[0] != 2 * look.d:  # outside the cube offsets are directions and inverse ranges
        return
    ends = [look.places(piece, at, half * rng.uniform(-1, 1, (8, 3))) for _ in range(2)]
    (first, one), (second, other) = (flight.profiled(end) for end in ends)
    for i in np.flatnonzero((first < level) & (second < level)):
        state = np.append(0.5 * (ends[0][i] + ends[1][i]), 0.5 * (one[i] + other[i]))
        mean = 0.5 * (first[i] + second[i])
        assert (flight.residual(state) ** 2).sum() <= mean + 1e-7 * (1.0 + mean)


@pytest.mark.parametrize(("d", "n", "kinds", "prior"), KINDS)
def test_position_costs_are_the_costs_of_the_problem(d, n, kinds, prior, seed):
    rng, flights = scenes(d, n, kinds, prior, seed)
    for flight in flights:
        costs = velocity_costs(flight.problem.flat())
        x = flight.truth + 1e3 * rng.standard_normal((1, 6, d))
        np.testing.assert_allclose(costs_at_scaled(costs, x)[0][0], flight.profiled(x[0])[0], rtol=1e-7)
        fix = solve(flight.problem)
        if fix.answered:
            assert matches_problem_cost(flight.problem.flat(), fix[None], costs).all()


def places_of(fix, d):
    """Return the fix and its alternatives (q, d)."""
    return np.array([fix.position, *(x[:d] for x in fix.alternatives.x if np.isfinite(x).all())])


# Dimension, stations, kinds of rows, factor of the noise; the last ones leave no row over, and have several minima.
FIXES = [(2, 5, PAIRS, 1.0), (3, 7, PAIRS, 1.0), (2, 4, RANGES, 10.0), (2, 3, PAIRS, 1.0), (2, 2, RANGES, 1.0)]


@pytest.mark.parametrize(("d", "n", "kinds", "noise"), FIXES)
def test_most_scenes_are_proven_and_no_proof_is_wrong(d, n, kinds, noise, seed):
    """Multi-start over position and velocity by MINPACK finds no cheaper minimum, and no other one within the gap."""
    rng, unique, total = np.random.default_rng([seed, 11, d, n]), 0, 8 if enabled() else 2
    for _ in range(total):
        flight = Flight.drawn(rng, d, n, kinds, None, noise)
        fix = solve(flight.problem)
        if fix.certificate.proof != "global":
            continue
        unique += fix.certificate.unique
        for cost, state in flight.minima(rng, 8):
            assert cost > fix.cost - 1e-3 * (1.0 + fix.cost)
            if cost < fix.cost + fix.certificate.margin - 1e-2:
                apart = np.linalg.norm(places_of(fix, d) - state[:d], axis=1).min()
                assert apart < 1e-3 * (1e3 + np.linalg.norm(state[:d] - fix.position))
    assert unique >= 0.8 * total or not enabled()


def test_rates_decide_between_places_that_ranges_leave_open(seed):
    """Two ranges leave mirror images, of which a prior on the velocity leaves one."""
    rng = np.random.default_rng([seed, 17])
    flight = Flight.drawn(rng, 2, 2, RANGES, 20.0)
    far = replace(
        flight, speed=np.array([[0.0, 150.0], [150.0, 0.0]]), truth=np.array([3e3, 5e3]), velocity=np.zeros(2)
    )
    found = []
    for prior in (None, 1.0):
        line = far.truth - far.place
        r = np.linalg.norm(line, axis=1)
        one = replace(far, ranges=r, rates=-(far.speed * line).sum(1) / r, prior=prior)
        found.append(solve(one.problem))
    assert [fix.certificate.proof for fix in found] == ["global", "global"]
    assert [len(places_of(fix, 2)) for fix in found] == [2, 1]
    assert np.allclose(found[1].position, far.truth, atol=1.0)


def test_problems_beyond_the_proof_are_named():
    rng = np.random.default_rng(3)
    problem = Flight.drawn(rng, 2, 5, PAIRS, None).problem
    assert why_unsupported(problem.flat()) == ""
    scaled = with_bias(problem, "gain", form="scale", per="kind", kind="tdoa", sigma=0.1)
    assert "unknown scales" in why_unsupported(scaled.flat())
    assert "constraints" in why_unsupported(replace(problem, constraints=speed(900.0)).flat())
    late = replace(problem, motions=(Motion(order=1, reference=-5.0),))
    assert "another time" in why_unsupported(late.flat())


def test_rates_alone_bound_no_position():
    """Far away a velocity that grows with the distance explains them, unless a prior bounds it."""
    rng = np.random.default_rng(4)
    flight = Flight.drawn(rng, 2, 7, ("range", "range_rate"), None)
    rates = measured("range_rate", flight.rates, a=np.arange(7), sigma=flight.sigma[1])
    problem = assemble(flight.problem.stations, rates, motions=(Motion(order=1),))
    assert "at all velocities" in solve(problem).certificate.reason
