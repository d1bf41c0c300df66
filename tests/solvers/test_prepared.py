"""The direct way from measurements to fixes: the same answers as the stages give, and no item disturbs another."""

import re
from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, ENU, STATIONS, TARGET, pairs
from hypothesis import given, settings, strategies as st
from model_checks.small import PLACE, SQUARE, ranges_to

from optloc import (
    InvalidProblem,
    Motion,
    Status,
    assemble,
    crlb,
    measured,
    prepare,
    simulate,
    solve,
    station_array,
    with_bias,
)
from optloc.base.types import Band
from optloc.engine.plan import plan_of
from optloc.kernels.jit import enabled
from optloc.linear.constraints import box, height
from optloc.problem import Prior
from optloc.solvers.methods import Method
from optloc.solvers.pool import in_parts
from optloc.solvers.prepared import prepare as ready
from optloc.solvers.solution import solve_in_stages
from optloc.solvers.stages import gtrs, lsr_with_mirror
from optloc.solvers.verdict.judge import verdict

compiled = pytest.mark.skipif(not enabled(), reason="there is no direct way without machine code")
TRIALS = 100


def by_stages(problem):
    """Return the fixes of a flat batch by the stages, never directly."""
    return verdict(problem, lsr_with_mirror(problem, gtrs(problem, None)))


def without_numbers(sentence):
    """Where a run to infinity stopped, and p-values of one digit, hang on the last bit."""
    return re.sub(r"[-+.e0-9]+", "#", sentence)


def assert_same(fix, other, apart=1e-6):
    """The same verdicts, and the same numbers to a millionth of a standard deviation, or so many of them."""
    assert np.array_equal(fix.code, other.code)
    assert [without_numbers(reason) for reason in fix.reason] == [without_numbers(reason) for reason in other.reason]
    assert list(fix.certificate) == list(other.certificate)
    for mine, theirs in zip(fix.active, other.active, strict=True):
        assert [held.name for held in mine] == [held.name for held in theirs]
        assert np.allclose(
            [held.multiplier for held in mine], [held.multiplier for held in theirs], rtol=1e-5, atol=1e-6
        )
    assert np.array_equal(fix.dof, other.dof)
    assert np.array_equal(fix.weights, other.weights)
    assert fix.layout == other.layout
    assert [stage.name for stage in fix.stages] == [stage.name for stage in other.stages]
    assert np.array_equal(
        fix.alternatives.gap.min(-1, initial=9.0) < 9.0, other.alternatives.gap.min(-1, initial=9.0) < 9.0
    )
    assert np.array_equal(np.isnan(fix.x), np.isnan(other.x))
    # what is held has no deviation of its own
    sigma = np.sqrt(np.maximum(np.diagonal(other.cov, axis1=-2, axis2=-1), 1e-6))
    n = sigma.shape[-1]
    assert np.nanmax(np.abs(fix.x[..., :n] - other.x[..., :n]) / sigma, initial=0.0) < apart
    assert np.allclose(fix.x[..., n:], other.x[..., n:], rtol=1e-9, atol=1e-5, equal_nan=True)
    spread = sigma[..., :, None] * sigma[..., None, :]
    assert np.nanmax(np.abs(fix.cov - other.cov) / spread, initial=0.0) < 10.0 * apart
    settled = fix.answered
    assert np.allclose(fix.cost[settled], other.cost[settled], rtol=1e-8, atol=1e-8, equal_nan=True)
    assert (fix.local is None) == (other.local is None)


def ring(d):
    """Every neighbour against the next, twice: loops among the rows, and no common reference."""
    s = len(STATIONS[d])
    a, b = np.arange(s), np.roll(np.arange(s), 1)
    return assemble(STATIONS[d], measured("tdoa", a=np.r_[a, a], b=np.r_[b, b], sigma=4.0))


