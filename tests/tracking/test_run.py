"""Whole runs: started without a guess, gated, carried over silence, begun anew; against a plain filter."""

from dataclasses import replace

import numpy as np
import pytest
from often import few

from optloc import InvalidProblem, Motion, Status, assemble, measured, station_array
from optloc.linear.constraints import box, height
from optloc.problem import ECEF
from optloc.tracking import Rules, State, collected, current_statistical, followed, polynomial, singer, tracked
from optloc.tracking.several_targets import alone

STATIONS = np.array([[0.0, 0, 0], [1000, 0, 300], [0, 1000, 250], [1000, 1000, 20], [500, 1300, 400], [-200, 500, 120]])
PAIRS = np.array([[1, 0], [2, 0], [3, 0], [4, 0], [5, 0]])
SIGMA, STEP = 1.0, 1.0
START, SPEED = np.array([200.0, 300, 150]), np.array([12.0, 8, 1])


def truth(times):
    return START + np.asarray(times)[:, None] * SPEED


def run(times, seed=0, wild=(), silent=(), lost=(), sigma=SIGMA):
    """Return a run of a straight flight; some scans hold a wild value, none, or only values that are not finite."""
    rng, times = np.random.default_rng(seed), np.asarray(times, dtype=float)
    k, m = len(times), len(PAIRS)
    range_ = np.linalg.norm(truth(times)[:, None] - STATIONS, axis=-1)
    arrival = range_ + sigma * rng.standard_normal(range_.shape)
    z = arrival[:, PAIRS[:, 0]] - arrival[:, PAIRS[:, 1]]
    weight = np.ones((k, m))
    z[list(wild), 2] += 400.0
    weight[list(silent)] = 0.0
    z[list(lost)] = np.nan
    rows = measured(
        "tdoa",
        z.ravel(),
        a=np.tile(PAIRS[:, 0], k),
        b=np.tile(PAIRS[:, 1], k),
        epoch=np.repeat(np.arange(k), m),
        weight=weight.ravel(),
        arrival_sigma=sigma,
    )
    if lost:  # `assemble` refuses what is not finite
        return assemble(STATIONS, replaced(rows, 0.0), times=times, motions=(Motion(span="epoch"),)).with_rows(
            z=z.ravel()
        )
    return assemble(STATIONS, rows, times=times, motions=(Motion(span="epoch"),))


def replaced(rows, value):
    return replace(rows, rows=replace(rows.rows, z=np.nan_to_num(rows.rows.z, nan=value)))


def labels(entries):
    return [entry.label for entry in entries]


def errors(problem, entries):
    return np.linalg.norm(collected(entries, 3).position - truth(problem.times), axis=-1)


def test_a_run_is_tracked_without_a_guess():
    problem = run(np.arange(40.0))
    entries = list(tracked(problem, polynomial(1, 0.1)))
    assert labels(entries) == ["starting", "started"] + ["ok"] * 38
    track = collected(entries, 3)
    assert np.isnan(track.mean[0]).all()
    assert np.nanmax(errors(problem, entries)[5:]) < 5.0
    assert track.velocity[-1] == pytest.approx(SPEED, abs=0.6)
    assert (track.count[1:] == 5).all()


@pytest.mark.parametrize("runs", few([30, 60], 1))
def test_errors_and_innovations_are_those_of_the_covariance(runs):
    """NEES and NIS of some runs: means within four standard deviations of their chi-squares."""
    nees, nis, rows = [], 0.0, 0
    for seed in range(runs):
        problem = run(np.arange(12.0), seed)
        track = collected(list(tracked(problem, polynomial(1, 1e-3), rules=Rules(gate=np.inf))), 3)
        off = track.mean[-1] - np.concatenate([truth(problem.times)[-1], SPEED])
        nees.append(off @ np.linalg.solve(track.cov[-1], off))
        nis, rows = nis + np.nansum(track.nis), rows + track.count[np.isfinite(track.nis)].sum()
    assert np.mean(nees) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / runs))
    assert nis / rows == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / rows))


