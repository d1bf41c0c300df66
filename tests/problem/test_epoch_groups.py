"""Epochs in groups of one structure have the fixes that their own problems have, whichever stations measured."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import optloc
from optloc import assemble, measured
from optloc.base.types import Motion, Rows
from optloc.engine.plan import plan_of
from optloc.problem.build import station_array
from optloc.problem.epoch_groups import epoch_groups, problem_of
from optloc.problem.epochs import _distinct_rows, by_epoch

STATIONS = np.random.default_rng(3).uniform([-3e4, -3e4, 0.0], [3e4, 3e4, 3e3], (12, 3))
NAMES = tuple(f"R{i}" for i in range(12))


def run(kind, epochs=40, fewest=6, **noise):
    """Return epochs, each measured by other stations, and the stations (k lists) of each."""
    rng = np.random.default_rng(5)
    rows, heard = [], []
    for k in range(epochs):
        own = rng.permutation(12)[: rng.integers(fewest, 8)]
        place = rng.uniform([-2e4, -2e4, 4e3], [2e4, 2e4, 9e3])
        ranges = np.linalg.norm(STATIONS[own] - place, axis=1) + rng.normal(size=len(own))
        heard.append(own)
        if kind == "toa":
            rows += [(k, a, -1, r + 1e5 * k) for a, r in zip(own, ranges, strict=True)]
        else:
            rows += [(k, a, own[0], r - ranges[0]) for a, r in zip(own[1:], ranges[1:], strict=True)]
    order = rng.permutation(len(rows))  # a table need not be sorted
    epoch, a, b, z = (np.array(column)[order] for column in zip(*rows, strict=True))
    own = {} if kind == "toa" else {"b": b.astype(int)}
    made = measured(kind, z, a=a.astype(int), epoch=epoch.astype(int), **own, **noise)
    return assemble(
        station_array(STATIONS, NAMES), made, motions=[Motion(0, "epoch")], times=np.arange(float(epochs))
    ), heard


@pytest.mark.parametrize(("kind", "noise"), [("toa", {"sigma": 1.0}), ("tdoa", {"arrival_sigma": 1.0})])
def test_fixes_are_those_of_the_union_of_all_rows(kind, noise):
    problem, heard = run(kind, **noise)
    groups = epoch_groups(problem)
    assert sorted(np.concatenate([one.epochs for one in groups]).tolist()) == list(range(40))
    assert len(groups) == len({len(own) for own in heard})
    union = optloc.solve(by_epoch(problem), "gtrs+lsr")
    for one in groups:
        fix = optloc.solve(one.problem, "gtrs+lsr")
        np.testing.assert_allclose(fix.position, union.position[one.epochs], atol=1e-3)
        np.testing.assert_allclose(fix.cov, union.cov[one.epochs], rtol=1e-4, atol=1e-9)
        assert fix.dof.tolist() == union.dof[one.epochs].tolist()


@pytest.mark.parametrize("kind", ["toa", "tdoa"])
def test_errors_of_stations_that_are_noise_stay_with_their_stations(kind):
    """Each station has an error of its own size: that of another one would be seen in the covariance."""
    problem, _ = run(kind, **({"sigma": 1.0} if kind == "toa" else {"arrival_sigma": 1.0}))
    covariance = np.geomspace(1.0, 1e4, 12)[:, None, None] * np.eye(3)
    problem = replace(problem, stations=replace(problem.stations, covariance=covariance, span="noise"))
    union = optloc.solve(by_epoch(problem), "gtrs+lsr")
    for one in epoch_groups(problem):
        fix = optloc.solve(one.problem, "gtrs+lsr")
        np.testing.assert_allclose(fix.cov, union.cov[one.epochs], rtol=1e-3)
        np.testing.assert_allclose(fix.p_value, union.p_value[one.epochs], atol=1e-3)


def test_one_plan_serves_all_sets_of_stations():
    problem, _ = run("toa", sigma=1.0)
    for one in epoch_groups(problem):
        assert plan_of(one.problem) is not None
        rows, noise = one.problem.rows[0], one.problem.noise.blocks[0]
        assert (rows.weight.ndim, rows.correction.ndim, noise.covariance.ndim) == (1, 1, 3)


def test_the_problem_of_an_epoch_has_the_names_of_its_stations():
    problem, heard = run("tdoa", arrival_sigma=1.0)
    groups = epoch_groups(problem)
    for k in range(0, 40, 7):
        own = problem_of(groups, k)
        assert set(own.stations.names) == {NAMES[i] for i in heard[k]}
        place = dict(zip(own.stations.names, own.stations.position[0, 0], strict=True))
        for name, at in place.items():
            assert at.tolist() == STATIONS[NAMES.index(name)].tolist()


def test_suspects_and_reasons_have_the_names_of_the_run():
    problem, _ = run("toa", fewest=7, sigma=1.0)
    rows = problem.rows[0]
    wrong = int(np.flatnonzero(rows.epoch == 4)[0])
    problem = replace(problem, rows=(replace(rows, z=rows.z + 4e3 * (np.arange(rows.count) == wrong)),))
    (group,) = epoch_groups(problem)
    part = group.take(slice(4, 5))
    fix = part.name(optloc.solve(part.problem, "robust"))
    assert fix.explanations[0][0].names == (f"station {NAMES[rows.a[wrong]]}",)
    assert "\ue000" not in fix.reason[0]


def test_equal_rows_of_all_epochs_make_the_batch_of_by_epoch():
    z = np.random.default_rng(1).uniform(1e4, 2e4, 30)
    made = measured("range", z, a=np.tile(np.arange(6), 5), epoch=np.repeat(np.arange(5), 6), sigma=1.0)
    problem = assemble(station_array(STATIONS, NAMES), made, motions=[Motion(0, "epoch")], times=np.arange(5.0))
    (group,) = epoch_groups(problem)
    batch = by_epoch(problem)
    assert group.stations is None
    assert group.problem.stations.names == NAMES
    np.testing.assert_array_equal(group.problem.z, batch.z)
    assert group.problem.structure == batch.structure


@pytest.mark.parametrize("count", [0, 1, 40])
def test_rows_that_repeat_within_an_epoch_keep_places_of_their_own(count, seed):
    """A dictionary of all rows, in the order in which they come, is the reference."""
    rng = np.random.default_rng(seed)
    a, b, target, epoch = (rng.integers(low, 4, count) for low in (-1, -1, -1, 0))
    rows = Rows("tdoa", np.zeros(count), a, b, epoch, target, np.ones(count), np.zeros(count))
    seen, keys, places = Counter(), {}, []
    for key in zip(a.tolist(), b.tolist(), target.tolist(), epoch.tolist(), strict=True):
        places.append(keys.setdefault((*key[:3], seen[key]), len(keys)))
        seen[key] += 1
    found, place = _distinct_rows(rows)
    assert [tuple(one) for one in found.tolist()] == list(keys)
    assert place.tolist() == places
