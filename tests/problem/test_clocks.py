"""Clocks that wander: what is estimated of them is right, is what its covariance says, and costs what it may."""

from dataclasses import replace

import numpy as np
import pytest
from often import few

import optloc
from optloc.base.errors import InvalidProblem
from optloc.files import load
from optloc.linear.walks import state_columns, walks
from optloc.problem.bias import with_bias, with_known_bias
from optloc.problem.clocks import clock_densities, greville, process, spline_weights
from tests.monte_carlo.tables import write

RNG = np.random.default_rng(20261123)
TARGET = np.array([4e3, 3e3, 1e3])


def run(epochs, *, seconds=10.0, sigma=3.0):
    """Return a run of four range differences an epoch, of stations that circle around a target."""
    t = seconds * np.arange(epochs)
    angle, turn = np.array([0.0, 1.3, 2.6, 3.8, 5.0]), (t / t[-1])[:, None]
    height = np.array([1.0, 4.0, 0.7, 3.0, 5.0]) * 1e3 * (1.0 + 0.5 * np.cos(3.0 * turn + angle))
    place = np.stack([9e3 * np.cos(angle + 1.5 * turn), 9e3 * np.sin(angle + 1.5 * turn), height], axis=-1)
    rows = optloc.measured(
        "tdoa", a=np.tile([1, 2, 3, 4], epochs), b=0, epoch=np.repeat(np.arange(epochs), 4), sigma=sigma
    )
    return optloc.assemble(place, rows, times=t)


def walking(epochs, **change):
    plain = run(epochs)
    return with_bias(plain, "clock", members=list(plain.stations.names[1:]), form="walk", **change)


def drawn(problem, seed, trials=None, begin=(40.0, -80.0, 120.0, 10.0)):
    """Return measurements of a problem, and the truth that they are of."""
    truth = np.zeros(problem.layout.size)
    truth[:3] = TARGET
    base = problem.layout.n_shared
    for bias in walks(problem):
        truth[base + state_columns(problem.layout, bias)[:, 0]] = begin
    truth = optloc.engine.simulate_walks(problem, truth, seed, trials)
    return optloc.simulate(problem, truth, seed + 1), truth


# Walks.


def test_a_walk_that_is_estimated_is_noise_that_is_correlated():
    """The position and its covariance are those of offsets under noise that holds the walk, made of its definition."""
    density, k = 0.09, 25
    problem, _ = drawn(walking(k, density=density), 3)
    fix = optloc.solve(problem)
    plain = with_bias(replace(problem, biases=()), "clock", members=problem.biases[0].members)
    # a random walk from zero has the covariance density min(t, t')
    together = density * np.minimum.outer(problem.times, problem.times)
    station = np.tile(np.arange(4), k)
    noise = 9.0 * np.eye(plain.count) + np.where(
        station[:, None] == station, together[np.ix_(plain.epoch, plain.epoch)], 0.0
    )
    rows = replace(
        plain, noise=optloc.problem.Noise((optloc.problem.Block(np.arange(plain.count)[None], noise[None]),))
    )
    other = optloc.solve(rows, "lsr", start=np.concatenate([fix.position, fix.take("clock")[0]]))
    np.testing.assert_allclose(fix.position, other.position, atol=1e-4)
    np.testing.assert_allclose(fix.covariance(), other.covariance(), rtol=1e-6)
    np.testing.assert_allclose(fix.cost, other.cost, rtol=1e-8)
    assert fix.dof == other.dof == problem.count - 7
    np.testing.assert_allclose(optloc.crlb(problem, fix.x), fix.cov, rtol=1e-6)


def test_the_bound_against_time_is_that_of_the_first_epochs():
    problem, truth = drawn(walking(30, density=0.04, sigma=100.0), 5)
    course = optloc.bounds.crlb_course(problem, truth, [10, 20, 30])
    first = optloc.problem.cut(problem, 0, 20)
    np.testing.assert_allclose(course.covariance[1], optloc.crlb(first, truth[: first.layout.size]), rtol=1e-8)
    np.testing.assert_allclose(course.covariance[2], optloc.crlb(problem, truth), rtol=1e-8)
    assert (np.diff(course.total("position")) < 0.0).all()


