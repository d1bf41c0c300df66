"""What Stone Soup asks of reversible models, initiators and states, as a table of ours times its contracts."""

import copy
import datetime as dt
import inspect
import pickle
import time
from io import StringIO

import numpy as np
import pytest
from monte_carlo.tables import write

pytest.importorskip("stonesoup", reason="Stone Soup is not installed: pip install 'optloc[stonesoup]'")

from plugins.stonesoup.test_stonesoup import MODELS, PAIRS, PLACE, RATE, SIGMA, STATIONS, TRANSITION, TRUTH, ZERO, tdoa
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator.simple import EnsembleInitiator, GaussianMixtureInitiator, GaussianParticleInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.serialise import YAML
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.mixture import GaussianMixture
from stonesoup.types.state import EnsembleState, GaussianState, ParticleState, State, StateVectors
from stonesoup.updater.kalman import ExtendedKalmanUpdater

import optloc
from optloc import InvalidProblem
from optloc.plugins import stonesoup as plugin
from optloc.plugins.stonesoup import AnyRows, FixInitiator, PairFeeder, chains, initiator, mixture_state

TABLE = [("tdoa", 1, 0), ("tdoa", 2, 0), ("azimuth", 3, -1), ("range", 4, -1), ("elevation", 5, -1), ("groa", 2, 1)]
NOISE = np.diag([100.0, 100.0, 1e-6, 100.0, 1e-6, 1e-6])
SHAPE = {"ndim_state": 6, "mapping": PLACE, "stations": STATIONS}


def mixed():
    return AnyRows(table=TABLE, noise_covar=NOISE, **SHAPE)


def mixed_rates():
    table = [*TABLE, *(("range_rate", i, -1) for i in range(4))]
    return AnyRows(table=table, noise_covar=np.diag([*np.diag(NOISE), *[0.01] * 4]), **SHAPE)


ALL = MODELS | {"mixed": mixed, "mixed with rates": mixed_rates}
# Rates alone do not show position and velocity at one instant.
REVERSIBLE = [name for name in ALL if name not in ("RangeRate", "FDOA")]
# On both sides: their ranges and angles differ by kilometres and quadrants.
STATES = np.hstack([TRUTH, TRUTH + np.array([[-2500.0, 30, -3000, 20, 900, -3]]).T, TRUTH + 500.0])


def of(model, states):
    return np.asarray(model.function(State(StateVectors(states))), dtype=float)


@pytest.mark.parametrize("name", REVERSIBLE)
def test_the_inverse_of_several_is_that_of_each(name):
    model = ALL[name]()
    values = model.function(State(StateVectors(STATES)))
    back = np.asarray(model.inverse_function(Detection(values, measurement_model=model)), dtype=float)
    assert back.shape == STATES.shape
    np.testing.assert_allclose(back[model.places], STATES[model.places], atol=1e-3)
    for i in range(STATES.shape[1]):
        one = model.inverse_function(Detection(values[:, i : i + 1], measurement_model=model))
        assert one.shape == (6, 1)
        np.testing.assert_allclose(np.asarray(one, dtype=float)[:, 0], back[:, i], atol=1e-6)
    assert (back[[i for i in range(6) if i not in model.places]] == 0.0).all()


@pytest.mark.parametrize("name", ["mixed", "mixed with rates"])
def test_a_mixture_has_the_derivatives_of_its_function(name):
    model = ALL[name]()
    step = 0.1 * np.eye(6)
    numeric = [(of(model, TRUTH + s[:, None]) - of(model, TRUTH - s[:, None]))[:, 0] / 0.2 for s in step]
    np.testing.assert_allclose(model.jacobian(State(TRUTH)), np.array(numeric).T, rtol=1e-5, atol=1e-9)
    detection = Detection(model.function(State(TRUTH)), measurement_model=model)
    assert model.pdf(detection, State(TRUTH)) > model.pdf(detection, State(TRUTH + 100.0))
    assert model.rvs(7).shape == (model.ndim_meas, 7)


PUBLIC = {name: getattr(plugin, name) for name in plugin.__all__}
CLASSES = {name: kind for name, kind in PUBLIC.items() if inspect.isclass(kind) and not inspect.isabstract(kind)}
MADE = ALL | {
    "FixInitiator": lambda: FixInitiator(speed=30.0, velocity_mapping=RATE, limit=7, prior_state=prior()),
    "PairFeeder": lambda: PairFeeder([], arrival_sigma=3.0, label="emitter"),
}


def test_no_class_of_the_plug_in_is_forgotten():
    assert {type(make()) for make in MADE.values()} == set(CLASSES.values())


@pytest.mark.parametrize("name", MADE)
def test_copies_pickles_and_yaml_have_the_same_properties(name):
    yaml = YAML()
    plugin.register_yaml(yaml)

    def written(one):
        text = StringIO()
        yaml.dump(one, text)
        return text.getvalue()

    def properties(one):
        return {key: written(getattr(one, key)) for key in type(one).properties}

    own = MADE[name]()
    known = properties(own)
    for two in (copy.copy(own), copy.deepcopy(own), pickle.loads(pickle.dumps(own)), yaml.load(written(own))):
        assert type(two) is type(own)
        assert properties(two) == known


