"""What must not matter does not: where the axes point, names, order, reference station, unit of length, the batch."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, dense_covariance
from hypothesis import given, settings, strategies as st

from optloc import assemble, crlb, measured, simulate, solve
from optloc.models import MODELS
from optloc.problem.noise import Block, Noise

STARTED = sorted(name for name, case in CASES.items() if case.start)
FLAT = [name for name in STARTED if "height" not in name]  # a height is measured from the Earth, which does not turn
seeds = st.integers(0, 10**6)
few = settings(max_examples=2)


def redrawn(name, seed):
    case = CASES[name]
    return simulate(case.problem, case.truth, seed, trials=5)


def rotation(rng, d):
    q, r = np.linalg.qr(rng.standard_normal((d, d)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1.0
    return q


def moved(problem, R, shift):
    """The same scene in other axes: p' = R p + shift."""
    s = problem.stations
    axes = np.broadcast_to(np.eye(problem.dimension), (1, s.count, *R.shape)) if s.axes is None else s.axes
    stations = replace(
        s,
        position=s.position @ R.T + shift,
        velocity=None if s.velocity is None else s.velocity @ R.T,
        axes=axes @ R.T,
    )
    return replace(problem, stations=stations)


def in_frame(fix, R, shift):
    """Position and velocity of a fix, and their covariance, turned."""
    d, n = len(R), fix.layout.n_shared
    whole = np.kron(np.eye(n // d), R)
    x = fix.x[..., :n] @ whole.T
    x[..., :d] += shift
    return x, whole @ fix.cov @ whole.T


def agree(fix, x, cov, cost, size=1e4, rtol=1e-6):
    n = x.shape[-1]
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    assert np.isfinite(sigma).all()
    assert np.all(np.abs(fix.x[..., :n] - x) <= 1e-9 * size + 1e-5 * sigma)
    assert np.abs((fix.cov - cov) / sigma[..., :, None] / sigma[..., None, :]).max() < 1e-5
    assert np.allclose(fix.cost, cost, rtol=rtol, atol=1e-6)


@pytest.mark.parametrize("name", FLAT)
@given(seed=seeds)
@few
def test_the_fix_turns_and_shifts_with_the_scene(name, seed):
    rng = np.random.default_rng(seed)
    problem = redrawn(name, seed)
    R, shift = rotation(rng, problem.dimension), rng.uniform(-2e4, 2e4, problem.dimension)
    fix, turned = solve(problem), solve(moved(problem, R, shift))
    assert np.array_equal(fix.code, turned.code)
    agree(turned, *in_frame(fix, R, shift), fix.cost)


def relabelled(problem, order):
    """Stations in another order; rows follow."""
    s, place = problem.stations, np.argsort(order)
    stations = replace(
        s,
        position=s.position[:, order],
        names=tuple(s.names[i] for i in order),
        velocity=None if s.velocity is None else s.velocity[:, order],
        axes=None if s.axes is None else s.axes[:, order],
    )
    rows = tuple(
        replace(r, a=np.where(r.a >= 0, place[r.a], -1), b=np.where(r.b >= 0, place[r.b], -1)) for r in problem.rows
    )
    return replace(problem, stations=stations, rows=rows)


def shuffled(problem, rng):
    """Rows of each kind in another order, and the kinds too."""
    kinds = rng.permutation(len(problem.rows))
    rows, old = [], []
    for i in kinds:
        block, order = problem.rows[i], rng.permutation(problem.rows[i].count)
        names = ("z", "a", "b", "epoch", "target", "weight", "correction")
        rows.append(replace(block, **{name: getattr(block, name)[..., order] for name in names}))
        old += list(problem.starts[i] + order)
    full = dense_covariance(problem)[np.ix_(old, old)]
    return replace(problem, rows=tuple(rows), noise=Noise((Block(np.arange(len(old))[None], full[None]),)))


@pytest.mark.parametrize("name", STARTED)
@given(seed=seeds)
@few
def test_names_and_order_change_nothing(name, seed):
    rng = np.random.default_rng(seed)
    problem = redrawn(name, seed)
    fix = solve(problem)
    other = solve(shuffled(relabelled(problem, rng.permutation(problem.stations.count)), rng))
    assert np.array_equal(fix.code, other.code)
    assert np.array_equal(fix.dof, other.dof)
    agree(other, fix.x[..., : fix.layout.n_shared], fix.cov, fix.cost)


@pytest.mark.parametrize("d", [2, 3])
@given(seed=seeds, reference=st.integers(0, 5))
@settings(max_examples=4)
def test_the_reference_of_differences_does_not_matter(d, seed, reference):
    problem = redrawn(f"tdoa-{d}d", seed)
    count = len(STATIONS[d])
    T = np.zeros((count - 1, count - 1))
    others = [i for i in range(count) if i != reference]
    for row, station in enumerate(others):  # r_s - r_ref = (r_s - r_0) - (r_ref - r_0)
        if station:
            T[row, station - 1] += 1.0
        if reference:
            T[row, reference - 1] -= 1.0
    full = T @ dense_covariance(problem) @ T.T
    changed = assemble(STATIONS[d], measured("tdoa", problem.z @ T.T, a=others, b=reference, covariance=full))
    fix, other = solve(problem), solve(changed)
    assert np.array_equal(fix.code, other.code)
    agree(other, fix.x, fix.cov, fix.cost)
    assert np.allclose(crlb(problem, TARGET[d]), crlb(changed, TARGET[d]), rtol=1e-9)


@pytest.mark.parametrize("name", FLAT)
@given(seed=seeds, unit=st.sampled_from([1e-3, 0.3048, 1852.0, 1e6]))
@few
def test_the_unit_of_length_does_not_matter(name, seed, unit):
    """Kilometres, feet, nautical miles, microns: lengths and speeds scale, angles and ratios stay."""
    problem = redrawn(name, seed)
    s = problem.stations
    factor = np.concatenate(
        [np.full(r.count, unit if MODELS[r.kind].quantity in ("length", "speed") else 1.0) for r in problem.rows]
    )
    velocity = None if s.velocity is None else s.velocity * unit
    full = factor[:, None] * dense_covariance(problem) * factor
    scaled = replace(
        problem.with_rows(z=problem.z * factor),
        stations=replace(s, position=s.position * unit, velocity=velocity),
        noise=Noise((Block(np.arange(problem.count)[None], full[None]),)),
    )
    fix, other = solve(problem), solve(scaled)
    assert np.array_equal(fix.code, other.code)
    n = fix.layout.n_shared
    agree(other, fix.x[..., :n] * unit, fix.cov * unit**2, fix.cost, size=1e4 * unit)


@pytest.mark.parametrize("name", STARTED)
def test_a_batch_is_its_problems_one_by_one(name):
    case = CASES[name]
    many = simulate(case.problem, case.truth, 77, trials=12)
    fix = solve(many)
    for i in (5, 11):
        alone = solve(case.problem.with_rows(z=many.z[i]))
        assert alone.status == fix.code[i]
        assert fix[i].status == alone.status
        agree(alone, fix.x[i][: fix.layout.n_shared], fix.cov[i], fix.cost[i], rtol=1e-9)


def test_as_many_problems_as_rows_may_have_stations_of_their_own():
    """One set of measurements for all: it is not taken for one measurement of each."""
    rng, n = np.random.default_rng(6), 16
    places, shift = rng.uniform(-1e3, 1e3, (n, 3)), rng.uniform(-1e4, 1e4, (n, 1, 1, 3))
    problem = assemble(places, measured("range", a=range(n), sigma=1.0))
    problem = simulate(problem, np.array([2e3, -1e3, 4e3]), 3)
    fix = solve(replace(problem, stations=replace(problem.stations, position=places + shift)))
    assert np.allclose(fix.x, solve(problem).x + shift[:, 0, 0], atol=1e-5)


@pytest.mark.parametrize("name", FLAT)
def test_a_batch_may_have_stations_of_its_own(name):
    """Every problem of the batch is another turn of the scene: all fixes turn back to one."""
    case = CASES[name]
    rng = np.random.default_rng(5)
    d, fix = case.problem.dimension, solve(case.problem)
    turns = [(rotation(rng, d), rng.uniform(-1e4, 1e4, d)) for _ in range(5)]
    scenes = [moved(case.problem, R, shift).stations for R, shift in turns]
    stacked = replace(
        scenes[0],
        **{
            key: np.stack([getattr(s, key) for s in scenes])
            for key in ("position", "velocity", "axes")
            if getattr(scenes[0], key) is not None
        },
    )
    batch = solve(replace(case.problem, stations=stacked))
    assert batch.shape == (5,)
    for i, (R, shift) in enumerate(turns):
        assert batch.code[i] == fix.status
        agree(batch[i], *in_frame(fix, R, shift), fix.cost)
