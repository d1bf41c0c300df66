"""The semidefinite start of registration: exact equalities, starts in the right basin, the need of price and prior."""

from dataclasses import dataclass
from time import perf_counter

import cvxpy as cp
import numpy as np
import pytest
from monte_carlo.tables import write
from often import few
from scipy.linalg import block_diag
from scipy.optimize import minimize

from formulations.registration_sdp import PRICES, RegistrationWindows, _parameters, registration, registration_problem

# Four stations that fly side by side and two pairs that cross: coplanar at every moment.
STATION = 1e3 * np.array([[0, 0, 10], [-15, 0, 10], [15, 0, 10], [-5, 30, 0], [5, 30, 0]])
SPEED = np.array([[0, 300, 0], [0, 300, 0], [0, 300, 0], [100, 300, 0], [-100, 300, 0.0]])
TARGET = 1e3 * np.array([200, 300, 0.0])
BIAS = np.array([30, -40, 50, -30.0])
PRIOR = 200.0


@dataclass
class Run:
    """Epochs of a run: what is measured, and what is true."""

    time: np.ndarray
    station: np.ndarray
    z: np.ndarray
    gram: np.ndarray
    sigma: np.ndarray
    design: np.ndarray
    truth: np.ndarray

    def windows(self, count, width=10):
        first = np.linspace(0, len(self.time) - width, count).round().astype(int)
        pick = first[:, None] + np.arange(width)
        whiten = np.linalg.cholesky(self.gram * width).T
        return self.station[pick].mean(1), self.z[pick].mean(1), whiten, self.time[pick].mean(1)

    def start(self, count=5, **options):
        station, z, whiten, time = self.windows(count)
        moving = {"time": time} if len(self.truth) == 2 else {}
        return registration(station, z, whiten, self.sigma, design=self.design, **moving, **options)


def run(rng, noise, *, epochs=600, station=STATION, speed=SPEED, target=TARGET, bias=BIAS, design=None, shake=1.0):
    """Range differences R = noise^2 (I + 11'), and stations known to `shake` metres an epoch."""
    target = np.atleast_2d(target)
    time = np.arange(epochs) * 1.0
    place = station + speed * time[:, None, None]
    design = np.eye(len(station) - 1) if design is None else design
    point = target[0] + (target[1] * time[:, None] if len(target) == 2 else 0.0)
    arrival = np.linalg.norm(np.broadcast_to(point, place[:, 0].shape)[:, None] - place, axis=-1)
    arrival = arrival + noise * rng.normal(size=arrival.shape)
    z = arrival[:, 1:] - arrival[:, :1] + design @ bias
    seen = place + shake * rng.normal(size=place.shape)
    count = len(station) - 1
    gram = np.linalg.inv((noise**2 + shake**2) * (np.eye(count) + 1.0))
    return Run(time, seen, z, gram, np.full(len(bias), PRIOR), design, target)


def refined(one, target, bias):
    """Levenberg-Marquardt on all epochs, target and biases side by side; cost and estimate."""
    W = np.linalg.cholesky(one.gram).T
    size, d = target.size, target.shape[-1]

    def rows(x):
        p = x[:d] + (x[d:size] * one.time[:, None] if size > d else np.zeros((len(one.time), d)))
        u = p[:, None] - one.station
        r = np.linalg.norm(u, axis=-1)
        slope = u[:, 1:] / r[:, 1:, None] - u[:, :1] / r[:, :1, None]
        parts = [slope, slope * one.time[:, None, None]] if size > d else [slope]
        parts.append(np.broadcast_to(one.design, (len(slope), *one.design.shape)))
        b = (one.z - r[:, 1:] + r[:, :1] - one.design @ x[size:]) @ W.T
        A = W @ np.concatenate(parts, axis=-1)
        prior = np.concatenate([np.zeros((len(one.sigma), size)), np.diag(1 / one.sigma)], axis=1)
        return np.append(b.ravel(), -x[size:] / one.sigma), np.concatenate([A.reshape(-1, len(x)), prior])

    x, damp = np.append(target.ravel(), bias), 1e-6
    b, A = rows(x)
    for _ in range(100):
        scale = np.linalg.norm(A, axis=0)
        wide = np.concatenate([A / scale, np.sqrt(damp) * np.eye(len(x))])
        step = np.linalg.lstsq(wide, np.append(b, np.zeros(len(x))), rcond=None)[0] / scale
        trial = rows(x + step)
        if trial[0] @ trial[0] > b @ b:
            damp *= 10
            continue
        gain = b @ b - trial[0] @ trial[0]
        x, (b, A), damp = x + step, trial, max(damp / 10, 1e-12)
        if gain < 1e-9 * (b @ b):
            break
    return b @ b, x[:size].reshape(target.shape)


