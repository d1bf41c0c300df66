"""One fix at once: the numbers and the verdict of a batch, whatever the measurements."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest

from optloc import Frame, Motion, Status, assemble, measured, prepare, simulate, solve
from optloc.kernels.jit import enabled
from optloc.problem import ECEF
from optloc.solvers.methods import Method
from optloc.solvers.single import prepare_fix

pytestmark = pytest.mark.skipif(not enabled(), reason="there is no short way without machine code")
SIGMA, FULL = 5.0, pytest.mark.full
# Metres: a network, of which the first few are taken.
STATIONS = 1e3 * np.array(
    [
        [0.0, 0.0, 0.0],
        [8.0, 0.0, 0.2],
        [0.0, 8.0, -0.15],
        [-7.0, 1.0, 0.4],
        [1.0, -8.0, 0.1],
        [5.0, 5.0, 0.9],
        [-5.0, 6.0, 0.0],
        [-4.0, -5.0, 0.15],
        [6.0, -4.0, 0.3],
    ]
)


def network(rows):
    """Differences to the first station of the arrivals at so many others."""
    a = np.arange(1, rows + 1)
    return assemble(STATIONS[: rows + 1], measured("tdoa", a=a, b=np.zeros(rows, dtype=int), arrival_sigma=SIGMA))


def drawn(rows, place, count, gross=0.0):
    """Measurements (count, rows) of emitters inside the network or 10 to 30 km away, one row of each off by so much."""
    rng = np.random.default_rng([rows, place == "inside"])
    turn, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(500.0, 6e3, count)
    r = rng.uniform(0.0, 4e3, count) if place == "inside" else rng.uniform(1e4, 3e4, count)
    truth = np.stack([r * np.cos(turn), r * np.sin(turn), height], axis=1)
    arrival = np.linalg.norm(truth[:, None] - STATIONS[: rows + 1], axis=-1)
    arrival += SIGMA * rng.standard_normal(arrival.shape)
    z = arrival[:, 1:] - arrival[:, :1]
    z[np.arange(count), rng.integers(0, rows, count)] += gross
    return z


@pytest.fixture(autouse=True, scope="module")
def _loaded():
    """Few problems take another way before the machine code is there."""
    solve(network(6).with_rows(z=drawn(6, "inside", 20)))


def check_same(one, other):
    """Compare single fixes with those of a batch: what they say, and all numbers to what rounding leaves."""
    assert one.shape == ()
    assert (one.code, one.marks, one.reason[()]) == (other.code, other.marks, other.reason[()])
    mine, theirs = one.certificate, other.certificate
    assert (mine.proof, mine.reason, mine.boxes, mine.margin) == (
        theirs.proof,
        theirs.reason,
        theirs.boxes,
        theirs.margin,
    )
    assert mine.region is None
    assert np.isclose(mine.bound, theirs.bound, rtol=1e-9, equal_nan=True)
    # in standard deviations, which may be kilometres
    n = len(other.cov)
    sigma = np.sqrt(np.diagonal(other.cov))
    assert (np.abs(one.x[:n] - other.x[:n]) <= 1e-6 * sigma).all()
    assert (np.abs(one.cov - other.cov) <= 1e-5 * sigma[:, None] * sigma).all()
    assert np.allclose(one.x[n:], other.x[n:], rtol=1e-9, atol=1e-6)
    for name in ("cost", "dof", "weights", "infinity"):
        assert np.allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9, equal_nan=True)
    assert (one.chart.kind, one.active[()]) == (other.chart.kind, other.active[()])
    assert np.allclose(one.chart.centre, other.chart.centre, rtol=1e-12)
    assert [stage.name for stage in one.stages] == [stage.name for stage in other.stages]
    names = ("x", "cov", "code", "reason", "cost", "dof", "weights", "marks", "infinity")
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    pairs += [(getattr(one.claims, own.name), getattr(other.claims, own.name)) for own in fields(one.claims)]
    for mine, theirs in pairs:
        assert (mine.dtype, mine.shape) == (theirs.dtype, theirs.shape)


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
@pytest.mark.parametrize("place", ["inside", "outside"])
@pytest.mark.parametrize("rows", [4, 5, 6, 8])
@pytest.mark.parametrize("count", [25, pytest.param(250, marks=FULL)])
def test_single_fixes_equal_a_batch(count, rows, place, method):
    problem, z = network(rows), drawn(rows, place, count)
    batch, ready, same, short = solve(problem.with_rows(z=z), method), prepare(problem, method), 0, 0
    for i in range(count):
        fix = ready.short(z[i])
        short += fix is not None
        if fix is not None:
            check_same(fix, batch[i])
            same += np.array_equal(fix.x, batch.x[i])
    clean = np.isin(batch.code, (Status.OK, Status.CURVED, Status.UNPROVEN)) & (batch.p_value > 1e-3)
    # four rows leave no redundancy to speak of, and rivals
    assert short >= (0.9 if rows > 4 else 0.5) * clean.sum()
    # a batch puts its stragglers off, and begins anew from where they are: a few differ in the last bits
    assert same >= 0.95 * short


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_a_site_on_earth_takes_the_short_way(method):
    problem = replace(network(6), frame=Frame.enu(lat_deg=48.2, lon_deg=11.6, height=500.0))
    z = np.concatenate([drawn(6, "inside", 12), drawn(6, "outside", 12)])
    batch, ready = solve(problem.with_rows(z=z), method), prepare(problem, method)
    short = [ready.short(one) for one in z]
    assert sum(fix is not None for fix in short) >= 20
    for i, fix in enumerate(short):
        if fix is not None:
            check_same(fix, batch[i])


def test_what_the_earth_hides_does_not_take_the_short_way():
    """Ranges from satellites meet behind the Earth as well as before it."""
    up = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.5, 0.4, 0.77], [0.1, -0.7, 0.71], [0.3, 0.6, 0.74]])
    place = 2.6e7 * up / np.linalg.norm(up, axis=1, keepdims=True)
    behind = np.array([2e4, -3e4, -6.35e6])
    problem = assemble(place, measured("range", a=np.arange(5), sigma=SIGMA), frame=ECEF)
    ready = prepare(problem, "gtrs+lsr")
    z = np.linalg.norm(place - behind, axis=1)
    assert ready.short(z) is None
    assert ready(z).status != Status.OK
    assert ready.short(np.linalg.norm(place + behind, axis=1)) is not None


@pytest.mark.parametrize(
    ("rows", "count"), [(5, 10), pytest.param(5, 100, marks=FULL), pytest.param(7, 100, marks=FULL)]
)
def test_a_gross_row_gives_the_status_of_a_batch(rows, count):
    problem, z = network(rows), drawn(rows, "inside", count, gross=300.0)
    batch, ready = solve(problem.with_rows(z=z)), prepare(problem, "auto")
    assert [int(ready(one).code) for one in z] == batch.code.tolist()
    assert (batch.code == Status.MISFIT).any()


def ranges(d, count):
    return assemble(STATIONS[:count, :d], measured("range", a=np.arange(count), sigma=SIGMA))


def absent():
    """A row of weight zero, one of half its weight, and known corrections."""
    problem = network(6)
    weight = np.array([1.0, 0.0, 0.5, 1.0, 1.0, 1.0])
    rows = replace(problem.rows[0], weight=weight, correction=np.linspace(-40.0, 60.0, 6))
    return replace(problem, rows=(rows,))


def pairs():
    """More rows than the proof has nodes: it folds them."""
    a, b = np.triu_indices(6, 1)
    return assemble(STATIONS[:6], measured("tdoa", a=a, b=b, sigma=SIGMA))


def times():
    """Arrivals with an unknown emission time at each of two epochs."""
    a, epoch = np.tile(np.arange(6), 2), np.repeat([0, 1], 6)
    rows = measured("toa", a=a, epoch=epoch, sigma=SIGMA)
    return assemble(STATIONS[:6], rows, times=np.array([0.0, 10.0]), motions=(Motion(0),))


KINDS = {"ranges": ranges(3, 6), "ranges-2d": ranges(2, 5), "absent": absent(), "pairs": pairs(), "times": times()}


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
@pytest.mark.parametrize("name", KINDS)
def test_kinds_of_rows(name, method):
    problem = KINDS[name]
    truth = np.array([1.5e3, -2e3, 3e3])[: problem.dimension]
    z = simulate(problem, np.r_[truth, np.zeros(problem.layout.size - len(truth))], 3, trials=20).z
    batch, short = solve(problem.with_rows(z=z), method), prepare_fix(problem, Method.parse(method))
    told = [short(one) for one in z]
    for fix, other in zip(told, batch, strict=True):
        if fix is not None:
            check_same(fix, other)
    assert sum(fix is not None for fix in told) >= 18


def test_what_is_missing_or_beyond_reach_takes_the_long_way():
    ready = prepare(absent(), "auto")
    z = simulate(ready.problem, np.array([1.5e3, -2e3, 3e3]), 3).z
    z[1] = np.nan  # the row that is absent
    assert ready(z).status == Status.OK
    assert ready.short(z) is not None
    z[2] = np.nan
    assert ready.short(z) is None
    assert ready(z).status == Status.REJECTED
    # elevations have no closed form, and no plan
    assert prepare(assemble(STATIONS[:4], measured("elevation", a=np.arange(4), sigma=0.01)), "auto").short is None


def test_no_fix_is_written_into_by_the_next():
    ready, z = prepare(network(6), "auto"), drawn(6, "inside", 2)
    first = ready(z[0])
    kept = [np.array(getattr(first, name)) for name in ("x", "cov", "code", "cost", "infinity")]
    ready(z[1])
    for name, array in zip(("x", "cov", "code", "cost", "infinity"), kept, strict=True):
        assert np.array_equal(getattr(first, name), array)


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_few_at_once_are_as_many_single_ones(method):
    problem, z = network(6), drawn(6, "outside", 21)
    ready, alone = prepare(problem, method), [prepare(problem, method)(one) for one in z]
    for first, last in ((0, 1), (1, 4), (4, 21)):
        fix = ready(z[first:last])
        assert fix.shape == (last - first,)
        for i, one in enumerate(fix):
            check_same(one, alone[first + i])
    assert ready.short(z[:16]).shape == (16,)
    assert ready(z[:12].reshape(3, 4, -1)).shape == (3, 4)
    assert ready(z[:0]).shape == (0,)


def test_what_is_prepared_is_so_in_another_process():
    ready, z = prepare(network(6), "auto"), drawn(6, "inside", 1)[0]
    fix, other = ready(z), pickle.loads(pickle.dumps(ready))(z)
    assert np.array_equal(fix.x, other.x)


def test_threads_do_not_share_what_they_write_into():
    ready, z = prepare(network(6), "auto"), drawn(6, "inside", 50)
    alone = [ready(one) for one in z]
    with ThreadPoolExecutor(4) as pool:
        for fix, other in zip(pool.map(ready, np.tile(z, (4, 1))), alone * 4, strict=True):
            assert np.array_equal(fix.x, other.x)
            assert fix.certificate.boxes == other.certificate.boxes


def test_problems_of_one_structure_are_told_apart_by_what_they_are_made_of():
    problem, z = network(6), drawn(6, "inside", 1)[0]
    one = problem.with_rows(z=z)
    loud = replace(
        one, noise=replace(one.noise, blocks=tuple(replace(b, covariance=4.0 * b.covariance) for b in one.noise.blocks))
    )
    moved = replace(one, stations=replace(one.stations, position=one.stations.position + 10.0))
    for fixed in (lambda some: prepare(some)(z), solve):
        fix = fixed(one)
        assert np.allclose(fixed(loud).cov, 4.0 * fix.cov, rtol=1e-6)
        assert np.allclose(fixed(moved).x, fix.x + 10.0, atol=1e-5)


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_solve_takes_the_short_way(method, monkeypatch):
    """To the last bit as a prepared problem, whatever was solved before."""
    problem, z = network(6), drawn(6, "inside", 20)
    ready = prepare(problem, method)
    monkeypatch.setattr("optloc.solvers.solution.solve_in_stages", None)
    for one in (z[0], z[1], z[0]):
        fix, same = solve(problem.with_rows(z=one), method), ready.short(one)
        assert (fix.shape, fix.x.tobytes(), fix.cov.tobytes()) == (same.shape, same.x.tobytes(), same.cov.tobytes())


@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
@pytest.mark.parametrize("axis", [(), (1,)], ids=["shared", "of length one"])
def test_few_that_differ_in_measurements_alone_take_the_short_way(method, axis, monkeypatch):
    """In `solve` and prepared, whether the stations have no batch axis or one of length one."""
    bare, z = network(6), drawn(6, "inside", 7)
    place = bare.stations.position.reshape(*axis, *bare.stations.position.shape[-3:])
    problem, ready = replace(bare, stations=replace(bare.stations, position=place)), prepare(bare, method)
    many = prepare(problem, method)
    monkeypatch.setattr("optloc.solvers.solution.solve_in_stages", None)
    monkeypatch.setattr("optloc.solvers.prepared.settle_by_plan", None)
    for fix in (solve(problem.with_rows(z=z), method), many(z)):
        assert fix.shape == (7,)
        for one, own in zip(fix, z, strict=True):
            check_same(one, ready.short(own))
    assert (solve(problem.with_rows(z=z[0]), method).shape, many(z[0]).shape) == (axis, axis)


def test_few_with_stations_of_their_own_take_the_stages():
    bare, z = network(6), drawn(6, "inside", 3)
    place = bare.stations.position + np.array([0.0, 10.0, -20.0])[:, None, None, None]
    fix = solve(replace(bare, stations=replace(bare.stations, position=place)).with_rows(z=z))
    alone = solve(bare.with_rows(z=z))
    assert np.allclose(fix.x - [[0.0], [10.0], [-20.0]], alone.x, atol=1e-4)
