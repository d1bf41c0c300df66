"""Proofs with an unknown speed of the wave: bounds, clipping and convexity over random boxes, and whole fixes."""

import numpy as np
import pytest
from proof.sampling import many
from scipy.optimize import least_squares
from waves import air, plate

from optloc import Problem, assemble, measured, solve, with_bias
from optloc.kernels.jit import enabled
from optloc.proof.atlas import atlas_of, set_centre, write_position
from optloc.proof.box import station_cube
from optloc.proof.convex_boxes import accuracy_floor_far
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.scaled.joint_curvature import clip_stationary, is_convex_scaled
from optloc.proof.scaled.reduction import HERE, bound_factors, bound_rows, clip_rows, reduce_rows
from optloc.proof.scaled.scaled_proof import costs_at_scaled, scaled_costs
from optloc.proof.scaled.scaled_search import set_scaled_minimum, tables_of
from optloc.proof.scope import why_unsupported
from optloc.proof.search_space import chart_at
from optloc.solvers.certificates.position_cost import matches_problem_cost

PRIORS = [0.02, 0.1, 0.3, None]


def scenes(rng, d):
    """Yield scenes on plates or rocks and in air, with every prior."""
    for prior in PRIORS:
        yield plate(rng, d, 5 + d, prior)
        yield air(rng, d, 4 + d, prior)


def profiled(scene, x):
    """Return the least cost (n,) over the factor and the emission at positions x (n, d), by formulas of its own.

    The second result is the best factor; a factor below zero counts as zero.
    """
    r = np.linalg.norm(scene.place - x[:, None], axis=-1) / scene.sigma
    z, n = scene.z / scene.sigma, len(scene.z)
    r, z = r - r.mean(1, keepdims=True), z - z.mean()
    weight = 0.0 if scene.prior is None else scene.prior**-2.0
    k = np.maximum((r @ z + weight) / ((r**2).sum(1) + weight), 0.0)
    assert n == r.shape[1]
    return ((k[:, None] * r - z) ** 2).sum(1) + weight * (k - 1.0) ** 2, k


class Look:
    """A cost with its atlas, and boxes at random places of it."""

    def __init__(self, scene, costs=scaled_costs):
        self.scene, self.d = scene, scene.place.shape[1]
        self.scaled = costs(scene.problem.flat()).one(0)
        cost = self.scaled.cost
        self.tables, (middle, radius) = tables_of(self.scaled), station_cube(cost.kinds, cost.data, scene.truth)
        self.atlas = atlas_of(middle, radius, self.d, 1)
        self.floor = accuracy_floor_far(cost, self.atlas)

    def set_minimum(self, x, level):
        """Write axes around a minimum; return whether it is one."""
        chart, _ = chart_at(self.scaled.cost, x, self.tables.near)
        return set_scaled_minimum(self.scaled, self.tables, self.atlas, chart, 0, x, 0.0, 1e-6, np.sqrt(level))

    def fill(self, piece, at, half):
        """Set a box and bound its nodes and their curves."""
        box, cost = self.tables.box, self.scaled.cost
        box.at[:], box.half[:] = at, half
        set_centre(self.atlas, piece, box.at)
        bound_pieces(self.atlas, cost.kinds, cost.data, box.half, box.nodes)
        curve_pieces(self.atlas, cost.kinds, cost.data, box.half, box.nodes, box.curves)
        reduce_rows(self.scaled, self.floor, box, self.tables.sheet)
        return box

    def draw(self, rng):
        """Return piece, centre and half-widths of a random box; the piece is a face or the inside of the cube."""
        d, piece = self.d, int(rng.integers(0, 2 * self.d + 1))
        at, half = np.zeros(3), np.zeros(3)
        half[:d] = 10.0 ** rng.uniform(-4.0, -0.3, d)
        at[:d] = rng.uniform(-0.9, 0.9, d)
        if piece < 2 * d:
            half[d - 1] = min(half[d - 1], 0.3)
            at[d - 1] = rng.uniform(half[d - 1], 1.0)
        if rng.random() < 0.5:  # around the truth, where costs are low
            place = (self.scene.truth - self.atlas.middle[:d]) / self.atlas.radius
            if np.abs(place).max() <= 1.0:
                piece, at[:d] = 2 * d, place + 0.3 * half[:d] * rng.standard_normal(d)
        return piece, at, half

    def places(self, piece, at, inside):
        """Return positions (n, d) at offsets (n, 3) from the centre of a box."""
        out = np.empty((len(inside), self.d))
        for i, offset in enumerate(inside):
            set_centre(self.atlas, piece, at + offset)
            write_position(self.atlas, out[i])
        set_centre(self.atlas, piece, at)
        return out


