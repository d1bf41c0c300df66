"""Proofs with several unknown scales, and with unknown path-loss exponents: bounds over boxes, and whole fixes."""

from dataclasses import replace

import numpy as np
import pytest
from proof.sampling import many
from proof.scaled.test_reduction import Look
from scales import scales
from scipy.optimize import least_squares, minimize, nnls
from waves import air

from optloc import assemble, measured, solve, with_bias
from optloc.base.types import Bias
from optloc.kernels.jit import enabled
from optloc.model_checks.scaled_rows import runs_backwards
from optloc.model_checks.shape import cost_at_infinity
from optloc.problem import Prior
from optloc.proof.scaled.joint_curvature import clip_stationary, is_convex_scaled
from optloc.proof.scaled.reduction import HERE, bound_factors, bound_rows, clip_rows, is_positive
from optloc.proof.scaled.scaled_proof import costs_at_scaled, scaled_costs
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates.position_cost import matches_problem_cost

# Dimension, stations, priors and whether rows are levels.
KINDS = [
    (2, 6, (0.1, 0.2), False),
    (2, 7, (None, None), False),
    (2, 6, (0.1, "known"), False),
    (3, 8, (None, 0.1), False),
    (2, 7, (0.2,), True),
    (2, 7, (0.2, 0.1), True),
    (3, 8, (0.2,), True),
]
COUNT = many(40, 3)


@pytest.mark.parametrize(("d", "n", "priors", "levels"), KINDS)
def test_no_point_of_a_box_is_below_its_bound(d, n, priors, levels, seed):
    """Bounds, ranges of the factors and clipped boxes hold at random points and corners."""
    rng = np.random.default_rng([seed, n, len(priors), levels])
    said = 0
    for _ in range(3):
        scene = scales(rng, d, n, priors, levels)
        look = Look(scene)
        for _ in range(COUNT):
            piece, at, half = look.draw(rng)
            box, sheet = look.fill(piece, at, half), look.tables.sheet
            inside = half * np.concatenate([rng.uniform(-1, 1, (8, 3)), rng.choice([-1.0, 1.0], (8, 3)), [[0, 0, 0]]])
            cost, k = scene.profiled(look.places(piece, at, inside))
            if (k[-1] > 0.0).all() and sheet.span[HERE] < np.inf:
                assert sheet.span[HERE] == pytest.approx(cost[-1], rel=1e-6, abs=1e-6)
            assert sheet.span[HERE] >= cost[-1] - 1e-6 * (1.0 + cost[-1])
            level = cost.min() + 10.0 ** rng.uniform(-1.0, 2.0)
            assert bound_factors(look.scaled, np.sqrt(level), box, sheet)
            low = cost < level
            assert (k[low] >= sheet.least * (1.0 - 1e-9)).all()
            assert (k[low] <= sheet.most * (1.0 + 1e-9)).all()
            bound = bound_rows(look.scaled, box, sheet)
            assert max(bound, 0.0) ** 2 <= cost.min() * (1.0 + 1e-9) + 1e-9
            said += bound > 0.0
            clip_rows(look.scaled, np.sqrt(level), box, sheet)
            kept = ((inside >= box.cut[:3] - 1e-12) & (inside <= box.cut[3:] + 1e-12)).all(1)
            assert kept[low].all()
    assert said > COUNT


@pytest.mark.parametrize(("d", "n", "priors", "levels"), KINDS)
def test_minima_are_never_clipped_and_convex_boxes_are_convex(d, n, priors, levels, seed):
    """A minimum stays in the rest of a box; in convex boxes midpoints cost no more than the mean of the ends."""
    rng = np.random.default_rng([seed, 7, n, len(priors), levels])
    convex = clipped = 0
    for _ in range(2):
        scene = scales(rng, d, n, priors, levels)
        look, found = Look(scene), scene.minima(rng, 12)
        if not found or not look.set_minimum(found[0][1][:d], found[0][0] + 25.0):
            continue
        best, piece, sheet = found[0][0], 2 * d + 1, look.tables.sheet
        for _ in range(COUNT):
            at, half = np.zeros(3), np.zeros(3)
            half[:d] = 10.0 ** rng.uniform(-3.0, 1.5, d)  # standard deviations
            at[:d] = rng.uniform(-0.999, 0.999, d) * half[:d]
            box, rho = look.fill(piece, at, half), np.sqrt(best + 25.0)
            assert bound_factors(look.scaled, rho, box, sheet)
            assert clip_stationary(look.scaled, box, sheet)
            slack = 1e-9 * half[:d] + 1e-3
            assert (-at[:d] >= box.cut[:d] - slack).all()
            assert (-at[:d] <= box.cut[3 : 3 + d] + slack).all()
            clipped += (box.cut[3 : 3 + d] - box.cut[:d] < 1.9 * half[:d]).any()
            box = look.fill(piece, at, half)
            bound_factors(look.scaled, rho, box, sheet)
            if is_convex_scaled(look.scaled, 0.0, box, sheet):
                convex += 1
                assert is_positive(sheet)
                _check_midpoints(scene, look, at, half, rho**2, rng)
    assert convex >= COUNT // 12
    assert clipped >= COUNT // 12