def plain(problem, mean, cov, first, noise):
    """Return means (k, 6) and NIS of a plain extended Kalman filter with derivatives by hand."""
    F, G = np.eye(6), np.vstack([0.5 * STEP**2 * np.eye(3), STEP * np.eye(3)])
    F[:3, 3:] = STEP * np.eye(3)
    D = np.zeros((5, 6))
    D[np.arange(5), PAIRS[:, 0]], D[np.arange(5), PAIRS[:, 1]] = 1.0, -1.0
    R = SIGMA**2 * D @ D.T
    z, means, nis = problem.z.reshape(-1, 5), [], []
    for k in range(first, len(z)):
        mean, cov = F @ mean, F @ cov @ F.T + noise**2 * G @ G.T
        line = mean[:3] - STATIONS
        far = np.linalg.norm(line, axis=1)
        H = np.hstack([D @ (line / far[:, None]), np.zeros((5, 3))])
        S = H @ cov @ H.T + R
        K = cov @ H.T @ np.linalg.inv(S)
        nu = z[k] - D @ far
        mean, cov = mean + K @ nu, (np.eye(6) - K @ H) @ cov
        means.append(mean)
        nis.append(nu @ np.linalg.solve(S, nu))
    return np.array(means), np.array(nis)


def test_a_track_is_that_of_a_plain_filter():
    problem = run(np.arange(25.0), seed=3)
    track = collected(list(tracked(problem, polynomial(1, 0.5), "ekf")), 3)
    means, nis = plain(problem, track.mean[1], track.cov[1], 2, 0.5)
    np.testing.assert_allclose(track.mean[2:], means, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(track.nis[2:], nis, rtol=1e-6)


@pytest.mark.parametrize("name", ["iekf", "ekf", "mgekf", "mvekf"])
def test_from_a_given_state_it_is_what_followed_gives(name):
    problem = run(np.arange(15.0), seed=4)
    start = State(-1.0, np.concatenate([START - SPEED + 3.0, SPEED + 1.0]), np.diag([25.0] * 3 + [4.0] * 3))
    ours = collected(list(tracked(problem, polynomial(1, 0.5), name, start=start)), 3)
    theirs = followed(problem, start, polynomial(1, 0.5), name)
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-12)
    np.testing.assert_allclose(ours.nis, theirs.nis, rtol=1e-9)


@pytest.mark.parametrize("dynamics", [polynomial(2, 0.1), singer(5.0, 1.0), current_statistical(5.0, 20.0)])
def test_accelerating_models_start_too(dynamics):
    problem = run(np.arange(30.0), seed=5)
    entries = list(tracked(problem, dynamics))
    assert labels(entries)[:3] == ["starting", "starting", "started"]
    assert set(labels(entries)[3:]) == {"ok"}
    assert errors(problem, entries)[-1] < 10.0


def test_silence_keeps_the_prediction_and_wild_values_are_left_out():
    problem = run(np.arange(30.0), seed=6, wild=(8,), silent=(12, 13), lost=(17,))
    entries = list(tracked(problem, polynomial(1, 0.1)))
    assert [e.label for e in entries[12:14]] == ["too few rows"] * 2
    assert "only predicted" in entries[12].reason
    assert entries[17].code == Status.REJECTED
    assert (entries[17].rejected, int(entries[17].updated.count)) == (5, 0)
    assert (entries[8].label, entries[8].rejected, int(entries[8].updated.count)) == ("ok", 1, 4)
    step = entries[13].updated.mean - entries[12].updated.mean
    np.testing.assert_allclose(step[:3], entries[12].updated.mean[3:], rtol=1e-12)
    assert np.trace(entries[13].updated.cov) > np.trace(entries[11].updated.cov)
    assert errors(problem, entries)[-1] < 5.0


def test_a_silence_that_the_model_cannot_bridge_ends_the_track():
    times = np.concatenate([np.arange(10.0), 100.0 + np.arange(10.0)])
    problem = run(times, seed=7)
    entries = list(tracked(problem, polynomial(1, 1.0)))
    assert labels(entries)[10:13] == ["starting", "restarted", "ok"]
    assert "uncertain by" in entries[11].reason
    assert errors(problem, entries)[-1] < 10.0
    bridged = list(tracked(problem, polynomial(1, 1e-4)))
    assert "restarted" not in labels(bridged)