@pytest.mark.parametrize("d", [2, 3])
def test_no_point_of_a_box_is_below_its_bound(d, seed, form):
    """Bounds, the range of the factor and clipped boxes hold at random points and corners."""
    rng, count = np.random.default_rng([seed, d]), many(60, 3)
    said = 0
    for scene in scenes(rng, d):
        look = Look(scene)
        for _ in range(count):
            piece, at, half = look.draw(rng)
            box, sheet = look.fill(piece, at, half), look.tables.sheet
            inside = half * np.concatenate(
                [rng.uniform(-1, 1, (20, 3)), rng.choice([-1.0, 1.0], (20, 3)), np.zeros((1, 3))]
            )
            cost, k = profiled(scene, look.places(piece, at, inside))
            assert sheet.span[HERE] == pytest.approx(cost[-1], rel=1e-6, abs=1e-6)
            level = cost.min() + 10.0 ** rng.uniform(-1.0, 2.0)
            any_left = bound_factors(look.scaled, np.sqrt(level), box, sheet)
            assert any_left
            low = cost < level
            assert (k[low] >= sheet.least[0] * (1.0 - 1e-9)).all()
            assert (k[low] <= sheet.most[0] * (1.0 + 1e-9)).all()
            bound = bound_rows(look.scaled, box, sheet)
            assert max(bound, 0.0) ** 2 <= cost.min() + 1e-9
            said += bound > 0.0
            clip_rows(look.scaled, np.sqrt(level), box, sheet)
            kept = ((inside >= box.cut[:3] - 1e-12) & (inside <= box.cut[3:] + 1e-12)).all(1)
            assert kept[low].all()
    assert said > count


@pytest.fixture
def solved(d, seed):
    """Return a generator, and scenes with their fixes; a test names it before `form`, so that machine code solves."""
    rng = np.random.default_rng([seed, 7, d])
    return rng, [(scene, solve(scene.problem)) for scene in scenes(rng, d)]


@pytest.mark.parametrize("d", [2, 3])
def test_minima_are_never_clipped_and_convex_boxes_are_convex(d, solved, form):
    """A minimum stays in what is left of a box; midpoints in convex boxes cost no more than the mean of the ends."""
    rng, count = solved[0], many(60, 3)
    convex = clipped = 0
    for scene, fix in solved[1]:
        look = Look(scene)
        if not (fix.answered and look.set_minimum(fix.position, float(fix.cost) + 25.0)):
            continue
        for _ in range(count):
            at, half = np.zeros(3), np.zeros(3)
            half[:d] = 10.0 ** rng.uniform(-3.0, 1.5, d)  # standard deviations
            at[:d] = rng.uniform(-0.999, 0.999, d) * half[:d]
            box, sheet, rho = look.fill(2 * d + 1, at, half), look.tables.sheet, np.sqrt(float(fix.cost) + 25.0)
            assert bound_factors(look.scaled, rho, box, sheet)
            assert clip_stationary(look.scaled, box, sheet)
            slack = 1e-9 * half[:d] + 1e-4
            assert (-at[:d] >= box.cut[:d] - slack).all()
            assert (-at[:d] <= box.cut[3 : 3 + d] + slack).all()
            clipped += (box.cut[3 : 3 + d] - box.cut[:d] < 1.9 * half[:d]).any()
            box = look.fill(2 * d + 1, at, half)
            assert bound_factors(look.scaled, rho, box, sheet)
            if is_convex_scaled(look.scaled, 0.0, box, sheet):
                convex += 1
                # one minimum: the fix, which is in the box, is the cheapest of all points
                cost, _ = profiled(scene, look.places(2 * d + 1, at, half * rng.uniform(-1, 1, (40, 3))))
                assert (cost >= fix.cost - 1e-6 * (1.0 + fix.cost)).all()
                _is_jointly_convex(scene, look, at, half, rho**2, rng)
    assert convex > count // 2
    assert clipped > count // 2


