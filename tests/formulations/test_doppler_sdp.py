"""The semidefinite start from Doppler shifts: what it relaxes, starts in the right basin, rows made few."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from formulations import doppler_sdp
from formulations.doppler_sdp import DopplerScene, doppler, doppler_problem
from formulations.normal_points import blocks, normal_points
from formulations.range_height import Ellipsoid, ellipsoid

EARTH = 6371e3


def rates_of(x, place, speed):
    away = x - place
    return -(away * speed).sum(-1) / np.linalg.norm(away, axis=-1)


class Rows:
    """Rows by their nodes, simulated at a source; what is measured, and a refinement of another hand."""

    def __init__(self, place, speed, ranges, rates, design=None, bias=(), sigma=1.0, noise=0.0, seed=0):
        self.place, self.speed = place, speed
        self.ranges, self.rates = (np.array(part, dtype=float) for part in (ranges, rates))
        self.design = np.zeros((len(self.rates), 0)) if design is None else np.array(design, dtype=float)
        self.sigma = np.broadcast_to(np.asarray(sigma, dtype=float), len(self.rates))
        self.bias, self.noise, self.seed = np.array(bias, dtype=float), noise, seed

    def at(self, x):
        return self.ranges @ np.linalg.norm(x - self.place, axis=-1) + self.rates @ rates_of(x, self.place, self.speed)

    def seen(self, x):
        self.z = self.at(x) + self.design @ self.bias
        self.z = self.z + self.noise * self.sigma * np.random.default_rng(self.seed).normal(size=len(self.z))
        return self

    def start(self, **more):
        white = np.diag(1.0 / self.sigma)
        design = self.design if self.design.shape[1] else None
        return doppler(
            self.place, self.speed, self.z, white, ranges=self.ranges, rates=self.rates, design=design, **more
        )

    def refined(self, x, radius=None):
        """The minimum from a start, offsets projected out; on a sphere where a radius is given."""
        white = self.design / self.sigma[:, None]
        basis = np.linalg.qr(white)[0]

        def left(p):
            point = p if radius is None else radius * p / np.linalg.norm(p)
            e = (self.z - self.at(point)) / self.sigma
            return e - basis @ (basis.T @ e)

        unit = np.linalg.norm(x - self.place.mean(0)) if radius is None else 1.0
        first = x if radius is None else x / np.linalg.norm(x)
        done = least_squares(left, first, x_scale=unit, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        return (done.x if radius is None else radius * done.x / np.linalg.norm(done.x)), 2 * done.cost


def receivers(rng, count, d=2, **more):
    """Range-rate differences to the first of some aircraft, and their source."""
    place, speed = rng.uniform(-10e3, 10e3, (count, d)), rng.normal(0, 120, (count, d))
    rates = np.eye(count)[1:] - np.eye(count)[0]
    return Rows(place, speed, 0 * rates, rates, **more), rng.uniform(-30e3, 30e3, d)


def satellite(rng, count=10, seconds=240.0, sigma=1.0, **more):
    """Range rates of a satellite over a ball with an unknown offset, and the emitter on its left or right."""
    radius, rate = EARTH + 780e3, 7460.0 / (EARTH + 780e3)
    turn = rate * np.linspace(-seconds / 2, seconds / 2, count)
    place = radius * np.stack([np.sin(turn), 0 * turn, np.cos(turn)], axis=-1)
    speed = radius * rate * np.stack([np.cos(turn), 0 * turn, -np.sin(turn)], axis=-1)
    along, across = rng.uniform(-0.15, 0.15), rng.uniform(0.03, 0.25) * rng.choice([-1, 1])
    away = [np.sin(along) * np.cos(across), np.sin(across), np.cos(along) * np.cos(across)]
    rows = Rows(place, speed, np.zeros((count, count)), np.eye(count), np.ones((count, 1)), [1500.0], sigma, **more)
    return rows, EARTH * np.array(away)


BALL = Ellipsoid(np.eye(3) / EARTH**2, np.zeros(3))


def mixed(rng, d, surface):
    """Two epochs of five stations: rate differences with an offset, single rates with a drift, range differences."""
    place, speed = rng.uniform(-1, 1, (10, d)) * 1e4, rng.normal(0, 120, (10, d))
    speed[2] = 0.0  # one that stays
    rates, ranges, design = np.zeros((11, 10)), np.zeros((11, 10)), np.zeros((11, 3))
    for m, (a, b) in enumerate([(1, 0), (2, 0), (0, 3), (6, 5), (7, 5), (8, -1), (9, -1)]):
        rates[m, a] = 1.0
        rates[m, b] -= b >= 0
        design[m, 0] = 1.0
        design[m, 1] = m if b < 0 else 0.0
    for m, (a, b) in enumerate([(1, 0), (3, 0), (6, 5), (4, 5)], start=7):
        ranges[m, a], ranges[m, b], design[m, 2] = 1.0, -1.0, 1.0
    sigma = np.where(rates.any(1), 0.1, 10.0)
    rows = Rows(place, speed, ranges, rates, design, [50.0, 3.0, 200.0], sigma, 1.0, 1)
    source = rng.uniform(-2e4, 2e4, d)
    if surface is not None:
        source = source / np.sqrt(source @ surface.shape @ source)
    return rows.seen(source), source


def lifted(scene, x, bias):
    """The vector y of the module's text at a source and biases, in the units of the scene."""
    x = (x - scene.origin) / scene.length
    r = np.linalg.norm(x - scene.place, axis=-1)
    q = rates_of(x, scene.place, scene.speed)
    beta = np.concatenate([(bias - scene.mean) / scene.unit, q[list(scene.shape.second)]])
    return np.concatenate([[1.0], x, beta, r, [beta[j] * r[i] for j, i in scene.shape.product]])