def test_a_stated_gap_ends_the_track_however_sure_the_prediction_is():
    problem = run(np.concatenate([np.arange(10.0), 25.0 + np.arange(10.0)]), seed=8)
    entries = list(tracked(problem, polynomial(1, 1e-3), rules=Rules(gap=10.0)))
    assert labels(entries)[10:12] == ["starting", "restarted"]
    assert "no valid row for 16 s" in entries[11].reason
    assert "restarted" not in labels(tracked(problem, polynomial(1, 1e-3), rules=Rules(gap=20.0)))


def test_a_target_that_jumps_is_found_again():
    one, two = run(np.arange(15.0), seed=9), run(np.arange(100.0, 115.0), seed=10)
    problem = run(np.arange(30.0)).with_rows(z=np.concatenate([one.z, two.z]))
    entries = list(tracked(problem, polynomial(1, 0.5), rules=Rules(patience=4)))
    assert labels(entries)[15:21] == ["rejected"] * 4 + ["starting", "restarted"]
    assert "4 scans" in entries[20].reason
    assert np.linalg.norm(entries[-1].updated.mean[:3] - truth([114.0])[0]) < 5.0


def lone(times, sigma=1.0, seed=0, stated=1.0, wild=0.0):
    """A drive past four beacons, of which one is heard at a time: its run, one row a scan, and the truth."""
    rng, times = np.random.default_rng(seed), np.asarray(times)
    truth = 50.0 * np.stack([np.cos(times / 40.0), np.sin(times / 25.0)], axis=-1)
    beacons, a = np.array([[-60.0, 0.0], [60.0, 10.0], [0.0, 70.0], [5.0, -60.0]]), np.arange(len(times)) % 4
    z = np.linalg.norm(truth - beacons[a], axis=-1) + sigma * rng.standard_normal(len(times))
    z += wild * (rng.random(len(times)) < 0.1)
    rows = measured("range", z, a=a, sigma=stated, epoch=np.arange(len(times)))
    return assemble(beacons, rows, times=times, motions=(Motion(span="epoch"),)), truth


def lone_errors(problem, truth, **options):
    entries = list(tracked(problem, polynomial(1, 0.5), **options))
    return labels(entries), np.linalg.norm(collected(entries, 2).position - truth, axis=-1)


@pytest.mark.slow
def test_a_lost_track_of_single_rows_ends():
    """For a while two rows of three are off: never five in succession, and the state goes elsewhere."""
    problem, truth = lone(np.arange(0.0, 60.0, 0.25))
    k = np.arange(problem.count)
    found, error = lone_errors(
        problem.with_rows(z=problem.z + np.where((k > 60) & (k < 120) & (k % 3 > 0), 60.0, 0.0)), truth
    )
    clean = np.array([label in ("ok", "started", "restarted") for label in found])
    # a window of scans tells
    assert not clean[85:120].any()
    assert error[170:].max() < 5.0
    assert clean[170:].mean() > 0.9


@pytest.mark.parametrize("wild", few([30.0, 0.0], 1))
def test_single_rows_are_tracked_without_losing_the_track(wild):
    """Also where one in ten is wild: twenty scans tell that from a track that is lost."""
    problem, truth = lone(np.arange(0.0, 100.0, 0.25), wild=wild, seed=2)
    found, error = lone_errors(problem, truth)
    assert "restarted" not in found[20:]
    assert np.nanmax(error[20:]) < 10.0


def test_what_is_noisier_than_stated_is_no_clean_track():
    problem, _ = lone(np.arange(0.0, 30.0, 0.25), sigma=1.0, stated=0.25)
    entries = list(tracked(problem, polynomial(1, 0.5)))
    assert np.mean([label == "ok" for label in labels(entries)[20:]]) < 0.5
    assert any("times as large as" in entry.reason for entry in entries if entry.code == Status.MISFIT)


def test_a_start_goes_around_contradicting_rows():
    problem = run(np.arange(20.0), seed=11, wild=(0, 1, 2))
    entries = list(tracked(problem, polynomial(1, 0.1)))
    assert labels(entries)[:5] == ["starting"] * 4 + ["started"]
    assert errors(problem, entries)[4:].max() < 20.0


def test_a_run_that_never_determines_a_state_says_so():
    problem = run(np.arange(1.0))
    entries = list(tracked(problem, polynomial(1)))
    assert len(entries) == 1
    assert entries[0].code != Status.OK
    assert "do not determine" in entries[0].reason