@pytest.mark.parametrize("name", ALL)
def test_every_model_begins_a_track(name, seed):
    """Rates alone have no start: they begin none, and break nothing."""
    rng, model, tracks, state = np.random.default_rng(seed), ALL[name](), set(), TRUTH.copy()
    begins = FixInitiator(speed=100.0)
    root = np.linalg.cholesky(np.asarray(model.covar(), dtype=float))
    for k in range(6):
        value = of(model, state) + root @ rng.standard_normal((model.ndim_meas, 1))
        when = ZERO + dt.timedelta(seconds=k)
        tracks = begins.initiate({Detection(value, timestamp=when, measurement_model=model)}, when)
        if tracks:
            break
        state[PLACE] += state[RATE]
    if name not in REVERSIBLE:
        assert not tracks
        return
    (track,) = tracks
    off = np.asarray(track.state_vector, dtype=float) - state
    assert off[:, 0] @ np.linalg.solve(np.asarray(track.covar, dtype=float), off[:, 0]) < 32.0  # 1e-5 of chi-square
    assert track[-1].hypothesis.measurement.measurement_model is model


@pytest.mark.parametrize("name", ALL)
def test_copies_pickles_and_yaml_are_the_same_model(name):
    model, yaml, text = ALL[name](), YAML(), StringIO()
    plugin.register_yaml(yaml)
    yaml.dump(model, text)
    for two in (copy.copy(model), copy.deepcopy(model), pickle.loads(pickle.dumps(model)), yaml.load(text.getvalue())):
        assert type(two) is type(model)
        np.testing.assert_array_equal(of(two, STATES), of(model, STATES))
        np.testing.assert_array_equal(np.asarray(two.covar(), float), np.asarray(model.covar(), float))


@pytest.mark.parametrize("name", ALL)
def test_an_offset_moves_all_stations(name):
    model, offset = ALL[name](), np.array([[300.0], [-200.0], [50.0]])
    before = of(model, STATES)
    model.translation_offset = offset
    moved = STATES.copy()
    moved[PLACE] += offset
    np.testing.assert_allclose(of(model, moved), before, rtol=1e-9, atol=1e-9)
    with pytest.raises(InvalidProblem, match="translation_offset"):
        tdoa(translation_offset=np.zeros((2, 1)))


def prior():
    return GaussianState(np.zeros((6, 1)), np.diag([1e6, 1e4] * 3), timestamp=ZERO)


def scans(count, seed, targets, clutter=0):
    """Yield times and detections: targets (6, 1) in uniform motion, and false ones drawn over the box."""
    rng, model = np.random.default_rng(seed), tdoa()
    root = np.linalg.cholesky(np.asarray(model.covar(), dtype=float))
    for k in range(count):
        when, found = ZERO + dt.timedelta(seconds=k), set()
        false = [np.array([rng.uniform([0, 0, 500], [9000, 9000, 6000])]).T for _ in range(clutter)]
        for target in targets:
            state = target.copy()
            state[PLACE] += k * target[RATE]
            found.add(
                Detection(
                    np.asarray(model.function(State(state)), float) + root @ rng.standard_normal((5, 1)),
                    timestamp=when,
                    measurement_model=model,
                )
            )
        for place in false:
            state = np.zeros((6, 1))
            state[PLACE] = place
            # Of every second one the rows do not fit together; the others are emitters that are heard once.
            off = rng.uniform(-300.0, 300.0, (5, 1)) if rng.random() < 0.5 else root @ rng.standard_normal((5, 1))
            value = np.asarray(model.function(State(state)), float) + off
            found.add(Detection(value, timestamp=when, measurement_model=model))
        yield when, found


WRAPPED = {
    "particles": (lambda inner: GaussianParticleInitiator(inner, number_particles=300), ParticleState),
    "mixture": (GaussianMixtureInitiator, GaussianMixture),
    "ensemble": (lambda inner: EnsembleInitiator(inner, ensemble_size=300), EnsembleState),
}


@pytest.mark.parametrize("name", WRAPPED)
def test_the_host_s_initiators_stand_around_ours(name, seed):
    np.random.seed(seed % 2**32)  # noqa: NPY002  # the host draws from it
    make, kind = WRAPPED[name]
    initiator = make(FixInitiator(speed=100.0, prior_state=prior()))
    tracks = set()
    k = -1
    for when, found in scans(6, seed, [TRUTH]):
        k += 1
        tracks = initiator.initiate(found, when)
        if tracks:
            break
    (track,) = tracks
    assert isinstance(track[-1], kind)
    truth = TRUTH.copy()
    truth[PLACE] += k * TRUTH[RATE]
    mean = np.asarray(track[-1].mean, dtype=float).reshape(6, 1)
    assert np.linalg.norm((mean - truth)[PLACE]) < 200.0