def other_geometry(rng, dimension=3):
    """Five stations spread over 60 km with courses of their own, a target up to 400 km off."""
    station = rng.uniform(-30e3, 30e3, (5, 3)) * [1, 1, 0.3]
    speed = rng.uniform(-200, 200, (5, 3)) * [1, 1, 0.1]
    away, round_ = rng.uniform(80e3, 400e3), rng.uniform(0, 2 * np.pi)
    target = np.array([away * np.cos(round_), away * np.sin(round_), rng.uniform(0, 10e3)])
    cut = slice(0, dimension)
    return {"station": station[:, cut], "speed": speed[:, cut], "target": target[cut]}


def lifted(data, target, bias):
    """The unknowns (1, p, v), r_1 (K,) and f (K, S - 1) at a target, in the units of the data."""
    scaled = np.concatenate([target[:1] - data.origin, target[1:]])
    if len(scaled) == 2:
        scaled = np.stack([scaled[0] + data.clock[0] * scaled[1], scaled[1] * data.clock[1]])
    scaled = scaled / data.scale
    r = np.linalg.norm((data.power @ scaled)[:, None] - data.station, axis=-1)
    f = (data.z - r[:, 1:] + r[:, :1]) / data.unit
    return np.append(1.0, scaled), r[:, 0], f


def in_one_piece(data, price):
    """The relaxation as the module states it: one lift of all windows, the biases eliminated beforehand."""
    K, S, _ = data.station.shape
    n, count = data.power.shape[1] * data.station.shape[2], K * (S - 1)
    given = _parameters(data)
    along = (data.gram @ data.design).reshape(count, -1)
    form = block_diag(*data.gram) - along @ np.linalg.solve(data.total, along.T)
    lift = cp.Variable((1 + n + K + count, 1 + n + K + count), symmetric=True)
    first, last = 1 + n, 1 + n + K
    owner = np.repeat(np.arange(first, last), S - 1)
    inner = cp.hstack([cp.trace(lift[a, b]) for a in parts(data) for b in parts(data)])
    rules = [
        lift >> 0,
        lift[0, 0] == 1,
        cp.diag(lift)[first:last] == given["moment"] @ inner + given["near"] @ lift[0, :first],
        data.unit * cp.diag(lift)[last:] - 2 * lift[owner, np.arange(last, last + count)]
        + given["level"] @ lift[0, :first] + cp.multiply(given["ahead"], lift[0, owner])
        == cp.multiply(given["turn"], lift[0, last:]),
    ]  # fmt: skip
    cost = cp.sum(cp.multiply(form, lift[last:, last:])) + cp.sum(cp.multiply(price, lift[1:first, 1:first]))
    problem = cp.Problem(cp.Minimize(cost), rules)
    problem.solve(solver=cp.CLARABEL)
    return problem.value, lift.value[0, 1:first]


def parts(data):
    d = data.station.shape[2]
    return [slice(1 + i * d, 1 + (i + 1) * d) for i in range(data.power.shape[1])]


@pytest.mark.parametrize("moving", [False, True])
def test_blocks_of_windows_are_the_whole_lift(moving):
    """Against the lift of all windows, written apart and solved by cvxpy alone."""
    target = np.array([[200e3, 300e3, 5e3], [-100.0, 0.0, 0.0]])[: 1 + moving]
    one = run(np.random.default_rng(3), 3.0, target=target)
    station, z, whiten, time = one.windows(4)
    data = RegistrationWindows.of(station, z, whiten, one.sigma, None, 0.0, time if moving else None)
    for price in (10.0, 0.3):
        (found,) = one.start(4, prices=(price,))
        weight = np.kron(data.power.T @ data.power / 4, np.eye(3))
        value, place = in_one_piece(data, price * weight)
        assert found.answer.primal == pytest.approx(value, rel=1e-5)
        assert np.linalg.norm((found.target - data.place(place))[0]) < 0.01 * np.linalg.norm(target[0])


