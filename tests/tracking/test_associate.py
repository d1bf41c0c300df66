"""Rows without names: gates, sets and assignments against brute force written from the spec's formula."""

from itertools import product

import numpy as np
import pytest
from often import few
from scipy.stats import chi2

import optloc
from optloc.base.errors import InvalidProblem
from optloc.base.types import Motion, Status
from optloc.lab.papers.kinematic import KinematicScenario, draw, start_from_fix, strip_labels
from optloc.linear.evaluate import predict
from optloc.linear.simulate import simulate
from optloc.tracking import State, followed, gated, polynomial
from optloc.tracking.associate import Clutter, assigned, joint, nearest, scored
from optloc.tracking.several_targets import RowCandidates, associated, candidates
from optloc.tracking.track import scans
from optloc.tracking.updates import innovation

STATIONS = np.array([[0.0, 0.0], [20e3, 1e3], [-3e3, 18e3], [12e3, -15e3]])
TARGETS = np.array([[40e3, 25e3], [40.2e3, 25.1e3], [39.9e3, 25.2e3]])
CLUTTER = Clutter(0.8, 1e-3)


def channels(epochs=1, *, shared=True, kinds=("tdoa",)):
    a, epoch = np.tile([1, 2, 3], epochs), np.repeat(np.arange(epochs), 3)
    rows = []
    if "tdoa" in kinds:
        noise = {"arrival_sigma": 30.0} if shared else {"sigma": 30.0}
        rows.append(optloc.measured("tdoa", a=a, b=0, epoch=epoch, **noise))
    if "azimuth" in kinds:
        rows.append(optloc.measured("azimuth", a=np.zeros(epochs, int), epoch=np.arange(epochs), sigma=1e-3))
    return optloc.assemble(STATIONS, *rows, times=np.arange(epochs) + 1.0, motions=[Motion(0)])


def around(places=TARGETS, sigma=300.0, seed=1):
    rng = np.random.default_rng(seed)
    mean = places + rng.normal(0.0, sigma, places.shape)
    return State(1.0, mean, np.broadcast_to(sigma**2 * np.eye(2), (*places.shape, 2)))


def table(seed, false=2, detection=0.8):
    """Return a scan and candidates (3, c) of the targets and of nobody."""
    rng = np.random.default_rng(seed)
    scan = next(iter(scans(channels(), 0)))[1]
    z = np.array([simulate(scan, place, seed * 10 + i).z for i, place in enumerate(TARGETS)]).T
    z = np.where(rng.random(z.shape) < detection, z, np.nan)
    return scan, np.concatenate([z, z.mean() + rng.normal(0.0, 400.0, (3, false))], axis=1)


def h(x):
    r = np.linalg.norm(x - STATIONS, axis=-1)
    return r[1:] - r[0]


def slope(x):
    u = (x - STATIONS) / np.linalg.norm(x - STATIONS, axis=-1, keepdims=True)
    return u[1:] - u[0]


def cost(x, P, pick, z, clutter, width=5.0):
    """Return the spec's score of a set, infinite where a row is missing or outside its own gate."""
    S = slope(x) @ P @ slope(x).T + 900.0 * (np.eye(3) + 1.0)
    used = [i for i in range(3) if pick[i] >= 0]
    nu = np.array([z[i, pick[i]] - h(x)[i] for i in used])
    if np.isnan(nu).any() or (np.abs(nu) > width * np.sqrt(np.diag(S)[used])).any():
        return np.inf
    n, part = len(used), S[np.ix_(used, used)]
    total = -2.0 * n * np.log(clutter.detection / clutter.density) - 2.0 * (3 - n) * np.log(1.0 - clutter.detection)
    return total + (nu @ np.linalg.solve(part, nu) + np.linalg.slogdet(2.0 * np.pi * part)[1] if n else 0.0)


def costs(state, z, clutter=CLUTTER):
    picks = list(product(range(-1, z.shape[1]), repeat=3))
    return picks, np.array(
        [[cost(x, P, p, z, clutter) for p in picks] for x, P in zip(state.mean, state.cov, strict=True)]
    )