def test_refinements_agree_and_a_prior_holds_where_a_walk_begins():
    problem, _ = drawn(walking(12, density=0.04, rate_density=1e-6, sigma=0.5, mean=[40.0, -80.0, 120.0, 10.0]), 5)
    fix = optloc.solve(problem, "roots+lsr")
    other = optloc.solve(problem, "roots+nlp")
    np.testing.assert_allclose(other.position, fix.position, atol=1e-3)
    np.testing.assert_allclose(other.take("clock"), fix.take("clock"), atol=1e-3)
    np.testing.assert_allclose(other.cost, fix.cost, rtol=1e-7)
    assert (fix.sigma("clock")[0] <= 0.5).all()
    assert fix.dof == problem.count - 3 - 4


def test_known_walks_and_splines_leave_the_problem():
    for change in ({"form": "walk", "density": 0.04}, {"form": "spline", "knots": 4}):
        problem = with_bias(run(20), "clock", members=["S2", "S3"], **change)
        truth = np.zeros(problem.layout.size)
        truth[:3] = TARGET
        truth[3:] = 30.0 * RNG.standard_normal(len(truth) - 3)
        values = problem.layout.take(truth, "clock")
        expected = optloc.engine.predict(problem, truth)
        known = with_known_bias(problem.with_rows(z=expected), "clock", values)
        assert not known.biases
        np.testing.assert_allclose(known.observed, optloc.engine.predict(known, TARGET), atol=1e-9)


def nees(order, trials, seed):
    """Return NEES over degrees of freedom of the position and of clocks at three epochs, and their 99 % bands."""
    change = {"density": 0.04} if order == 1 else {"density": 0.01, "rate_density": 1e-7}
    problem, truth = drawn(walking(24, **change), seed, trials)
    fix = optloc.solve(problem, "roots+lsr")
    assert np.isfinite(fix.x).all()
    error = fix.position - TARGET
    found = {"position": _nees(error, fix.covariance())}
    clocks = fix.take("clock") - problem.layout.take(truth, "clock")
    for k in (0, 12, 23):
        found[f"clocks at epoch {k}"] = _nees(clocks[:, k], fix.covariance("clock")[:, k])
    from scipy.stats import chi2

    out = {}
    for name, (values, size) in found.items():
        low, high = chi2.ppf([0.005, 0.995], size * trials) / (size * trials)
        out[name] = float(values.mean() / size), float(low), float(high)
    return out


def _nees(error, covariance):
    return (error[:, None] @ np.linalg.inv(covariance) @ error[..., None])[:, 0, 0], error.shape[-1]


@pytest.mark.parametrize("order", few([1, 2], 1))
def test_clocks_and_positions_are_as_certain_as_is_said(order):
    for name, (value, low, high) in nees(order, 50, 40 + order).items():
        assert low < value < high, (name, value)


@pytest.mark.full
def test_clocks_and_positions_are_as_certain_as_is_said_over_500_runs():
    rows = []
    for order, name in ((1, "random walk"), (2, "integrated random walk")):
        for what, (value, low, high) in nees(order, 500, 60 + order).items():
            rows.append((f"{name}: {what}", f"{value:.3f}", f"{low:.3f}", f"{high:.3f}"))
            assert low < value < high, rows[-1]
    header = ("NEES over degrees of freedom", "500 runs", "99 %: from", "to")
    write("clocks", header, rows, "24 epochs of 4 range differences of 3 m, seeds 61 and 62")