def _is_jointly_convex(scene, look, at, half, level, rng):
    """Check midpoints: in the offsets and the factor the cost is convex between points with their best factors."""
    piece = 2 * look.d + 1
    if look.atlas.minima.home[0] != 2 * look.d:  # outside the cube offsets are those of a direction and inverse range
        return
    ends = np.stack([look.places(piece, at, half * rng.uniform(-1, 1, (20, 3))) for _ in range(2)])
    values, factors = zip(*(profiled(scene, end) for end in ends), strict=True)
    good = (values[0] < level) & (values[1] < level)
    k, middle = 0.5 * (factors[0] + factors[1]), 0.5 * (ends[0] + ends[1])
    r = np.linalg.norm(scene.place - middle[:, None], axis=-1) / scene.sigma
    z = scene.z / scene.sigma - (scene.z / scene.sigma).mean()
    own = ((k[:, None] * (r - r.mean(1, keepdims=True)) - z) ** 2).sum(1)
    own += 0.0 if scene.prior is None else ((k - 1.0) / scene.prior) ** 2
    mean = 0.5 * (values[0] + values[1])
    assert (own[good] <= mean[good] + 1e-7 * (1.0 + mean[good])).all()


@pytest.mark.parametrize("d", [2, 3])
def test_position_costs_are_the_costs_of_the_problem(d, seed):
    rng = np.random.default_rng([seed, 5, d])
    for scene in scenes(rng, d):
        costs = scaled_costs(scene.problem.flat())
        x = scene.truth + rng.standard_normal((1, 6, d)) * np.ptp(scene.place)
        np.testing.assert_allclose(costs_at_scaled(costs, x)[0][0], profiled(scene, x[0])[0], rtol=1e-7)
        fix = solve(scene.problem)
        if fix.answered:
            assert matches_problem_cost(scene.problem.flat(), fix[None], costs).all()


@pytest.mark.parametrize("rounds", [1, pytest.param(30, marks=pytest.mark.full)])
def test_most_scenes_are_proven_and_no_proof_is_wrong(rounds, seed):
    """Multi-start over position, speed and time by SciPy finds no cheaper minimum, and no other one within the gap."""
    rng = np.random.default_rng([seed, 11])
    proven = total = 0
    for scene in (one for _ in range(rounds) for d in (2, 3) for one in scenes(rng, d)):
        d, fix = scene.place.shape[1], solve(scene.problem)
        told, total = fix.certificate, total + 1
        if told is None or told.proof != "global":
            continue
        proven += told.unique
        assert fix.status.label != "unbounded" or scene.plane_wave() < fix.cost + 9.0
        known = [fix.position, *(x[:d] for x in fix.alternatives.x if np.isfinite(x).all())]
        for cost, x in scene.minima(rng, 8 if enabled() else 2):
            assert cost > fix.cost - 1e-3 * (1.0 + fix.cost)
            if told.unique and cost < fix.cost + min(told.margin, 9.0) - 1e-3:
                near = min(np.linalg.norm(x[:d] - one) for one in known)
                assert near < 1e-2 * np.ptp(scene.place, axis=0).max()
    assert proven >= 0.9 * total if enabled() else proven >= 0