def test_what_was_tracked_stays_when_a_later_scan_fails():
    problem, calls = run(np.arange(20.0)), []

    def failing(scan, mean, cov):
        from optloc.tracking import UPDATES

        calls.append(scan)
        if len(calls) > 5:
            raise KeyError("a bug")
        return UPDATES["iekf"](scan, mean, cov)

    entries = []
    with pytest.raises(KeyError):
        entries.extend(tracked(problem, polynomial(1, 0.1), failing))
    assert labels(entries) == ["starting", "started"] + ["ok"] * 5


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("no convergence"), FloatingPointError("overflow")])
def test_an_update_that_fails_is_the_status_of_its_scan(error):
    from optloc.tracking import UPDATES

    problem, calls = run(np.arange(20.0)), []

    def failing(scan, mean, cov):
        calls.append(scan)
        if len(calls) == 6:
            raise error
        return UPDATES["iekf"](scan, mean, cov)

    entries = list(tracked(problem, polynomial(1, 0.1), failing))
    assert labels(entries) == ["starting", "started", *["ok"] * 5, "numerical", *["ok"] * 12]
    assert entries[7].reason == f"{error}; the update failed: the state was only predicted"
    step = entries[7].updated.mean - entries[6].updated.mean
    np.testing.assert_allclose(step[:3], entries[6].updated.mean[3:], rtol=1e-12)
    assert np.nanmax(errors(problem, entries)[5:]) < 5.0


def test_an_update_that_fails_for_one_of_a_batch_leaves_the_others():
    from optloc.tracking import UPDATES

    problem = run(np.arange(5.0))
    means = np.concatenate([START, SPEED]) + np.array([0.0, 3.0, -3.0])[:, None]
    start = State(-1.0, means, np.tile(np.diag([25.0] * 3 + [4.0] * 3), (3, 1, 1)))

    def failing(scan, mean, cov):
        if (np.atleast_2d(mean)[:, 5] > 3.0).any():
            raise np.linalg.LinAlgError
        return UPDATES["ekf"](scan, mean, cov)

    many, plain = (followed(problem, start, polynomial(1, 0.5), update) for update in (failing, "ekf"))
    assert (many.code == Status.NUMERICAL).tolist() == [[False] * 5, [True] * 5, [False] * 5]
    np.testing.assert_allclose(many.mean[[0, 2]], plain.mean[[0, 2]], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"update": "ukf"}, "unknown filter 'ukf'"),
        ({"start": State(0.0, np.zeros(3), np.eye(3))}, "3 numbers"),
        ({"start": State(5.0, np.zeros(6), np.eye(6))}, "after the first scan"),
        ({"start": State(0.0, np.full(6, np.nan), np.eye(6))}, "not finite"),
        ({"start": State(0.0, np.zeros(6), -np.eye(6))}, "semidefinite"),
        ({"start": State(0.0, np.full(6, 1e4), np.eye(6))}, "contradicts the first scan"),
        ({"start": State(0.0, np.full(6, 100.0), np.eye(6)), "rules": Rules(gate=np.inf)}, "contradicts"),
    ],
)
def test_bad_input_is_a_sentence(change, words):
    with pytest.raises(InvalidProblem, match=words) as caught:
        list(tracked(run(np.arange(5.0)), polynomial(1), **change))
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize("times", [[0.0, 2.0, 1.0, 3.0], [0.0, 1.0, 1.0, 2.0]])
def test_times_that_do_not_increase_are_refused_before_the_first_scan(times):
    problem = replace(run(np.arange(4.0)), times=np.array(times))
    with pytest.raises(InvalidProblem, match="sort the scans"):
        tracked(problem, polynomial(1))


def test_one_target_of_several_keeps_its_rows_times_and_noise():
    times = np.arange(6.0)
    one, two = run(times, seed=1), run(times, seed=2)
    both = assemble(
        STATIONS,
        *(
            measured(
                "tdoa",
                part.z,
                a=part.rows[0].a,
                b=part.rows[0].b,
                epoch=part.rows[0].epoch,
                target=np.full(part.count, i),
                arrival_sigma=SIGMA,
            )
            for i, part in enumerate((one, two))
        ),
        times=times,
        motions=(Motion(1), Motion(1)),
    )
    target = np.concatenate([rows.target for rows in both.rows])
    for i, part in enumerate((one, two)):
        own = alone(both, (target == i) & (both.epoch > 0))
        assert own.times.tolist() == times[1:].tolist()
        ours = collected(list(tracked(own, polynomial(1, 0.1))), 3)
        theirs = collected(list(tracked(alone(part, part.epoch > 0), polynomial(1, 0.1))), 3)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-9)
    with pytest.raises(InvalidProblem, match="no rows"):
        alone(both, target == 7)


