"""Other array libraries: linearisation, normal equations and fixed steps stay in them and equal those of numpy."""

import importlib
from dataclasses import fields, replace

import numpy as np
import pytest
from cases import CASES, kitchen_sink, random_vector
from often import few
from runs import drawn, estimated, run, truth

from optloc import InvalidProblem, simulate, solve
from optloc.base.types import Prior
from optloc.engine import gauss_newton, linearise, normal, predict

LIBRARIES = ("array_api_strict", "torch", "jax.numpy")
STARTS = 4


@pytest.fixture(params=LIBRARIES)
def xp(request):
    module = pytest.importorskip(request.param, reason=f"{request.param} is not installed")
    if request.param == "jax.numpy":
        importlib.import_module("jax").config.update("jax_enable_x64", True)
    return module


def back(array, like):
    """Return a foreign array as numpy; refuse one of another library."""
    assert type(array) is type(like)
    return np.asarray(array)


def close(array, like, expected, tolerance=1e-12):
    found, size = back(array, like), np.abs(np.nan_to_num(expected)).max(initial=0.0)
    assert found.shape == expected.shape
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.abs(np.nan_to_num(found - expected)).max(initial=0.0) <= tolerance * max(size, 1e-300)


def starts(vector, spread, seed=1):
    return vector + spread * np.random.default_rng(seed).normal(size=(STARTS, len(vector)))


def compare(problem, x0, xp):
    """Assert that linearisation and normal equations agree."""
    x = xp.asarray(x0)
    moved = problem.placed(x)
    assert type(moved.z) is type(x)
    ours, theirs = linearise(problem, x0), linearise(moved, x)
    for name in ("residual", "shared", "local"):
        close(getattr(theirs, name), x, getattr(ours, name))
    first, second = normal(ours, problem.epochs), normal(theirs, problem.epochs)
    for field in fields(first):
        if getattr(first, field.name) is not None:  # walks, which numpy solves, are not among these
            close(getattr(second, field.name), x, getattr(first, field.name))
    close(predict(moved, x), x, predict(problem, x0))


@pytest.mark.parametrize("name", few(CASES, 20))
def test_every_kind_and_mixture(name, xp):
    case = CASES[name]
    x0 = starts(case.truth, 5.0)
    compare(case.problem, x0, xp)
    expected, x = gauss_newton(case.problem, x0, steps=4), xp.asarray(x0)
    # Doubles carry 4e-9 m of a height; the rest of a cost is as exact as the residuals are.
    loose = 1e-9 if any(rows.kind == "height" for rows in case.problem.rows) else 1e-11
    for problem in (case.problem, case.problem.placed(x)):
        found = gauss_newton(problem, x, steps=4)
        close(found.x, x, expected.x)
        close(found.covariance, x, expected.covariance)
        close(found.cost, x, expected.cost, loose)


@pytest.mark.parametrize("span", ["epoch", "run"])
@pytest.mark.parametrize("d", [2, 3])
def test_three_targets_and_every_form_of_bias(d, span, xp):
    problem = kitchen_sink(d, span)
    vector = random_vector(problem)
    problem = simulate(problem, vector, np.random.SeedSequence(3))
    compare(problem, starts(vector, 0.1), xp)


@pytest.mark.parametrize("prior", [None, 200.0])
def test_a_run_with_station_errors_eliminated_epoch_by_epoch(prior, xp):
    problem = drawn(estimated(run(5, gain=1e-4, prior=prior)), 7, STARTS)
    x0 = starts(truth(problem), 0.1)
    x = xp.asarray(x0)
    compare(problem, x0, xp)
    expected, found = (gauss_newton(p, v, steps=3, damping=1e-3) for p, v in ((problem, x0), (problem.placed(x), x)))
    # The weakest direction of a far target amplifies rounding: what is compared is the step in its own units.
    sigma = np.sqrt(np.diagonal(expected.covariance, axis1=-2, axis2=-1))
    n = problem.layout.n_shared
    assert (np.abs(back(found.x, x) - expected.x)[:, :n] <= 1e-6 * sigma).all()
    close(found.covariance, x, expected.covariance, 1e-8)
    close(found.cost, x, expected.cost, 1e-9)


def test_absent_rows_weights_loops_and_priors(xp):
    """Rows of weight 0 and 1/2, a singular covariance (all pairs) and a prior on the position."""
    problem = CASES["tdoa-3d"].problem
    block, spread = problem.rows[0], problem.noise.blocks[0]
    weight = np.ones((STARTS, block.count))
    weight[1, 2], weight[2, 0] = 0.0, 0.5
    loop = np.concatenate(
        [np.eye(block.count), np.eye(block.count)[:1]]
    )  # the first row twice, as correlated as can be
    twice = {name: np.concatenate([getattr(block, name), getattr(block, name)[:1]]) for name in ("a", "b", "epoch")}
    again = replace(
        block,
        z=block.z @ loop.T,
        weight=np.ones(block.count + 1),
        correction=np.zeros(block.count + 1),
        target=np.zeros(block.count + 1, dtype=int),
        **twice,
    )
    noise = replace(spread, row=np.arange(block.count + 1)[None], covariance=loop @ spread.covariance @ loop.T)
    prior = Prior("position", CASES["tdoa-3d"].truth + 3.0, 100.0 * np.eye(3))
    for changed in (
        problem.with_rows(weight=weight),
        replace(problem, rows=(again,), noise=replace(problem.noise, blocks=(noise,))),
        replace(problem, priors=(prior,)),
    ):
        x0 = starts(CASES["tdoa-3d"].truth, 5.0)
        x = xp.asarray(x0)
        expected, found = gauss_newton(changed, x0, steps=4), gauss_newton(changed.placed(x), x, steps=4)
        close(found.x, x, expected.x)
        close(found.covariance, x, expected.covariance, 1e-11)
        close(found.cost, x, expected.cost, 1e-11)


