"""One receiver and one illuminator: the simplified recursion, its cures, and lines in measurement space."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from verdicts import alone

from optloc import InvalidProblem, Motion, assemble, crlb, measured, simulate, solve
from optloc.base.types import Stations, Status
from optloc.engine import linearise
from optloc.linear.constraints import box
from optloc.solvers.starts.angles import course_starts
from optloc.tracking.measurement_space import lines, simplified

D, R0, AZ0, EL0 = 150e3, 81.2e3, 1.446, 0.123
PATH, ANGLE = 20e-9 * 299792458.0, np.radians(1.0)
SPEED = np.array([4.0, 10.0, 6.0])
U0 = np.array([np.cos(EL0) * np.cos(AZ0), np.cos(EL0) * np.sin(AZ0), np.sin(EL0)])


def run(epochs, order=0, turn=None, home=(0.0, 0.0, 0.0), path=PATH):
    k = np.arange(epochs)
    place = np.stack([home, np.array(home) + (np.eye(3) if turn is None else turn).T @ [D, 0.0, 0.0]])[None]
    axes = None if turn is None else np.broadcast_to(turn, (1, 2, 3, 3))
    return assemble(
        Stations(place, ("receiver", "illuminator"), axes=axes),
        measured("range_sum", a=0, b=1, epoch=k, sigma=path),
        measured("azimuth", a=0, epoch=k, sigma=ANGLE),
        measured("elevation", a=0, epoch=k, sigma=ANGLE),
        motions=[Motion(order)],
    )


def draw(epochs, trials, seed, slow=False, path=PATH):
    return simulate(
        run(epochs, int(slow), path=path), np.concatenate([R0 * U0, SPEED]) if slow else R0 * U0, seed, trials
    )


def columns(problem):
    """Return excess path, azimuth and elevation (3, trials, epochs)."""
    path, azimuth, elevation = (rows.z for rows in problem.rows)
    return np.stack([path - D, azimuth, elevation])


def place(polar):
    r, az, el = polar
    return np.stack([r * np.cos(el) * np.cos(az), r * np.cos(el) * np.sin(az), r * np.sin(el)], axis=-1)


def inverted(l, az, el):
    return (l**2 + 2 * D * l) / (2 * (D * (1 - np.cos(az) * np.cos(el)) + l))


def plain(l, az, el, restart=None, mean=1, floor=0.0):
    """Return range, azimuth and elevation of one run by the equations of the recursion, written out."""
    out = []
    for k in range(len(l)):
        if k < mean or (restart is not None and k % restart == 0):
            part = slice(max(0, k + 1 - mean), k + 1)
            a, e = az[part].mean(), el[part].mean()
            r, i = inverted(l[part].mean(), a, e), k + 1 - part.start
            P = 1.0 / i
        else:
            i += 1
            g = max(1.0 / i, floor)
            ca, sa, ce, se = np.cos(a), np.sin(a), np.cos(e), np.sin(e)
            reach = np.sqrt(r**2 + D**2 - 2 * D * r * ca * ce)
            x = 1 + (r - D * ca * ce) / reach
            la, le = D * r * sa * ce / reach, D * r * ca * se / reach
            da, de = g * (az[k] - a), g * (el[k] - e)
            y = l[k] - (r + reach - D) - la * da - le * de
            K = P * x / (1 + x * P * x)
            a, e, r, P = a + da, e + de, r + max(K, floor / x) * y, P - K * x * P
        out.append((r, a, e))
    return np.array(out)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"restart": 50},
        {"restart": 25, "mean": 10},
        {"floor": 0.05},
        {"mean": 7},
        pytest.param({"restart": 1}, marks=pytest.mark.full),
    ],
)
def test_one_run_is_that_of_the_written_out_recursion(options):
    drawn = draw(120, 2, 11, slow=True)
    found = simplified(drawn, **options)
    for i in range(2):
        wanted = place(plain(*columns(drawn)[:, i], **options).T)
        assert np.abs(found.position[i] - wanted).max() < 1e-6 * R0
    assert (found.code == Status.OK).all()
    assert (found.count == 3).all()


def test_gains_with_the_printed_weight():
    x = 1.0 + (R0 - D * U0[0]) / np.linalg.norm(R0 * U0 - [D, 0.0, 0.0])
    assert x == pytest.approx(1.38804, abs=1e-5)
    assert x / (1 + x * x) == pytest.approx(0.474, abs=5e-4)
    z = run(2).with_rows(z=np.zeros(6)).z
    exact = np.array([R0 + np.linalg.norm(R0 * U0 - [D, 0, 0]), AZ0, EL0])
    z = np.repeat(exact, 2)
    z[1] += 1.0  # one metre more of path at the second epoch moves the range by the gain
    moved = simplified(run(2).with_rows(z=z)).position
    assert np.linalg.norm(moved[1]) - np.linalg.norm(moved[0]) == pytest.approx(0.474, abs=5e-4)


def test_the_fix_of_a_target_that_stays_inverts_the_mean_measurement():
    drawn = draw(40, 3, 2)
    l, az, el = (np.cumsum(v, -1) / np.arange(1, 41) for v in columns(drawn))
    found = lines(drawn, 0)
    assert np.abs(found.position - place((inverted(l, az, el), az, el))).max() < 1e-6 * R0
    assert np.abs(found.position[:, -1] - solve(drawn).position).max() < 1.0


@pytest.mark.parametrize("window", [None, 30])
def test_the_line_fit_is_a_polynomial_fit_that_is_inverted(window):
    drawn, t = draw(90, 2, 3, slow=True), np.arange(90.0)
    found = lines(drawn, 1, window)
    assert found.times[0] == 1.0
    for i in range(2):
        for k in (1, 5, 40, 89):
            part = slice(0 if window is None else max(0, k + 1 - window), k + 1)
            slope, value = np.polyfit(t[part] - k, columns(drawn)[:, i, part].T, 1)
            r = inverted(*value)
            assert np.abs(found.position[i, k - 1] - place((r, *value[1:]))).max() < 1e-6 * R0
            ahead = value + 1e-3 * slope
            speed = (place((inverted(*ahead), *ahead[1:])) - place((r, *value[1:]))) / 1e-3
            assert found.velocity[i, k - 1] == pytest.approx(speed, rel=1e-3, abs=1e-2)


@pytest.mark.parametrize("trials", few([200, 400], 1))
def test_covariances_are_those_of_the_errors(trials):
    drawn = draw(50, trials, 4)
    across = np.cross([0.0, 0.0, 1.0], U0) / np.cos(EL0)
    axes = np.stack([U0, across, np.cross(U0, across)])  # of growing range, azimuth and elevation
    for options in ({}, {"floor": 0.1}, {"mean": 5}, None):
        track = lines(drawn, 0) if options is None else simplified(drawn, **options)
        for k in (0, 9, 49):
            r = np.linalg.norm(track.position[:, k], axis=-1)
            u = track.position[:, k] / r[:, None]
            error = np.stack([r - R0, R0 * (u @ across), R0 * (u @ axes[2])])
            claimed = np.einsum("ai,nij,aj->an", axes, track.cov[:, k], axes)
            assert (error**2).mean(1) / claimed.mean(1) == pytest.approx(1.0, abs=4 * np.sqrt(2 / trials))
    # With a path of 20 ns the ellipse is a curved sheet, which no covariance matrix describes.
    still = lines(draw(50, trials, 4, path=20 * PATH), 0)
    error = still.position[:, -1] - R0 * U0
    nees = (error * np.linalg.solve(still.cov[:, -1], error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / trials))
    slow = draw(60, 200, 5, slow=True, path=20 * PATH)
    track, exact = lines(slow), np.concatenate([R0 * U0 + 59 * SPEED, SPEED])
    error = track.mean[:, -1] - exact
    nees = (error * np.linalg.solve(track.cov[:, -1], error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / 200) + 0.3)


def range_error(track, exact, k=-1):
    return np.sqrt(((np.linalg.norm(track.position[:, k], axis=-1) - np.linalg.norm(exact)) ** 2).mean()) / 1e3


def still_numbers(trials, seed):
    drawn = draw(10, trials, seed)
    return [range_error(track, R0 * U0) for track in (simplified(drawn), lines(drawn, 0))]


def slow_numbers(trials, seed):
    drawn, exact = draw(200, trials, seed, slow=True), R0 * U0 + 199 * SPEED
    batch = replace(drawn, motions=(Motion(1, reference=199.0),))
    fix = solve(batch, "lsr", start=course_starts(batch).reshape(trials, 6))
    return [range_error(simplified(drawn), exact), range_error(lines(drawn), exact), range_error(fix, exact, ...)]


def test_ten_epochs_of_a_target_that_stays():
    assert still_numbers(500, 6) == pytest.approx([0.370, 0.293], rel=0.1)
    bound = crlb(run(10), R0 * U0)
    assert np.sqrt(U0 @ bound @ U0) / 1e3 == pytest.approx(0.295, abs=1e-3)


@pytest.mark.slow
def test_two_hundred_epochs_of_a_slow_target():
    assert slow_numbers(200, 8) == pytest.approx([1.19, 0.136, 0.118], rel=0.1)


@pytest.mark.full
def test_numbers_of_many_trials():
    assert still_numbers(2000, 1) == pytest.approx([0.370, 0.293], rel=0.05)
    assert slow_numbers(1000, 1) == pytest.approx([1.19, 0.136, 0.118], rel=0.07)


@pytest.mark.slow
def test_restarts_and_floors_follow_a_slow_target():
    drawn, exact = draw(200, 100, 9, slow=True), R0 * U0 + 199 * SPEED
    found = {
        "restart": range_error(simplified(drawn, restart=50), exact),
        "mean": range_error(simplified(drawn, restart=25, mean=10), exact),
        "floor": range_error(simplified(drawn, floor=0.05), exact),
    }
    assert found == pytest.approx({"restart": 0.345, "mean": 0.266, "floor": 0.268}, rel=0.15)


def test_a_batch_fit_of_one_run_needs_no_start_of_ours():
    drawn = draw(60, 1, 10, slow=True).take(np.array([0]))
    batch = replace(drawn, motions=(Motion(1, reference=59.0),))
    own = solve(batch)
    ours = solve(batch, "lsr", start=lines(drawn).last.mean)
    assert alone(own).all()
    assert np.abs(own.x - ours.x).max() < 1.0


def test_the_place_and_the_axes_of_the_receiver_do_not_matter():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    home = np.array([3e4, -2e4, 500.0])
    drawn = draw(40, 2, 12, slow=True)
    moved = run(40, turn=turn, home=home).with_rows(z=drawn.z)
    for tracker in (simplified, lines):
        assert np.abs(tracker(moved).position - (home + tracker(drawn).position @ turn)).max() < 1e-3


def test_epochs_without_an_echo_leave_the_state_as_it_was():
    drawn = draw(30, 2, 13)
    weight, z = np.ones(drawn.z.shape), drawn.z.copy()
    weight[0, [0, 12, 13]] = 0.0  # the path of the first run
    z[1, 30 + 7] = np.nan  # an azimuth of the second
    gappy = drawn.with_rows(z=z, weight=weight)
    track = simplified(gappy)
    assert np.isnan(track.position[0, 0]).all()
    assert np.flatnonzero(track.code[0]).tolist() == [0, 12, 13]
    assert np.flatnonzero(track.code[1]).tolist() == [7]
    assert (track.position[0, 13] == track.position[0, 11]).all()
    heard = [k for k in range(30) if k not in (0, 12, 13)]
    wanted = plain(*columns(drawn)[:, 0, heard])
    assert np.abs(track.position[0, heard] - place(wanted.T)).max() < 1e-6 * R0
    fit = lines(gappy, 0)
    assert fit.code[0, 0] == Status.TOO_FEW_ROWS
    l, az, el = columns(drawn)[:, 0]
    l = np.delete(l, [0, 12, 13]).mean()
    assert np.abs(fit.position[0, -1] - place((inverted(l, az.mean(), el.mean()), az.mean(), el.mean()))).max() < 0.1


def test_angles_are_averaged_across_the_cut():
    drawn = run(20)
    z = np.concatenate([np.full(20, 400e3), np.pi + 0.01 * np.linspace(-1, 1, 20), np.full(20, 0.1)])
    z = np.where(z > np.pi, np.where(z < 7, z - 2 * np.pi, z), z)
    fixed = drawn.with_rows(z=z)
    l = 400e3 - D
    for track in (lines(fixed, 0), simplified(fixed)):
        assert np.abs(track.position[-1] - place((inverted(l, np.pi, 0.1), np.pi, 0.1))).max() < 2.0


def test_lines_take_any_rows_of_stations_that_stay():
    stations = np.array([[0.0, 0.0], [9e3, 1e3], [2e3, 8e3], [9e3, 9e3]])
    k = np.repeat(np.arange(30), 3)
    made = assemble(
        stations, measured("tdoa", a=np.tile([1, 2, 3], 30), b=0, epoch=k, arrival_sigma=3.0), motions=[Motion(1)]
    )
    exact = np.array([4e3, 5e3, 2.0, -1.0])
    drawn = simulate(made, exact, 1, 200)
    track, at = lines(drawn), exact[:2] + 29 * exact[2:]
    bound = crlb(replace(made, motions=(Motion(1, reference=29.0),)), np.concatenate([at, exact[2:]]))
    error = track.mean[:, -1] - np.concatenate([at, exact[2:]])
    assert np.sqrt((error**2).mean(0)) == pytest.approx(np.sqrt(np.diagonal(bound)), rel=0.15)
    assert np.sqrt(np.diagonal(track.cov[0, -1])) == pytest.approx(np.sqrt(np.diagonal(bound)), rel=0.02)


def test_a_batch_is_its_runs_one_by_one():
    drawn = draw(25, 3, 14, slow=True)
    for tracker in (simplified, lines):
        alone = tracker(replace(drawn, rows=tuple(replace(rows, z=rows.z[1]) for rows in drawn.rows)))
        assert alone.position.shape == tracker(drawn).position.shape[1:]
        assert np.abs(alone.position - tracker(drawn).position[1]).max() < 1e-6 * R0


def test_partials_of_the_path_are_those_of_the_model():
    H = linearise(run(1).with_rows(z=np.zeros(3)), R0 * U0).shared[0]
    assert H @ U0 == pytest.approx(1.38804, abs=1e-5)
    east = R0 * np.array([-U0[1], U0[0], 0.0])
    assert H @ east / 1e3 == pytest.approx(74.2633, abs=1e-3)


MOVING = assemble(
    np.zeros((2, 3, 3)) + np.arange(3)[:, None] * 1e3 + np.arange(2)[:, None, None],
    measured("range", a=np.tile([0, 1, 2], 2), epoch=np.repeat([0, 1], 3), sigma=1.0, z=1.0),
)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: simplified(MOVING), "one receiver and one illuminator"),
        (lambda: simplified(draw(5, 1, 1), restart=0), "restart is 0"),
        (lambda: simplified(draw(5, 1, 1), mean=0), "mean is 0"),
        (lambda: simplified(draw(5, 1, 1), floor=1.5), "gain floor"),
        (lambda: lines(MOVING), "stations move"),
        (lambda: lines(replace(draw(5, 1, 1), constraints=box([0, 0, 0], [9e9] * 3))), "fences or priors"),
        (
            lambda: simplified(replace(draw(5, 1, 1), constraints=box([0, 0, 0], [9e9] * 3))),
            "constraints, fences or priors",
        ),
        (lambda: lines(draw(5, 1, 1), 3), "order of the polynomial is 3"),
        (lambda: lines(draw(5, 1, 1), 1, window=1), "too few epochs"),
        (lambda: lines(draw(1, 1, 1), 1), "too few epochs"),
        (lambda: lines(replace(draw(5, 1, 1), motions=(Motion(), Motion()))), "several targets"),
    ],
)
def test_what_cannot_be_tracked_is_said(call, words):
    with pytest.raises(InvalidProblem, match=words):
        call()
