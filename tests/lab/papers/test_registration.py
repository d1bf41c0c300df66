"""The paper `registration`: its numbers, what is wrong with them, and what its algorithm does."""

from dataclasses import replace
from importlib.resources import files as package_files

import numpy as np
import pytest
from often import few
from typer.testing import CliRunner
from verdicts import alone

from optloc import crlb, simulate, solve
from optloc.cli import app
from optloc.engine import linearise
from optloc.files import read
from optloc.lab.papers import registration, registration_tables
from optloc.lab.papers.registration import (
    MOVING,
    NANOSECOND,
    PRINTED,
    SPATIAL,
    RegistrationSetting,
    branch,
    ghost,
    mirror,
    one_shot,
    problem,
    rms,
    score,
    truth,
    wander,
)
from optloc.lab.papers.registration_recursion import FIRST, joint_recursion, recursion
from optloc.lab.papers.registration_tables import flatness, separation
from optloc.lab.papers.report import Study
from optloc.linear.evaluate import predict
from optloc.linear.normal import normal

RUN = CliRunner()


def bound(scenario, epochs, **settings):
    made = problem(scenario, epochs, **settings)
    return crlb(made, truth(scenario, made))


# Position bounds for station errors of 0, 1 and 5 m, computed once by a program written apart from this one.
BOUNDS = [
    (600, "full", 10, (38.2155, 40.2826, 74.2775)),
    (600, "full", 20, (76.4309, 77.4852, 99.4908)),
    (600, "half", 20, (54.0448, 55.5258, 83.5318)),
    (600, "diag", 10, (33.9075, 36.9827, 73.4636)),
    (600, "diag", 20, (67.8150, 69.5042, 96.1228)),
    (700, "full", 10, (28.2627, 29.7915, 54.9327)),
    (700, "diag", 20, (49.8259, 51.0967, 70.9559)),
]


@pytest.mark.parametrize(("epochs", "shape", "delay", "wanted"), BOUNDS)
def test_bounds_of_the_fixed_target(epochs, shape, delay, wanted):
    found = [
        rms(bound(PRINTED, epochs, sigma=delay * NANOSECOND, station_sigma=size, shape=shape))
        for size in (0.0, 1.0, 5.0)
    ]
    assert found == pytest.approx(wanted, abs=1e-4)


def test_the_one_shot_bound_is_the_printed_one():
    assert one_shot() == pytest.approx([1855.63, 2758.83, 160.337], abs=5e-3)
    assert tuple(np.floor(one_shot())) == registration_tables.SIGMA0


def test_the_moving_bound_is_that_of_the_initial_place():
    cov = bound(MOVING, 600)
    at_end = np.hstack([np.eye(3), 600.0 * np.eye(3)])
    assert rms(cov) == pytest.approx(602.5, abs=0.05)
    assert rms(at_end @ cov[:6, :6] @ at_end.T) == pytest.approx(275.0, abs=1.0)


@pytest.mark.parametrize(("sigma", "wanted", "within"), [(0.03, 40.2825, 1e-4), (3e-4, 38.9, 0.05), (3e-5, 24.9, 0.05)])
def test_gain_ratios_matter_only_when_they_are_very_good(sigma, wanted, within):
    assert rms(bound(PRINTED, 600, gain_sigma=sigma)) == pytest.approx(wanted, abs=within)


def test_a_prior_of_the_biases_counts():
    free, loose, known = (rms(bound(PRINTED, 100, prior=size)) for size in (None, 10.0, 1e-6))
    assert known < loose < free
    assert rms(bound(PRINTED, 100, prior=1e6)) == pytest.approx(free, rel=1e-6)


def test_printed_stations_are_flat_and_collide_and_the_spatial_ones_do_not():
    assert flatness(PRINTED, 700) < 1e-9
    track = PRINTED.track(700)
    assert np.linalg.norm(track[50, 3] - track[50, 4]) == 0.0
    assert separation(PRINTED, 700) == 0.0
    assert flatness(SPATIAL, 800) > 1e3
    assert separation(SPATIAL, 800) > 10e3


# Seconds, place of the image in km, offset of its biases 4 and 5, cost gap, probability of taking it at 10 and 40 ns.
GHOSTS = [
    (40, (192.2, 282.3, -60.3), 1140, 0.146, 0.42, 0.48),
    (100, (192.6, 284.0, -56.4), 1111, 12.56, 0.038, 0.32),
    (200, (193.4, 286.7, -50.2), 1052, 317.2, 3e-19, 9.7e-3),
    (300, (194.3, 289.2, -43.8), 979, 1843, None, 9e-9),
    (600, (196.6, 295.6, -22.6), 638, 25262, None, None),
    (700, (197.6, 297.6, -14.6), 457, 36157, None, None),
]