def _check_midpoints(scene, look, at, half, level, rng):
    """Check that no point of a box costs less than its minimum, and that the cost is convex in offsets and factors."""
    piece = 2 * look.d + 1
    ends = [look.places(piece, at, half * rng.uniform(-1, 1, (8, 3))) for _ in range(2)]
    (first, one), (second, other) = (scene.profiled(end) for end in ends)
    if look.atlas.minima.home[0] != 2 * look.d:  # outside the cube offsets are those of a direction and inverse range
        return
    for i in np.flatnonzero((first < level) & (second < level)):
        own = scene.cost(0.5 * (ends[0][i] + ends[1][i]), 0.5 * (one[i] + other[i]))
        mean = 0.5 * (first[i] + second[i])
        assert own <= mean + 1e-7 * (1.0 + mean)


@pytest.mark.parametrize(("d", "n", "priors", "levels"), [*KINDS, (2, 8, (None,), True)])
def test_position_costs_are_the_costs_of_the_problem(d, n, priors, levels, seed):
    rng = np.random.default_rng([seed, 5, n, len(priors), levels])
    scene = scales(rng, d, n, priors, levels)
    costs = scaled_costs(scene.problem.flat())
    x = scene.truth + rng.standard_normal((1, 6, d))
    expected, k = scene.profiled(x[0])
    good = (k > 0.0).all(1)
    np.testing.assert_allclose(costs_at_scaled(costs, x)[0][0, good], expected[good], rtol=1e-7)
    assert why_unsupported(scene.problem.flat()) == ""
    fix = solve(scene.problem)
    if fix.answered:
        assert matches_problem_cost(scene.problem.flat(), fix[None], costs).all()


@pytest.mark.parametrize("rounds", [1, pytest.param(30, marks=pytest.mark.full)])
@pytest.mark.parametrize(("d", "n", "priors", "levels"), [*KINDS, (2, 8, (None,), True)])
def test_proofs_with_scales_are_never_wrong(rounds, d, n, priors, levels, seed):
    """Multi-start by SciPy finds no cheaper minimum, and no other one within the gap that is not listed."""
    rng, proven, total = np.random.default_rng([seed, 11, n, len(priors), levels]), 0, 0
    for _ in range(2 * rounds):
        scene = scales(rng, d, n, priors, levels)
        fix, total = solve(scene.problem), total + 1
        told = fix.certificate
        if d == 2 and len(scene.free) == 1 and fix.answered:
            assert (fix.status.label != "unbounded") or scene.infinity() < fix.cost + 9.0
        if told is None or told.proof != "global":
            continue
        proven += told.unique
        known = [fix.position, *(x[:d] for x in fix.alternatives.x if np.isfinite(x).all())]
        for cost, x in scene.minima(rng, 8 if enabled() else 2):
            assert cost > fix.cost - 1e-3 * (1.0 + fix.cost)
            if told.unique and cost < fix.cost + min(told.margin, 9.0) - 1e-3:
                assert min(np.linalg.norm(x[:d] - one) for one in known) < 0.1
    if enabled() and (not levels or (d == 2 and priors[0] is not None)):
        assert proven >= 0.5 * total


def test_infinity_of_several_scales_costs_what_plane_waves_cost(seed):
    rng = np.random.default_rng([seed, 3])
    for priors, levels in (((0.1, None), False), (("known", 0.2), False), ((0.2,), True), ((None,), True)):
        scene = scales(rng, 2, 7, priors, levels)
        x = np.concatenate([scene.truth, np.zeros(len(scene.free))])[None]
        assert cost_at_infinity(scene.problem.flat(), x)[0] == pytest.approx(scene.infinity(), rel=1e-3, abs=1e-3)


def test_two_free_scales_above_a_plane_come_from_one_place(seed):
    """Far above coplanar stations the waves of all scales come from one place: no infinity costs less."""
    rng = np.random.default_rng([seed, 4])
    for _ in range(3):
        scene = scales(rng, 3, 7, (None, None), levels=False)
        flat = replace(scene, place=scene.place * [1.0, 1.0, 0.0])
        x = np.concatenate([scene.truth, np.zeros(2)])[None]
        found = cost_at_infinity(flat.problem.flat(), x)[0]

        def above(y, own=flat):
            return own.profiled(np.array([[*y, 1e5]]))[0][0]

        starts = rng.uniform(-20.0, 30.0, (8, 2))
        least = min(minimize(above, start, method="Nelder-Mead", options={"fatol": 1e-6}).fun for start in starts)
        assert found <= least * (1.0 + 1e-2) + 1e-2
        # plane waves cost no less than this family: only what no place explains would be cheaper than all of both
        assert found >= min(least, _plane_waves(flat)) * (1.0 - 1e-2) - 1e-2