def test_a_singular_or_absent_item_leaves_the_others_alone(xp):
    problem = CASES["range-3d"].problem
    weight = np.ones((STARTS, problem.count))
    weight[1, 2:] = 0.0  # two ranges for three unknowns
    z = np.broadcast_to(problem.z, (STARTS, problem.count)).copy()
    z[2, 0] = np.nan
    x0 = starts(CASES["range-3d"].truth, 50.0)
    x = xp.asarray(x0)
    found = gauss_newton(problem.with_rows(z=z, weight=weight).placed(x), x)
    assert back(found.regular, x).tolist()[:2] == [True, False]
    position, covariance = back(found.x, x), back(found.covariance, x)
    assert np.array_equal(position[1], x0[1])
    assert np.isnan(covariance[1]).all()
    assert np.isnan(back(found.cost, x)[2])
    whole = gauss_newton(problem, x0)
    assert np.allclose(position[[0, 3]], whole.x[[0, 3]], rtol=1e-12)
    assert np.allclose(covariance[[0, 3]], whole.covariance[[0, 3]], rtol=1e-10)


@pytest.mark.parametrize(
    "name", ["tdoa-3d", "groa-3d", "range-2d", "range_sum-3d", "angles-3d", "toa-3d", "tdoa+fdoa-3d"]
)
def test_the_fixed_point_is_the_fix(name):
    case = CASES[name]
    fix = solve(case.problem)
    found = gauss_newton(case.problem, starts(case.truth, 10.0), steps=12)
    sigma = np.sqrt(np.diagonal(fix.cov))
    n = case.problem.layout.n_shared
    assert (np.abs(found.x[:, :n] - fix.x[:n]) <= 1e-5 * sigma).all()
    assert np.allclose(found.covariance, fix.cov, rtol=1e-6)
    assert np.allclose(found.cost, fix.cost, rtol=1e-9, atol=1e-9)


def test_damped_steps_are_shorter():
    case = CASES["tdoa-3d"]
    x0 = case.truth + 100.0
    plain, damped = (gauss_newton(case.problem, x0, steps=1, damping=damping) for damping in (0.0, 1.0))
    assert np.linalg.norm(damped.x - x0) < 0.9 * np.linalg.norm(plain.x - x0)


def test_single_precision_stays_single():
    xp = pytest.importorskip("array_api_strict")
    case = CASES["tdoa-3d"]
    x = xp.asarray(case.truth[None] + 10.0, dtype=xp.float32)
    found = gauss_newton(case.problem.placed(x), x, steps=5)
    assert found.x.dtype == xp.float32 == found.covariance.dtype
    assert np.allclose(np.asarray(found.x), gauss_newton(case.problem, case.truth[None] + 10.0).x, atol=0.1)


def test_jax_compiles_the_steps():
    jax = pytest.importorskip("jax", reason="jax is not installed")
    jax.config.update("jax_enable_x64", True)
    case = CASES["tdoa-3d"]
    x0 = starts(case.truth, 5.0)
    found = jax.jit(lambda x: gauss_newton(case.problem, x, steps=4).x)(x0)
    assert np.allclose(found, gauss_newton(case.problem, x0, steps=4).x, rtol=1e-12)


def test_torch_differentiates_the_steps():
    """The fix depends on a measurement as the gain of least squares says."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    case = CASES["tdoa-3d"]
    x = torch.asarray(case.truth)
    z = torch.asarray(case.problem.z, requires_grad=True)
    moved = case.problem.placed(x).with_rows(z=z)
    gauss_newton(moved, x, steps=8).x[0].backward()
    step = np.zeros(case.problem.count)
    step[1] = 0.1
    high, low = (solve(case.problem.with_rows(z=case.problem.z + s * step)).x[0] for s in (1, -1))
    assert z.grad[1].item() == pytest.approx((high - low) / 0.2, rel=1e-5)


@pytest.mark.parametrize(("steps", "damping"), [(0, 0.0), (3, -1.0), (3, np.nan)])
def test_bad_arguments(steps, damping):
    with pytest.raises(InvalidProblem, match="damping"):
        gauss_newton(CASES["tdoa-3d"].problem, CASES["tdoa-3d"].truth, steps=steps, damping=damping)


def test_noise_that_depends_on_the_place_is_for_numpy():
    xp = pytest.importorskip("array_api_strict")
    problem = run(3, gain=1e-4)
    x = truth(problem)
    assert np.isfinite(gauss_newton(drawn(problem, 1, 1), x[None], steps=2).cost).all()
    with pytest.raises(InvalidProblem, match="array_api_strict"):
        gauss_newton(problem, xp.asarray(x))
