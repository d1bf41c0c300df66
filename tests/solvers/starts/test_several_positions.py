"""Starts of several targets and epochs: what no epoch alone can fix, a run can."""

from dataclasses import replace

import numpy as np
import pytest
from verdicts import alone

from optloc import Motion, assemble, measured, simulate, solve, station_array, with_bias
from optloc.problem.noise import Block, Noise, dense
from optloc.solvers.starts.several_positions import _take_noise, from_pieces

TAGS = np.array([[4.0, 1.0, 0.5], [-3.0, 2.0, 1.5], [1.0, -4.0, 2.0], [0.0, 5.0, 0.0]])


def camera(rng, epochs=30):
    """Return a camera that wanders and turns, in the plane and by small nods."""
    heading = np.cumsum(rng.normal(0.0, 0.5, epochs))
    nod = rng.normal(0.0, 0.2, epochs)
    place = np.column_stack([rng.uniform(-1.5, 1.5, (epochs, 2)), rng.uniform(0.5, 1.5, epochs)])
    c, s, cn, sn = np.cos(heading), np.sin(heading), np.cos(nod), np.sin(nod)
    ahead = np.stack([c * cn, s * cn, sn], axis=-1)
    left = np.stack([-s, c, 0.0 * s], axis=-1)
    axes = np.stack([ahead, left, np.cross(ahead, left)], axis=-2)
    return replace(station_array(place[:, None], ("camera",)), axes=axes[:, None])


def bearings(stations, sigma):
    """Return the problem of one bearing of one tag at each epoch, and an unknown mount."""
    epoch = np.arange(len(stations.position))
    rows = [
        measured(kind, a=0, epoch=epoch, target=epoch % len(TAGS), sigma=sigma) for kind in ("azimuth", "elevation")
    ]
    problem = assemble(stations, *rows, motions=tuple(Motion() for _ in TAGS))
    return with_bias(problem, "mount", form="rotation")


@pytest.mark.parametrize("mount", [(0.01, -0.02, 0.03), (0.1, -0.15, 0.2)], ids=["small", "large"])
def test_tags_and_mount_of_a_moving_camera_need_no_guess(mount):
    problem = bearings(camera(np.random.default_rng(4)), 1e-3)
    truth = np.concatenate([TAGS.ravel(), mount])
    exact = simulate(
        replace(problem, noise=Noise(tuple(Block(b.row, 0.0 * b.covariance) for b in problem.noise.blocks))), truth, 0
    )
    fix = solve(replace(exact, noise=problem.noise))
    assert alone(fix)
    np.testing.assert_allclose(fix.x, truth, atol=1e-6)


def test_their_errors_are_what_the_covariance_says():
    problem = bearings(camera(np.random.default_rng(5), epochs=60), 2e-3)
    truth = np.concatenate([TAGS.ravel(), (0.02, 0.05, -0.03)])
    fix = solve(simulate(problem, truth, 3, trials=100))
    assert fix.answered.all()
    error = fix.x - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.cov), error)
    # 15 unknowns, 100 trials: the mean of the chi-square has a standard deviation of sqrt(2 * 15 / 100).
    assert nees.mean() == pytest.approx(15.0, abs=4.0 * np.sqrt(0.3))


def test_ranges_taken_one_at_a_time_meet():
    # A single range fixes nothing, three places on the way do; the scale of the ranges is unknown as well.
    way = np.column_stack([np.linspace(0.0, 60.0, 25), 10.0 * np.sin(np.linspace(0.0, 4.0, 25))])
    targets = np.array([[20.0, 40.0], [45.0, -30.0]])
    epoch, target = np.repeat(np.arange(25), 2), np.tile([0, 1], 25)
    rows = measured("range", a=0, epoch=epoch, target=target, sigma=0.1)
    problem = assemble(way[:, None], rows, motions=(Motion(), Motion()))
    problem = with_bias(problem, "scale", per="kind", form="scale")
    truth = np.array([*targets.ravel(), 0.05])
    fix = solve(simulate(problem, truth, 11))
    assert alone(fix)
    off = (fix.x - truth) / np.sqrt(np.diagonal(fix.cov))
    assert np.abs(off).max() < 4.0