@pytest.mark.parametrize(("epochs", "place", "offset", "gap", "doubt", "noisy"), few(GHOSTS, 3, 6))
def test_the_image_in_the_plane_of_the_stations(epochs, place, offset, gap, doubt, noisy):
    found = ghost(PRINTED, epochs)
    assert np.abs(found.x[:3] / 1e3 - place).max() < 0.1
    assert np.abs(found.x[5:7] - PRINTED.delays[2:]) == pytest.approx([offset, offset], abs=8.0)
    assert found.gap == pytest.approx(gap, rel=0.02)
    if doubt is not None:
        assert found.doubt == pytest.approx(doubt, rel=0.2)
    if noisy is not None:
        assert ghost(PRINTED, epochs, sigma=40 * NANOSECOND).doubt == pytest.approx(noisy, rel=0.1)


def test_stations_that_span_space_have_no_image_in_a_short_record():
    assert ghost(SPATIAL, 100) is None


def test_the_image_of_a_moving_target_explains_all_data_exactly():
    place, velocity = mirror(MOVING)
    assert place == pytest.approx([200e3, 243e3, -166e3], abs=1e-6)
    assert velocity == pytest.approx([-100.0, 60.0, 180.0], abs=1e-9)
    made = problem(MOVING, 800, gain_sigma=0.03)
    exact = truth(MOVING, made)
    image = np.concatenate([place, velocity, exact[6:]])
    assert np.abs(predict(made, image) - predict(made, exact)).max() < 1e-9
    drawn = simulate(made, exact, 3)
    costs = [normal(linearise(drawn, x), drawn.epochs).cost for x in (exact, image)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


def test_both_places_of_a_moving_target_are_listed_and_a_spatial_array_has_one():
    fix = solve(RegistrationSetting(MOVING, 10, 1, 1).draw(600))
    image = mirror(MOVING)[0]
    for place in (MOVING.target, image):
        apart = np.linalg.norm(np.concatenate([fix.x[:, None], fix.alternatives.x], 1)[..., :3] - place, axis=-1)
        assert (np.nanmin(apart, axis=1) < 3e3).all()
    flying = replace(SPATIAL, target=MOVING.target, course=MOVING.course)
    single = solve(RegistrationSetting(flying, 10, 1, 1).draw(600))
    assert alone(single).all()
    assert not score(single.x, truth(flying, problem(flying, 1)), bound(flying, 600)).lost.any()


@pytest.mark.parametrize("gain", few([None, 0.03], 1))
def test_the_recursion_meets_the_bound_from_a_good_start(gain):
    trials = 60 if gain is None else 20
    setting = RegistrationSetting(PRINTED, trials, 1, 1, gain_sigma=gain)
    drawn = setting.draw(300)
    bounds = [setting.bound(k) for k in (200, 300)]
    size = 7 if gain is None else 11
    for found, limit in zip(wander(setting, drawn, (200, 300), bounds), bounds, strict=True):
        assert not found.lost.any()
        assert found.rmse == pytest.approx(rms(limit), rel=0.3 if gain is None else 0.5)
        nees = (found.error @ np.linalg.inv(limit) * found.error).sum(-1)
        assert nees.mean() == pytest.approx(size, abs=4.0 * np.sqrt(2.0 * size / trials))


def test_what_runs_away_stays_lost():
    z = problem(PRINTED, 60).with_rows(z=np.zeros(240)).z.reshape(1, 60, 4)
    track, nowhere = PRINTED.track(60), np.array([[np.nan, 0.0, 0.0]])
    joint = joint_recursion(track, z, z, nowhere, (3.0, 0.03, 1.0))
    assert joint.shape == (1, 60 - FIRST + 1, 11)
    assert np.isnan(joint).all()
    out = recursion(track, PRINTED.times(60), z, nowhere)
    assert out.shape == (1, 60 - FIRST + 1, 7)
    assert np.isnan(out).all()
    assert score(out[:, -1], truth(PRINTED, problem(PRINTED, 1)), np.eye(7)).lost.all()


def divergence(count, seed):
    setting = RegistrationSetting(PRINTED, count, seed, 5)
    drawn, limit = setting.draw(600), setting.bound(600)
    (plain,) = wander(setting, drawn, (600,), (limit,), width=20.0)
    # Without the proof, which takes seconds a run and has tests of its own.
    return plain, score(solve(drawn, "searched").x, truth(PRINTED, drawn), limit), limit


@pytest.mark.full
def test_from_wild_starts_the_recursion_diverges_and_the_fix_without_a_guess_does_not():
    plain, found, limit = divergence(100, 1)
    assert 1 <= plain.lost.sum() <= 9
    assert not found.lost.any()
    assert found.rmse == pytest.approx(rms(limit), rel=0.2)


@pytest.mark.full
def test_divergence_of_500_wild_starts():
    plain, found, limit = divergence(500, 1)
    assert 0.02 <= plain.share <= 0.07
    assert not found.lost.any()
    assert found.rmse == pytest.approx(rms(limit), rel=0.1)


def test_the_nearest_branch_is_scored():
    fix = solve(RegistrationSetting(MOVING, 3, 2, 2).draw(500))
    exact = truth(MOVING, problem(MOVING, 1))
    assert (np.linalg.norm(branch(fix, exact)[:, :3] - exact[:3], axis=1) < 10e3).all()


def test_the_shipped_problem_is_made_by_its_script_and_solved():
    folder = package_files("optloc") / "scenarios"
    for name, text in registration.files().items():
        assert (folder / name).read_text(encoding="utf-8") == text, f"write {name} anew"
    loaded = read(folder / "registration.toml")
    fix = solve(loaded.problem).require(allow=("unproven",))
    assert np.abs(fix.position - SPATIAL.target).max() < 4.0 * fix.sigma().max()
    late = 0.299792458 * np.array(registration.DELAYS)
    assert (np.abs(fix.take("clock") - late) < 4.0 * fix.sigma("clock")).all()
    assert 1e-3 < fix.p_value < 0.999


TINY = registration_tables.RegistrationSample(4, 6, (150, 200, 300, 400), (300, 400, 550, 700), last=150)


@pytest.fixture(scope="module")
def report():
    ticks, ready = [], registration_tables.STUDY.reproduction(TINY, 3)
    made = ready.run(lambda: ticks.append(1))
    assert len(ticks) == ready.work
    return made


@pytest.mark.full
def test_a_reproduction_has_every_table_and_figure(report):
    names = [table.name for table in report.tables]
    assert {f"table-{i}" for i in (2, 3, 4, 5, 6)} | {"scenes", "minima", "gains", "readings"} <= set(names)
    assert [picture.name for picture in report.pictures] == ["figure-1", "figure-2", "figure-3"]
    rows = {table.name: table.rows for table in report.tables}
    assert [len(rows[name]) for name in ("table-2", "table-5", "table-6")] == [16, 16, 32]
    assert [row[2] for row in rows["table-2"][:4]] == ["99.60", "89.38", "92.10", "86.65"]
    assert [row[:4] for row in rows["table-3"]][-1] == ("20", "38.0", "36.7", "2.5 %")
    assert [row[1] for row in rows["table-4"]] == ["10 ns", "20 ns", "30 ns", "40 ns"]
    assert all(row[-1] == "100.0 %" for row in rows["figure-2"])  # a moving target has two places
    assert all(row[-2] == "0.0 %" for i in (1, 2, 3) for row in rows[f"figure-{i}"])  # none is lost silently
    assert all(len(row) == len(table.header) for table in report.tables for row in table.rows)


@pytest.mark.full
def test_reproduce_writes_tables_and_pictures(report, tmp_path, monkeypatch):
    seeds = []
    cheap = Study(registration_tables.STUDY.sizes, lambda _: 1, lambda _, seed, tick: seeds.append(seed) or report)
    monkeypatch.setattr(registration_tables, "STUDY", cheap)
    folder = tmp_path / "new"
    result = RUN.invoke(app, ["reproduce", "registration", "--out", str(folder), "--seed", "3"])
    assert result.exit_code == 0, result.output
    assert seeds == [3]
    names = {path.name for path in folder.iterdir()}
    tables = {f"{table.name}.csv" for table in report.tables}
    assert names == {"README.md", "figure-1.png", "figure-2.png", "figure-3.png"} | tables
    page = (folder / "README.md").read_text(encoding="utf-8")
    assert all(f"({name})" in page for name in names if name.endswith(".png"))
    wanted = ("seed 3", "1855.6, 2758.8, 160.3", "40.28", "87.71", "## What is wrong in the paper")
    assert [text for text in wanted if text not in page] == []
    assert "Table 3: initial error" in result.stdout
    assert len((folder / "table-2.csv").read_text(encoding="utf-8").splitlines()) == 1 + 16
    assert (folder / "figure-1.png").read_bytes().startswith(b"\x89PNG")
    again = ["reproduce", "registration", "--out", str(folder), "--quiet"]
    assert RUN.invoke(app, again).exit_code == 2
    assert RUN.invoke(app, [*again, "--force"]).output == ""


def test_draws_depend_on_seed_and_key_alone():
    one, same, seed, key = (RegistrationSetting(PRINTED, 2, *at).draw(50).z for at in ((1, 1), (1, 1), (2, 1), (1, 2)))
    assert (one == same).all()
    assert abs(one - seed).max() > 1.0
    assert abs(one - key).max() > 1.0