@pytest.mark.parametrize("seed", range(4))
def test_scores_of_sets_are_those_of_the_formula(seed):
    scan, z = table(seed)
    state = around(seed=seed)
    picks, wanted = costs(state, z)
    sets = scored(scan, state, z, CLUTTER)
    for t in range(3):
        found = dict.fromkeys(picks, np.inf)
        for pick, score in zip(sets.picks[t], sets.score[t], strict=True):
            found[tuple(pick.tolist())] = score
        assert np.array([found[p] for p in picks]) == pytest.approx(wanted[t], rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_joint_rule_takes_the_best_set_of_each_target(seed):
    scan, z = table(seed)
    state = around(seed=seed)
    picks, wanted = costs(state, z)
    assert (joint(CLUTTER)(scan, state, z) == [picks[i] for i in wanted.argmin(1)]).all()


@pytest.mark.parametrize("seed", few(range(6), 2))
def test_the_assignment_is_the_best_of_all_that_use_no_row_twice(seed):
    scan, z = table(seed, false=1)
    state = around(seed=seed)
    picks, wanted = costs(state, z)
    better = [np.flatnonzero(own <= own[picks.index((-1, -1, -1))]) for own in wanted]
    best = (np.inf, None)
    for numbers in product(*better):
        chosen = np.array([picks[i] for i in numbers])
        apart = all(len(set(col[col >= 0])) == (col >= 0).sum() for col in chosen.T)
        total = sum(wanted[t, i] for t, i in enumerate(numbers))
        if apart and total < best[0]:
            best = (total, chosen)
    assert (assigned(CLUTTER)(scan, state, z) == best[1]).all()


def test_some_of_these_targets_do_compete_for_rows():
    rivals = 0
    for seed in range(6):
        scan, z = table(seed, false=1)
        pick = joint(CLUTTER)(scan, around(seed=seed), z)
        rivals += any(len(set(col[col >= 0])) < (col >= 0).sum() for col in pick.T)
    assert rivals >= 2


def test_the_nearest_rule_is_nearest_and_gated():
    scan, z = table(3)
    state = around(seed=3)
    pick = nearest(2.0)(scan, state, z)
    for t, (x, P) in enumerate(zip(state.mean, state.cov, strict=True)):
        sigma = np.sqrt(np.diag(slope(x) @ P @ slope(x).T + 900.0 * (np.eye(3) + 1.0)))
        for i in range(3):
            far = np.abs(z[i] - h(x)[i]) / sigma[i]
            inside = np.where(far <= 2.0, far, np.inf)
            assert pick[t, i] == (int(np.argmin(inside)) if np.isfinite(inside).any() else -1)
    assert (nearest(1e-9)(scan, state, z) == -1).all()


def test_batches_are_their_scans():
    given = [table(seed) for seed in range(5)]
    scan, z = given[0][0], np.stack([z for _, z in given])
    states = [around(seed=seed) for seed in range(5)]
    both = State(1.0, np.stack([s.mean for s in states]), np.stack([s.cov for s in states]))
    for rule in (nearest(), joint(CLUTTER), assigned(CLUTTER)):
        together = rule(scan, both, z)
        for i, state in enumerate(states):
            assert (together[i] == rule(scan, state, z[i])).all()


def test_many_channels_and_candidates_keep_to_the_near_ones():
    """Twelve channels of twelve candidates are 2 10^13 sets; the right one is among those that are followed."""
    stations = np.array([[20e3 * np.cos(a), 20e3 * np.sin(a)] for a in np.linspace(0.0, 6.0, 13)])
    rows = optloc.measured("tdoa", a=np.arange(1, 13), b=0, arrival_sigma=10.0)
    scan = next(iter(scans(optloc.assemble(stations, rows), 0)))[1]
    rng = np.random.default_rng(4)
    z = rng.uniform(-40e3, 40e3, (12, 12))
    right = rng.integers(0, 12, 12)
    z[np.arange(12), right] = simulate(scan, TARGETS[0], 5).z
    state = around(TARGETS[:1])
    clutter = Clutter(0.9, 12 / 80e3)
    assert (assigned(clutter)(scan, state, z) == right).all()
    sets = scored(scan, state, z, clutter)
    assert sets.score.shape == (1, 1000)
    assert (sets.picks[0, 0] == -1).all()


def test_angles_wrap():
    made = channels(kinds=("azimuth",))
    scan = next(iter(scans(made, 0)))[1]
    place = np.array([[-30e3, -1.0], [-30e3, 20e3]])
    state = State(1.0, place, np.broadcast_to(1e2 * np.eye(2), (2, 2, 2)))
    z = np.array([[np.pi - 1e-4, predict(scan, place[1])[0]]])
    clutter = Clutter(0.9, {"azimuth": 1.0})
    for rule in (nearest(), joint(clutter), assigned(clutter)):
        assert (rule(scan, state, z) == [[0], [1]]).all()


def test_densities_go_by_kind():
    made = channels(kinds=("tdoa", "azimuth"))
    assert (Clutter(0.9, {"tdoa": 2.0, "azimuth": 5.0}).of(made) == [2.0, 2.0, 2.0, 5.0]).all()
    with pytest.raises(InvalidProblem, match="azimuth"):
        Clutter(0.9, {"tdoa": 2.0}).of(made)


def test_a_gated_filter_leaves_out_an_outlier_and_nothing_else():
    run = simulate(channels(12, shared=False), TARGETS[0], 6)
    z, weight = run.z.copy(), np.ones(run.count)
    z[[4, 20]] += 5e3
    weight[[4, 20]] = 0.0
    start = State(0.0, TARGETS[0] + 50.0, 200.0**2 * np.eye(2))
    track = followed(run.with_rows(z=z), start, polynomial(0), gated("ekf", 5.0))
    clean = followed(run.with_rows(weight=weight), start, polynomial(0), "ekf")
    assert track.mean == pytest.approx(clean.mean, rel=1e-12)
    assert (track.count == np.where(np.isin(np.arange(12), [1, 6]), 2, 3)).all()
    shut = followed(run.with_rows(z=z + 9e3), start, polynomial(0), gated("iekf"))
    assert (shut.count == 0).all()
    assert (shut.mean == start.mean).all()


# The elements of a covariance of 200 samples are known to a tenth of the largest variance.
@pytest.mark.parametrize(("trials", "within"), few([(200, 0.4), (4000, 0.04)], 1, 2))
def test_innovations_have_the_covariance_that_they_claim(trials, within):
    scan = next(iter(scans(channels(), 0)))[1]
    rng = np.random.default_rng(8)  # other numbers than those of the noise
    many = simulate(scan, TARGETS[0], 7, trials=trials)
    mean = TARGETS[0] + rng.normal(0.0, 60.0, (trials, 2))
    found = innovation(many, mean, np.broadcast_to(3600.0 * np.eye(2), (trials, 2, 2)))
    S = found.covariance.mean(0)
    assert np.cov(found.value.T) == pytest.approx(S, abs=within * S.max())
    squares = (found.value * np.linalg.solve(found.covariance, found.value[..., None])[..., 0]).sum()
    assert chi2.ppf(1e-3, found.value.size) < squares < chi2.isf(1e-3, found.value.size)


def test_rows_without_names_become_candidates():
    """Three channels; the second epoch has two rows in one channel, one row that is absent, and a correction."""
    a, epoch = [1, 2, 3, 3, 1, 2, 1], [0, 0, 0, 1, 1, 1, 1]
    z, weight = np.arange(7.0), [1, 1, 1, 1, 1, 0, 1]
    rows = optloc.measured(
        "tdoa",
        z,
        a=a,
        b=0,
        epoch=epoch,
        target=-1,
        weight=weight,
        arrival_sigma=2.0,
        correction=[0, 0, 0, 0, 0, 0, 0.5],
    )
    given = candidates(optloc.assemble(STATIONS, rows))
    made = given.channels
    assert made.rows[0].a.tolist() == [1, 2, 3, 3, 1, 2]
    assert made.epoch.tolist() == [0, 0, 0, 1, 1, 1]
    nan = np.nan
    wanted = [[0, nan], [1, nan], [2, nan], [3, nan], [4, 5.5], [nan, nan]]
    assert given.z == pytest.approx(np.array(wanted), nan_ok=True)
    for scan in scans(made, 0):
        seen = innovation(scan[1].with_rows(z=np.zeros(3)), TARGETS[0], np.zeros((2, 2)))
        assert seen.covariance == pytest.approx(4.0 * (np.eye(3) + 1.0))


def test_known_corrections_are_taken_off():
    run = channels(3)
    state = around()
    z = np.concatenate([table(seed)[1] for seed in range(3)])
    shifted = optloc.measured(
        "tdoa", a=run.rows[0].a, b=0, epoch=run.epoch, arrival_sigma=30.0, correction=np.arange(9) * 50.0
    )
    other = optloc.assemble(STATIONS, shifted, times=run.times)
    start = State(0.0, state.mean, state.cov)
    plain, moved = (
        associated(given, start, polynomial(0, 10.0), joint(CLUTTER)).track.mean
        for given in (RowCandidates(run, z), RowCandidates(other, z + 50.0 * np.arange(9)[:, None]))
    )
    assert moved == pytest.approx(plain, rel=1e-12)


@pytest.fixture(scope="module")
def drawn():
    scene = KinematicScenario()
    own = draw(scene, scene.course(1), 4, (31,))
    return own, strip_labels(own, 0.7, 2.0, (32,))


def test_everything_seen_and_nothing_false_is_the_labelled_track(drawn):
    own = drawn[0]
    given = strip_labels(own, 1.0 - 1e-12, 0.0, (33,))
    rule = assigned(Clutter(0.99, 1e-7))
    found = associated(given, start_from_fix(own, 1), polynomial(1), rule, "ekf")
    track = followed(own.runs, start_from_fix(own, 1), polynomial(1), "ekf")
    # One predicts before rows are picked, the other with them: rounding differs.
    assert found.track.mean == pytest.approx(track.mean, rel=1e-9, abs=1e-9)
    assert all((pick == np.arange(3)[:, None]).all() for pick in found.picks)


def test_a_missed_row_is_dropped_or_believed(drawn):
    """Against weights of zero, and against measurements that repeat the prediction."""
    own, given = drawn
    start = start_from_fix(own, 1)
    found = associated(given, start, polynomial(1), joint(Clutter(0.7, 1e-5)), "ekf")
    for index in ((0, 0), (3, 2)):
        pick = np.concatenate([p[index] for p in found.picks])
        z = given.z[index[0], 3:][np.arange(60), np.maximum(pick, 0)]
        run = own.runs.with_rows(
            z=np.concatenate([np.zeros(3), np.where(pick >= 0, z, 0.0)]),
            weight=np.concatenate([np.ones(3), (pick >= 0).astype(float)]),
        )
        alone = followed(run, State(0.0, start.mean[index], start.cov[index]), polynomial(1), "ekf")
        assert found.track.mean[index] == pytest.approx(alone.mean, rel=1e-9)
        assert (found.track.count[index] == (pick >= 0).reshape(20, 3).sum(-1)).all()
    believed = associated(given, start, polynomial(1), nearest(), "ekf", missing="expect")
    assert (believed.track.count == 3).all()
    none = associated(given, start, polynomial(1), nearest(1e-12), "ekf", missing="expect")
    assert (none.track.mean[..., 0, :2] == start.mean[..., :2]).all()
    assert (none.track.cov[..., 0, 0, 0] < start.cov[..., 0, 0] + (2e3 * 2.25) ** 2).all()


def test_runs_may_share_their_targets(drawn):
    own, given = drawn
    start = start_from_fix(own, 1)
    one = State(0.0, start.mean[0], start.cov[0])
    z = given.z.copy()
    z[:, 3:6] = np.nan  # nothing at all in the first scan
    rule = assigned(Clutter(0.7, 1e-5))
    made = associated(RowCandidates(given.channels, z), one, polynomial(1), rule)
    assert made.track.mean.shape == (4, 3, 20, 4)
    alone = associated(RowCandidates(given.channels, z[2]), one, polynomial(1), rule)
    assert made.track.mean[2] == pytest.approx(alone.track.mean, rel=1e-9)


def test_scans_of_which_nothing_is_taken_say_why(drawn):
    own, given = drawn
    empty = RowCandidates(given.channels, np.full((4, 63, 1), np.nan))
    lone = associated(empty, start_from_fix(own, 1), polynomial(1), joint(CLUTTER))
    assert (lone.track.code == Status.TOO_FEW_ROWS).all()
    shut = associated(given, start_from_fix(own, 1), polynomial(1), nearest(1e-12))
    assert (shut.track.code == Status.REJECTED).all()
    assert np.isnan(shut.track.nis).all()


@pytest.mark.parametrize("detection", [0.0, 1.0, -0.1, np.nan])
def test_impossible_detections_are_refused(detection):
    with pytest.raises(InvalidProblem, match="between 0 and 1"):
        Clutter(detection, 1.0)


@pytest.mark.parametrize("density", [0.0, -1.0, np.inf, {"tdoa": 0.0}])
def test_impossible_densities_are_refused(density):
    with pytest.raises(InvalidProblem, match="density"):
        Clutter(0.5, density)


def test_what_does_not_fit_is_refused(drawn):
    own, given = drawn
    state = start_from_fix(own, 1)
    lone = State(0.0, state.mean[0, 0], state.cov[0, 0])
    for bad, words in (
        (lambda: associated(given, lone, polynomial(1), nearest()), "axis of targets"),
        (lambda: associated(given, state, polynomial(2), nearest()), "a state of 4 numbers"),
        (lambda: associated(given, state, polynomial(1), nearest(), "kf"), "unknown filter"),
        (lambda: associated(RowCandidates(given.channels, given.z[:, 3:]), state, polynomial(1), nearest()), "shape"),
        (lambda: associated(RowCandidates(own.runs, given.z), state, polynomial(1), nearest()), "batch"),
        (lambda: nearest(0.0), "gate"),
        (lambda: gated("ekf", -1.0), "gate"),
    ):
        with pytest.raises(InvalidProblem, match=words):
            bad()
