"""Doppler rows: range rates of single stations and their differences, in files and in memory, of targets that move."""

import json
import tomllib
from dataclasses import replace
from importlib.resources import files as resources

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

import optloc
from optloc import InvalidProblem, Motion, assemble, measured, simulate, solve, with_bias
from optloc.bounds.cramer_rao import crlb
from optloc.cli import app
from optloc.files import load, read
from optloc.linear.normal import linearise, normal
from optloc.models import MODELS, Point, distance
from optloc.problem import ECEF, noise as noises
from optloc.tracking import begun, followed, polynomial

C, CARRIER = 299_792_458.0, 1090e6
RUN = CliRunner()
STARTERS = resources("optloc") / "starters"
PLACE = np.array([[-6e3, -4e3], [7e3, -5e3], [5e3, 8e3], [-8e3, 6e3], [300.0, -7e3]])
RATE = np.array([[60.0, 130.0], [-140.0, 40.0], [-90.0, -110.0], [120.0, -70.0], [30.0, 90.0]])
TARGET = np.array([1500.0, 900.0])
# Each receiver's own frequency error, m/s.
SPREAD = np.array([0.1, 0.4, 0.2, 0.3, 0.25])


def flying():
    return optloc.station_array(PLACE, velocity=RATE)


# ---------------------------------------------------------------------------------------------------------- h
@pytest.mark.parametrize("kind", ["range_rate", "fdoa"])
@pytest.mark.parametrize("d", [2, 3])
def test_a_rate_is_the_change_of_ranges_along_the_motion(kind, d):
    rng, step = np.random.default_rng(1), 1e-3
    place, rate = rng.normal(0.0, 8e3, (3, d, 50)), rng.normal(0.0, 200.0, (3, d, 50))

    def value(t):
        ranges = [distance(Point(tuple(place[0] + t * rate[0])), Point(tuple(place[i] + t * rate[i]))) for i in (1, 2)]
        return ranges[0] - (ranges[1] if kind == "fdoa" else 0.0)

    points = [Point(tuple(place[i]), tuple(rate[i])) for i in range(3)]
    assert np.allclose(MODELS[kind].h(*points), (value(step) - value(-step)) / (2.0 * step), atol=1e-5)


def test_a_receding_emitter_has_a_positive_rate_and_a_lower_frequency(tmp_path):
    """The exact formula of a moving source, f = f_c / (1 + v / c), differs from that of a file by (v / c)^2 only."""
    text = f"""
        format = 1
        stations.rows = [{{ name = "A", x = 0.0, y = 0.0, vx = -300.0, vy = 0.0 }}]
        measurements = [{{ kind = "range_rate", unit = "Hz", carrier_hz = {CARRIER}, sigma = 1.0, a = "A",
          rows = [{{ z = {CARRIER / (1.0 + 300.0 / C) - CARRIER!r} }}] }}]
    """
    path = tmp_path / "one.toml"
    path.write_text(text.replace("\n          ", " "))
    point, station = Point((5e3, 0.0), (0.0, 0.0)), Point((0.0, 0.0), (-300.0, 0.0))
    assert MODELS["range_rate"].h(point, station, station) == 300.0
    assert load(path).z[0] == pytest.approx(300.0, abs=2.0 * 300.0**2 / C)


# ------------------------------------------------------------------------------------------------------- files
def in_metres(text, kind):
    """Return a starter with its values and noise in m/s."""
    table = next(t for t in tomllib.loads(text)["measurements"] if t["kind"] == kind)
    size = -C / table["carrier_hz"]
    head, mark, tail = text.partition('unit = "Hz"')
    assert mark
    rows, end, rest = tail.partition("]\n")
    lines = []
    for line in rows.splitlines():
        key, _, value = line.partition(" = ")
        before, mark, z = line.partition("z = ")
        if key in ("sigma", "arrival_sigma"):
            lines.append(f"{key} = {abs(size) * float(value.split()[0])!r}")
        elif mark and key != "carrier_hz":
            lines.append(f"{before}z = {size * float(z.split()[0])!r} }},")
        elif key != "carrier_hz":
            lines.append(line)
    return f'{head}unit = "m/s"' + "\n".join(lines) + end + rest