def test_steps_have_the_variance_of_their_definition():
    problem = walking(400, density=0.04, rate_density=1e-4)
    x = optloc.engine.simulate_walks(problem, np.zeros(problem.layout.size), 4)
    value, rate = (problem.layout.take(x, name) for name in ("clock", "clock rate"))
    F, Q = process(problem.biases[0], problem.times)
    state = np.stack([value, rate], axis=-1)
    step = state[1:] - (F[:, None] @ state[:-1, :, :, None])[..., 0]
    # 1600 steps: their covariance is known to 3.5 %
    np.testing.assert_allclose(np.cov(step.reshape(-1, 2).T), Q[0, 0], rtol=0.15)
    # from the sum of many short steps of white noise, by its definition
    assert Q[0, 0, 0, 0] == pytest.approx(0.04 * 10 + 1e-4 * 10**3 / 3)


def test_allan_deviations_become_densities_and_walks_have_these_deviations():
    tau = np.array([1.0, 4.0, 16.0, 64.0])
    density, rate_density = 4e-2, 1e-4
    speed = 299792458.0
    allan = np.sqrt(density / tau + rate_density * tau / 3.0) / speed
    np.testing.assert_allclose(clock_densities(tau, allan), (density, rate_density), rtol=1e-9)
    assert clock_densities(10.0, 1e-10) == (pytest.approx(speed**2 * 1e-19), 0.0)
    # second differences of the error over tau: Allan's definition
    plain = run(4000, seconds=1.0)
    problem = with_bias(plain, "clock", members=["S2", "S3"], form="walk", density=density, rate_density=rate_density)
    x = problem.layout.take(optloc.engine.simulate_walks(problem, np.zeros(problem.layout.size), 8), "clock")
    for n, expected in zip((1, 4, 16), allan, strict=False):
        second = x[2 * n :] - 2.0 * x[n:-n] + x[: -2 * n]
        assert np.sqrt(np.mean(second**2) / 2.0) / n / speed == pytest.approx(expected, rel=0.1)


# Splines.


def test_a_walk_and_a_spline_begin_together_on_both_sides_of_a_line_of_stations():
    k, x = 40, np.array([-900.0, -300.0, 100.0, 500.0, 1000.0])
    rows = optloc.measured("tdoa", a=np.tile([1, 2, 3, 4], k), b=0, epoch=np.repeat(np.arange(k), 4), sigma=3.0)
    place = np.stack([x, np.zeros(5)], axis=-1)
    problem = optloc.assemble(place, rows, times=2.0 * np.arange(k), motions=(optloc.Motion(1),))
    problem = with_bias(problem, "walk", members=["S2"], form="walk", density=0.5, rate_density=0.01, sigma=5.0)
    problem = with_bias(problem, "spline", members=["S3"], form="spline", knots=3)
    truth = np.zeros(problem.layout.size)
    truth[:4] = 300.0, 400.0, 1.0, -2.0
    fix = optloc.solve(optloc.simulate(problem, optloc.engine.simulate_walks(problem, truth, 1), 2))
    assert fix.status == optloc.Status.AMBIGUOUS
    np.testing.assert_allclose(fix.x[:4] * [1.0, -1.0, 1.0, -1.0], fix.alternatives.x[0, :4], rtol=1e-5)


def test_a_spline_is_one_and_a_straight_line_where_its_coefficients_are():
    problem = with_bias(run(30), "clock", members=["S2"], form="spline", knots=[-5.0, 20.0, 100.0, 200.0, 300.0])
    bias = problem.biases[0]
    entry, factor = spline_weights(bias.knots, problem.times)
    np.testing.assert_allclose(factor.sum(1), 1.0)
    np.testing.assert_allclose((factor * greville(bias)[entry]).sum(1), problem.times, atol=1e-9)
    assert problem.layout.find("clock")[0].entries[0] == "S2 at -5 s"


