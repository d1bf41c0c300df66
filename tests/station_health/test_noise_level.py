"""Sigma before suspects: understated noise is named, liars, a bad station and clean data are no noise."""

import json

import numpy as np
import pytest
from often import few
from station_health.rings import FREE, RING, ranged
from station_health.test_stations import RUN, written

from optloc import assemble, measured, solve
from optloc.cli import app
from optloc.model_checks.elements import batch_of
from optloc.model_checks.noise_level import common_level_at
from optloc.model_checks.score import descend
from optloc.station_health import common_level

STATED = 10.0


def ranges(seed, *, epochs=50, stations=5, factor=1.0, bias=0.0):
    """Return ranges of a free target whose noise is a multiple of what is stated, those of S3 too long."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1500.0, 1500.0, (epochs, 2))
    z = np.linalg.norm(target[:, None] - RING[:stations], axis=-1)
    z = z + STATED * factor * rng.standard_normal(z.shape) + bias * (np.arange(stations) == 3)
    a, epoch = np.tile(np.arange(stations), epochs), np.repeat(np.arange(epochs), stations)
    return assemble(RING[:stations], measured("range", z.ravel(), a=a, sigma=STATED, epoch=epoch), motions=FREE), target


def found(seed, **options):
    problem, target = ranges(seed, **options)
    batch = batch_of(problem)
    return common_level_at(batch, descend(batch, target)[0])


def test_clean_noise_stays_as_stated():
    for seed in range(40):
        level = found(seed)
        assert level.sentence == ""
        np.testing.assert_array_equal(level.factor, 1.0)


@pytest.mark.parametrize("factor", few([2.0, 3.0], 1))
def test_understated_noise_is_the_suspect(factor):
    levels = [found(seed, factor=factor) for seed in range(24)]
    assert sum(level.suspect for level in levels) >= 23
    inside = [level.low[0] < factor < level.high[0] for level in levels if level.suspect]
    assert np.mean(inside) > 0.85
    assert np.median([level.factor[0] for level in levels]) == pytest.approx(factor, rel=0.05)
    assert "noise level is the suspect" in levels[0].sentence
    # Rescaled, no more fixes accuse than the test rejects of clean data.
    assert np.mean([level.left / level.fixes for level in levels]) < 0.02


def test_liars_are_no_noise():
    # Every third fix has a liar of 100 sigma, each time another.
    for seed in range(5):
        problem, _ = ranges(seed, stations=6)
        rng = np.random.default_rng(seed)
        z = problem.z.reshape(50, 6).copy()
        z[::3][np.arange(17), rng.integers(0, 6, 17)] += 100.0 * STATED
        level = common_level(problem.with_rows(z=z.ravel()))
        assert level.accused >= 15
        assert level.sentence == ""


def test_a_station_that_is_wrong_in_all_fixes_is_no_noise():
    for seed in range(5):
        level = found(seed, bias=10.0 * STATED)
        assert not level.suspect
        assert level.alone == "S3"
        assert "the suspect is S3" in level.sentence


def test_the_kind_that_is_understated_is_rescaled():
    rng, epochs = np.random.default_rng(0), 60
    target = rng.uniform(-1500.0, 1500.0, (epochs, 2))
    away = target[:, None] - RING[:4]
    a, epoch = np.tile(np.arange(4), epochs), np.repeat(np.arange(epochs), 4)
    ranging = np.linalg.norm(away, axis=-1) + STATED * rng.standard_normal((epochs, 4))
    bearing = np.arctan2(away[..., 1], away[..., 0]) + 3.0 * 0.01 * rng.standard_normal((epochs, 4))
    rows = (
        measured("range", ranging.ravel(), a=a, sigma=STATED, epoch=epoch),
        measured("azimuth", bearing.ravel(), a=a, sigma=0.01, epoch=epoch),
    )
    problem = assemble(RING[:4], *rows, motions=FREE)
    level = common_level(problem)
    assert level.suspect
    assert level.factor[level.kinds.index("range")] == 1.0
    assert level.factor[level.kinds.index("azimuth")] == pytest.approx(3.0, rel=0.2)
    assert "azimuth rows" in level.sentence
    assert "range rows" not in level.sentence
    assert np.mean(solve(batch_of(level.scale(problem))).p_value < 0.01) < 0.06


def told(*arguments):
    """Return what a command prints, as one line; not every fix need be ok."""
    return " ".join(RUN.invoke(app, [str(one) for one in arguments]).stdout.split())


@pytest.mark.slow
def test_files_say_so_and_rescale(tmp_path):
    path = written(tmp_path, ranged(np.random.default_rng(1), 12, np.full(8, 25.0)))
    plain = json.loads(told("fix", path, "--method", "robust", "--json"))
    assert plain["noise_level"]["suspect"]
    # the method uses the larger noise itself
    assert plain["noise_level"]["used"]
    assert plain["noise_level"]["factor"] == [pytest.approx(2.5, rel=0.25)]
    assert "noise level is the suspect" in told("fix", path, "--method", "robust")
    used = json.loads(told("fix", path, "--method", "robust", "--rescale-noise", "--json"))
    assert used["noise_level"]["used"]
    named = [sum(bool(fix["explanations"]) for fix in one["fixes"]) for one in (plain, used)]
    assert max(named) <= 1
    assert all("rescaled" in fix["findings"] for fix in plain["fixes"])
    assert not any("rescaled" in fix["findings"] for fix in used["fixes"])
    for one in (plain, used):
        assert sum(fix["status"] == "ok" for fix in one["fixes"]) > 8
    assert "noise level is the suspect" in told("check", path)
    clean = written(tmp_path, ranged(np.random.default_rng(1), 12, np.full(8, 10.0)))
    assert "used as stated" in told("fix", clean, "--rescale-noise")