def test_what_a_fix_does_not_say_is_of_the_prior():
    big = GaussianState(np.arange(8.0)[:, None], np.diag(np.arange(8.0) + 1.0), timestamp=ZERO)
    model = tdoa(ndim_state=8)
    value = model.function(State(np.vstack([TRUTH, [[0.0], [0.0]]])))
    initiator = FixInitiator(order=0, prior_state=big)
    (track,) = initiator.initiate({Detection(value, timestamp=ZERO, measurement_model=model)}, ZERO)
    rest = [1, 3, 5, 6, 7]
    assert np.asarray(track.state_vector, float)[rest, 0].tolist() == rest
    np.testing.assert_array_equal(np.asarray(track.covar, float)[np.ix_(rest, rest)], np.diag(np.array(rest) + 1.0))
    np.testing.assert_allclose(np.asarray(track.state_vector, float)[PLACE], TRUTH[PLACE], atol=1e-2)


def test_a_mixture_of_optloc_is_one_of_the_host():
    problem = optloc.assemble(STATIONS, optloc.measured("tdoa", a=PAIRS[:, 0], b=PAIRS[:, 1], arrival_sigma=SIGMA))
    problem = optloc.simulate(problem, TRUTH[PLACE, 0], 1)
    fix = optloc.solve(problem)
    found, own = mixture_state(problem, fix, PLACE, prior(), ZERO), optloc.uncertainty.mixture(problem, fix)
    assert isinstance(found, GaussianMixture)
    assert len(found) == len(own.weight)
    assert sum(float(one.weight) for one in found) == pytest.approx(1.0)
    np.testing.assert_allclose(np.asarray(found[0].state_vector, float)[PLACE, 0], own.mean[0])
    np.testing.assert_allclose(np.asarray(found[0].covar, float)[np.ix_(PLACE, PLACE)], own.covariance[0])
    assert found.mean.shape == (6, 1)


TWO = [TRUTH, np.array([6000.0, -50, 3000, 30, 4500, 0])[:, None]]


def in_clutter(seed, clutter, count):
    """Return the tracks of two targets in clutter, how many of the targets have one, and processor seconds a scan."""
    updater = ExtendedKalmanUpdater(measurement_model=None)
    hypothesiser = DistanceHypothesiser(ExtendedKalmanPredictor(TRANSITION), updater, Mahalanobis(), missed_distance=10)
    tracker = MultiTargetTracker(
        initiator=FixInitiator(speed=100.0, confirm=4),
        detector=list(scans(count, seed, TWO, clutter=clutter)),
        deleter=UpdateTimeStepsDeleter(4),
        data_associator=GNNWith2DAssignment(hypothesiser),
        updater=updater,
    )
    every, spent, began = set(), [], time.process_time()
    for _, tracks in tracker:
        spent.append(time.process_time() - began)
        every |= tracks
        began = time.process_time()
    ends = [target[PLACE] + (count - 1) * target[RATE] for target in TWO]
    gaps = [[np.linalg.norm(np.asarray(t.state_vector, float)[PLACE] - end) for t in every] for end in ends]
    return len(every), sum(min(gap, default=np.inf) < 100.0 for gap in gaps), spent


@pytest.mark.parametrize("clutter", [5, 10])
def test_two_targets_in_clutter_are_two_tracks_by_bounded_work(clutter, seed, monkeypatch):
    """What a scan costs is counted, not timed: work in its own units, and solutions without a start."""
    calls, solved = [], []
    solve = initiator.solve

    def counted(left):
        calls.append(chains.ChainWork(left))
        return calls[-1]

    monkeypatch.setattr(initiator, "ChainWork", counted)
    for module in (initiator, chains):
        monkeypatch.setattr(module, "solve", lambda *problem: solved.append(len(calls)) or solve(*problem))
    tracks, found, _ = in_clutter(seed, clutter, 8)
    assert (tracks, found) == (2, 2)
    bound = FixInitiator().work
    # What is begun is finished: one search at most, or one batch.
    assert min(call.left for call in calls) > -chains.LONG
    assert max(np.bincount(solved)) <= bound / chains.LONG + 1
    assert len(solved) <= len(calls)


COUNTED = {"seeds": 30, "scans": 16}


@pytest.mark.full
def test_counts_in_clutter():
    """Two targets and 5 or 10 false alarms a scan: the table of the documentation."""
    rows = []
    in_clutter(0, 5, 4)  # machine code is loaded before anything is timed
    for clutter in (5, 10):
        all_of = [in_clutter(seed, clutter, COUNTED["scans"]) for seed in range(COUNTED["seeds"])]
        tracks, found, spent = (np.array(part) for part in zip(*all_of, strict=True))
        cells = [found.sum(), 2 * len(found), (tracks - found).sum()]
        times = [spent.mean(), np.median(spent), spent.mean(1).max(), spent.max()]
        rows.append([str(clutter), *map(str, cells), *(f"{value:.3f}" for value in times)])
        assert found.sum() >= 0.97 * 2 * len(found)
    header = ["false alarms a scan", "targets with a track", "of", "spurious tracks", "mean, s", "median, s"]
    header += ["mean of the slowest run, s", "slowest scan, s"]
    facts = f"seeds 0 to {COUNTED['seeds'] - 1}, {COUNTED['scans']} scans each, processor time of each scan"
    write("stonesoup_clutter", header, rows, facts)