def test_a_spline_follows_a_clock_that_bends():
    beacon = np.broadcast_to([1e3, 2e3, 0.0], (1, 1, 3))
    plain = run(60)
    (rows,) = plain.rows
    # a transponder at a known place besides: without it slow clocks are slow motions
    both = replace(
        plain,
        rows=(
            replace(
                rows,
                **{n: np.tile(getattr(rows, n), 2) for n in ("a", "b", "epoch", "z", "weight", "correction")},
                target=np.repeat([0, 1], rows.count),
            ),
        ),
        motions=(optloc.Motion(), optloc.Motion(known=beacon)),
        noise=optloc.problem.independent(np.full(2 * rows.count, 9.0)),
    )
    problem = with_bias(both, "clock", members=["S1", "S2", "S3", "S4"], form="spline", knots=6)
    truth = np.concatenate([TARGET, np.zeros(problem.layout.size - 3)])
    wave = 60.0 * np.sin(2.0 * np.pi * problem.times / 600.0)
    z = optloc.simulate(problem, truth, 12).z + wave[problem.epoch]
    fix = optloc.solve(problem.with_rows(z=z))
    assert fix.p_value > 1e-3
    error = fix.take("position[0]") - TARGET
    assert error @ np.linalg.inv(fix.covariance("position[0]")) @ error < 20.0
    entry, factor = spline_weights(problem.biases[0].knots, problem.times)
    shape = fix.take("clock").reshape(4, -1)
    assert np.abs((factor * shape[0][entry]).sum(1) - wave).max() < 5.0


# What cannot be meant.


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"form": "walk"}, "needs a spectral density"),
        ({"form": "walk", "density": -1.0}, "density is not positive"),
        ({"form": "walk", "density": [1.0, 2.0]}, "give one, or one for each of 4"),
        ({"form": "offset", "density": 1.0}, "the form offset has no density"),
        ({"form": "spline"}, "needs knots"),
        ({"form": "spline", "knots": 1}, "1 knots"),
        ({"form": "spline", "knots": [0.0, 50.0]}, "the run lasts from 0 to 90 s"),
        ({"form": "walk", "knots": 3, "density": 1.0}, "the form walk has no knots"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, words):
    with pytest.raises(InvalidProblem, match=words):
        with_bias(run(10), "clock", members=["S1", "S2", "S3", "S4"], **change)


def test_what_adds_up_epochs_refuses_walks():
    problem, _ = drawn(walking(12, density=0.04), 5)
    with pytest.raises(InvalidProblem, match="links each epoch to the next"):
        optloc.solvers.Running.begin(problem, optloc.solve(problem, "roots+lsr"))
    one = optloc.assemble(np.eye(3), optloc.measured("range", a=[0, 1, 2], sigma=1.0))
    with pytest.raises(InvalidProblem, match="needs several epochs"):
        with_bias(one, "clock", form="walk", density=1.0)


# Files.

SITE = """
format = 1
[stations]
rows = [{name = "A", x = 0, y = 0}, {name = "B", x = 9000, y = 0}, {name = "C", x = 0, y = 9000},
        {name = "D", x = 9000, y = 8000}]
[[measurements]]
kind = "tdoa"
unit = "ns"
arrival_sigma = 10.0
b = "A"
rows = [ROWS]
[target]
motion = "static"
[targets.beacon]
motion = "known"
rows = [{x = 5000, y = 3000}]
[[biases]]
name = "clock"
members = ["B", "C", "D"]
"""


def site(tmp_path, lines):
    """Return the problem of a file: a ship, and a transponder at a known place, for two minutes."""
    place = {"A": (0, 0), "B": (9e3, 0), "C": (0, 9e3), "D": (9e3, 8e3)}
    rng, rows, clock = np.random.default_rng(3), [], {"B": 100.0, "C": -50.0, "D": 300.0}
    for k in range(13):
        for a in "BCD":
            clock[a] += 3.0 * rng.standard_normal()
            for target, at in (("ship", (2e3, 6e3)), ("beacon", (5e3, 3e3))):
                far = np.hypot(*np.subtract(at, place[a])) - np.hypot(*np.subtract(at, place["A"]))
                z = far / 0.299792458 + clock[a] + 14.0 * rng.standard_normal()
                rows.append(f'{{time = {10.0 * k}, target = "{target}", a = "{a}", z = {z:.3f}}}')
    path = tmp_path / "site.toml"
    path.write_text(SITE.replace("ROWS", ",\n".join(rows)) + lines)
    return load(path)