@pytest.mark.parametrize("d", [2, 3])
def test_ranges_with_a_scale_are_proven_within_balls(d, seed):
    """Ranges without an emission time grow without end: a prior on the scale encloses the position."""
    rng, n = np.random.default_rng([seed, 13, d]), d + 3
    for prior in (0.02, 0.05, 0.1, 0.15):
        place, truth = rng.uniform(-10.0, 10.0, (n, d)), rng.uniform(-15.0, 15.0, d)
        r = np.linalg.norm(place - truth, axis=1) * (1.0 + prior * np.clip(rng.standard_normal(), -2.0, 2.0))
        z = r + 0.05 * rng.standard_normal(n)
        rows = measured("range", a=np.arange(n), z=z, sigma=0.05)
        fix = solve(with_bias(assemble(place, rows), "speed", form="scale", per="kind", sigma=prior))
        assert fix.certificate.proof == "global"
        assert fix.certificate.unique or not enabled()  # plain Python has few boxes

        def residual(y, place=place, z=z, prior=prior):
            return np.append(((1.0 + y[d]) * np.linalg.norm(place - y[:d], axis=1) - z) / 0.05, y[d] / prior)

        known = [fix.position, *(x[:d] for x in fix.alternatives.x if np.isfinite(x).all())]
        for _ in range(8):
            one = least_squares(residual, np.append(rng.uniform(-40.0, 40.0, d), 0.0), method="lm")
            assert 2.0 * one.cost > fix.cost - 1e-3
            if np.abs(one.grad).max() < 1e-2 and 2.0 * one.cost < fix.cost + 9.0 - 1e-3:
                assert min(np.linalg.norm(one.x[:d] - x) for x in known) < 0.1


def arrivals(**more):
    """Return a problem of arrivals in the plane with a scale, changed in one way."""
    place = np.random.default_rng(1).uniform(0.0, 10.0, (6, 2))
    found: Problem = assemble(place, measured("toa", a=np.arange(6), z=np.arange(6.0), sigma=0.1), **more)
    return with_bias(found, "speed", form="scale", per="kind", sigma=0.1)


def test_problems_beyond_the_proof_are_named():
    assert why_unsupported(arrivals().flat()) == ""
    one = with_bias(arrivals(), "more", form="scale", per="station", kind="toa", members=["S0"], sigma=0.1)
    assert "several scales" in why_unsupported(one.flat())
    place = np.random.default_rng(1).uniform(0.0, 10.0, (6, 2))
    ranges = assemble(place, measured("range", a=np.arange(6), z=np.full(6, 5.0), sigma=0.1))
    assert "no prior" in why_unsupported(with_bias(ranges, "speed", form="scale", per="kind").flat())
    mixed = assemble(
        place,
        measured("toa", a=np.arange(6), z=np.arange(6.0), sigma=0.1),
        measured("azimuth", a=np.arange(2), z=np.zeros(2), sigma=0.1),
    )
    assert "azimuth" in why_unsupported(with_bias(mixed, "speed", form="scale", per="kind", kind="toa").flat())
    levels = assemble(
        place,
        measured("rss_difference", a=np.arange(1, 6), b=np.zeros(5, dtype=int), z=np.arange(5.0), sigma=1.0),
        measured("tdoa", a=np.arange(1, 6), b=np.zeros(5, dtype=int), z=np.arange(5.0), sigma=1.0),
    )
    free = with_bias(levels, "exponent", form="scale", per="kind", kind="rss_difference")
    assert "rss_difference rows has no prior" in why_unsupported(free.flat())
    many = with_bias(ranges, "each", form="scale", per="station", sigma=0.1)
    assert "several scales (6)" in why_unsupported(many.flat())
