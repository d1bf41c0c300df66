"""Late signals: their share and mean delay from many fixes, the loss that follows, and what is no late signal."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.stats import exponnorm, norm
from station_health.rings import FREE, RING
from typer.testing import CliRunner

from optloc import InvalidProblem, assemble, measured, solve
from optloc.cli import app
from optloc.model_checks.elements import batch_of
from optloc.problem import LOSSES
from optloc.station_health import common_level, late_signals

STATED = 10.0


def late(seed, share, delay, *, epochs=50, stations=8, kind="range", factor=1.0, alike=0.0):
    """Return rows of a free target of which a share is late by so many sigma on average, and the targets."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1500.0, 1500.0, (epochs, 2))
    z = np.linalg.norm(target[:, None] - RING[:stations], axis=-1) + alike
    z = z + STATED * factor * rng.standard_normal(z.shape)
    z = z + np.where(rng.random(z.shape) < share, rng.exponential(STATED * delay, z.shape), 0.0)
    z = z + (rng.uniform(0.0, 500.0, (epochs, 1)) if kind == "toa" else 0.0)
    a, epoch = np.tile(np.arange(stations), epochs), np.repeat(np.arange(epochs), stations)
    return assemble(RING[:stations], measured(kind, z.ravel(), a=a, sigma=STATED, epoch=epoch), motions=FREE), target


def test_the_loss_is_the_likelihood_of_normal_errors_and_delays():
    loss = LOSSES["late(0.2,6)"]

    def density(u):
        return 0.8 * norm.pdf(u) + 0.2 * exponnorm.pdf(u, 6.0)

    mode = -1.0 + 0.001 * np.argmax(density(np.arange(-1.0, 1.0, 0.001)))
    u = np.linspace(0.01, 40.0, 200)
    np.testing.assert_allclose(loss.rho(u), -2.0 * np.log(density(u + mode) / density(mode)), atol=2e-3)
    step = 1e-5
    slope = (loss.rho(u + step) - loss.rho(u - step)) / (4.0 * step)
    np.testing.assert_allclose(loss.weight(u) * u, slope, atol=1e-6)
    np.testing.assert_array_equal(loss.rho(-u), u**2)
    assert quad(density, -10.0, 300.0, limit=200)[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("word", ["late(0,5)", "late(1.5,5)", "late(0.1,0)", "late(0.1)", "lat(0.1,5)"])
def test_what_is_no_loss_is_refused(word):
    problem, _ = late(0, 0.0, 1.0, epochs=1)
    with pytest.raises(InvalidProblem, match=r"late|method"):
        solve(problem, word)


@pytest.mark.parametrize(
    ("share", "delay", "kind"), [(0.2, 8.0, "range"), pytest.param(0.2, 10.0, "toa", marks=pytest.mark.full)]
)
def test_share_and_delay_are_found(share, delay, kind):
    found = [late_signals(late(seed, share, delay, kind=kind)[0]) for seed in range(2)]
    # 400 rows each: 0.02 and 9 % of the delay are the standard errors of who knows which rows are late.
    assert np.mean([one.share for one in found]) == pytest.approx(share, abs=0.04)
    assert np.mean([one.delay for one in found]) == pytest.approx(delay, rel=0.15)
    assert "rows are late" in found[0].sentence


def test_its_loss_fixes_better_than_others():
    squared = dict.fromkeys(("cauchy", "late", "found"), 0.0)
    for seed in range(1):
        problem, target = late(seed, 0.3, 10.0, epochs=80)
        signals, batch = late_signals(problem), batch_of(problem)
        for name in squared:
            fix = solve(batch, signals.method if name == "found" else name)
            squared[name] += np.median(((fix.position - target) ** 2).sum(-1))
    assert squared["found"] < squared["late"] < squared["cauchy"]


@pytest.mark.parametrize(("factor", "share"), [(1.0, 0.0), (2.5, 0.0)])
def test_clean_and_understated_noise_is_not_late(factor, share):
    for seed in range(3):
        found = late_signals(late(seed, share, 1.0, stations=6, factor=factor)[0])
        assert found.share == 0.0
        assert found.sentence == ""
        assert found.method == "late"


def test_fixes_that_stand_on_late_rows_are_marked():
    problem, _ = late(3, 0.0, 1.0, stations=5, epochs=40)
    z = problem.z.reshape(40, 5).copy()
    z[:6, :3] += np.array([300.0, 700.0, 1500.0])  # two of five are left: nothing checks them
    z[6:12, 0] += 400.0
    found = late_signals(problem.with_rows(z=z.ravel()))
    assert found.carried[:6].sum() >= 4
    assert not found.carried[6:].any()
    assert (found.late[6:12] == 1).sum() >= 5
    assert "fixes depend on late rows" in found.sentence


def written(folder, problem):
    epochs = problem.epochs
    pd.DataFrame({"name": problem.stations.names, "x": RING[:8, 0], "y": RING[:8, 1]}).to_csv(folder / "s.csv")
    a, epoch = [f"S{i}" for i in range(8)] * epochs, np.repeat(np.arange(epochs), 8)
    pd.DataFrame({"a": a, "z": problem.z, "epoch": epoch}).to_csv(folder / "r.csv", index=False)
    path = folder / "p.toml"
    rows = '[[measurements]]\nkind = "range"\nfile = "r.csv"\nsigma = "10 m"\n'
    path.write_text(f'format = 1\n[stations]\nfile = "s.csv"\n{rows}')
    return path


def told(*arguments):
    """Return what a command prints, as one line; not every fix need be ok."""
    return " ".join(CliRunner().invoke(app, [str(one) for one in arguments]).stdout.split())


@pytest.mark.slow
def test_files_say_so(tmp_path):
    path = written(tmp_path, late(1, 0.2, 10.0, epochs=20)[0])
    assert "--late-from-data fixes with this loss" in told("check", path)
    found = json.loads(told("fix", path, "--late-from-data", "--json"))
    assert found["late_signals"]["share"] == pytest.approx(0.2, abs=0.08)
    assert found["late_signals"]["used"]
    assert {"late_rows", "on_late_rows"} <= found["fixes"][0].keys()
    assert found["stages"][0]["name"] == found["late_signals"]["method"]
    clean = written(tmp_path, late(1, 0.0, 10.0, epochs=5)[0])
    assert "no late rows are found" in told("fix", clean, "--late-from-data").lower()


def test_rows_late_alike_are_an_offset(tmp_path):
    # Every range is 100 sigma too long: no row is late against the others, and the advice offers the offset.
    path = written(tmp_path, late(1, 0.0, 1.0, epochs=10, alike=100.0 * STATED)[0])
    words = told("fix", path)
    assert "an offset of all range rows" in words.lower()
    assert 'form = "offset"' in words
    assert "all range rows are late by the same" in words.lower()
    assert "fixes with that" not in words
    problem, _ = late(2, 0.0, 1.0, alike=100.0 * STATED)
    found = late_signals(problem)
    assert found.alike == "range"
    assert found.offset == pytest.approx(100.0 * STATED, rel=0.2)


def test_late_rows_are_no_noise():
    for seed in range(4):
        level = common_level(late(seed, 0.2, 10.0)[0], method="gtrs+lsr")
        assert level.accused > 25
        assert not level.suspect