@pytest.mark.parametrize(("d", "surface"), [(2, None), (3, None), (3, ellipsoid([2e4, 2e4, 1.9e4], 100.0))])
def test_any_source_is_a_rank_one_point_at_its_own_cost(d, surface):
    rng = np.random.default_rng(d)
    rows, source = mixed(rng, d, surface)
    white = np.linalg.inv(np.linalg.cholesky(np.diag(rows.sigma**2) + 0.003 * rows.sigma[:, None] * rows.sigma))
    arguments = (rows.place, rows.speed, rows.z, white, rows.ranges, rows.rates, rows.design, surface)
    scene = DopplerScene.of(*arguments)
    assert scene.shape.second
    assert (scene.shape.swaps()[:, 0] < 0).any()
    problem = doppler_problem(scene.shape)
    for _ in range(3):
        x = source * rng.uniform(0.8, 1.2) if surface is None else rng.normal(size=d)
        x = x if surface is None else x / np.sqrt(x @ surface.shape @ x)
        bias, far = rows.bias + rng.normal(0, [5, 0.5, 20]), np.where(scene.pivot < 0, 1.0, rng.uniform(0.5, 2, 11))
        given, size = scene.parameters(far, 10.0)
        for parameter in problem.parameters():
            parameter.value = given[parameter.name()]
        y = lifted(scene, x, bias)
        problem.variables()[0].value = np.outer(y, y)
        for rule in problem.constraints:
            assert np.max(rule.violation()) < 1e-8 * np.max(np.abs(y)) ** 2
        ratio = np.where(scene.pivot < 0, 1.0, np.linalg.norm(x - rows.place[scene.pivot], axis=1) / scene.length / far)
        left = white @ (ratio * (rows.z - rows.at(x) - rows.design @ bias))
        assert problem.objective.value * size == pytest.approx(left @ left, rel=1e-7)


def test_the_value_is_below_the_weighted_cost_everywhere():
    rng = np.random.default_rng(5)
    for d in (2, 3):
        rows, source = receivers(rng, 6, d, sigma=30.0, noise=1.0)  # noise of a quarter of the speeds: a value to see
        found = rows.seen(source).start(reach=5.0)
        assert found.answer.solved
        assert 0.0 <= found.bound <= found.value * (1 + 1e-6) + 1e-6
        held = rows.place[doppler_sdp._nodes_of_rows(rows.rates, rows.speed)[0]]
        for x in rng.uniform(-15e3, 15e3, (200, d)):
            ratio = np.linalg.norm(x - held, axis=1) / found.far
            cost = (((ratio * (rows.z - rows.at(x))) / rows.sigma) ** 2).sum()
            assert found.value <= cost * (1 + 1e-6) + 1e-6


def reached(trials, make, radius=None, **more):
    """How many of some noise-free scenes have a start that is refined to a source that fits."""
    count = 0
    for seed in range(trials):
        rows, source = make(np.random.default_rng(seed))
        found = rows.seen(source).start(**more)
        count += any(rows.refined(x, radius)[1] < 1e-8 for x in found.point)
    return count


def test_starts_lead_to_a_source_that_fits():
    assert reached(12, lambda rng: receivers(rng, 4)) >= 11
    assert reached(8, lambda rng: receivers(rng, 6, 3)) >= 7
    assert reached(3, lambda rng: satellite(rng, 8), EARTH, surface=BALL) == 3


@pytest.mark.full
def test_starts_lead_to_a_source_that_fits_in_more_scenes():
    assert reached(100, lambda rng: receivers(rng, 4)) >= 98
    assert reached(100, lambda rng: receivers(rng, 6, 3)) >= 98
    assert reached(40, satellite, EARTH, surface=BALL) == 40


