"""Uncertain fences against high precision, SciPy's minimisers, hard half-planes, IPOPT and simulated targets."""

from dataclasses import replace
from decimal import Decimal, localcontext

import casadi as ca
import numpy as np
import pytest
from often import few
from scipy.integrate import dblquad
from scipy.optimize import minimize
from scipy.special import log_ndtr, ndtr

from optloc import InvalidProblem, Motion, Status, assemble, constraints, crlb, measured, simulate, solve, track
from optloc.base.types import Fence
from optloc.bounds.cramer_rao import crlb_course
from optloc.engine.plan import is_planned
from optloc.kernels.sums import equations_at, serves
from optloc.linear.fences import cost_of_margin, derivatives_of_margin, posterior_spread, unfenced
from optloc.linear.gauss_newton import gauss_newton
from optloc.linear.normal import covariance
from optloc.proof.scope import why_unsupported

PLACE = np.array([[-80.0, -70.0], [90.0, -60.0], [85.0, 95.0], [-70.0, 80.0], [5.0, -95.0], [10.0, 100.0]])
TRUTH, NORMAL, SIGMA = np.array([10.0, 20.0]), np.array([0.8, 0.6]), 3.0


def fenced(z, *fences):
    return assemble(PLACE, measured("range", z, a=np.arange(6), sigma=SIGMA), constraints=fences)


def ranges(rng, *size):
    return np.linalg.norm(PLACE - TRUTH, axis=1) + SIGMA * rng.standard_normal((*size, 6))


# standard deviation across the fence that the ranges alone leave
ALONE = float(np.sqrt(NORMAL @ crlb(fenced(np.zeros(6)), TRUTH) @ NORMAL))


def exact_cost(u):
    """Return -2 log Phi(u) of a decimal number, with at least 150 digits."""
    with localcontext() as context:
        context.prec = 700
        term = total = u
        n = 0
        while abs(term) > abs(total) * Decimal(10) ** -690:
            n += 1
            term *= u * u / (2 * n + 1)
            total += term
        # Bailey, Borwein and Plouffe
        pi = sum(
            (Decimal(4) / (8 * k + 1) - Decimal(2) / (8 * k + 4) - 1 / Decimal(8 * k + 5) - 1 / Decimal(8 * k + 6))
            / Decimal(16) ** k
            for k in range(590)
        )
        return -2 * (Decimal("0.5") + (-u * u / 2).exp() / (2 * pi).sqrt() * total).ln()


@pytest.mark.parametrize("u", ["-33", "-5.5", "-1", "-0.25", "0.001", "0.7", "6", "20"])
def test_cost_and_derivatives_have_the_digits_of_high_precision(u):
    with localcontext() as context:
        context.prec = 300
        step, u = Decimal(10) ** -40, Decimal(u)
        here, more, less = (exact_cost(u + k * step) for k in (0, 1, -1))
        slope, bend = (more - less) / (2 * step), (more - 2 * here + less) / step**2
    w, second = derivatives_of_margin(np.array(float(u)))
    assert float(cost_of_margin(np.array(float(u)))) == pytest.approx(float(here), rel=1e-12, abs=0.0)
    assert -2.0 * float(w) == pytest.approx(float(slope), rel=1e-12, abs=0.0)
    assert 2.0 * float(second) == pytest.approx(float(bend), rel=1e-9, abs=0.0)


def test_cost_agrees_with_scipy_in_numpy_and_casadi():
    u = np.r_[np.linspace(-40.0, 37.0, 1001), 0.0, -np.logspace(0, 8, 60)]
    assert np.allclose(cost_of_margin(u), -2.0 * log_ndtr(u), rtol=1e-12, atol=0.0)
    y = ca.SX.sym("y")
    cost = cost_of_margin(y)
    program = ca.Function("f", [y], [cost, ca.gradient(cost, y), ca.hessian(cost, y)[0]])
    u = u[:1002]
    value, slope, bend = (np.array(part).ravel() for part in program(u[None]))
    w, second = derivatives_of_margin(u)
    assert np.allclose(value, -2.0 * log_ndtr(u), rtol=1e-12, atol=0.0)
    assert np.allclose(slope, -2.0 * w, rtol=1e-11, atol=0.0)
    assert np.allclose(bend, 2.0 * second, rtol=1e-10, atol=0.0)