@pytest.mark.parametrize("kind", ["range_rate", "fdoa"])
def test_hertz_beside_their_carrier_are_metres_per_second(kind, tmp_path):
    text = (STARTERS / f"{kind}.toml").read_text()
    path = tmp_path / "rates.toml"
    path.write_text(in_metres(text, kind))
    one, two = load(STARTERS / f"{kind}.toml"), load(path)
    assert np.allclose(one.z, two.z, rtol=1e-14)
    rows = np.arange(one.count)
    assert np.allclose(noises.dense(one.noise, rows), noises.dense(two.noise, rows), rtol=1e-14)


@pytest.mark.parametrize("name", ["range_rate", "fdoa", "tdoa_fdoa"])
def test_a_simulation_is_written_in_the_units_and_signs_of_its_file(name, tmp_path):
    site, drawn = STARTERS / f"{name}.toml", tmp_path / "drawn.toml"
    place = ["1500,900,400", "--velocity", "60,-35,5"] if name == "tdoa_fdoa" else ["1500,900"]
    at = ["47.83,11.21,650", "--geodetic"] if name == "range_rate" else place
    made = RUN.invoke(app, ["simulate", str(site), "--truth", *at, "--seed", "3", "--out", str(drawn)])
    assert made.exit_code == 0, made.output
    one, two = load(site), load(drawn)
    assert one.structure == two.structure
    assert [t["unit"] for t in tomllib.loads(drawn.read_text())["measurements"]][-1] == "Hz"
    # another draw of the same noise; of the pass without the emitter's offset
    off = two.z - one.z
    off = off - off.mean() if name == "range_rate" else off
    white = np.concatenate([w.apply(off[:, None])[:, 0] for w in noises.whiten(one.noise, one.weight)])
    assert (np.abs(white) < 6.0 * np.sqrt(2.0)).all()
    assert np.abs(white).max() > 0.5


PASS = (STARTERS / "range_rate.toml").read_text()


def passing(tmp_path, *changes):
    text = PASS
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "pass.toml"
    path.write_text(text)
    return path


def test_offset_and_drift_of_a_frequency_have_their_units(tmp_path):
    name = 'name = "frequency"  '
    prior = f'mean = "700 Hz"\nsigma = "2000 Hz"\n{name}'
    drift = '\n[[biases]]\nname = "drift"\nform = "drift"\nper = "kind"\nmean = "-0.1 Hz/s"\nsigma = "0.5 Hz/s"\n'
    made = read(passing(tmp_path, (name, prior), ("\n[[constraints]]", f"{drift}\n[[constraints]]")))
    size, (offset, slope) = -C / 1626.27e6, made.problem.biases
    assert np.allclose([offset.mean[0], offset.sigma[0]], [700.0 * size, 2000.0 * abs(size)])
    assert np.allclose([slope.mean[0], slope.sigma[0]], [-0.1 * size, 0.5 * abs(size)])
    assert made.bias_units == {"frequency": ("Hz", size), "drift": ("Hz/s", size)}
    told = RUN.invoke(app, ["check", str(tmp_path / "pass.toml")])
    assert "prior 2000 Hz" in (words := " ".join(told.stdout.replace("│", " ").split()))
    assert "prior 0.5 Hz/s" in words


def test_a_prior_in_hertz_needs_one_carrier(tmp_path):
    table = PASS[PASS.index("[[measurements]]") : PASS.index("[[biases]]")]
    other = table.replace("1626.27e6", "1625e6").replace(" },", "5 },")
    name = 'name = "frequency"  '
    path = passing(tmp_path, ('[[biases]]\nname = "freq', other + '[[biases]]\nname = "freq'))
    assert read(path).bias_units == {}  # no one unit to read it in
    path = passing(
        tmp_path, ('[[biases]]\nname = "freq', other + '[[biases]]\nname = "freq'), (name, 'sigma = "9 Hz"\n' + name)
    )
    with pytest.raises(InvalidProblem, match="several carriers; give the value in m/s"):
        read(path)


def test_a_bias_is_told_in_the_unit_of_the_file():
    """On the screen; JSON stays in SI."""
    words = ["crlb", str(STARTERS / "range_rate.toml"), "--at", "47.83,11.21,650", "--geodetic"]
    found = json.loads(RUN.invoke(app, [*words, "--json"]).stdout)
    (sigma,) = next(bound["sigma"] for bound in found["bounds"] if bound["unknown"] == "frequency")
    assert f"range_rate: {sigma * 1626.27e6 / C:.4g} Hz" in RUN.invoke(app, words).stdout