@pytest.mark.parametrize("less", [False, True])
@pytest.mark.parametrize(("dimension", "moving", "clocks"), [(3, False, False), (3, True, True), (2, False, True)])
def test_any_target_is_a_rank_one_point_at_its_own_cost(dimension, moving, clocks, less):
    """In the remainders themselves, or in half of the remainders less their biases."""
    rng = np.random.default_rng(0)
    design = np.concatenate([-np.ones((4, 1)), np.eye(4)], axis=1) if clocks else np.eye(4)
    bias = 50 * rng.normal(size=design.shape[1])
    scene = other_geometry(rng, dimension)
    if moving:
        scene["target"] = np.stack([scene["target"], 100 * rng.normal(size=dimension)])
    one = run(rng, 3.0, bias=bias, design=design, **scene)
    station, z, whiten, time = one.windows(4)
    data = RegistrationWindows.of(station, z, whiten, one.sigma, design, 10.0, time if moving else None)
    change = np.block([[np.eye(1, len(bias) + 5, len(bias))], [design, np.zeros((4, 1)), 2.0 * np.eye(4)]])
    problem = registration_problem(4, 5, dimension, int(moving), len(bias), change if less else None)
    target = one.truth + 0.1 * one.truth * rng.normal(size=one.truth.shape)
    y, near, left_over = lifted(data, target, bias)
    weight = np.kron(data.power.T @ data.power / 4, np.eye(dimension))
    for parameter in problem.parameters():
        parameter.value = {**_parameters(data), "price": 0.7 * weight}[parameter.name()]
    cost, shift = data.cost(y[1:])
    shared = np.append(y, shift)
    left_over = 0.5 * (left_over - design @ shift) if less else left_over
    for variable in problem.variables():
        name, _, k = variable.name().partition(" ")
        own = np.append(near[int(k)], left_over[int(k)]) if k else shared
        variable.value = np.outer(shared if name == "across" else own, own)
    for rule in problem.constraints:
        assert np.max(rule.violation()) < 1e-7
    # the cost of target and bias, the biases eliminated by brute force
    point = target[0] + (target[1] * time[:, None] if moving else np.zeros((4, dimension)))
    r = np.linalg.norm(point[:, None] - station, axis=-1)
    left = z - r[:, 1:] + r[:, :1]
    A = np.concatenate([np.tile(whiten @ design, (4, 1)), np.diag(1 / one.sigma)])
    b = np.concatenate([(left @ whiten.T).ravel(), 10.0 / one.sigma])
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    assert cost == pytest.approx(np.sum((b - A @ found) ** 2), rel=1e-8)
    np.testing.assert_allclose(10.0 + shift * data.unit * data.scale, found, rtol=1e-7)
    far = np.mean(np.sum((point - data.origin) ** 2, axis=-1)) / data.scale**2
    assert problem.objective.value == pytest.approx(cost + 0.7 * far, rel=1e-8)
    np.testing.assert_allclose(data.place(y[1:]), target, rtol=1e-9)


@pytest.mark.parametrize(
    ("noise", "prices", "trials", "half", "most"),
    [
        (3.0, PRICES, 2, 2000, 5000),
        (12.0, (10.0, 3.0, 1.0), 3, 4500, 12000),
        *(
            pytest.param(noise, (10.0, 3.0, 1.0, 0.3), 200, half, most, marks=pytest.mark.full)
            for noise, half, most in ((3.0, 2000, 6000), (6.0, 3000, 10000), (12.0, 4500, 15000))
        ),
    ],
)
def test_paper_geometry_starts_near_and_ends_in_the_truths_minimum(noise, prices, trials, half, most):
    error = []
    for seed in range(trials):
        one = run(np.random.default_rng(seed), noise)
        found = one.start(prices=prices)
        assert all(start.answer.solved for start in found)
        assert [start.cost for start in found] == sorted(start.cost for start in found)
        error.append(np.linalg.norm(found[0].target - one.truth))
        cost, point = refined(one, found[0].target, found[0].bias)
        best, ideal = refined(one, one.truth, BIAS)
        assert cost == pytest.approx(best, rel=1e-7)
        assert np.linalg.norm(point - ideal) < 10.0
    assert np.median(error) < half
    assert np.max(error) < most