def test_far_margins_are_finite_and_nan_stays():
    u = np.array([-1e150, -1e8, -1e4, 40.0, 1e150, np.nan])
    w, second = derivatives_of_margin(u)
    assert np.isfinite(cost_of_margin(u)[:5]).all()
    assert np.isnan(cost_of_margin(u)[5])
    assert np.isnan(w[5])
    assert ((second[:5] >= 0.0) & (second[:5] <= 1.0)).all()
    assert w[1] == pytest.approx(1e8)
    assert second[0] == 1.0


def test_equations_are_the_derivatives_of_the_cost():
    rng = np.random.default_rng(1)
    fences = (constraints.fence(NORMAL, 12.0, 4.0), constraints.fence((0.0, 2.0), 30.0, 8.0))
    problem, x = fenced(ranges(rng), *fences).flat(), np.array([13.0, 18.0])
    bare = replace(problem, fences=())

    def extra(q):
        return float(equations_at(problem, q[None]).cost[0] - equations_at(bare, q[None]).cost[0])

    with_, without = equations_at(problem, x[None]), equations_at(bare, x[None])
    step = 1e-4 * np.eye(2)
    slope = [(extra(x + e) - extra(x - e)) / 2e-4 for e in step]
    assert with_.shared_vector[0] - without.shared_vector[0] == pytest.approx(-0.5 * np.array(slope), rel=1e-6)
    bend = [
        [(extra(x + e + f) - extra(x + e - f) - extra(x - e + f) + extra(x - e - f)) / 4e-8 for f in step] for e in step
    ]
    assert with_.shared[0] - without.shared[0] == pytest.approx(0.5 * np.array(bend), rel=1e-4, abs=1e-6)
    assert extra(x) == pytest.approx(
        -2.0 * (log_ndtr((12.0 - NORMAL @ x) / 4.0) + log_ndtr((15.0 - x[1]) / 4.0)), rel=1e-9
    )


def test_a_sharp_fence_is_a_half_plane_and_a_far_one_is_none():
    z = ranges(np.random.default_rng(2))
    free = solve(fenced(z))
    offset = float(NORMAL @ free.position) - 2.0
    # the half-plane, by its optimum along the boundary
    along = np.array([-0.6, 0.8])
    on_line = minimize(
        lambda t: (((z - np.linalg.norm(offset * NORMAL + t * along - PLACE, axis=1)) / SIGMA) ** 2).sum(),
        0.0,
        tol=1e-12,
    )
    before = np.inf
    for sigma in (1.0, 1e-2, 1e-4, 1e-6):
        fix = solve(fenced(z, constraints.fence(NORMAL, offset, sigma)))
        away = np.linalg.norm(fix.position - (offset * NORMAL + on_line.x * along))
        assert away < min(before, 20.0 * sigma + 1e-6)
        before = away
    assert float(fix.cost) == pytest.approx(on_line.fun, rel=1e-4)
    # the mean squared error about the boundary is the second moment of the truncated law
    bound = 2.0 / ALONE
    hazard = np.exp(-0.5 * bound**2) / np.sqrt(2.0 * np.pi) / ndtr(-bound)
    square = ALONE**2 * (1.0 - bound * hazard + bound**2)
    assert NORMAL @ fix.covariance() @ NORMAL == pytest.approx(square, rel=0.05)
    far = solve(fenced(z, constraints.fence(NORMAL, offset + 1e4, 10.0)))
    assert far.position == pytest.approx(free.position, abs=1e-6)
    assert far.covariance() == pytest.approx(free.covariance(), rel=1e-6)
    assert (float(far.cost), int(far.dof)) == (pytest.approx(float(free.cost), rel=1e-9), int(free.dof))
    assert float(far.p_value) == pytest.approx(float(free.p_value), rel=1e-9)