def test_both_sides_of_a_pass_are_among_the_starts():
    for seed in range(2):
        rows, source = satellite(np.random.default_rng(seed), count=8)
        found = rows.seen(source).start(surface=BALL)
        np.testing.assert_allclose(np.linalg.norm(found.point, axis=1), EARTH)
        ends = np.array([rows.refined(x, EARTH)[0] for x in found.point])
        for place in (source, source * [1, -1, 1]):
            assert np.linalg.norm(ends - place, axis=1).min() < 1.0


def test_range_differences_beside_make_it_sharper():
    error = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rows, source = receivers(rng, 5, 3, noise=1.0, sigma=0.1)
        alone = rows.seen(source).start()
        both = Rows(
            rows.place,
            rows.speed,
            np.concatenate([rows.ranges, rows.rates]),
            np.concatenate([rows.rates, rows.ranges]),
            sigma=np.repeat([0.1, 30.0], 4),
            noise=1.0,
        )
        error.append([np.linalg.norm(one.point[0] - source) for one in (alone, both.seen(source).start())])
    alone, both = np.median(error, axis=0)
    assert both < 0.5 * alone


def test_neither_unit_nor_origin_nor_axes_nor_signs_matter():
    rng = np.random.default_rng(8)
    rows, source = receivers(rng, 6, 3, sigma=0.1, noise=1.0)
    rows.design, rows.bias = np.ones((5, 1)), np.array([300.0])
    plain = rows.seen(source).start()
    turn, move = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.array([3e6, -2e6, 5e6])
    other = doppler(
        (rows.place @ turn.T + move) / 1e3,
        rows.speed @ turn.T / 1e3,
        -rows.z / 1e3,
        1e4 * np.eye(5),
        ranges=rows.ranges,
        rates=-rows.rates,
        design=-rows.design / 1e3,
    )
    # not tight, it is flat at its optimum: both stop within 2 % of the size of the array
    np.testing.assert_allclose((other.point[0] * 1e3 - move) @ turn, plain.point[0], atol=300.0)
    np.testing.assert_allclose(other.unknown, plain.unknown, atol=3.0)


def test_joined_rows_lead_to_the_same_places_as_all():
    for seed in range(2):
        rng = np.random.default_rng(seed)
        rows, source = satellite(rng, count=10, noise=1.0, seed=seed)
        every = rows.seen(source).start(surface=BALL)
        time = np.linspace(-120, 120, 10)
        row, z, sigma = normal_points(time, rows.z, rows.sigma, blocks(time, 2))
        some, one = np.zeros((5, 5)), np.ones((5, 1))
        few = doppler(
            rows.place[row],
            rows.speed[row],
            z,
            np.diag(1 / sigma),
            ranges=some,
            rates=np.eye(5),
            design=one,
            surface=BALL,
        )
        ends = [np.array([rows.refined(x, EARTH)[0] for x in found.point]) for found in (every, few)]
        for end in ends[0]:
            assert np.linalg.norm(ends[1] - end, axis=1).min() < 1.0


def test_what_cannot_be_started_is_nan(monkeypatch):
    rng = np.random.default_rng(10)
    rows, source = receivers(rng, 4)
    rows.seen(source)
    rows.z[0] = np.nan
    found = rows.start()
    assert np.isnan(found.point).all()
    assert found.point.shape == (5, 2)
    assert found.answer is None
    # all at one place, and at rest: anything but an exception
    for place, speed in ((np.zeros((4, 2)), rows.speed), (rows.place, np.zeros((4, 2)))):
        still = Rows(place, speed, rows.ranges, rows.rates)
        still.z = np.array([1.0, 2.0, -3.0])
        assert still.start().point.shape == (5, 2)
    plain = doppler_sdp._relaxation(DopplerScene.of(*_arguments(rows)).shape, "CLARABEL")

    def lost(values, **more):
        answer = type(plain).solve(plain, values, **more)
        answer.values["lift"][:] = np.nan
        return answer

    monkeypatch.setattr(doppler_sdp, "_relaxation", lambda *_: type("Lost", (), {"solve": staticmethod(lost)}))
    assert np.isnan(rows.seen(source).start().point).all()


def _arguments(rows):
    return rows.place, rows.speed, np.zeros(3), np.eye(3), rows.ranges, rows.rates, rows.design, None


def test_rows_of_another_form_are_refused():
    with pytest.raises(ValueError, match="the difference of two"):
        doppler(np.eye(2), np.eye(2), [1.0], np.eye(1), ranges=np.zeros((1, 2)), rates=[[1.0, 1.0]])