def test_it_is_a_relaxation_and_far_from_tight():
    one = run(np.random.default_rng(1), 3.0)
    station, z, whiten, _time = one.windows(5)
    data = RegistrationWindows.of(station, z, whiten, one.sigma, None, 0.0, None)
    truth, fitted = (((p - data.origin) / data.scale).ravel() for p in (one.truth, refined(one, one.truth, BIAS)[1]))
    found = one.start()
    for start in found:
        assert start.answer.primal <= data.cost(truth)[0] + start.price * truth @ truth
        assert start.rank_ratio > 1e-4
        assert start.slack > -1.0
    assert found[0].misfit < 0.1 * data.cost(fitted)[0]


def test_other_geometry_and_clock_biases():
    rng = np.random.default_rng(2)
    design = np.concatenate([-np.ones((4, 1)), np.eye(4)], axis=1)
    for _ in range(2):
        bias = 50 * rng.normal(size=5)
        one = run(rng, 3.0, bias=bias, design=design, **other_geometry(rng))
        found = one.start()
        assert refined(one, found[0].target, found[0].bias)[0] <= refined(one, one.truth, bias)[0] * (1 + 1e-7)


def test_plane():
    rng = np.random.default_rng(3)
    for _ in range(2):
        one = run(rng, 3.0, **other_geometry(rng, 2))
        found = one.start()
        assert found[0].target.shape == (1, 2)
        assert np.linalg.norm(found[0].target - one.truth) < 0.03 * np.linalg.norm(one.truth)
        assert refined(one, found[0].target, found[0].bias)[0] <= refined(one, one.truth, BIAS)[0] * (1 + 1e-7)


def test_moving_target_ends_in_the_truth_or_its_mirror():
    target = np.array([[200e3, 300e3, 5e3], [-100.0, 0.0, 0.0]])
    normal = np.array([0.0, 1.0, 3.0]) / np.sqrt(10)
    flip = np.eye(3) - 2 * np.outer(normal, normal)
    centre = STATION.mean(axis=0)
    mirror = np.stack([centre + flip @ (target[0] - centre), SPEED[0] + flip @ (target[1] - SPEED[0])])
    prices = (10.0, 3.0, 0.3, 0.1)
    for seed in range(2):
        one = run(np.random.default_rng(seed), 3.0, target=target)
        goals = [refined(one, goal, BIAS) for goal in (target, mirror)]
        assert goals[0][0] == pytest.approx(goals[1][0], rel=0.2)
        cost, point = min(
            (refined(one, s.target, s.bias) for s in one.start(6, prices=prices)), key=lambda pair: pair[0]
        )
        assert cost <= max(goal[0] for goal in goals) * (1 + 1e-7)
        assert min(np.linalg.norm(point[0] - goal[1][0]) for goal in goals) < 50.0