def absent(d):
    """A row with weight zero, one with half its weight, and known corrections."""
    a, b = pairs(d)
    problem = assemble(STATIONS[d], measured("tdoa", a=a, b=b, arrival_sigma=5.0))
    weight = np.ones(len(a))
    weight[1], weight[2] = 0.0, 0.5
    rows = replace(problem.rows[0], weight=weight, correction=np.linspace(-40.0, 60.0, len(a)))
    return replace(problem, rows=(rows,))


def epochs(d):
    """A target that stays, heard at three epochs with an emission time each, the last by half of the stations."""
    s = len(STATIONS[d])
    a, epoch = np.r_[np.arange(s), np.arange(s), np.arange(s // 2)], np.repeat([0, 1, 2], [s, s, s // 2])
    rows = measured("toa", a=a, epoch=epoch, sigma=5.0)
    return assemble(STATIONS[d], rows, times=np.array([0.0, 10.0, 25.0]), motions=(Motion(0),))


def loose(d):
    """Stations whose positions are known to three metres only: as much noise of their arrivals."""
    a, b = pairs(d)
    base = station_array(STATIONS[d])
    stations = replace(base, covariance=np.tile(9.0 * np.eye(d), (base.count, 1, 1)), span="noise")
    return assemble(stations, measured("tdoa", a=a, b=b, arrival_sigma=5.0))


def unheard(d):
    """A station that no row mentions, far from the others."""
    a, b = pairs(d)
    place = np.concatenate([STATIONS[d], 3.0 * STATIONS[d][1:2]])
    return assemble(place, measured("tdoa", a=a, b=b, arrival_sigma=5.0))


def somewhere(d):
    """In a geodetic frame."""
    return assemble(STATIONS[d], measured("range", a=np.arange(len(STATIONS[d])), sigma=5.0), frame=ENU)


DIRECT = ["tdoa", "range", "toa", "range_sum", "range+range_sum", "toa+tdoa"]
BUILT = {"ring": ring, "absent": absent, "epochs": epochs, "loose": loose, "unheard": unheard}


def problems():
    """Return every problem that has a direct way, with simulated measurements (TRIALS, m)."""
    made = {f"{name}-{d}d": CASES[f"{name}-{d}d"].problem for name in DIRECT for d in (2, 3)}
    made |= {f"{name}-{d}d": build(d) for name, build in BUILT.items() for d in (2, 3)}
    made["geodetic"] = somewhere(3)
    return made


PROBLEMS = problems()


def trials(problem, seed=1, count=TRIALS):
    early = {"emission": -1234.0 - 77.0 * np.arange(problem.epochs)}
    local = early["emission"] if problem.layout.n_local else np.zeros(0)
    return simulate(problem, np.concatenate([TARGET[problem.dimension], local]), seed, trials=count)


@compiled
@pytest.mark.parametrize("name", sorted(PROBLEMS))
def test_equals_the_stages(name):
    batch = trials(PROBLEMS[name])
    assert plan_of(batch) is not None
    assert_same(solve(batch, "gtrs+lsr"), by_stages(batch))


TAPED = ["groa", "tdoa+azimuth", "angles", "bistatic", "toa+azimuth", "prior", "bias", "errors", "height"]
TAPED += ["exact height", "plane", "line", "above ground", "box", "angles at a height", "bias in a plane"]


def taped(name):
    """Return a problem whose rows take tapes, or whose position is not alone, and its truth."""
    s = len(STATIONS[3])
    a, b = pairs(3)
    rows = {
        "groa": (measured("groa", a=a, b=b, sigma=0.002),),
        "tdoa+azimuth": (measured("tdoa", a=a, b=b, arrival_sigma=5.0), measured("azimuth", a=[1], sigma=0.01)),
        "angles": (
            measured("azimuth", a=np.arange(s), sigma=0.005),
            measured("elevation", a=np.arange(s), sigma=0.005),
        ),
        "bistatic": (
            measured("range_sum", a=[0, 0, 0], b=[1, 2, 3], sigma=5.0),
            measured("azimuth", a=[0], sigma=0.005),
            measured("elevation", a=[0], sigma=0.005),
        ),
        "toa+azimuth": (measured("toa", a=np.arange(s), sigma=5.0), measured("azimuth", a=[0, 2], sigma=0.01)),
        "height": (measured("toa", a=np.arange(s), sigma=5.0), measured("height", a=[0], sigma=30.0)),
    }.get(name, (measured("tdoa", a=a, b=b, arrival_sigma=5.0),))
    truth, stations, more = TARGET[3], STATIONS[3], {}
    if name == "prior":
        more["priors"] = [Prior("position", truth + 50.0, 1e4 * np.eye(3))]
    if name == "errors":
        base = station_array(stations)
        stations = replace(base, covariance=np.tile(9.0 * np.eye(3), (base.count, 1, 1)))
    if name == "height":
        more["frame"] = ENU
    if name in ("exact height", "above ground", "angles at a height"):
        more["frame"] = ENU
        level = ENU.to_geodetic(truth)[2]
        more["constraints"] = height(0.0) if name == "above ground" else height(exactly=level)
    if name == "angles at a height":
        rows = tuple(measured(kind, a=np.arange(s), sigma=0.005) for kind in ("azimuth", "elevation"))
    if name == "box":
        more["constraints"] = box([-1e5, -1e5, 0.0], [1e5, 1e5, 2e4])
    if name.endswith(("plane", "line")):
        held = Band("plane", np.array(truth[2]), np.array(truth[2]), np.eye(3)[2], "z")
        across = np.array([1.0, 2.0, 0.0])
        other = Band("plane", np.array(across @ truth), np.array(across @ truth), across, "line")
        more["constraints"] = (held, other) if name == "line" else (held,)
    problem = assemble(stations, *rows, **more)
    if name.startswith("bias"):
        problem = with_bias(problem, "clock", members=tuple(problem.stations.names[1:4]), sigma=5.0)
    return problem, np.append(truth, np.zeros(problem.layout.size - 3))


@compiled
@pytest.mark.parametrize("name", TAPED)
def test_kinds_of_every_sort_equal_the_stages(name):
    problem, truth = taped(name)
    batch = simulate(problem, truth, 1, trials=60)
    assert plan_of(batch) is not None
    fix = solve(batch, "gtrs+lsr")
    assert_same(fix, by_stages(batch))
    ready = prepare(problem)
    for i in range(5):
        one = ready(batch.z[i])
        assert one.status == fix[i].status
        assert np.allclose(one.x, fix.x[i], rtol=0.0, atol=1e-5)
        assert np.allclose(one.cov, fix.cov[i], rtol=1e-6)


@compiled
@pytest.mark.parametrize("kind", ["tdoa", "range", "range_sum"])
@pytest.mark.parametrize("d", [2, 3])
def test_random_networks(d, kind):
    """Stations anew in each problem, emitters near and far, noise from fair to three times what is claimed."""
    rng = np.random.default_rng([d, len(kind)])
    count, s = 400, d + 3
    place = rng.uniform(-5e3, 5e3, (count, 1, s, d))
    target = rng.standard_normal((count, d)) * 10.0 ** rng.uniform(3.0, 5.0, (count, 1))
    r = np.sqrt(((place[:, 0] - target[:, None]) ** 2).sum(-1))
    a, b = np.arange(1, s), np.zeros(s - 1, dtype=int)
    exact = {"tdoa": r[:, 1:] - r[:, :1], "range": r[:, 1:], "range_sum": r[:, 1:] + r[:, :1]}[kind]
    z = exact + rng.standard_normal(exact.shape) * 10.0 ** rng.uniform(0.0, 1.5, (count, 1))
    batch = assemble(place, measured(kind, z, a=a, **({} if kind == "range" else {"b": b}), sigma=10.0))
    fix = solve(batch, "gtrs+lsr")
    other = by_stages(batch)
    # amid thick networks the compiled way gives up mirror images that lead to a rival now and then
    apart = fix.code != other.code
    assert apart.sum() <= 0.01 * count
    assert (other.code[apart] == Status.AMBIGUOUS).all()
    same = np.flatnonzero(~apart)
    assert_same(fix[same], other[same], apart=1e-5)  # far away convergence is slow, and both stop a little short
    assert (fix.reason != "").any()


@compiled
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_network(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 4))
    s = int(rng.integers(d + 2, 9))
    place = rng.uniform(-1.0, 1.0, (s, d)) * 10.0 ** rng.uniform(1.0, 5.0)
    pair = np.array([(i, j) for i in range(s) for j in range(i)])
    pair = pair[rng.permutation(len(pair))[: int(rng.integers(d, len(pair) + 1))]]
    problem = assemble(place, measured("tdoa", a=pair[:, 0], b=pair[:, 1], sigma=10.0 ** rng.uniform(-2.0, 2.0)))
    batch = simulate(problem, rng.uniform(-1.0, 1.0, d) * np.abs(place).max() * 3.0, seed, trials=20)
    assert_same(solve(batch, "gtrs+lsr"), by_stages(batch))


def test_bad_items_leave_the_others_as_they_are():
    """Missing measurements, wild ones, and stations that stand on one line, at one point or a universe away."""
    rng = np.random.default_rng(7)
    place = np.broadcast_to(STATIONS[3], (TRIALS, 1, *STATIONS[3].shape)).copy()
    a, b = pairs(3)
    good = trials(assemble(place[0], measured("tdoa", a=a, b=b, arrival_sigma=5.0)), seed=3)
    z = good.z.copy()
    z[3, 1], z[50, 0], z[99, 4] = np.nan, np.nan, np.nan
    place[10, 0] = STATIONS[3][0]
    place[20, 0] = np.arange(7)[:, None] * np.array([2e3, 1e3, 500.0])
    place[40, 0, 2] = 1e12
    z[60] = rng.uniform(-1e5, 1e5, z.shape[1])
    bad = [3, 10, 20, 40, 50, 60, 99]
    batch = assemble(place, measured("tdoa", z, a=a, b=b, arrival_sigma=5.0))
    fix, alone = solve(batch, "gtrs+lsr"), solve(good, "gtrs+lsr")
    rest = np.setdiff1d(np.arange(TRIALS), bad)
    assert np.array_equal(fix.x[rest], alone.x[rest])
    assert np.array_equal(fix.cov[rest], alone.cov[rest])
    assert_same(fix, by_stages(batch))
    assert (fix.code[[3, 50, 99]] == Status.REJECTED).all()
    assert (fix.code[[10, 20]] == Status.SINGULAR_GEOMETRY).all()
    assert np.isnan(fix.x[[3, 10, 20, 50, 99]]).all()


@pytest.mark.parametrize("name", sorted(PROBLEMS))
def test_prepared_equals_solve(name):
    batch = trials(PROBLEMS[name], count=40)
    ready = prepare(PROBLEMS[name])
    fix = ready(batch.z)
    assert_same(fix, solve(batch, "gtrs+lsr"))
    one = ready.solve(batch.z[7])
    assert one.shape == solve(batch.with_rows(z=batch.z[7]), "gtrs+lsr").shape == ()
    assert np.allclose(one.x, fix.x[7], rtol=0.0, atol=1e-6)
    many = ready(batch.z.reshape(4, 10, -1))
    assert np.array_equal(many.x, fix.x.reshape(4, 10, -1))
    assert many.reason.shape == (4, 10)


@pytest.mark.parametrize("method", ["gtrs+lsr", "roots+lsr", "auto"])
@pytest.mark.parametrize("name", ["tdoa+azimuth-2d", "groa-3d", "angles-3d", "tdoa+height-3d", "tdoa-3d"])
def test_every_problem_and_method_can_be_prepared(name, method):
    problem = CASES[name].problem
    fix, other = prepare(problem, method)(problem.z), solve(problem, method)
    assert fix.status == other.status
    assert np.allclose(fix.x, other.x, rtol=0.0, atol=1e-4, equal_nan=True)
    assert [s.name for s in fix.stages] == [s.name for s in other.stages]


def test_prepared_networks_share_measurement_axes():
    """Two networks and five measurements of each: batch axes broadcast."""
    a, b = pairs(3)
    place = np.stack([STATIONS[3], 1.5 * STATIONS[3]])[:, None]
    pair = assemble(place, measured("tdoa", a=a, b=b, arrival_sigma=5.0))
    alone = [assemble(one, measured("tdoa", a=a, b=b, arrival_sigma=5.0)) for one in place[:, 0]]
    z = np.stack([trials(one, seed=i, count=5).z for i, one in enumerate(alone)], axis=1)
    fix = prepare(pair)(z)
    assert fix.shape == z.shape[:2] == (5, 2)
    for i, one in enumerate(alone):
        assert np.array_equal(fix.x[:, i], prepare(one)(z[:, i]).x)


def test_prepared_refuses_what_does_not_fit():
    ready = prepare(CASES["tdoa-3d"].problem)
    with pytest.raises(InvalidProblem, match="6 rows"):
        ready(np.zeros(5))
    with pytest.raises(InvalidProblem, match="6 rows"):
        ready(3.0)
    with pytest.raises(InvalidProblem, match="unknown method"):
        prepare(CASES["tdoa-3d"].problem, "gtrss+lsr")
    a, b = pairs(3)
    two = assemble(np.stack([STATIONS[3]] * 2)[:, None], measured("tdoa", a=a, b=b, sigma=1.0))
    with pytest.raises(InvalidProblem, match="batch axes"):
        prepare(two)(np.zeros((3, 6)))


def test_errors_are_those_that_the_covariance_says():
    """By the truth alone: mean squared errors on the bound, and normalised ones that average to the dimension."""
    case, count = CASES["tdoa-3d"], 4000
    fix = prepare(case.problem)(simulate(case.problem, case.truth, 11, trials=count).z)
    error = fix.position - case.truth
    bound = crlb(case.problem, case.truth)
    scatter = error.T @ error / count
    assert np.allclose(np.diag(scatter), np.diag(bound), rtol=6.0 * np.sqrt(2.0 / count))
    nees = np.einsum("Ni,Nij,Nj->N", error, np.linalg.inv(fix.cov), error)
    assert abs(nees.mean() - 3.0) < 5.0 * np.sqrt(6.0 / count)
    assert abs(fix.cost.mean() - fix.dof[0]) < 5.0 * np.sqrt(2.0 * fix.dof[0] / count)


@pytest.mark.parametrize("method", ["gtrs+lsr", "roots+lsr", "roots+lsr+add_candidates+lsr+search"])
def test_parts_make_the_whole(method):
    """A large batch is worked on in parts: the same fixes, whatever slots of alternatives each part needs."""
    near_plane = STATIONS[3] * np.array([1.0, 1.0, 0.01])
    a, b = pairs(3)
    batch = simulate(
        assemble(near_plane, measured("tdoa", a=a, b=b, sigma=5.0)), np.array([3e3, 4e3, 500.0]), 2, trials=50
    )
    parts = in_parts(batch, lambda some, part: solve(some, method), most=7)
    fix = solve(batch, method)
    for name in ("x", "cov", "code", "reason", "cost", "dof", "weights"):
        mine, theirs = getattr(parts, name), getattr(fix, name)
        assert mine.shape == theirs.shape
        close = mine == theirs if name == "reason" else np.isclose(mine, theirs, rtol=1e-6, atol=1e-6, equal_nan=True)
        assert close.all()
    assert np.allclose(parts.alternatives.gap, fix.alternatives.gap, atol=1e-6)
    assert [s.name for s in parts.stages] == [s.name for s in fix.stages]
    assert "parts" in parts.stages[0].detail


@compiled
@pytest.mark.parametrize("method", ["gtrs+lsr", "auto"])
def test_what_is_kept_knows_levels_names_and_rates(method):
    """Problems of one structure, one after the other: each has its own height, bounds and names."""
    a, b = pairs(3)
    rows = measured("tdoa", simulate(CASES["tdoa-3d"].problem, TARGET[3], 5).z, a=a, b=b, arrival_sigma=5.0)
    for level in (1000.0, 4000.0, 1000.0):
        problem = assemble(STATIONS[3], rows, frame=ENU, constraints=height(exactly=level))
        fix = solve(problem, method)
        assert ENU.to_geodetic(fix.position)[2] == pytest.approx(level, abs=1e-6)
        assert [held.name for held in fix.active[()]] == ["height equal"]
    for name in ("first", "second"):
        held = Band("plane", np.array(900.0), np.array(900.0), np.eye(3)[2], name)
        fix = solve(assemble(STATIONS[3], rows, constraints=(held,)), method)
        assert [one.name for one in fix.active[()]] == [f"{name} equal"]
    for most, inside in ((1e6, True), (TARGET[3][2] - 500.0, False), (1e6, True)):
        fix = solve(assemble(STATIONS[3], rows, constraints=box([-1e6] * 3, [1e6, 1e6, most])), method)
        assert bool(fix.active[()]) != inside


def test_a_batch_has_statuses():
    batch = trials(PROBLEMS["tdoa-3d"], count=4)
    fix = solve(batch, "gtrs+lsr")
    assert fix.statuses.shape == (4,)
    assert all(isinstance(one, Status) for one in fix.statuses)
    assert (fix.statuses == Status.UNPROVEN).all()
    assert fix[0].status is Status.UNPROVEN
    with pytest.raises(InvalidProblem, match=r"fix\.statuses"):
        _ = fix.status


@compiled
def test_of_two_exact_positions_the_nearer_to_the_heard_stations_is_answered():
    """As many ranges as coordinates, and stations without rows: the short way and the stages choose alike."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        place, truth = rng.uniform(-5e3, 5e3, (5, 3)), rng.uniform(-9e3, 9e3, 3)
        a = np.arange(3)
        r = np.sqrt(((place[a] - truth) ** 2).sum(-1))
        problem = assemble(place, measured("range", r, a=a, sigma=5.0))
        fix, other = solve(problem), solve_in_stages(problem, Method.parse("auto"))
        # three stations lie in a plane: near it both sides are one region
        assert fix.status == other.status
        assert fix.status in {Status.AMBIGUOUS, Status.CURVED, Status.UNPROVEN}
        assert np.allclose(fix.x, other.x, atol=1e-3)
        alone = solve(assemble(place[a], measured("range", r, a=a, sigma=5.0)))
        assert np.allclose(fix.x, alone.x, atol=1e-3)


def test_what_is_prepared_fixes_measurements_as_solve_does():
    first, error = ranges_to(PLACE, 2.0), np.array([0.5, -1.0, 2.0, -0.5, 1.0])
    z = np.linalg.norm(PLACE - SQUARE, axis=1) + error * np.array([[1.0], [-2.0]])
    prepared = ready(assemble(SQUARE, measured("range", a=np.arange(5), sigma=2.0)))
    fix = prepared(z)
    expected = solve(first.take(np.zeros(2, dtype=int)).with_rows(z=z), "gtrs+lsr")
    np.testing.assert_allclose(fix.x, expected.x, atol=1e-3)
    assert prepared(z[0]).shape == ()
    with pytest.raises(InvalidProblem, match="the problem has 5 rows"):
        prepared(z[:, :4])
