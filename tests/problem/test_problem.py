"""Batches, parts of batches and epochs: the same problems whichever way they are packed."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, RATE, STATIONS, TARGET, kitchen_sink, plain_predict, random_vector, turned

from optloc import InvalidProblem, Motion, Stations, Status, assemble, measured, simulate, solve
from optloc.base.types import Band
from optloc.engine import linearise, predict
from optloc.problem import Bias, Layout, Prior, by_epoch
from optloc.problem.epochs import separable
from optloc.problem.noise import Block, Noise


def batch_of(count=6):
    """Problems that differ in everything that may differ: stations, axes, measurements, weights, noise, priors."""
    rng = np.random.default_rng(3)
    place = STATIONS[3] + rng.normal(0, 300.0, (count, 1, *STATIONS[3].shape))
    n = len(STATIONS[3])
    axes = np.stack([turned(i, 3, n) for i in range(count)])
    stations = Stations(place, tuple("ABCDEFG"), None, axes, np.tile(np.eye(3), (count, n, 1, 1)))
    spread = np.stack([np.eye(3) * (100.0 + 50.0 * i) ** 2 for i in range(count)])
    sigma, correction = rng.uniform(1, 3, (count, 5)), rng.normal(0, 1, (count, 5))
    problem = assemble(
        stations,
        measured("range", np.zeros((count, 5)), a=np.arange(5), sigma=sigma, correction=correction),
        measured("azimuth", np.zeros((count, 3)), a=[0, 1, 6], sigma=0.01, weight=rng.uniform(0.2, 1.0, (count, 3))),
        priors=(Prior("position", TARGET[3] + rng.normal(0, 50, (count, 3)), spread),),
    )
    x = np.zeros(problem.layout.size)
    x[:3] = TARGET[3]
    return simulate(problem, x, 4), x


def one(problem, i):
    """The i-th problem of a batch, unbatched, by hand."""
    s = problem.stations
    stations = replace(s, position=s.position[i], axes=s.axes[i], covariance=s.covariance[i])
    rows = tuple(replace(r, z=r.z[i], weight=pick(r.weight, i), correction=pick(r.correction, i)) for r in problem.rows)
    noise = Noise(
        tuple(Block(b.row, b.covariance[i] if b.covariance.ndim > 3 else b.covariance) for b in problem.noise.blocks)
    )
    priors = tuple(replace(p, mean=p.mean[i], covariance=p.covariance[i]) for p in problem.priors)
    return replace(problem, stations=stations, rows=rows, noise=noise, priors=priors)


def pick(array, i):
    return array[i] if array.ndim > 1 else array


def same(left, right):
    for name in ("residual", "shared", "local"):
        assert np.array_equal(getattr(left, name), getattr(right, name)), name


def test_the_batch_shape_is_that_of_everything():
    problem, _ = batch_of()
    assert problem.batch_shape == (6,)
    assert CASES["tdoa-2d"].problem.batch_shape == ()
    case = CASES["tdoa-2d"]
    assert simulate(case.problem, case.truth, 1, trials=5).batch_shape == (5,)
    assert simulate(case.problem, np.tile(case.truth, (3, 1)), 1, trials=5).batch_shape == (5, 3)


def test_take_is_the_problem_itself():
    problem, x = batch_of()
    for index in (np.array([4, 1]), np.array([True, False, True, False, False, True])):
        taken = problem.take(index)
        wanted = np.arange(6)[index]
        assert taken.batch_shape == (len(wanted),)
        assert taken.structure == problem.structure
        linear = linearise(taken, x)
        for place, i in enumerate(wanted):
            alone = linearise(one(problem, int(i)), x)
            assert np.allclose(linear.residual[place], alone.residual, rtol=1e-14, atol=1e-12)
            assert np.array_equal(linear.shared[place], alone.shared)


def test_take_of_one_or_repeated_entries():
    case = CASES["range-2d"]
    flat = case.problem.flat()
    assert flat.batch_shape == (1,)
    assert flat.take(np.array([0, 0, 0])).batch_shape == (3,)
    assert flat.take(np.array([0])).batch_shape == (1,)
    problem, _ = batch_of()
    assert np.array_equal(problem.take(np.array([2, 2])).z, problem.z[[2, 2]])
    assert problem.take(np.zeros(6, dtype=bool)).batch_shape == (0,)


def test_flat_keeps_the_order_of_several_axes():
    case = CASES["tdoa+azimuth-3d"]
    truths = case.truth + np.random.default_rng(1).normal(0, 100, (3, 3))
    many = simulate(case.problem, truths, 2, trials=4)
    flat = many.flat()
    assert many.batch_shape == (4, 3)
    assert flat.batch_shape == (12,)
    assert np.array_equal(flat.z, many.z.reshape(12, -1))
    fix = solve(many)
    assert fix.x.shape == (4, 3, 3)
    assert np.allclose(fix.x[2, 1], solve(case.problem.with_rows(z=many.z[2, 1])).x, rtol=1e-12)


def test_axes_of_length_one_broadcast():
    rng = np.random.default_rng(1)
    places = STATIONS[2] + rng.normal(0, 100, (4, 1, 1, *STATIONS[2].shape))
    z = rng.uniform(1e3, 9e3, (1, 3, 6))
    problem = assemble(places, measured("range", z, a=np.arange(6), sigma=1.0))
    assert problem.batch_shape == (4, 3)
    flat = problem.flat()
    assert flat.batch_shape == (12,)
    assert np.array_equal(flat.stations.position[7], places[2, 0])
    assert np.array_equal(flat.z[7], z[0, 1])


def test_structure_knows_everything_but_the_numbers():
    problem = kitchen_sink(2)
    assert problem.structure == simulate(problem, random_vector(problem), 1, trials=3).structure
    assert hash(problem.structure) == hash(kitchen_sink(2).structure)
    changed = [
        replace(problem, times=problem.times + np.array([0.0, 0.0, 1.0])),
        replace(problem, motions=(*problem.motions[:2], Motion(1))),
        replace(problem, motions=(Motion(0), *problem.motions[1:])),
        replace(problem, biases=problem.biases[:3]),
        replace(problem, stations=replace(problem.stations, span="run")),
        replace(problem, rows=(replace(problem.rows[0], a=problem.rows[0].b, b=problem.rows[0].a), *problem.rows[1:])),
        replace(
            problem,
            biases=(replace(problem.biases[0], coefficient=-problem.biases[0].coefficient), *problem.biases[1:]),
        ),
    ]
    assert len({problem.structure, *(p.structure for p in changed)}) == len(changed) + 1
    for other in changed:
        x = random_vector(other)
        assert np.allclose(predict(other, x), plain_predict(other, x), atol=1e-8)


def test_with_rows_puts_rows_where_they_were():
    case = CASES["toa+tdoa-3d"]
    z, weight = np.arange(case.problem.count, dtype=float), np.linspace(0, 1, case.problem.count)
    changed = case.problem.with_rows(z=z, weight=weight)
    assert np.array_equal(changed.z, z)
    assert np.array_equal(changed.weight, weight)
    assert [r.count for r in changed.rows] == [r.count for r in case.problem.rows]


def test_layout_of_everything():
    layout = kitchen_sink(3).layout
    names = [slot.name for slot in layout.shared]
    assert names[:5] == ["position[0]", "velocity[0]", "position[1]", "velocity[1]", "acceleration[1]"]
    assert names[5:] == ["clock", "scale", "drift", "boresight"]
    assert [slot.name for slot in layout.local][-1] == "stations"
    x = np.arange(float(layout.size))
    shared, local = layout.split(x)
    assert np.array_equal(np.r_[shared, local.ravel()], x)
    taken = [layout.take(x, slot.name) for slot in layout.shared]
    assert np.array_equal(np.concatenate(taken), shared)
    assert layout.take(x, "stations").shape == (3, 21)
    assert len(layout.labels()) == layout.n_shared
    assert isinstance(layout, Layout)
    with pytest.raises(InvalidProblem, match=r"'speed'.*position"):
        layout.find("speed")


# ------------------------------------------------------------------------------------------------ many epochs
K = 9


def many_epochs(seed=2, moving=False, d=3, uncertain=False):
    """A free target heard by other stations at each epoch: correlated differences, arrivals, angles, absent rows."""
    rng = np.random.default_rng(seed)
    count = len(STATIONS[d])
    path = TARGET[d] + np.arange(K)[:, None] * RATE[d]
    a, b, epoch, covariance = [], [], [], np.zeros((0, 0))
    for k in range(K):
        heard = rng.permutation(count)[: rng.integers(5, count + 1)]
        n = len(heard) - 1
        a += list(heard[1:])
        b += [heard[0]] * n
        epoch += [k] * n
        block = np.diag(rng.uniform(4, 20, n)) + rng.uniform(2, 9)
        grown = np.zeros((len(a), len(a)))
        grown[: -n or None, : -n or None][: len(covariance), : len(covariance)] = covariance
        grown[-n:, -n:] = block
        covariance = grown
    order = rng.permutation(len(a))
    a, b, epoch = (np.array(v)[order] for v in (a, b, epoch))
    weight = np.where(rng.random(len(a)) < 0.08, 0.0, 1.0)
    place = STATIONS[d] + (rng.normal(0, 200, (K, count, d)) if moving else 0.0)
    axes = np.concatenate([turned(k, d, count) for k in range(K)]) if moving else None
    spread = np.tile(4.0 * np.eye(d), (count, 1, 1)) if uncertain else None
    stations = Stations(place if moving else place[None], tuple(f"S{i}" for i in range(count)), None, axes, spread)
    toa_epoch, toa_station = np.divmod(rng.permutation(K * count)[: K * 3], count)
    problem = assemble(
        stations,
        measured("tdoa", a=a, b=b, epoch=epoch, weight=weight, covariance=covariance[np.ix_(order, order)]),
        measured("toa", a=toa_station, epoch=toa_epoch, sigma=rng.uniform(3, 6, len(toa_epoch))),
        measured("azimuth", a=rng.integers(0, count, K), epoch=np.arange(K), sigma=0.004),
        motions=(Motion(0, span="epoch"),),
        times=np.arange(K) * 1.5,
    )
    x = np.zeros(problem.layout.size)
    slot, _ = problem.layout.find("position")
    emission, _ = problem.layout.find("emission")
    for k in range(K):
        at = k * problem.layout.n_local
        x[at + slot.start : at + slot.start + d] = path[k]
        x[at + emission.start] = 500.0 * k
    return simulate(problem, x, seed), path


def alone(problem, k):
    """The problem of one epoch, built by hand."""
    s = problem.stations
    moving = len(s.position) > 1
    stations = replace(
        s, position=s.position[k : k + 1] if moving else s.position, axes=s.axes[k : k + 1] if moving else None
    )
    parts, kept = [], []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        inner = np.flatnonzero((rows.epoch == k) & (rows.weight > 0))
        if len(inner):
            parts.append(measured(rows.kind, rows.z[inner], a=rows.a[inner], b=rows.b[inner], sigma=1.0))
            kept += list(start + inner)
    from cases import dense_covariance

    return assemble(stations, *parts, covariance=dense_covariance(problem)[np.ix_(kept, kept)])


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("uncertain", [False, True])
def test_every_epoch_is_fixed_as_if_it_were_alone(moving, uncertain):
    problem, path = many_epochs(moving=moving, uncertain=uncertain)
    assert (problem.weight == 0.0).any()
    split = by_epoch(problem)
    assert split.batch_shape == (K,)
    fix = solve(problem)
    assert fix.shape == (K,)
    for k in range(K):
        own = solve(alone(problem, k))
        assert fix.code[k] == own.code
        assert np.allclose(fix.position[k], own.position, atol=2e-5)
        assert np.allclose(fix.covariance()[k], own.covariance(), rtol=1e-5)
        assert fix.cost[k] == pytest.approx(float(own.cost), rel=1e-5, abs=1e-8)
        assert fix.dof[k] == own.dof
    # station errors enter angles in a way that depends on the place, which is more than the proof covers
    good = fix.code == (Status.UNPROVEN if uncertain else Status.OK)
    assert good.sum() >= K - 1
    error = (fix.position - path)[good]
    squared = np.einsum("kd,kde,ke->k", error, np.linalg.inv(fix.covariance()[good]), error)
    assert squared.max() < 30.0


def test_batches_of_many_epochs_and_priors_split_too():
    problem, path = many_epochs(d=2)
    spread = 1e4 * np.eye(2)
    several = problem.with_rows(z=np.stack([problem.z] * 2))
    fix = solve(several)
    assert fix.shape == (2, K)
    assert np.array_equal(fix.x[0], fix.x[1], equal_nan=True)
    held = replace(
        several, priors=(Prior("position", np.stack([path.mean(0), path.mean(0) + 40.0]), np.stack([spread] * 2)),)
    )
    fixed = solve(held)
    assert fixed.shape == (2, K)
    for i in range(2):
        single = solve(replace(problem, priors=(Prior("position", held.priors[0].mean[i], spread),)))
        assert np.allclose(fixed.position[i], single.position, atol=1e-4, equal_nan=True)


def test_constraints_of_a_batch_split_too():
    problem, path = many_epochs(d=2)
    several = problem.with_rows(z=np.stack([problem.z] * 2))
    low = path[:, 1].mean() + np.array([-9e3, 500.0])
    band = Band("plane", low, np.full(2, np.inf), np.tile([0.0, 1.0], (2, 1)), "north of a line")
    fix = solve(replace(several, constraints=(band,)))
    assert fix.shape == (2, K)
    free = solve(problem)
    assert np.allclose(fix.position[0], free.position, atol=1e-4, equal_nan=True)
    held = np.isfinite(fix.position[1, :, 1]) & np.isfinite(free.position[:, 1])
    assert (fix.position[1, held, 1] >= low[1] - 1e-3).all()
    assert (free.position[held, 1] < low[1]).any()


def test_epochs_tied_by_anything_are_not_torn_apart():
    free, _ = many_epochs(d=2)
    assert separable(free)
    assert not separable(replace(free, motions=(Motion(0),)))
    assert not separable(replace(free, biases=(Bias("clock", ("one",), np.arange(3), np.zeros(3, int), np.ones(3)),)))
    run = replace(free.stations, covariance=np.tile(np.eye(2), (6, 1, 1)), span="run")
    assert not separable(replace(free, stations=run))
    rows = [measured("range", np.full(6, 5e3), a=[0, 1, 2, 0, 1, 2], epoch=[0, 0, 0, 1, 1, 1], sigma=1.0)]
    tied = np.eye(6)
    assert separable(assemble(STATIONS[2], *rows, motions=free.motions, covariance=tied))
    tied[0, 3] = tied[3, 0] = 0.5
    static = assemble(STATIONS[2], *rows, covariance=tied)
    assert not separable(replace(static, motions=free.motions))
    with pytest.raises(InvalidProblem, match="correlated noise"):
        by_epoch(static)


def test_a_row_measured_twice_in_an_epoch_counts_twice():
    z = np.array([5e3, 5.002e3, 6e3, 7e3, 5e3])
    problem = assemble(
        STATIONS[2],
        measured("range", z, a=[0, 0, 1, 2, 0], epoch=[0, 0, 0, 0, 1], sigma=1.0),
        motions=(Motion(0, span="epoch"),),
    )
    split = by_epoch(problem)
    assert split.weight.sum() == 5
    assert np.array_equal(split.weight.sum(-1), [4, 1])
    fix = solve(problem)
    assert fix.code[1] == Status.TOO_FEW_ROWS
    assert fix.dof[0] == 2


def test_known_targets_and_velocities_follow_their_epoch():
    known = np.arange(2 * 2 * 2, dtype=float).reshape(2, 2, 2) * 100.0
    place = STATIONS[2] + np.array([0.0, 50.0])[:, None, None]
    rates = np.random.default_rng(1).normal(0, 10, (2, 6, 2))
    stations = Stations(place, tuple("abcdef"), rates)
    problem = assemble(
        stations,
        measured(
            "fdoa", np.zeros(8), a=[1, 2, 3, 4] * 2, b=0, epoch=[0] * 4 + [1] * 4, target=[0, 0, 1, 1] * 2, sigma=1.0
        ),
        motions=(Motion(1, span="epoch"), Motion(1, known=known)),
    )
    split = by_epoch(problem)
    state = np.r_[TARGET[2], RATE[2]]
    joint = predict(problem, np.r_[state, state + 7.0])
    apart = predict(split, np.stack([state, state + 7.0]))
    assert np.allclose(np.sort(apart[split.weight > 0]), np.sort(joint))