# -------------------------------------------------------------------------------------- receivers share errors
def frequencies(epochs=1):
    """Return the frequencies that five receivers measure, and all their differences to the first, of one draw."""
    a, k = np.tile(np.arange(5), epochs), np.repeat(np.arange(epochs), 5)
    single = assemble(flying(), measured("range_rate", a=a, epoch=k, sigma=SPREAD[a]))
    single = simulate(single, TARGET, 4)
    z = single.z.reshape(epochs, 5)
    b, j = np.tile(np.arange(1, 5), epochs), np.repeat(np.arange(epochs), 4)
    rows = measured("fdoa", (z[:, 1:] - z[:, :1]).ravel(), a=b, b=0, epoch=j, arrival_sigma=SPREAD)
    return single, assemble(flying(), rows)


@pytest.mark.parametrize("epochs", [1, 3])
def test_correlated_differences_weigh_like_frequencies_with_an_unknown_common_one(epochs):
    """z_a - z_0 with cov D diag(s^2) D' is z_a with cov diag(s^2), an offset of the epoch projected out."""
    single, paired = frequencies(epochs)
    for x in TARGET + np.random.default_rng(2).normal(0.0, 3e3, (20, 2)):
        one = normal(linearise(paired, x), epochs)
        # by hand: rows of each epoch with a column of ones, eliminated
        weight = 1.0 / SPREAD**2
        line = x - PLACE
        r = np.linalg.norm(line, axis=1)
        u = line / r[:, None]
        rate = -(u * RATE).sum(1)
        slope = -(RATE - (u * RATE).sum(1)[:, None] * u) / r[:, None]
        information, vector, cost = np.zeros((2, 2)), np.zeros(2), 0.0
        P = np.diag(weight) - np.outer(weight, weight) / weight.sum()
        for z in single.z.reshape(epochs, 5):
            e = z - rate
            information += slope.T @ P @ slope
            vector += slope.T @ P @ e
            cost += e @ P @ e
        assert np.allclose(one.shared, information, rtol=1e-9, atol=1e-9 * np.abs(information).max())
        assert np.allclose(one.shared_vector, vector, rtol=1e-9, atol=1e-9 * np.abs(vector).max())
        assert one.cost == pytest.approx(cost, rel=1e-9)


def test_the_fix_of_correlated_differences_is_that_of_the_frequencies():
    single, paired = frequencies()
    common = with_bias(single, "frequency", per="kind")
    one = solve(common, start=np.append(TARGET, 0.0))
    two = solve(paired, start=TARGET)
    assert np.allclose(one.position, two.position, rtol=0.0, atol=1e-6)
    assert np.allclose(one.cov[:2, :2], two.cov, rtol=1e-8)
    assert (one.dof, one.cost) == (two.dof, pytest.approx(two.cost, rel=1e-9))


def test_a_file_says_the_same_of_shared_errors(tmp_path):
    rows = "".join(f'{{ a = "{a}", z = 1.0 }}, ' for a in "BCDE")
    sigma = ", ".join(f"{name} = {s}" for name, s in zip("ABCDE", SPREAD, strict=True))
    places = ", ".join(
        f'{{ name = "{name}", x = {p[0]}, y = {p[1]}, vx = {v[0]}, vy = {v[1]} }}'
        for name, p, v in zip("ABCDE", PLACE, RATE, strict=True)
    )
    path = tmp_path / "five.toml"
    head = f'format = 1\nstations = {{ rows = [{places}] }}\n[[measurements]]\nb = "A"\nrows = [{rows}]\n'
    path.write_text(f'{head}kind = "fdoa"\narrival_sigma = {{ {sigma} }}\n')
    made = load(path)
    expected = np.diag(SPREAD[1:] ** 2) + SPREAD[0] ** 2
    assert np.allclose(noises.dense(made.noise, np.arange(4)), expected)
    path.write_text(f'{head}kind = "rss_difference"\narrival_sigma = {{ {sigma} }}\n')
    assert np.allclose(noises.dense(load(path).noise, np.arange(4)), expected)  # of levels the same
    path.write_text(f'{head}kind = "groa"\narrival_sigma = {{ {sigma} }}\n')
    with pytest.raises(InvalidProblem, match="are not sums or differences of arrivals; give sigma or covariance"):
        load(path)