def _plane_waves(scene):
    """Return the least cost of plane waves in space, by a fine net of directions."""
    number = np.arange(4000) + 0.5
    up, turn = 1.0 - 2.0 * number / 4000, np.pi * (1.0 + np.sqrt(5.0)) * number
    ways = np.sqrt(1.0 - up**2)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    along = scene.place[1:, :2] - scene.place[0, :2]
    return min(nnls(*scene.system(-along @ way))[1] ** 2 for way in ways)


def common_emission(rng, d, sigma):
    """Return arrivals of a fast and a slow wave with one emission time, their stations, truth and residual."""
    n, slow = 5 + d, 0.73
    place, truth = rng.uniform(0.0, 10.0, (n, d)), rng.uniform(-3.0, 13.0, d)
    r, means = np.linalg.norm(place - truth, axis=1), (0.0, slow)
    z = [3.0 + (1.0 + m + sigma * rng.uniform(-1, 1)) * r + 0.05 * rng.standard_normal(n) for m in means]
    found = assemble(place, measured("toa", a=np.tile(np.arange(n), 2), z=np.concatenate(z), sigma=0.05))
    for i, mean in enumerate(means):
        row, name = np.arange(i * n, (i + 1) * n), f"wave{i}"
        own = Bias(name, (name,), row, 0 * row, np.ones(n), "scale", np.array([mean]), np.array([sigma]))
        found = replace(found, biases=(*found.biases, own))

    def residual(y):
        far = np.linalg.norm(place - y[:d], axis=1)
        rows = [((1.0 + y[d + i]) * far + y[-1] - z[i]) / 0.05 for i in range(2)]
        return np.concatenate([*rows, (y[d : d + 2] - means) / sigma])

    return found, residual


@pytest.mark.parametrize("d", [2, 3])
def test_two_waves_of_one_emission_are_proven_within_balls(d, seed):
    """The difference of both arrivals bounds each range, if the priors keep the speeds apart."""
    rng, proven = np.random.default_rng([seed, 17, d]), 0
    for sigma in (0.02, 0.03, 0.05):
        problem, residual = common_emission(rng, d, sigma)
        fix = solve(problem)
        if fix.certificate.proof != "global":
            continue
        proven += fix.certificate.unique
        known = [fix.position, *(x[:d] for x in fix.alternatives.x if np.isfinite(x).all())]
        for _ in range(6):
            one = least_squares(residual, np.r_[rng.uniform(-15.0, 25.0, d), 0.0, 0.73, 3.0], method="lm")
            assert 2.0 * one.cost > fix.cost - 1e-3
            if fix.certificate.unique and np.abs(one.grad).max() < 1e-2 and 2.0 * one.cost < fix.cost + 9.0:
                assert min(np.linalg.norm(one.x[:d] - x) for x in known) < 0.1
    assert proven >= (2 if enabled() else 0)
    free = tuple(replace(bias, sigma=None) for bias in problem.biases)
    assert "emission time" in why_unsupported(replace(problem, biases=free).flat())
    alike = tuple(replace(bias, mean=np.zeros(1), sigma=np.array([0.4])) for bias in problem.biases)
    assert "the position is not bounded" in solve(replace(problem, biases=alike)).certificate.reason


def test_a_scale_with_a_prior_on_the_position_and_known_ranges_are_proven(seed):
    """Rows without a scale enclose the position: a Gaussian prior, or ranges whose speed is known."""
    rng = np.random.default_rng([seed, 19])
    scene = air(rng, 2, 6, None)
    near = Prior("position", scene.truth + rng.standard_normal(2), np.eye(2))
    fix = solve(replace(scene.problem, priors=(near,)))
    assert fix.certificate.unique

    def residual(y):
        return np.append(scene.residual(y), y[:2] - near.mean)

    for _ in range(6):
        one = least_squares(residual, np.r_[scene.truth + 5.0 * rng.standard_normal(2), 0.0, 0.0], method="lm")
        assert 2.0 * one.cost > fix.cost - 1e-3
    r = np.linalg.norm(scene.place - scene.truth, axis=1)
    rows = (
        measured("range", a=np.arange(3), z=r[:3] + 0.3 * rng.standard_normal(3), sigma=0.3),
        measured("tdoa", a=np.arange(1, 6), b=np.zeros(5, dtype=int), z=1.1 * (r[1:] - r[0]), sigma=0.1),
    )
    mixed = with_bias(assemble(scene.place, *rows), "speed", form="scale", per="kind", kind="tdoa")
    assert solve(mixed).certificate.unique


def test_exponents_of_rounding_are_no_candidates_beside_others():
    scene = scales(np.random.default_rng(0), 2, 7, (None,), levels=True)
    x = np.array([[[*scene.truth, 0.0], [1e15, 1e15, 1e15], [*scene.truth, -1.5]]])
    assert runs_backwards(scene.problem.flat(), x).tolist() == [[False, True, True]]
    assert not runs_backwards(scene.problem.flat(), x[:, 1:2]).any()
