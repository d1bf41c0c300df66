"""Constrained fixes against SLSQP, multipliers against finite differences, covariances against Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from scipy.optimize import minimize
from verdicts import alone

from optloc import Frame, InvalidProblem, Motion, Status, assemble, measured, simulate, solve
from optloc.base.types import Band, Polygon
from optloc.kernels.least_squares import refine
from optloc.linear.constraints import box, exact, faces, height, on_face, polygon, speed, visible
from optloc.solvers.certificates.admitted import _is_costly
from optloc.solvers.certificates.position_cost import eliminate_nuisance

ENU = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
PLANE = np.array([[0.0, 0.0], [5e3, 400.0], [300.0, 5e3], [5e3, 5200.0], [2.5e3, -2e3]])
SPACE = np.c_[PLANE, [0.0, 50.0, 600.0, 20.0, 300.0]]
ELL = np.array([[1e3, 1e3], [4e3, 1e3], [4e3, 2e3], [2e3, 2e3], [2e3, 4e3], [1e3, 4e3]])


def drawn(place, truth, rng, *constraints, sigma=30.0, **more):
    """Return a problem of ranges with noise and the cost of a position."""
    z = np.linalg.norm(place - truth, axis=-1) + sigma * rng.standard_normal(len(place))
    rows = measured("range", z, a=np.arange(len(place)), sigma=sigma)

    def cost(x):
        return float(((z - np.linalg.norm(place - np.asarray(x), axis=-1)) ** 2).sum() / sigma**2)

    return assemble(place, rows, constraints=constraints, **more), cost


def reference(cost, starts, scale, **demands):
    """Return the best feasible minimum that SLSQP finds from several starts, in units of `scale`."""
    best = np.inf
    for start in starts:
        found = minimize(
            lambda u: cost(u * scale), start / scale, method="SLSQP", options={"maxiter": 300, "ftol": 1e-12}, **demands
        )
        short = max((np.max(np.abs(c["fun"](found.x)) if c["type"] == "eq" else np.max(-c["fun"](found.x)))
                     for c in demands.get("constraints", ())), default=0.0)  # fmt: skip
        if short < 1e-6:
            best = min(best, found.fun)
    return best


def agree(fix, value):
    held = [active.name for active in fix.active[()]]
    if fix.status == Status.CONTRADICTORY:  # some regions here are far from the truth
        assert held
        assert all(name in fix.reason[()] for name in held)
    else:
        # a height may be far from the truth: data that do not allow it are then a misfit
        assert fix.answered, fix.reason
        assert fix.has(Status.MISFIT) == (fix.p_value < 1e-4)
    assert float(fix.cost) == pytest.approx(value, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("seed", few(range(12), 6))
def test_boxes(seed):
    rng = np.random.default_rng(seed)
    low = rng.uniform(0.0, 3e3, 2)
    high = low + rng.uniform(200.0, 2e3, 2)
    problem, cost = drawn(PLANE, rng.uniform(-1e3, 6e3, 2), rng, box(low, high))
    starts = rng.uniform(low, high, (8, 2))
    fix = solve(problem)
    agree(fix, reference(cost, starts, 1e3, bounds=list(zip(low / 1e3, high / 1e3, strict=True))))
    assert (fix.position >= low - 1e-2).all()
    assert (fix.position <= high + 1e-2).all()
    held = {active.name for active in fix.active[()]}
    sides = [(i, side, bound[i]) for i in range(2) for side, bound in (("lower", low), ("upper", high))]
    touching = {f"{'xy'[i]} {side}" for i, side, bound in sides if abs(fix.position[i] - bound) < 1e-6}
    assert held == touching


def above(x):
    return ENU.to_geodetic(np.asarray(x))[2]


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("seed", few(range(6), 1))
def test_heights(seed, exact):
    rng = np.random.default_rng(seed)
    truth = np.array([*rng.uniform(500.0, 4500.0, 2), rng.uniform(100.0, 2e3)])
    low, high = (900.0, 900.0) if exact else (800.0, 1200.0)
    problem, cost = drawn(SPACE, truth, rng, height(low, high), sigma=60.0, frame=ENU)
    if exact:
        demands = [{"type": "eq", "fun": lambda u: (above(u * 1e3) - low) / 1e3}]
    else:
        demands = [{"type": "ineq", "fun": lambda u: np.array([above(u * 1e3) - low, high - above(u * 1e3)]) / 1e3}]
    starts = np.c_[rng.uniform(0.0, 5e3, (4, 2)), np.full(4, 600.0)]
    fix = solve(problem)
    agree(fix, reference(cost, starts, 1e3, constraints=demands))
    assert low - 1e-2 <= float(above(fix.position)) <= high + 1e-2


@pytest.mark.parametrize("seed", few(range(12), 6))
def test_polygons_that_are_not_convex(seed):
    rng = np.random.default_rng(seed)
    problem, cost = drawn(PLANE, rng.uniform(0.0, 5e3, 2), rng, polygon(ELL))
    parts = ([(1.0, 4.0), (1.0, 2.0)], [(1.0, 2.0), (1.0, 4.0)])
    best = min(
        reference(cost, 1e3 * rng.uniform(*np.transpose(bounds), (6, 2)), 1e3, bounds=bounds) for bounds in parts
    )
    agree(solve(problem), best)


def moving(rng, *constraints, truth=(1e3, 2e3, 60.0, 30.0)):
    times, state = np.arange(5.0) * 4.0, np.array(truth)
    a, epoch = np.tile(np.arange(5), 5), np.repeat(np.arange(5), 5)
    place = state[:2] + times[epoch, None] * state[2:]
    z = np.linalg.norm(PLANE[a] - place, axis=-1) + 30.0 * rng.standard_normal(25)
    rows = measured("range", z, a=a, epoch=epoch, sigma=30.0)

    def cost(x):
        at = x[:2] + times[epoch, None] * x[2:]
        return float(((z - np.linalg.norm(PLANE[a] - at, axis=-1)) ** 2).sum() / 900.0)

    return assemble(PLANE, rows, times=times, motions=(Motion(1),), constraints=constraints), cost


@pytest.mark.parametrize("limit", [40.0, 65.0, 100.0])
def test_speeds(limit):
    rng = np.random.default_rng(int(limit))
    problem, cost = moving(rng, speed(limit))
    scale = np.array([1e3, 1e3, 10.0, 10.0])
    demands = [{"type": "ineq", "fun": lambda u: np.array([(limit**2 - ((u * scale)[2:] ** 2).sum()) / 1e3])}]
    starts = [np.array([1e3, 2e3, *v]) for v in ((30.0, 15.0), (10.0, -5.0), (0.1, 0.1))]
    fix = solve(problem)
    agree(fix, reference(cost, starts, scale, constraints=demands))
    assert np.linalg.norm(fix.velocity) <= limit * (1.0 + 1e-6)


def shifted(problem, name, by):
    """Return the problem with the finite bounds of one constraint moved."""
    return replace(
        problem,
        constraints=tuple(
            replace(c, lower=c.lower + by, upper=c.upper + by) if c.name == name else c for c in problem.constraints
        ),
    )


@pytest.mark.parametrize(
    ("name", "make", "sign"),
    few(
        [
            ("x", lambda rng: drawn(PLANE, np.array([2e3, 2e3]), rng, box((0.0, 0.0), (1.5e3, 5e3))), 1.0),
            (
                "height",
                lambda rng: drawn(SPACE, np.array([2e3, 2e3, 900.0]), rng, height(exactly=1e3), frame=ENU),
                None,
            ),
            ("speed", lambda rng: moving(rng, speed(50.0)), 1.0),
            ("y", lambda rng: drawn(PLANE, np.array([2e3, 2e3]), rng, box((0.0, 2.5e3), (9e3, 5e3))), -1.0),
            ("height", lambda rng: drawn(SPACE, np.array([2e3, 2e3, 900.0]), rng, height(0.0, 900.0), frame=ENU), 1.0),
        ],
        3,
        3,
    ),
    ids=["upper", "exact", "speed", "lower", "band"],
)
def test_multipliers_are_the_price_of_a_bound(name, make, sign):
    """From the definition, gradient + sum of multiplier * gradient of g = 0: d cost / d bound = -multiplier."""
    problem, _ = make(np.random.default_rng(3))
    (active,) = solve(problem).active[()]
    assert active.name.startswith(name)
    step = 1e-2
    slope = (solve(shifted(problem, name, step)).cost - solve(shifted(problem, name, -step)).cost) / (2.0 * step)
    assert active.multiplier == pytest.approx(-float(slope), rel=1e-3, abs=1e-6)
    assert sign is None or np.sign(active.multiplier) == sign


@pytest.mark.parametrize(("trials", "within"), few([(300, 0.15), (2000, 0.05)], 1, 2))
def test_covariance_at_an_exact_height_is_that_of_monte_carlo(trials, within):
    truth = np.array([2e3, 1.5e3, 700.0])
    rows = measured("tdoa", np.zeros(4), a=[1, 2, 3, 4], b=0, arrival_sigma=5.0)
    blank = assemble(SPACE, rows, frame=ENU, constraints=[height(exactly=float(above(truth)))])
    fix = solve(simulate(blank, truth, 11, trials), "searched")  # of so many no proof is asked for
    good = alone(fix)
    assert good.mean() > 0.99
    error = fix.position[good] - truth
    sampled, stated = np.cov(error.T), fix.cov[good].mean(0)
    assert np.trace(sampled) == pytest.approx(np.trace(stated), rel=within)
    u, s, _ = np.linalg.svd(stated)
    along = u[:, :2]
    spread = np.einsum("ni,ij,nj->n", error @ along, np.linalg.inv(along.T @ stated @ along), error @ along)
    assert spread.mean() == pytest.approx(2.0, rel=within)
    assert s[2] < 1e-6 * s[0]
    assert np.sqrt(np.mean((error @ u[:, 2]) ** 2)) < 1e-2


def test_a_region_that_cannot_be_reached_is_infeasible_and_leaves_the_others_alone():
    rng = np.random.default_rng(4)
    z = np.linalg.norm(PLANE - np.array([2.5e3, 1.5e3]), axis=-1) + 10.0 * rng.standard_normal((3, 5))
    rows = measured("range", z, a=np.arange(5), sigma=10.0)
    bands = box((0.0, 0.0), (9e3, 9e3))
    bands = (replace(bands[0], lower=np.array([0.0, 8e3, 0.0])), bands[1])
    fix = solve(assemble(PLANE, rows, constraints=[bands, polygon(ELL)]))
    assert [Status(c) for c in fix.code] == [Status.OK, Status.INFEASIBLE, Status.OK]
    assert np.isnan(fix.position[1]).all()
    assert np.isnan(fix.cov[1]).all()
    assert "polygon" in fix.reason[1]
    free = solve(assemble(PLANE, rows))
    np.testing.assert_allclose(fix.position[[0, 2]], free.position[[0, 2]], rtol=1e-9)


def test_a_height_outside_the_box_is_infeasible():
    floor, ceiling = (-50e3, -50e3, -500.0), (50e3, 50e3, 0.0)  # farther out the Earth curves away below the box
    problem, _ = drawn(SPACE, np.array([2e3, 2e3, 900.0]), np.random.default_rng(1), frame=ENU)
    fix = solve(replace(problem, constraints=(*box(floor, ceiling), *height(exactly=2e3))))
    assert (fix.status, fix.active[()]) == (Status.INFEASIBLE, ())
    assert np.isnan(fix.position).all()


@pytest.mark.slow
def test_satellites_behind_the_horizon_are_a_status():
    earth = Frame("ecef")
    truth = earth.from_geodetic(0.8, 0.1, 100.0)
    place = earth.from_geodetic([0.8, 0.8, 0.9, 0.7], [3.1, 3.3, 3.2, 3.2], np.full(4, 2e7))
    rows = measured("range", np.linalg.norm(place - truth, axis=-1), a=np.arange(4), sigma=10.0)
    # Positions on the other side of the Earth see all satellites, but they contradict the ranges.
    assert solve(assemble(place, rows, frame=earth, constraints=[visible(place)])).status == Status.CONTRADICTORY


def test_where_nothing_binds_the_fix_is_the_unconstrained_one():
    problem, _ = drawn(SPACE, np.array([2e3, 2e3, 900.0]), np.random.default_rng(1), frame=ENU)
    wide = (*box((-1e4,) * 3, (1e4,) * 3), *height(0.0, 1e4), *polygon([[-1e5, -1e5], [1e5, -1e5], [0.0, 1e5]]))
    fix, free = solve(replace(problem, constraints=wide)), solve(problem)
    np.testing.assert_allclose(fix.x, free.x, rtol=1e-8)
    np.testing.assert_allclose(fix.cov, free.cov, rtol=1e-6)
    assert (fix.active[()], int(fix.dof)) == ((), int(free.dof))
    assert float(fix.cost) == pytest.approx(float(free.cost), rel=1e-9)
    # edges that are far away take nothing from what is proven of all positions
    assert fix.certificate.unique
    assert free.certificate.unique
    assert fix.status == free.status


@pytest.mark.parametrize(
    "side", few([height(3e3, 1e9), box((-2e3, -1e9, -1e9), (1e9,) * 3)], 1), ids=["height", "plane"]
)
def test_an_edge_is_too_dear_only_where_all_of_it_is(side):
    rng, levels = np.random.default_rng(4), np.linspace(0.5, 1.5, 11)
    for _ in range(3):
        problem, _ = drawn(SPACE, rng.uniform([-4e3, -4e3, 0.0], 4e3), rng, *side, frame=ENU)
        flat = problem.flat()
        on = on_face(flat, faces(flat)[1])
        least = refine(
            on.take(np.zeros(40, int)), rng.uniform(-9e3, 9e3, (40, 3)), face=exact(on), limit=300
        ).cost.min()
        many = on.take(np.zeros(11, int))
        anywhere = rng.uniform(-9e3, 9e3, (11, 3, 3))
        dear, boxes = _is_costly(
            many, np.full((2, 3), np.inf), eliminate_nuisance(flat.take(np.zeros(11, int))), anywhere, least * levels, 1
        )
        assert not dear[levels > 1.0 + 1e-6].any()
        assert dear[levels < 0.8].all()
        assert (boxes > 0).any()


def problem_of(*constraints, place=SPACE, frame=ENU, **more):
    return drawn(place, place[0] + 1e3, np.random.default_rng(0), *constraints, frame=frame, **more)


BOW = [[0.0, 0.0], [9.0, 10.0], [9.0, 0.0], [0.0, 8.0]]
SPIKE = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [4.0, -2.0]]
TOUCH = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 0.0], [0.0, 4.0]]
PLAIN = Frame("cartesian")
REFUSED = {
    "least above greatest": (lambda: problem_of(height(9.0, 3.0)), "'height'.*at least 9 m and at most 3 m"),
    "two heights": (lambda: problem_of(height(exactly=500.0), height(exactly=600.0)), "600 m and at most 500 m"),
    "height outside its band": (lambda: problem_of(height(exactly=5.0), height(10.0, 20.0)), "least 10 m.*most 5 m"),
    "boxes apart": (
        lambda: problem_of(box((0, 0, 0), (1, 1, 1)), box((2, 0, 0), (3, 1, 1))),
        "'x'.*least 2 m.*most 1 m",
    ),
    "the same height twice": (lambda: problem_of(height(exactly=5.0), height(exactly=5.0)), "twice"),
    "height in no frame": (lambda: problem_of(height(0.0), frame=PLAIN), "height needs a geodetic frame"),
    "height in the plane": (lambda: problem_of(height(0.0), place=PLANE), "height needs three"),
    "sight in no frame": (lambda: problem_of(visible(SPACE), frame=PLAIN), "visible needs a geodetic frame"),
    "nan bound": (lambda: problem_of(box((0, np.nan, 0), (1, 1, 1))), "'y'.*lower bound is nan"),
    "bound beyond": (lambda: problem_of(height(np.inf)), "lower bound is inf"),
    "nan height": (lambda: problem_of(height(exactly=np.nan)), "bound is nan"),
    "box in another dimension": (lambda: problem_of(box((0, 0), (1, 1))), "'x'.*3 numbers"),
    "speed at rest": (lambda: problem_of(speed(10.0)), "'speed'.*moves"),
    "target beyond": (lambda: problem_of(height(0.0, target=2)), "no target 2"),
    "unknown quantity": (lambda: problem_of(Band("hight", np.zeros(()), np.ones(()), np.zeros(0), "h")), "'height'"),
    "two corners": (lambda: problem_of(polygon([[0, 0], [1, 1]])), "only 2 corners"),
    "corners in space": (lambda: problem_of(polygon(np.zeros((4, 3)))), "no pairs"),
    "nan corner": (lambda: problem_of(polygon([[0, 0], [1, np.nan], [1, 0]])), "corner 2 is not finite"),
    "closed ring": (lambda: problem_of(polygon([*ELL, ELL[0]])), "corner 7 repeats corner 1"),
    "no area": (lambda: problem_of(polygon([[0, 0], [1, 1], [2, 2]])), "no area"),
    "bow tie": (lambda: problem_of(polygon(BOW)), "1-2 and 3-4 meet"),
    "spike": (lambda: problem_of(polygon(SPIKE)), "not simple"),
    "corner on an edge": (lambda: problem_of(polygon(TOUCH)), "not simple"),
    "polygon in ECEF": (lambda: problem_of(polygon(ELL), frame=Frame("ecef")), "needs a plan"),
    "known target": (lambda: assemble(PLANE, measured("range", np.ones(5), a=np.arange(5), sigma=1.0),
        motions=(Motion(0, known=np.zeros((1, 1, 2))), Motion()), constraints=[polygon(ELL)]), "known"),
    "angles without axes": (
        lambda: assemble(SPACE, measured("azimuth", [0.1], a=0, sigma=0.1), frame=Frame("ecef")), "azimuth.*axes",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_one_sentence_names_the_constraint(name):
    build, words = REFUSED[name]
    with pytest.raises(InvalidProblem, match=words) as caught:
        build()
    assert caught.value.advice
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("turn", [1, -1])
def test_simple_polygons_pass_either_way_round(turn):
    rng = np.random.default_rng(6)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 40))
    star = rng.uniform(1.0, 3.0, (40, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for corners in (ELL, star + 5e6, 1e6 * star):
        assert isinstance(problem_of(polygon(corners[::turn]))[0].constraints[0], Polygon)