# ------------------------------------------------------------------------------------- unknown frequencies
SITE = np.array([47.83, 11.21, 650.0])


def pass_problem():
    """Return the pass of the starter and the true vector: place and offset in m/s."""
    problem = load(STARTERS / "range_rate.toml")
    return problem, np.append(ECEF.from_geodetic(*np.radians(SITE[:2]), SITE[2]), -742.0 * C / 1626.27e6)


def test_an_estimated_offset_is_an_offset_projected_out():
    """The same pass by scipy over latitude and longitude, residuals less their mean: it knows no offset at all."""
    problem, truth = pass_problem()
    fix = solve(problem, start=truth)
    place, rate = problem.stations.position[:, 0], problem.stations.velocity[:, 0]

    def residual(angles):
        line = ECEF.from_geodetic(*angles, SITE[2]) - place
        off = problem.z + (line * rate).sum(1) / np.linalg.norm(line, axis=1)
        return (off - off.mean()) * 1626.27e6 / C

    found = least_squares(residual, np.radians(SITE[:2] + 0.2), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    there = ECEF.from_geodetic(*found.x, SITE[2])
    assert np.linalg.norm(there - fix.position) < 1e-2
    assert fix.cost == pytest.approx(2.0 * found.cost, rel=1e-8)
    assert fix.dof == 13 - 2 - 1
    # the offset is the mean of what is left
    line = fix.position - place
    left = problem.z + (line * rate).sum(1) / np.linalg.norm(line, axis=1)
    assert fix.bias["frequency"] == pytest.approx(left.mean(), abs=1e-6)
    # a prior that says little changes little, one that says nearly all pulls
    loose = with_bias(replace(problem, biases=()), "frequency", per="kind", mean=truth[3], sigma=1e4)
    assert np.linalg.norm(solve(loose, start=truth).position - fix.position) < 1e-3
    tight = with_bias(replace(problem, biases=()), "frequency", per="kind", mean=truth[3], sigma=1e-4)
    held = solve(tight, start=truth)
    assert held.bias["frequency"] == pytest.approx(truth[3], abs=1e-3)
    assert held.sigma().max() < fix.sigma().max()


def test_the_bound_of_a_pass_is_what_draws_scatter_by():
    problem, truth = pass_problem()
    drawn = simulate(problem, truth, 5, trials=200)
    fix = solve(drawn, "roots+lsr", start=np.broadcast_to(truth, (200, 4)))
    error = fix.x - truth
    bound = crlb(problem, truth)
    # The place moves on the ellipsoid: two directions of it and the frequency.
    nees = np.einsum("ti,ij,tj->t", error, np.linalg.pinv(bound, rcond=1e-9, hermitian=True), error)
    assert nees.mean() == pytest.approx(3.0, abs=3.0 * np.sqrt(6.0 / 200))
    assert fix.cost.mean() == pytest.approx(10.0, abs=3.0 * np.sqrt(20.0 / 200))


def rounds(sigma=0.05, targets=1):
    """Return a minute of range rates of five receivers that fly, of one or more emitters, and its times."""
    t = np.linspace(0.0, 60.0, 13)
    path = PLACE + t[:, None, None] * RATE
    a, epoch = np.tile(np.arange(5), 13 * targets), np.tile(np.repeat(np.arange(13), 5), targets)
    rows = measured("range_rate", a=a, epoch=epoch, target=np.repeat(np.arange(targets), 65), sigma=sigma)
    fleet = optloc.station_array(path, "ABCDE", velocity=np.broadcast_to(RATE, path.shape))
    return assemble(fleet, rows, times=t, motions=(Motion(),) * targets)


def test_an_offset_of_every_receiver_is_the_mean_of_its_residuals_projected_out():
    truth = np.concatenate([TARGET, [3.0, -8.0, 15.0, -1.0, 4.0]])
    drawn = simulate(with_bias(rounds(), "oscillator"), truth, 8)
    fix = solve(drawn, start=np.append(TARGET + 200.0, np.zeros(5)))
    place = drawn.stations.position

    def residual(x):
        line = x - place
        off = drawn.z.reshape(13, 5) + (line * RATE).sum(-1) / np.linalg.norm(line, axis=-1)
        return ((off - off.mean(0)) / 0.05).ravel()

    found = least_squares(residual, TARGET + 200.0, x_scale=100.0, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.allclose(fix.position, found.x, atol=1e-3)
    assert fix.cost == pytest.approx(2.0 * found.cost, rel=1e-9)
    J = found.jac
    assert np.allclose(fix.cov[:2, :2], np.linalg.inv(J.T @ J), rtol=1e-4)
    assert np.abs((fix.bias["oscillator"] - truth[2:]) / fix.sigma("oscillator")).max() < 4.0


def test_every_emitter_has_its_own_frequency(tmp_path):
    other = np.array([-3e3, 2e3])
    problem = with_bias(rounds(targets=2), "frequency", per="target")
    assert problem.biases[0].members == ("0", "1")
    truth = np.concatenate([TARGET, other, [200.0, -150.0]])
    drawn = simulate(problem, truth, 9)
    fix = solve(drawn, start=truth + np.array([200.0, -300.0, 100.0, 200.0, 0.0, 0.0]))
    # each by itself, all its rows with one unknown
    for i, place in enumerate((TARGET, other)):
        own = with_bias(rounds(), "frequency", per="kind").with_rows(z=drawn.z[65 * i : 65 * i + 65])
        alone = solve(own, start=np.append(place, 0.0))
        assert np.allclose(fix.take(f"position[{i}]"), alone.position, atol=1e-3)
        assert fix.bias["frequency"][i] == pytest.approx(alone.bias["frequency"][0], abs=1e-5)
        assert fix.sigma("frequency")[i] == pytest.approx(alone.sigma("frequency")[0], rel=1e-5)
    one = with_bias(rounds(targets=2), "frequency", per="target", members=["1"])
    assert set(one.biases[0].row.tolist()) == set(range(65, 130))
    with pytest.raises(InvalidProblem, match="there is no target '2'"):
        with_bias(rounds(targets=2), "frequency", per="target", members=["2"])
    with pytest.raises(InvalidProblem, match="targets have no groups"):
        with_bias(rounds(targets=2), "frequency", per="target", members={"both": ["0", "1"]})

    lines = PASS.partition("rows = [\n  { time = 0.0, z")
    rows = "".join(
        f'  {{ time = {t}.0, z = 1.0, target = "{name}" }},\n' for t in (0, 15, 30) for name in ("red", "blue")
    )
    text = (lines[0] + "rows = [\n" + rows + "]\n" + PASS[PASS.index("\n[[biases]]") :]).replace(
        'per = "kind"', 'per = "target"'
    )
    path = tmp_path / "two.toml"
    path.write_text(text)
    assert read(path).problem.biases[0].members == ("blue", "red")
    path.write_text(text.replace('motion = "static"', 'motion = "free"'))
    with pytest.raises(InvalidProblem, match="free targets are fixed separately, so they share no bias"):
        read(path)


def test_receivers_whose_oscillators_are_off_and_drift_are_told_apart():
    """Offsets and drifts of four receivers against the first, over a minute of frequency differences."""
    k, t = 13, np.linspace(0.0, 60.0, 13)
    path = PLACE + t[:, None, None] * RATE
    a, epoch = np.tile(np.arange(1, 5), k), np.repeat(np.arange(k), 4)
    rows = measured("fdoa", a=a, b=0, epoch=epoch, arrival_sigma=0.05)
    fleet = optloc.station_array(path, velocity=np.broadcast_to(RATE, path.shape))
    problem = assemble(fleet, rows, times=t)
    for name, form in (("offset", "offset"), ("drift", "drift")):
        problem = with_bias(problem, name, form=form, members=fleet.names[1:])
    truth = np.concatenate([TARGET, [3.0, -8.0, 15.0, -1.0], [0.01, -0.02, 0.0, 0.03]])
    drawn = simulate(problem, truth, 6)
    # the first receiver's errors enter every row: of what is modelled, each member only its own rows
    assert np.allclose(drawn.biases[0].coefficient, 1.0)
    fix = solve(drawn, start=np.concatenate([TARGET + 300.0, np.zeros(8)]))
    error = fix.x - truth
    assert error @ np.linalg.solve(fix.cov, error) < 30.0
    assert fix.sigma("drift").max() < 5e-3


# ------------------------------------------------------------------------------------------------ moving targets
START = np.array([9e3, 5e3, 90.0, -40.0])
GROUND = np.array([[0.0, 0.0], [20e3, 1e3], [-3e3, 18e3], [12e3, -15e3]])


def course(epochs=20, *, doppler="fdoa", seed=1, trials=None):
    a, epoch = np.tile([1, 2, 3], epochs), np.repeat(np.arange(epochs), 3)
    rows = [measured("tdoa", a=a, b=0, epoch=epoch, arrival_sigma=30.0)]
    if doppler == "fdoa":
        rows += [measured("fdoa", a=a, b=0, epoch=epoch, arrival_sigma=0.1)]
    if doppler == "range_rate":
        four = np.tile(np.arange(4), epochs)
        rows += [measured("range_rate", a=four, epoch=np.repeat(np.arange(epochs), 4), sigma=0.1)]
    made = assemble(GROUND, *rows, times=np.arange(float(epochs)), motions=(Motion(1),))
    return simulate(made, START, seed, trials=trials)


def at(time):
    return np.append(START[:2] + time * START[2:], START[2:])


@pytest.mark.parametrize("kind", ["fdoa", "range_rate"])
def test_doppler_rows_update_the_velocity_of_a_track(kind):
    """Consistent, at the fix of the whole run in the end, and far surer of the velocity than without them."""
    nees = []
    for seed in range(20):
        problem = course(8, doppler=kind, seed=seed)
        track = followed(problem, begun(problem, polynomial(1)), polynomial(1), "iekf")
        error = track.mean[-1] - at(problem.times[-1])
        nees.append(error @ np.linalg.solve(track.cov[-1], error))
    assert np.mean(nees) == pytest.approx(4.0, abs=2.6 * np.sqrt(8.0 / 20))
    problem = course(20, doppler=kind)
    track = followed(problem, begun(problem, polynomial(1), epochs=10), polynomial(1), "iekf")
    whole = solve(replace(problem, motions=(Motion(1, reference=float(problem.times[-1])),)))
    assert (np.abs(track.mean[-1] - whole.x) < 0.02 * np.sqrt(np.diag(whole.cov))).all()
    blind = course(20, doppler=None)
    without = followed(blind, begun(blind, polynomial(1), epochs=10), polynomial(1), "iekf")
    assert (np.sqrt(np.diag(track.cov[-1]))[2:] < 0.2 * np.sqrt(np.diag(without.cov[-1]))[2:]).all()


def test_a_position_and_a_velocity_of_every_epoch(tmp_path):
    """`free_velocity` in a file: each epoch by itself, with the covariance that it claims."""
    problem = course(60)
    lines = {kind: [] for kind in ("tdoa", "fdoa")}
    for block in problem.rows:
        for a, k, z in zip(block.a, block.epoch, block.z.tolist(), strict=True):
            lines[block.kind].append(f'  {{ epoch = {k}, a = "S{a}", z = {z!r} }},')
    places = ", ".join(f'{{ name = "S{i}", x = {p[0]}, y = {p[1]} }}' for i, p in enumerate(GROUND))
    text = f'format = 1\ntarget = {{ motion = "free_velocity" }}\nstations = {{ rows = [{places}] }}\n'
    for kind, sigma in (("tdoa", 30.0), ("fdoa", 0.1)):
        rows = "\n".join(lines[kind])
        text += f'[[measurements]]\nkind = "{kind}"\nb = "S0"\narrival_sigma = {sigma}\nrows = [\n{rows}\n]\n'
    path = tmp_path / "free.toml"
    path.write_text(text)
    made = load(path)
    assert [slot.name for slot in made.layout.local] == ["position", "velocity"]
    fix = solve(optloc.problem.by_epoch(made), "searched")
    error = np.concatenate([fix.position, fix.velocity], axis=-1) - np.array([at(t) for t in problem.times])
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(fix.cov), error)
    assert nees.mean() == pytest.approx(4.0, abs=3.0 * np.sqrt(8.0 / 60))
    # at rest nothing of the kind would be seen: without a velocity such rows are refused
    path.write_text(text.replace("free_velocity", "free"))
    with pytest.raises(InvalidProblem, match=r"needs stations that move.*or state the motion of the target"):
        load(path)