def scene(seed):
    """Return a random problem with one or two fences, its cost as a plain function, and starts of a search."""
    rng = np.random.default_rng(seed)
    d = 2 + seed % 2
    kind = ("range", "azimuth", "tdoa")[seed % 3] if d == 2 else ("range", "tdoa")[seed // 2 % 2]
    m = int(rng.integers(d + {"range": seed // 2 % 2, "azimuth": 1, "tdoa": 2}[kind], d + 4))
    place, x, sigma = rng.uniform(-100.0, 100.0, (m, d)), rng.uniform(-120.0, 120.0, d), 10.0 ** rng.uniform(-1, 1)
    sigma *= 0.01 if kind == "azimuth" else 1.0

    def h(q):
        away = q[..., None, :] - place
        if kind == "azimuth":
            return np.arctan2(away[..., 1], away[..., 0])
        length = np.sqrt((away**2).sum(-1))
        return length if kind == "range" else length[..., 1:] - length[..., :1]

    z = h(x) + sigma * rng.standard_normal(len(h(x)))
    count = 1 + seed // 4 % 2
    normal = rng.standard_normal((count, d))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    s = 10.0 ** rng.uniform(-1.0, 1.5, count)
    b = normal @ x + s * rng.standard_normal(count) + rng.choice([0.0, 0.0, 20.0], count)

    def cost(q):
        r = z - h(q)
        r = (r + np.pi) % (2.0 * np.pi) - np.pi if kind == "azimuth" else r
        return (r**2).sum(-1) / sigma**2 - 2.0 * log_ndtr((b - q @ normal.T) / s).sum(-1)

    pairs = {"a": np.arange(1, m), "b": np.zeros(m - 1, dtype=int)} if kind == "tdoa" else {"a": np.arange(m)}
    fences = [constraints.fence(*one, name=f"fence {i}") for i, one in enumerate(zip(normal, b, s, strict=True))]
    problem = assemble(place, measured(kind, z, sigma=sigma, **pairs), constraints=fences)
    return problem, cost, [x, *rng.uniform(-200.0, 200.0, (5000, d))]


@pytest.mark.parametrize("part", few(range(50), 1))
def test_no_optimum_is_missed(part):
    for seed in range(6 * part, 6 * part + 6):
        problem, cost, starts = scene(seed)
        fix = solve(problem)
        # the cheapest of many points, and in full runs many minimisations
        starts = [starts[np.argmin(cost(np.array(starts)))], *(starts[:16] if part else [])]
        found = [minimize(cost, start, method="BFGS", options={"gtol": 1e-7}) for start in starts]
        best = min((one.fun for one in found if np.linalg.norm(one.x) < 2e3), default=np.inf)
        assert float(fix.cost) <= best * (1.0 + 1e-6) + 1e-6, seed
        assert float(fix.cost) == pytest.approx(cost(fix.position), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("part", few(range(10), 1))
def test_least_squares_and_ipopt_agree(part):
    for seed in range(5 * part, 5 * part + 5):
        problem = scene(seed)[0]
        fix = solve(problem)
        again = solve(problem, "nlp", start=fix.x + 0.01 * fix.sigma())
        assert np.linalg.norm((again.position - fix.position) / fix.sigma()) < 1e-6, seed


def test_an_ipopt_program_is_kept_for_other_fences():
    z = ranges(np.random.default_rng(4), 3)
    problem = fenced(z, constraints.fence(NORMAL, [10.0, 15.0, 20.0], [1.0, 3.0, 9.0]))
    assert solve(problem, "gtrs+nlp").x == pytest.approx(solve(problem).x, abs=1e-5)


def drawn(rng, trials, sigma, at=None):
    """Return fixes of targets behind fences of this sigma, in standard deviations of the ranges.

    The prior is flat: the place of the boundary is drawn, and kept with the probability that the target is inside. Or
    the true boundary is `at` standard deviations from the target.
    """
    s = sigma * ALONE
    if at is None:
        beyond = rng.uniform(-4.0 * (ALONE + s), 6.0 * s, 40 * trials)
        beyond = beyond[rng.random(len(beyond)) < ndtr(-beyond / s)][:trials]
    else:
        beyond = s * rng.standard_normal(trials) - at * ALONE
    return solve(fenced(ranges(rng, trials), constraints.fence(NORMAL, NORMAL @ TRUTH - beyond, s)))


def covered(fix):
    plain = fix[fix.chart.kind == 0]
    return plain.covers(TRUTH)


@pytest.mark.parametrize(
    ("sigma", "trials"),
    [
        *((sigma, 200) for sigma in (0.1, 1.0, 5.0)),
        *(pytest.param(sigma, 2000, marks=pytest.mark.full) for sigma in (1e-3, 0.1, 0.3, 1.0, 3.0, 10.0)),
    ],
)
def test_regions_hold_the_target_under_a_flat_prior(sigma, trials):
    fix = drawn(np.random.default_rng(int(1e4 * sigma)), trials, sigma)
    assert fix.answered.all()
    share = covered(fix).mean()
    # three standard errors of 200 draws
    assert (0.93 <= share <= 0.98) if trials > 1000 else (0.90 <= share <= 0.99)


@pytest.mark.full
@pytest.mark.parametrize("sigma", [1e-3, 0.1, 0.3, 1.0, 3.0, 10.0])
def test_regions_hold_targets_near_the_boundary(sigma):
    """Pooled over true distances of 0 to 2 standard deviations, as for hard bounds."""
    rng = np.random.default_rng(int(1e4 * sigma))
    inside = np.concatenate([covered(drawn(rng, 2000, sigma, at)) for at in (0.0, 0.5, 1.0, 2.0)])
    assert 0.93 <= inside.mean() <= 0.98


def test_the_chi_square_test_is_not_fooled():
    """A fence adds no degree of freedom: its cost lowers the p-value, most for targets on the boundary."""
    rng = np.random.default_rng(5)
    z = ranges(rng, 40)
    free = solve(fenced(z))
    for offset in (1e3, NORMAL @ TRUTH + 10.0, NORMAL @ TRUTH):
        fix = solve(fenced(z, constraints.fence(NORMAL, offset, 4.0 * ALONE)))
        assert (fix.dof == free.dof).all()
        assert (fix.p_value <= free.p_value + 1e-9).all()
    # gross errors are found, however many fences are far away
    z[:, 0] += 40.0
    fences = [constraints.fence((np.cos(t), np.sin(t)), 1e3, 5.0, name=f"far {t}") for t in range(6)]
    assert (solve(fenced(z, *fences)).p_value < 1e-3).all()
    # the worst case: the target is on the boundary, and only the fence is uncertain
    assert (drawn(rng, 300, 5.0, 0.0).p_value < 1e-3).mean() < 0.015


def test_a_contradiction_names_the_fence():
    z = ranges(np.random.default_rng(6))
    shore = constraints.fence(NORMAL, NORMAL @ TRUTH - 30.0, 2.0, name="shore")
    far = constraints.fence(-NORMAL, 1e3, 2.0, name="far shore")
    fix = solve(fenced(z, shore, far))
    assert fix.status == Status.CONTRADICTORY
    assert "the data and shore disagree" in str(fix.reason)
    assert "far shore" not in str(fix.reason)


def test_the_model_without_fences_is_recovered():
    z = ranges(np.random.default_rng(7), 20)
    problem = fenced(z, constraints.fence(NORMAL, NORMAL @ TRUTH - 2.0, 3.0), constraints.fence((0.0, 1.0), 21.0, 1.0))
    fix, free = solve(problem), solve(fenced(z))
    flat = problem.flat()
    found = unfenced(flat, fix.x, covariance(equations_at(flat, fix.x))[0])
    assert fix.x + found.shift == pytest.approx(free.x, abs=0.1)
    assert found.covariance == pytest.approx(free.cov, rel=0.1, abs=0.1)
    assert fix.cost + found.cost == pytest.approx(free.cost, abs=0.3)


def test_the_spread_of_two_fences_is_that_of_their_law():
    z = ranges(np.random.default_rng(8), 1)
    problem = fenced(z, constraints.fence(NORMAL, NORMAL @ TRUTH - 2.0, 1.0), constraints.fence((0.0, 1.0), 20.0, 0.5))
    x = solve(problem).x
    laplace = covariance(equations_at(problem, x))[0]
    free = unfenced(problem, x, laplace)
    precision, mean = np.linalg.inv(free.covariance[0]), free.shift[0]

    def density(v, u):
        q = np.array([u, v])
        power = -0.5 * (q - mean) @ precision @ (q - mean)
        for fence in problem.fences:
            power += log_ndtr((fence.offset - fence.normal @ (x[0] + q)) / fence.sigma)
        return np.exp(power)

    reach = 8.0 * np.sqrt(np.diag(free.covariance[0]))
    ends = (-reach[0], reach[0], -reach[1], reach[1])
    parts = [lambda v, u, f=f: f(u, v) * density(v, u) for f in (lambda u, v: 1.0, lambda u, v: u * u, lambda u, v: u * v, lambda u, v: v * v)]  # fmt: skip  # noqa: E501
    total, xx, xy, yy = (dblquad(part, *ends, epsabs=0.0, epsrel=1e-3)[0] for part in parts)
    truth = np.array([[xx, xy], [xy, yy]]) / total
    assert posterior_spread(problem, x, laplace)[0] == pytest.approx(truth, rel=0.02, abs=0.02 * np.abs(truth).max())


def test_bounds_simulation_and_engines_know_fences():
    z = ranges(np.random.default_rng(9))
    problem, bare = fenced(z, constraints.fence(NORMAL, NORMAL @ TRUTH, 2.0)), fenced(z)
    # the second derivative at the boundary is 2 / pi
    information = np.linalg.inv(crlb(bare, TRUTH)) + 2.0 / np.pi / 4.0 * np.outer(NORMAL, NORMAL)
    assert crlb(problem, TRUTH) == pytest.approx(np.linalg.inv(information), rel=1e-9)
    assert crlb_course(problem, TRUTH).covariance[-1] == pytest.approx(crlb(problem, TRUTH), rel=1e-9)
    assert (simulate(problem, TRUTH, 1).z == simulate(bare, TRUTH, 1).z).all()
    assert simulate(problem, TRUTH, 1).fences == problem.fences
    assert is_planned(bare.flat())
    assert not is_planned(problem.flat())
    assert not serves(problem.flat(), 1)
    assert "uncertain fence" in why_unsupported(problem.flat())
    fix = solve(problem)
    assert fix.status == Status.UNPROVEN
    assert "'fence' is an uncertain fence" in str(fix.reason)
    assert gauss_newton(problem, fix.x + 1.0, steps=20).x == pytest.approx(fix.x, abs=1e-6)
    with pytest.raises(InvalidProblem, match="a track cannot use fences"):
        track(problem, "static")


def test_a_batch_has_a_fence_for_each_problem():
    z = ranges(np.random.default_rng(10), 4)
    offset, normal = NORMAL @ TRUTH + np.array([-3.0, 0.0, 3.0, 100.0]), np.broadcast_to(NORMAL, (4, 2))
    batch = solve(fenced(z, constraints.fence(normal, offset, 2.0)))
    for i in range(4):
        alone = solve(fenced(z[i], constraints.fence(NORMAL, offset[i], 2.0)))
        assert batch.position[i] == pytest.approx(alone.position, abs=1e-6)
        assert batch.cov[i] == pytest.approx(alone.cov, rel=1e-5)
    assert fenced(z, constraints.fence(normal, offset, 2.0)).take(np.array([2])).fences[0].offset == offset[2]


def test_a_free_target_meets_the_fence_at_every_epoch():
    rng = np.random.default_rng(11)
    z = ranges(rng, 2)
    rows = measured("range", z.ravel(), a=np.tile(np.arange(6), 2), epoch=np.repeat([0, 1], 6), sigma=SIGMA)
    fence = constraints.fence(NORMAL, NORMAL @ TRUTH - 3.0, 1.0)
    fix = solve(assemble(PLACE, rows, motions=(Motion(span="epoch"),), constraints=fence))
    for k in range(2):
        assert fix.position[k] == pytest.approx(solve(fenced(z[k], fence)).position, abs=1e-6)


def test_fences_are_scaled_to_unit_normals_and_take_units():
    (one,) = constraints.fence((6.0, 8.0), "2 km", 30.0, target=1, name="shore")
    assert one.normal == pytest.approx([0.6, 0.8])
    assert (float(one.offset), float(one.sigma), one.name, one.target) == (200.0, 3.0, "shore", 1)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (((0.0, 0.0), 1.0, 1.0), "the normal is not a direction"),
        (((np.nan, 0.0), 1.0, 1.0), "the normal is not a direction"),
        (((1.0, 0.0), np.inf, 1.0), "the offset is not a finite number"),
        (((1.0, 0.0), 1.0, 0.0), "sigma is not a positive number"),
        (((1.0, 0.0), 1.0, -2.0), "sigma is not a positive number"),
        (((1.0, 0.0), 1.0, np.nan), "sigma is not a positive number"),
    ],
)
def test_bad_fences_are_refused(given, sentence):
    with pytest.raises(InvalidProblem, match=sentence):
        constraints.fence(*given)


def test_a_fence_fits_its_problem():
    z = np.ones(6)
    with pytest.raises(InvalidProblem, match="another dimension"):
        fenced(z, constraints.fence((1.0, 0.0, 0.0), 1.0, 1.0))
    with pytest.raises(InvalidProblem, match="there is no target 3"):
        fenced(z, constraints.fence(NORMAL, 1.0, 1.0, target=3))
    problem = replace(fenced(z), constraints=constraints.fence(NORMAL, 1.0, 1.0))
    assert problem.constraints == ()
    assert isinstance(problem.fences[0], Fence)


def test_a_fence_alone_can_have_the_batch_axis():
    rng = np.random.default_rng(3)
    place = rng.uniform(-100.0, 100.0, (6, 2))
    rows = measured("range", np.linalg.norm(place - [10.0, 20.0], axis=1), a=np.arange(6), sigma=3.0)
    offsets = np.array([8.0, -4.0])
    both = solve(assemble(place, rows, constraints=constraints.fence((1.0, 0.0), offsets, 2.0)))
    for one, offset in zip(both.position, offsets, strict=True):
        alone = solve(assemble(place, rows, constraints=constraints.fence((1.0, 0.0), float(offset), 2.0)))
        assert one == pytest.approx(alone.position, abs=1e-6)
