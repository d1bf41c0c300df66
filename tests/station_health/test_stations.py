"""Station health: known biases, noise and outliers are found within their errors, and what is not seen is said."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from often import few
from station_health.rings import FREE, RING, SIGMA, ranged
from typer.testing import CliRunner

from optloc import InvalidProblem, assemble, measured, solve
from optloc.cli import app
from optloc.engine import predict
from optloc.files import read
from optloc.model_checks import reliability
from optloc.problem import by_epoch
from optloc.show.pictures import save
from optloc.show.pictures.residuals import plot_health
from optloc.station_health import health, with_noise_levels
from optloc.station_health.stations import _sentences

RUN = CliRunner()
BIAS = np.array([0.0, 0.0, 60.0, 0.0, -15.0, 0.0, 0.0, 200.0])


def biased(seed, epochs=200, *, kind="toa", gross=0.0):
    problem = ranged(np.random.default_rng(seed), epochs, kind=kind, gross=gross)
    return problem.with_rows(z=problem.z + np.tile(BIAS, epochs))


@pytest.mark.parametrize("kind", few(["toa", "range"], 1))
def test_biases_are_within_their_errors(kind):
    # Times of emission are unknown, so that arrivals show biases up to a common one; ranges show them all.
    true = BIAS - BIAS.mean() if kind == "toa" else BIAS
    off = []
    for seed in range(6):
        found = health(biased(seed, 100, kind=kind))
        off.append((found.bias - true) / found.bias_error)
        assert ("relative to their mean" in " ".join(found.sentences)) == (kind == "toa")
    off = np.array(off)
    assert 0.6 < (off**2).mean() < 1.6
    assert np.abs(off.mean(0)).max() < 4.0 / np.sqrt(len(off))


def test_a_station_does_not_hide_in_its_own_fixes():
    # A fix absorbs part of a bias of 200 m: its plain residuals show less, and lay some of it on others.
    problem = biased(1)
    fix = solve(problem)
    found = health(problem)
    bad = found.group == found.names.index("S7")
    assert np.median(found.residual[bad]) == pytest.approx(200.0 - BIAS.mean(), abs=8.0)
    batch = by_epoch(problem)
    plain = np.median(batch.observed - predict(batch, fix.x), axis=0)
    assert plain[7] < 0.8 * (200.0 - BIAS.mean())


@pytest.mark.slow
def test_shares_of_outliers_and_noise():
    shares, noise = [], []
    for seed in range(4):
        found = health(biased(100 + seed, 100, gross=0.05), method="cauchy")
        shares.append(found.outliers)
        noise.append((found.noise - SIGMA) / found.noise_error)
    # 400 draws a station: 0.05 has a sigma of 0.011, and clean measurements are outliers in 0.3 %; where two of eight
    # stations are wrong at once, a third may take some of the blame.
    assert np.abs(np.mean(shares, axis=0) - 0.053).max() < 0.05
    assert abs(np.mean(shares) - 0.053) < 0.02
    # A few gross errors are too small to be seen as such and count as noise.
    assert (np.array(noise) ** 2).mean() < 3.0


def test_the_least_error_that_shows_is_that_of_reliability():
    """Of the same fixes, with the noise as it is found."""
    problem = ranged(np.random.default_rng(5), 100, kind="range")
    batch = by_epoch(problem)
    fix = solve(batch)
    found = health(problem, fix=fix)
    levelled = with_noise_levels(batch, found.levels)
    told = np.median([reliability(levelled.take(np.array([i])), fix.x[i]).least for i in range(100)], axis=0)
    np.testing.assert_allclose(found.least_noticed, told, rtol=1e-3)


def test_clean_measurements_are_rarely_outliers():
    found = health(ranged(np.random.default_rng(2), 400))
    assert found.outlying.mean() < 0.008


def test_a_scale_error_is_seen_where_paths_vary():
    rng, epochs = np.random.default_rng(3), 400
    target = rng.uniform(-2500.0, 2500.0, (epochs, 2))
    path = np.linalg.norm(target[:, None] - RING, axis=-1)
    scale = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    z = path * (1.0 + scale) + 5.0 * rng.standard_normal(path.shape)
    a, epoch = np.tile(np.arange(8), epochs), np.repeat(np.arange(epochs), 8)
    found = health(assemble(RING, measured("range", z.ravel(), a=a, sigma=5.0, epoch=epoch), motions=FREE))
    assert np.abs((found.scale - scale) / found.scale_error).max() < 4.0
    assert found.scale[1] > 8.0 * found.scale_error[1]


def test_residuals_of_angles_and_ranges_are_told_apart():
    rng, epochs = np.random.default_rng(4), 120
    target = rng.uniform(-1500.0, 1500.0, (epochs, 2))
    away = target[:, None] - RING[:4]
    bearing = np.arctan2(away[..., 1], away[..., 0]) + np.array([0.0, 0.02, 0.0, 0.0])
    a, epoch = np.tile(np.arange(4), epochs), np.repeat(np.arange(epochs), 4)
    noisy = [v + s * rng.standard_normal(v.shape) for v, s in ((bearing, 0.005), (np.linalg.norm(away, axis=-1), 8.0))]
    problem = assemble(
        RING[:4],
        measured("azimuth", noisy[0].ravel(), a=a, sigma=0.01, epoch=epoch),
        measured("range", noisy[1].ravel(), a=a, sigma=10.0, epoch=epoch),
        motions=FREE,
    )
    found = health(problem)
    assert len(found.names) == 8
    at = found.names.index("S1 azimuth")
    assert found.units[at] == "rad"
    assert found.bias[at] == pytest.approx(0.02, abs=4.0 * found.bias_error[at])
    for i, name in enumerate(found.names):
        assert found.noise[i] == pytest.approx(0.005 if "azimuth" in name else 8.0, rel=0.4)


def written(folder, problem, text='sigma = "10 m"'):
    epochs, z = problem.epochs, problem.z
    stations = pd.DataFrame({"name": problem.stations.names, "x": RING[:8, 0], "y": RING[:8, 1]})
    stations.to_csv(folder / "stations.csv", index=False)
    a = [f"S{i}" for i in range(8)] * epochs
    pd.DataFrame({"a": a, "z": z, "epoch": np.repeat(np.arange(epochs), 8)}).to_csv(folder / "rows.csv", index=False)
    path = folder / "p.toml"
    path.write_text(
        'format = 1\n[stations]\nfile = "stations.csv"\n[[measurements]]\nkind = "toa"\nfile = "rows.csv"\n' + text
    )
    return path


def run(*arguments, code=0):
    result = RUN.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result


@pytest.mark.slow
def test_check_tells_health_as_table_json_files_and_picture(tmp_path):
    path = written(tmp_path, biased(5, 60))
    assert "Health by station" in run("check", path).stdout
    assert "Health" not in run("check", path, "--no-solve").stdout
    out, picture = tmp_path / "h.csv", tmp_path / "h.svg"
    told = json.loads(run("check", path, "--json", "--out", out, "--plot", picture).stdout)
    stations = {row["name"]: row for row in told["health"]["stations"]}
    assert stations["S7"]["bias"] == pytest.approx(200.0 - BIAS.mean(), abs=30.0)
    table = pd.read_csv(out)
    assert list(table["name"]) == list(stations)
    assert picture.read_text().startswith("<?xml")
    assert "no-solve" in run("check", path, "--no-solve", "--out", out, "--force", code=2).stderr
    assert "did you mean" in run("check", path, "--by", "stations", code=2).stderr


def test_check_says_why_there_is_no_health(tmp_path):
    one = written(tmp_path, biased(5, 1))
    assert "several epochs" in run("check", one).stdout
    assert "several epochs" in run("check", one, "--plot", tmp_path / "x.png", code=2).stderr


def test_noise_is_estimated_where_the_file_says_so(tmp_path):
    problem = ranged(np.random.default_rng(6), 150, np.full(8, 25.0))
    path = written(tmp_path, problem, 'sigma = "estimate"')
    levels = read(path).levels
    assert levels.sigma[0] == pytest.approx(25.0, abs=4.0 * levels.sigma_error[0])
    told = json.loads(run("fix", path, "--json").stdout)
    assert told["noise"]["levels"][0]["sigma"] == pytest.approx(25.0, rel=0.1)
    assert np.median([fix["p_value"] for fix in told["fixes"]]) == pytest.approx(0.5, abs=0.15)
    stated = written(tmp_path, problem)
    assert "Noise from data, by station" in run("fix", stated, "--noise-from-data", "station").stdout
    assert "did you mean" in run("fix", stated, "--noise-from-data", "stations", code=2).stderr


def test_noise_without_redundancy_is_bad_input(tmp_path):
    problem = ranged(np.random.default_rng(6), 1, np.full(8, 25.0))
    path = written(tmp_path, problem, 'sigma = "estimate"')
    lines = (tmp_path / "rows.csv").read_text().splitlines()[:4]
    (tmp_path / "rows.csv").write_text("\n".join(lines) + "\n")
    assert "more rows than unknowns" in run("fix", path, code=2).stderr


def test_many_units_are_many_panels(tmp_path):
    found = health(biased(5, 60))
    figure = plot_health(found, title="health")
    assert len(figure.axes) == 1
    save(figure, tmp_path / "h.pdf")
    assert (tmp_path / "h.pdf").stat().st_size > 2_000


def test_the_worst_station_is_in_the_picture():
    """Its bias lies within the limits, or where it is far beyond the others the edge tells it."""
    found = health(biased(5, 60))
    (panel,) = plot_health(found).axes
    assert np.abs(found.bias).max() < panel.get_xlim()[1]
    worst = int(np.argmax(np.abs(found.bias)))
    found.bias[worst] *= 1e3
    (panel,) = plot_health(found).axes
    assert panel.get_xlim()[1] < 1e3
    assert f"{found.bias[worst]:.3g} m" in panel.texts[0].get_text()


def test_no_epoch_fixed_is_said():
    problem = ranged(np.random.default_rng(2), 5)
    with pytest.raises(InvalidProblem, match="no epoch has a fix"):
        health(problem.with_rows(weight=np.zeros(problem.count)))


def test_combinations_of_offsets_that_no_row_is_used_of_say_nothing():
    unseen = SimpleNamespace(open=[np.array([0.0, 0.0, 1.0]), np.array([1.0, 1e-9, 0.0])])
    assert _sentences(unseen, ("A", "B", "C"), np.array([0, 1])) == ("the data do not show a bias of A",)
