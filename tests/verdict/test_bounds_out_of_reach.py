"""Fixes inside their bounds, proven the short way: an independent search finds nothing cheaper, and no rival."""

import numpy as np
import pytest
from scipy.optimize import minimize

from optloc import Status, assemble, measured, prepare, solve
from optloc.base.types import Band
from optloc.kernels.jit import enabled
from optloc.linear.constraints import box, height
from optloc.solvers.certificates.out_of_reach import edges_of, lay_planes, new_questions
from optloc.solvers.methods import Method
from optloc.solvers.solution import solve_in_stages

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no short way without machine code")
SIGMA, TRIALS, STARTS = 10.0, 40, 30


def scene(seed, d, s):
    """Stations, box, truth inside, and range differences with noise."""
    rng = np.random.default_rng([seed, d, s])
    place = rng.uniform(-5e3, 5e3, (s, d))
    low, high = -rng.uniform(2e3, 2e4, d), rng.uniform(2e3, 2e4, d)
    truth = rng.uniform(low, high)
    r = np.sqrt(((place - truth) ** 2).sum(-1)) + SIGMA * rng.standard_normal(s)
    a = np.arange(1, s)
    problem = assemble(place, measured("tdoa", r[1:] - r[0], a=a, b=0, arrival_sigma=SIGMA), constraints=box(low, high))
    return problem, place, (low, high)


def cost_of(problem, place):
    """Return a function that gives the cost of a position and its gradient."""
    white = np.linalg.inv(np.linalg.cholesky(SIGMA**2 * (np.eye(len(place) - 1) + 1.0)))

    def cost(x):
        r = np.sqrt(((place - x) ** 2).sum(-1))
        left = white @ (problem.z - (r[1:] - r[0]))
        towards = (x - place) / r[:, None]
        return left @ left, -2.0 * (left @ white) @ (towards[1:] - towards[0])

    return cost


def in_km(x, cost):
    value, gradient = cost(1e3 * x)
    return value, 1e3 * gradient


@pytest.mark.parametrize(("d", "s"), [(2, 3), (2, 4), (2, 5), (3, 5), (3, 6)])
def test_no_position_in_a_box_is_cheaper_or_comes_near(d, s):
    """With as few receivers as can be, hyperbolas leave boxes and come back: there short proofs must give up."""
    short = 0
    for seed in range(TRIALS):
        problem, place, (low, high) = scene(seed, d, s)
        ready = prepare(problem, "auto").short
        fix = None if ready is None else ready(problem.z)
        if fix is None or fix.certificate.proof != "global":
            continue
        short += 1
        assert not len(fix.alternatives.gap)
        cost, rng = cost_of(problem, place), np.random.default_rng(seed)
        for start in rng.uniform(low, high, (STARTS, d)):
            bounds = list(zip(low, high, strict=True))
            done = minimize(in_km, start / 1e3, cost, jac=True, bounds=np.array(bounds) / 1e3, method="L-BFGS-B")
            x = np.clip(1e3 * done.x, low, high)
            if cost(x)[0] < fix.cost + 9.0:
                apart = x - fix.position
                # a search that has stopped on its way is no rival
                assert apart @ np.linalg.solve(fix.covariance(), apart) < 30.0 or done.nit > 500, (seed, x)
    assert short >= (TRIALS // 3 if s > d + 1 else 1)


def test_a_place_that_leaves_its_plane_proves_nothing():
    """An oblique plane and a box: the least place of the model on the plane is outside the box."""
    plane = Band("plane", np.array(-np.inf), np.array(30.0), np.array([1.0, 1.0]), "oblique")
    place = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    rows = measured("range", a=np.arange(4), sigma=1.0)
    problem = assemble(place, rows, constraints=(*box([-1.0, -50.0], [5.0, 50.0]), plane))
    edges = edges_of(problem)
    assert len(edges.levels) == 5
    asked = new_questions(edges, 1, 2, 4.0)
    x, slope = np.array([[1.0, 2.0]]), np.array([[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 1.0]]])
    missing = edges.value - (slope * x[:, None]).sum(-1)
    lay_planes(edges, x, np.eye(2)[None], missing, slope, asked)
    assert np.isfinite(asked.x[:4]).all()
    assert np.isnan(asked.x[4]).all()


@pytest.mark.parametrize("seed", range(12))
def test_above_ground_is_as_the_stages_say(seed):
    from cases import ENU

    rng = np.random.default_rng(seed)
    place = np.concatenate([rng.uniform(-1e4, 1e4, (6, 2)), rng.uniform(0.0, 400.0, (6, 1))], axis=1)
    truth = np.array([*rng.uniform(-2e4, 2e4, 2), 10.0 ** rng.uniform(2.0, 4.0)])
    r = np.sqrt(((place - truth) ** 2).sum(-1)) + SIGMA * rng.standard_normal(6)
    rows = measured("tdoa", r[1:] - r[0], a=np.arange(1, 6), b=0, arrival_sigma=SIGMA)
    problem = assemble(place, rows, frame=ENU, constraints=height(0.0))
    fix, other = solve(problem), solve_in_stages(problem, Method.parse("auto"))
    assert fix.status == other.status or {fix.status, other.status} <= {Status.OK, Status.CURVED}
    if fix.answered:
        assert np.allclose(fix.x, other.x, atol=1e-3)
        assert fix.certificate.proof == other.certificate.proof