def test_neither_unit_nor_origin_nor_axes_matter():
    rng = np.random.default_rng(4)
    one = run(rng, 3.0)
    station, z, whiten, _time = one.windows(5)
    (plain,) = registration(station, z, whiten, one.sigma, prices=(3.0,))
    move = np.array([3e6, -2e6, 5e6])
    (moved,) = registration((station + move) / 1e3, z / 1e3, whiten * 1e3, one.sigma / 1e3, prices=(3.0,))
    np.testing.assert_allclose(moved.target * 1e3 - move, plain.target, atol=10.0)
    np.testing.assert_allclose(moved.bias * 1e3, plain.bias, atol=1.0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    (turned,) = registration(station @ turn.T, z, whiten, one.sigma, prices=(3.0,))
    np.testing.assert_allclose(turned.target @ turn, plain.target, atol=10.0)


@pytest.mark.parametrize("prior", few([1000.0, 50.0, 3000.0], 1))
def test_the_ladder_serves_other_priors(prior):
    one = run(np.random.default_rng(5), 3.0)
    one.sigma[:] = prior
    found = one.start()
    assert np.linalg.norm(found[0].target - one.truth) < 5000
    assert refined(one, found[0].target, found[0].bias)[0] == pytest.approx(refined(one, one.truth, BIAS)[0], rel=1e-7)


def test_a_prior_mean_moves_the_biases():
    one = run(np.random.default_rng(6), 3.0, bias=BIAS + 1000.0)
    found = one.start(mean=np.full(4, 1000.0), prices=(10.0, 3.0, 1.0))
    np.testing.assert_allclose(found[0].bias, BIAS + 1000.0, atol=100.0)
    assert np.linalg.norm(found[0].target - one.truth) < 5000


def test_price_and_prior_are_both_needed():
    one = run(np.random.default_rng(7), 3.0)
    good = one.start(prices=(3.0,))[0]
    free = one.start(prices=(1e-4,))[0]
    assert np.linalg.norm(free.target - one.truth) > 100e3
    assert free.slack + np.sum(free.target**2) > 1.5 * np.sum(one.truth**2)
    assert free.answer.primal < 0.1
    assert good.answer.primal > 10.0
    one.sigma[:] = 1.5e4
    drawn = one.start(prices=(3.0,))[0]
    assert np.linalg.norm(drawn.target - one.truth) > 150e3
    assert np.linalg.norm(drawn.target - one.station.mean((0, 1))) < 60e3


def test_what_cannot_be_started():
    one = run(np.random.default_rng(8), 3.0, epochs=60)
    station, z, whiten, _time = one.windows(3)
    assert registration(station, z, whiten, one.sigma, time=np.ones(3)) == ()
    z[0, 0] = np.nan
    assert registration(station, z, whiten, one.sigma) == ()
    for sigma in (np.inf, 0.0, np.nan):
        with pytest.raises(ValueError, match="prior standard deviation"):
            registration(station, z, whiten, np.full(4, sigma))


def least(data, price, start):
    """Return the least cost with the price on the squared distance next to a scaled target: what is relaxed."""
    weight = np.kron(data.power.T @ data.power / len(data.station), np.eye(data.station.shape[2]))
    unit = np.abs(start).max()

    def cost(u):
        return data.cost(unit * u)[0] + price * unit**2 * u @ weight @ u

    return minimize(cost, start / unit, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-9, "maxiter": 2000})


@pytest.mark.full
def test_how_far_from_tight():
    """Writes docs/measured/relaxation_of_runs.md: bound over least cost, and what both leave of the data's cost."""
    lines, trials, windows = [], 12, 6
    for noise in (3.0, 12.0):
        runs = [run(np.random.default_rng(seed), noise) for seed in range(trials)]
        for price in (30.0, 3.0, 0.3, 0.03):
            shares, misfits, ratios, errors, seconds = [], [], [], [], []
            for one in runs:
                station, z, whiten, _ = one.windows(windows)
                data = RegistrationWindows.of(station, z, whiten, one.sigma, None, 0.0, None)
                began = perf_counter()
                (found,) = one.start(windows, prices=(price,))
                seconds.append(perf_counter() - began)
                starts = [((x - data.origin) / data.scale).ravel() for x in (one.truth, found.target)]
                best = min(least(data, price, start).fun for start in starts)
                shares.append(found.answer.primal / best)
                misfits.append(found.misfit / min(least(data, 0.0, start).fun for start in starts))
                ratios.append(found.rank_ratio)
                errors.append(np.linalg.norm(found.target - one.truth))
            assert np.max(shares) < 1.0  # a relaxation
            middle = [f"{np.median(part):.2g}" for part in (shares, misfits, ratios)]
            milliseconds = f"{1e3 * np.median(seconds):.0f}"
            lines.append((f"{noise:g} m, price {price:g}", *middle, f"{np.median(errors):.0f}", milliseconds))
    header = (
        "case", "bound / least cost", "misfit / least misfit", "second / first eigenvalue", "start error, m", "ms",
    )  # fmt: skip
    write("relaxation_of_runs", header, lines, f"seeds 0 to {trials - 1}, medians of {trials} runs of 600 epochs")