def test_an_epoch_without_a_fix_starts_where_the_last_one_was():
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [90.0, 80.0]])
    way = np.column_stack([np.linspace(20.0, 70.0, 6), np.linspace(30.0, 60.0, 6)])
    a, epoch = np.tile(np.arange(4), 6), np.repeat(np.arange(6), 4)
    weight = np.where(np.isin(epoch, (0, 3)) & (a > 0), 0.0, 1.0)
    problem = assemble(
        stations, measured("range", a=a, epoch=epoch, sigma=0.1, weight=weight), motions=(Motion(span="epoch"),)
    )
    problem = with_bias(problem, "scale", per="kind", form="scale")
    drawn = simulate(problem, np.append(0.0, way), 2).flat()
    start = from_pieces(drawn, lambda piece: solve(piece, "roots+lsr"))
    local = problem.layout.split(start)[1][0, 0]
    np.testing.assert_array_equal(local[0], local[1])
    np.testing.assert_array_equal(local[3], local[2])
    np.testing.assert_allclose(local[[1, 2, 4, 5]], way[[1, 2, 4, 5]], atol=1.0)


def test_a_target_that_no_row_sees_is_no_error():
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [90.0, 80.0]])
    rows = measured("range", [50.0, 60.0, 70.0, 80.0], a=np.arange(4), sigma=1.0)
    fix = solve(assemble(stations, rows, motions=(Motion(), Motion())))
    assert not fix.answered


def test_the_noise_of_some_rows_is_the_matching_part():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 3, 3))
    noise = Noise(
        (
            Block(np.array([[0, 4, 2], [1, 3, 6]]), root @ np.swapaxes(root, -1, -2)),
            Block(np.array([[5]]), np.full((1, 1, 1), 2.0)),
        )
    )
    kept = np.array([1, 2, 4, 6])
    part = dense(_take_noise(noise, kept, 7), np.arange(4))
    np.testing.assert_array_equal(part, dense(noise, np.arange(7))[np.ix_(kept, kept)])


@pytest.mark.parametrize("epochs", [1, 4])
@pytest.mark.parametrize("kind", ["tdoa", "range"])
def test_biases_that_are_large_but_roughly_known_do_not_mislead_the_start(kind, epochs):
    # Delays of the size of the array, known to 20 m: taken for zero they start one run in five at a wrong place.
    stations = 1e3 * np.array([[0.0, 0.0], [20.0, 1.0], [3.0, 18.0], [17.0, 21.0], [9.0, -12.0]])
    rng, delay = np.random.default_rng(7), np.array([20e3, -10e3])
    others, each = np.tile(np.arange(1, 5), epochs), np.repeat(np.arange(epochs), 4)
    rows = (
        measured("tdoa", a=others, b=0 * others, sigma=10.0, epoch=each)
        if kind == "tdoa"
        else measured("range", a=others, sigma=10.0, epoch=each)
    )
    problem = assemble(stations, rows, motions=(Motion(span="epoch" if epochs > 1 else "run"),))
    problem = with_bias(problem, "delay", members=["S1", "S2"], mean=delay, sigma=20.0)
    places = rng.uniform(-40e3, 40e3, (60, 2 * epochs))
    delays = delay + rng.normal(0.0, 20.0, (60, 2))
    parts = [places, delays] if epochs == 1 else [delays, places]
    truth = np.concatenate(parts, axis=1)
    drawn = simulate(problem, truth, 1)
    fix, started = solve(drawn), solve(drawn, "lsr", start=truth)
    assert fix.answered.all()
    assert np.all(fix.cost <= started.cost * (1.0 + 1e-6) + 1e-6)


def test_a_large_error_of_one_station_has_a_start_without_its_rows():
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [90.0, 80.0], [-40.0, 50.0]])
    way = np.column_stack([np.linspace(20.0, 70.0, 6), np.linspace(30.0, 60.0, 6)])
    a, epoch = np.tile(np.arange(5), 6), np.repeat(np.arange(6), 5)
    template = assemble(stations, measured("range", a=a, epoch=epoch, sigma=0.1), motions=(Motion(span="epoch"),))
    problem = with_bias(template, "offset", members=[template.stations.names[4]])
    drawn = simulate(problem, np.append(60.0, way), 2).flat()
    start = from_pieces(drawn, lambda piece: solve(piece, "roots+lsr"))
    error = np.abs(problem.layout.split(start)[1][0] - way).max((-1, -2))
    assert error.shape == (2,)
    assert error[0] > 5.0
    assert error[1] < 1.0