def test_a_file_says_how_clocks_walk(tmp_path):
    walk = site(tmp_path, 'form = "walk"\ndensity = "0.9 ns^2/s"\n')
    np.testing.assert_allclose(walk.biases[0].density, 0.9 * 0.299792458**2)
    fix = optloc.solve(walk)
    error = fix.take("position[1]") - [2e3, 6e3]
    assert error @ np.linalg.inv(fix.covariance("position[1]")) @ error < 14.0
    assert fix.take("clock").shape == (13, 3)
    allan = site(tmp_path, 'form = "walk"\nallan = [[1.0, 1e-9], [100.0, 2e-10]]\n')
    assert allan.biases[0].density.shape == (3, 2)
    np.testing.assert_allclose(allan.biases[0].density[0], clock_densities([1.0, 100.0], [1e-9, 2e-10]))
    spline = site(tmp_path, 'form = "spline"\nknots = 3\nsigma = "500 ns"\n')
    assert spline.biases[0].sigma.shape == (3, 5)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('form = "walk"\ndensity = "0.9 ns/s"\n', "is not a density"),
        ('form = "walk"\ndensity = "1 m^2/s"\nallan = [[1.0, 1e-9]]\n', "and densities are both given"),
        ('form = "walk"\nallan = [[1.0]]\n', "not two numbers"),
        ('form = "walk"\n', "needs a spectral density"),
        ('form = "spline"\nknots = [0.0, 60.0]\n', "beyond the knots"),
        ("knots = 3\n", "the form offset has no knots"),
    ],
)
def test_a_file_that_says_it_wrongly_is_refused(tmp_path, lines, words):
    with pytest.raises(InvalidProblem, match=words):
        site(tmp_path, lines)


def test_an_aircraft_that_reports_lets_unsynchronised_receivers_fix_others():
    """Six receivers on the ground with walking clocks; one aircraft's places are known, another's course is not."""
    stations = 1e3 * np.array(
        [[0, 0, 0.1], [40, 5, 0.3], [12, 38, 0.6], [-35, 22, 0.2], [-28, -30, 0.4], [25, -33, 0.8]]
    )
    times, trials = 4.0 * np.arange(30), 40
    reported = np.array([-30e3, 10e3, 10.2e3]) + times[:, None] * np.array([210.0, -60.0, 0.0])
    rows = optloc.measured(
        "tdoa",
        a=np.tile([1, 2, 3, 4, 5], 60),
        b=0,
        epoch=np.repeat(np.arange(30), 10),
        target=np.tile(np.repeat([0, 1], 5), 30),
        arrival_sigma=15.0,
    )
    motions = (optloc.Motion(order=1), optloc.Motion(known=reported[:, None]))
    plain = optloc.assemble(stations, rows, times=times, motions=motions)
    model = with_bias(plain, "clock", form="walk", members=plain.stations.names[1:], density=81.0)
    begin = np.zeros((30, 5))
    begin[0] = [350.0, -820.0, 130.0, 610.0, -240.0]
    silent = np.array([18e3, 24e3, 7.6e3, -150.0, -110.0, 0.0])
    data = optloc.simulate(
        model, optloc.engine.simulate_walks(model, np.concatenate([silent, begin.ravel()]), 3, trials), 4
    )
    fix = optloc.solve(data)
    assert (fix.code == optloc.Status.UNPROVEN).sum() >= trials - 1  # one in a thousand may be told a misfit
    error = fix.x[:, :6] - silent
    from scipy.stats import chi2

    low, high = chi2.ppf([0.005, 0.995], 6 * trials) / (6 * trials)
    assert low < np.mean(_nees(error, fix.cov[:, :6, :6])[0]) / 6.0 < high
    still = optloc.solve(with_bias(plain.with_rows(z=data.z[:4]), "clock", members=plain.stations.names[1:]))
    assert (still.code == optloc.Status.MISFIT).all()