def test_rows_that_are_left_keep_their_covariance():
    part = run(np.arange(3.0))
    kept = (np.arange(part.count) % 5) != 1
    own = alone(part, kept)
    D = np.zeros((4, 6))
    pairs = np.delete(PAIRS, 1, axis=0)
    D[np.arange(4), pairs[:, 0]], D[np.arange(4), pairs[:, 1]] = 1.0, -1.0
    for block in own.noise.blocks:
        np.testing.assert_allclose(
            np.broadcast_to(block.covariance, (len(block.row), 4, 4)), [D @ D.T] * len(block.row)
        )


def earth(count=20):
    """Return three satellites, their range differences to a slow target on the ground, and the truth (k, 3)."""
    rng = np.random.default_rng(0)
    site = ECEF.from_geodetic(np.radians(47.0), np.radians(8.0), 400.0)
    east = np.array([-np.sin(np.radians(8.0)), np.cos(np.radians(8.0)), 0.0])
    up = site / np.linalg.norm(site)
    north = np.cross(up, east)
    sky = np.array([[0.6, 0.2, 0.77], [-0.7, 0.3, 0.65], [0.1, -0.75, 0.65]]) @ np.stack([east, north, up])
    stations = site + 2.2e7 * sky
    times = np.arange(float(count))
    path = site + times[:, None] * 10.0 * east
    lat, lon, _ = ECEF.to_geodetic(path)
    path = np.stack([ECEF.from_geodetic(a, b, 400.0) for a, b in zip(lat, lon, strict=True)])
    arrival = np.linalg.norm(path[:, None] - stations, axis=-1) + rng.standard_normal((count, 3))
    z = arrival[:, 1:] - arrival[:, :1]
    rows = measured(
        "tdoa",
        z.ravel(),
        a=np.tile([1, 2], count),
        b=np.zeros(2 * count, dtype=int),
        epoch=np.repeat(np.arange(count), 2),
        arrival_sigma=1.0,
    )
    made = assemble(
        station_array(stations), rows, times=times, frame=ECEF, motions=(Motion(),), constraints=[height(exactly=400.0)]
    )
    return made, path


def test_a_known_height_is_held_by_every_update():
    problem, path = earth()
    entries = list(tracked(problem, polynomial(1, 0.1)))
    track = collected(entries, 3)
    known = np.isfinite(track.position).all(-1)
    assert known.sum() >= 17
    np.testing.assert_allclose(ECEF.to_geodetic(track.position[known])[2], 400.0, atol=0.05)
    assert np.linalg.norm(track.position[-1] - path[-1]) < 15.0


def test_other_equalities_are_refused():
    problem = replace(run(np.arange(4.0)), constraints=box([150.0, -1e4, -1e4], [150.0, 1e4, 1e4]))
    with pytest.raises(InvalidProblem, match="equality"):
        tracked(problem, polynomial(1))


@pytest.mark.slow
def test_pictures_of_tracks_in_space_and_on_earth(tmp_path):
    pytest.importorskip("matplotlib")
    from optloc.show.pictures import plot_tracks, save
    from optloc.show.pictures.track import PlottedTrack

    for name, problem in (("space", run(np.arange(15.0), wild=(6,))), ("earth", earth(12)[0])):
        figure = plot_tracks([PlottedTrack(name, problem, tuple(tracked(problem, polynomial(1, 0.1))))], title=name)
        panels = [axes for axes in figure.axes if axes.get_visible()]
        assert [axes.get_ylabel() for axes in panels][1:] == [
            f"{'up' if name == 'earth' else 'z'} (m)",
            "sigma (m)",
            "NIS",
        ]
        # Satellites are out of the picture, stations on the ground are in it.
        assert (panels[0].get_legend_handles_labels()[1].count("station, first scan") == 1) == (name == "space")
        save(figure, tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000
