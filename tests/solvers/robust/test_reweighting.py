"""Robust fixes: nothing that the truth leads to is better, gross errors are named, and sigma means what it says."""

import json
import tracemalloc
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
import runs
from monte_carlo.test_liars import Cell, unnoticed
from often import few
from robust_cases import MILLIRADIANS, SIGMA, least_squares, nees, rmse, spoilt, wild_run, worse_than_from_truth
from scipy.optimize import minimize
from scipy.stats import binom, chi2, poisson
from typer.testing import CliRunner
from verdicts import alone

from optloc import Motion, Status, assemble, measured, simulate, solve
from optloc.cli import app
from optloc.problem.loss import LOSSES
from optloc.problem.noise import Block, Noise
from optloc.solvers import pool, rejected
from optloc.solvers.outside import accept
from optloc.solvers.robust.reweighting import Doubt, reweight
from optloc.solvers.verdict.judge import judge

REDESCENDING = ("cauchy", "truncated")


def _cost(loss, problem, x):
    """Return the robust cost of independent range rows, written down anew."""
    place = problem.stations.position[:, 0]
    distance = np.linalg.norm(x[:, None, :3] - place, axis=-1)
    u = (problem.z - distance - x[:, 3:]) / SIGMA
    return loss.rho(u if loss.one_sided else np.abs(u)).sum(-1)


@pytest.mark.parametrize("name", LOSSES)
def test_no_weighing_raises_the_cost(name):
    case = spoilt("toa", 30, 8, bad=2)
    start = case.truth + np.random.default_rng(2).normal(0.0, 60.0, case.truth.shape)
    doubt, costs = Doubt.of(case.problem, start), [_cost(LOSSES[name], case.problem, start)]
    for limit in (1, 2, 3, 5, 8, 12):
        done = reweight(case.problem, start, LOSSES[name], doubt, limit=limit)
        np.testing.assert_allclose(done.cost, _cost(LOSSES[name], case.problem, done.x), rtol=1e-9)
        costs.append(done.cost)
    assert np.all(np.diff(costs, axis=0) <= 1e-7 * (1.0 + np.abs(costs[0])))
    assert (costs[-1] < costs[0]).mean() > (0.5 if name == "truncated" else 0.99)


@pytest.mark.parametrize("name", ["huber", "cauchy", "late"])
def test_the_answer_is_a_minimum_of_the_loss(name):
    case = spoilt("toa", 20, 8, bad=1)
    fix = solve(case.problem, name)
    good = np.flatnonzero(fix.answered)
    assert len(good) >= 19
    problem, x = case.problem.take(good), fix.x[good]
    sigma = np.sqrt(np.trace(fix.covariance()[good], axis1=1, axis2=2))[:, None]
    rng = np.random.default_rng(4)
    for _ in range(20):
        way = rng.standard_normal(x.shape)
        step = 1e-2 * sigma * way / np.linalg.norm(way, axis=1, keepdims=True)
        assert np.all(_cost(LOSSES[name], problem, x + step) >= _cost(LOSSES[name], problem, x) - 1e-9)


@pytest.mark.parametrize("kind", few(["tdoa", "range", "toa"], 2))
@pytest.mark.parametrize("name", REDESCENDING)
def test_the_truth_leads_to_nothing_better(kind, name):
    case = spoilt(kind, 20, 8, bad=2, size=30.0)
    if kind == "tdoa":
        case = replace(case, truth=case.truth[:, :3])
    worse = worse_than_from_truth(case, name, solve(case.problem, name))
    assert len(worse) <= 1, f"{kind}, {name}: {worse}"


@pytest.mark.parametrize("name", REDESCENDING)
def test_gross_errors_are_named_and_do_no_harm(name):
    case = spoilt("toa", 40, 10, bad=1, size=1000.0)
    fix = solve(case.problem, name)
    claimed = alone(fix)
    assert claimed.mean() >= 0.95
    assert np.array_equal(rejected(case.problem, fix)[claimed] & case.wrong[claimed], case.wrong[claimed])
    assert np.nanmax(np.linalg.norm(fix.position - case.truth[:, :3], axis=1)[claimed]) < 50 * SIGMA
    # Least squares is dragged by the hundreds of sigma.
    assert np.median(np.linalg.norm(least_squares(case) - case.truth[:, :3], axis=1)) > 100 * SIGMA


@pytest.mark.parametrize("name", LOSSES)
def test_clean_data_lose_next_to_nothing(name):
    case = spoilt("toa", 60, 9)
    fix = solve(case.problem, name)
    ok = fix.code == Status.OK
    assert ok.mean() >= 0.85
    assert fix.has(Status.ROBUST)[ok].all()
    assert alone(fix).mean() >= 0.97
    assert rmse(fix.position, case.truth) <= 1.07 * rmse(least_squares(case), case.truth)
    assert 0.75 < np.nanmean(nees(fix, case.truth)) < 1.25


@pytest.mark.parametrize("name", few(["truncated", "cauchy"], 1))
@pytest.mark.parametrize(
    ("kind", "bad", "size", "share"),
    few([("range", 1, 30.0, 0.85), ("toa", 0, 0.0, 0.85), ("toa", 1, 100.0, 0.75)], 2, 4),
)
def test_the_ellipses_of_ok_fixes_hold(name, kind, bad, size, share):
    """Clean data, and one wrong row of eight: most are ok, and 95 % of these hold the truth."""
    case = spoilt(kind, 150, 8, bad=bad, size=size, seed=17)
    fix = solve(case.problem, name)
    ok, squared = fix.code == Status.OK, 3.0 * nees(fix, case.truth)
    assert ok.mean() > share
    assert (squared[ok] < chi2.isf(0.05, 3)).sum() >= binom.ppf(1e-3, ok.sum(), 0.94)
    assert (squared[ok] > chi2.isf(1e-5, 3)).sum() <= 1
    assert (rejected(case.problem, fix) == case.wrong)[ok].all(1).mean() > 0.9


def test_errors_that_the_geometry_hides_are_the_only_wrong_ones():
    """One of eight arrivals is 10 sigma off: no more fixes are wrong than reliability expects to miss the error."""
    case = spoilt("toa", 200, 8, bad=1, size=10.0, seed=18)
    fix = solve(case.problem, "truncated")
    ok = fix.code == Status.OK
    wrong = ok & (3.0 * nees(fix, case.truth) > chi2.isf(1e-4, 3))
    assert ok.sum() > 100
    assert wrong.sum() <= poisson.isf(1e-3, unnoticed(case, Cell("toa", 3, 8, 1, 10.0)))


@pytest.mark.parametrize(("stations", "bad"), [(5, 1), (6, 2), (4, 0)])
def test_too_little_redundancy_is_never_ok(stations, bad):
    """Rejecting q rows takes a redundancy of q + 1 without them."""
    case = spoilt("toa", 60, stations, bad=bad, size=1000.0, seed=19)
    fix = solve(case.problem, "cauchy")
    spent = rejected(case.problem, fix).sum(1)
    assert (fix.dof[fix.code == Status.OK] - spent[fix.code == Status.OK] > spent[fix.code == Status.OK]).all()
    lacking = (spent > 0) & fix.answered & ~fix.has(Status.AMBIGUOUS)
    assert not (fix.code[lacking & (fix.dof <= 2 * spent)] == Status.OK).any()


def test_no_other_minimum_of_the_loss_is_as_cheap_as_an_ok_fix():
    """Descents of the loss by definition, from the best 20 of 4000 places, find no cheaper minimum and no rival."""
    rng, fixed, cut = np.random.default_rng(17), 0, 2.385
    for _ in range(10):
        stations, target = rng.uniform(-1e3, 1e3, (6, 2)), rng.uniform(-1.5e3, 1.5e3, 2)
        z = np.linalg.norm(stations - target, axis=1) + SIGMA * rng.standard_normal(6)
        z[0] += rng.choice([0.0, 300.0])
        fix = solve(assemble(stations, measured("range", z, a=np.arange(6), sigma=SIGMA)), "cauchy")
        if fix.status != Status.OK:
            continue
        fixed += 1

        def cost(x, stations=stations, z=z):
            u = (z - np.linalg.norm(stations - x[..., None, :], axis=-1)) / SIGMA
            return (cut**2 * np.log1p((u / cut) ** 2)).sum(-1)

        places, inverse = rng.uniform(-3e3, 3e3, (4000, 2)), np.linalg.inv(fix.covariance("position"))
        for start in places[np.argsort(cost(places))[:20]]:
            found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-9})
            away = found.x - fix.position
            assert found.fun >= cost(fix.position) - 1e-3
            assert found.fun >= cost(fix.position) + 9.0 or away @ inverse @ away < chi2.isf(1e-3, 2)
    assert fixed >= 5


def test_a_loss_next_to_a_start_promises_nothing():
    """Only its own search looks for other minima."""
    case = spoilt("range", 10, 8, seed=20)
    own = solve(case.problem, "cauchy")
    assert (own.code == Status.OK).sum() >= 8
    for fix in (solve(case.problem, "cauchy", start=own.x), solve(case.problem, "gtrs+cauchy")):
        assert (fix.code == Status.UNPROVEN).all()
        assert not fix.has(Status.ROBUST).any()


@pytest.mark.parametrize("name", REDESCENDING)
def test_an_accepted_fix_keeps_its_findings(name):
    case = spoilt("toa", 40, 8, bad=1, size=30.0, seed=21)
    fix = solve(case.problem, name)
    again = judge(case.problem, accept(case.problem, fix))
    assert (again.code == fix.code).all()
    assert (again.has(Status.ROBUST) == fix.has(Status.ROBUST)).all()
    assert all(again.reason[again.code == Status.UNPROVEN])


def test_the_sheet_names_the_search():
    case = spoilt("range", 10, 8, seed=20)
    fix = solve(case.problem, "cauchy")
    one = fix[int(np.flatnonzero(fix.code == Status.OK)[0])]
    assert one.findings == (Status.ROBUST,)
    assert "a search found" in str(one)


@pytest.mark.parametrize("name", few(REDESCENDING, 1))
def test_sigma_means_what_it_says_with_one_row_in_ten_wrong(name):
    case = spoilt("range", 200, 10, share=0.1)
    fix = solve(case.problem, name)
    claimed = alone(fix)
    assert claimed.mean() > 0.9
    assert 0.7 < np.nanmean(nees(fix, case.truth)) < 1.4


def test_range_differences_are_doubted_as_arrivals():
    # Of the first station's arrival all differences are made: all seven are wrong, and one arrival is.
    arrivals, differences = (spoilt(kind, 8, 8, bad=1, seed=6) for kind in ("toa", "tdoa"))
    for name in ("cauchy", "late"):
        one, two = solve(arrivals.problem, name), solve(differences.problem, name)
        np.testing.assert_allclose(one.position, two.position, atol=1e-2)
        np.testing.assert_allclose(one.cost, two.cost, rtol=1e-4)
    assert two.weights.shape == (8, 7)
    assert two.x.shape == (8, 3)


def test_late_arrivals_are_doubted_and_early_ones_believed():
    case = spoilt("range", 50, 8, bad=2, size=50.0, late=True)
    fix = solve(case.problem, "late")
    claimed = alone(fix)
    assert claimed.mean() > 0.9
    lost = rejected(case.problem, fix)[claimed]
    assert (lost == case.wrong[claimed]).all(1).mean() > 0.95
    error = np.linalg.norm(fix.position - case.truth[:, :3], axis=1)[claimed]
    assert np.median(error) < 4 * SIGMA


def test_angles_of_a_wrong_detection_are_rejected():
    rng = np.random.default_rng(8)
    stations, truth = rng.uniform(-50.0, 50.0, (7, 3)), np.array([20.0, 40.0, 10.0])
    rows = [measured(kind, a=np.arange(7), sigma=5e-3) for kind in ("azimuth", "elevation")]
    problem = simulate(assemble(stations, *rows), np.tile(truth, (50, 1)), 9)
    z = problem.z.copy()
    z[:, [2, 9]] += 0.7
    fix = solve(problem.with_rows(z=z), "cauchy")
    claimed = alone(fix)
    assert claimed.mean() > 0.9
    assert rejected(problem, fix)[claimed][:, [2, 9]].all()
    assert np.linalg.norm(fix.position - truth, axis=1)[claimed].max() < 5.0


def test_partners_tell_which_of_correlated_rows_is_wrong():
    # Pairs of rows share most of their error: one of a pair is known from the other far better than by itself.
    rng = np.random.default_rng(10)
    stations, truth = rng.uniform(-50.0, 50.0, (6, 3)), np.array([5.0, -10.0, 20.0])
    a = np.repeat(np.arange(6), 2)
    pair = np.array([[1.0, 0.99], [0.99, 1.0]])
    problem = assemble(stations, measured("range", a=a, sigma=1.0))
    problem = replace(problem, noise=Noise((Block(np.arange(12).reshape(6, 2), pair[None]),)))
    problem = simulate(problem, np.tile(truth, (20, 1)), 11)
    z = problem.z.copy()
    z[:, 4] += 2.0
    fix = solve(problem.with_rows(z=z), "truncated")
    lost = rejected(problem, fix)
    assert lost[:, 4:6].any(1).mean() > 0.95
    assert lost[:, [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]].mean() < 0.03


def test_a_run_with_biases_bears_wild_rows():
    template = runs.run(24, station=0.0, prior=60.0, places=runs.SPATIAL)
    x = np.tile(runs.truth(template), (3, 1))
    problem = simulate(template, x, 12)
    wild = np.random.default_rng(13).random(problem.z.shape) < 0.05
    spoilt_run = problem.with_rows(z=problem.z + 600.0 * wild)
    fix = solve(spoilt_run, "cauchy")
    best = solve(spoilt_run, "cauchy", start=x)
    assert fix.answered.all()
    assert np.all(fix.cost <= best.cost + 1e-3)
    assert rejected(spoilt_run, fix)[wild].mean() > 0.95
    assert rejected(spoilt_run, fix)[~wild].mean() < 0.02
    n = problem.layout.n_shared
    error = (fix.x - x)[:, :n, None]
    squared = (np.swapaxes(error, 1, 2) @ np.linalg.solve(fix.cov, error))[:, 0, 0]
    assert squared.max() < 3.0 * n


@pytest.mark.parametrize("name", few(REDESCENDING, 1))
@pytest.mark.parametrize("epochs", few([8, 4], 1))
@pytest.mark.parametrize("trials", [4, pytest.param(40, marks=pytest.mark.full)])
def test_a_moving_target_is_found_with_one_row_in_five_wrong(name, epochs, trials):
    lost = []
    for seed in range(1000, 1000 + trials):
        problem, places, wild = wild_run(seed, epochs, 0.2)
        fix = solve(problem, name)
        good = rejected(problem, fix)[wild].all() and np.linalg.norm(fix.position - places[-1]) < 150.0
        lost += [] if good or not alone(fix) else [seed]
    # four epochs with a third of their rows wrong may be explained by others at less
    assert len(lost) <= (0.05 * trials if epochs == 4 else 0), lost


@pytest.mark.parametrize("name", few(["cauchy", "truncated", "robust"], 1))
@pytest.mark.parametrize("trials", [6, pytest.param(25, marks=pytest.mark.full)])
def test_bearings_of_a_moving_target_may_be_anything_in_one_row_of_five(name, trials):
    stations = 1e3 * np.array([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0], [4.0, -3.0], [-3.0, 4.0]])
    times, a, epoch = np.arange(8.0), np.tile(np.arange(6), 8), np.repeat(np.arange(8), 6)
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        places = rng.uniform(1e3, 8e3, 2) + times[:, None] * rng.uniform(-150.0, 150.0, 2)
        apart = places[epoch] - stations[a]
        z = np.arctan2(apart[:, 1], apart[:, 0]) + MILLIRADIANS * rng.standard_normal(len(a))
        wild = rng.random(len(a)) < 0.2
        z[wild] = rng.uniform(-np.pi, np.pi, wild.sum())
        rows = measured("azimuth", z, a=a, sigma=MILLIRADIANS, epoch=epoch)
        motion = Motion(1, reference=times[-1])
        fix = solve(assemble(stations, rows, times=times, motions=(motion,)), name)
        assert np.linalg.norm(fix.position - places[-1]) < 150.0, seed


def test_the_command_line_takes_a_loss_as_a_method(tmp_path):
    out = tmp_path / "fixes.csv"
    path = files("optloc") / "scenarios" / "demo.toml"
    words = ["--method", "cauchy", "--allow", "unproven", "--out", str(out), "--json"]
    result = CliRunner().invoke(app, ["fix", str(path), *words])
    assert result.exit_code == 0, result.output
    assert all(len(fix["weights"]) for fix in json.loads(result.output)["fixes"])
    assert len(out.read_text(encoding="utf-8").splitlines()) >= 2


def test_absent_rows_stay_absent_and_broken_ones_are_said():
    case = spoilt("toa", 4, 8, bad=1, seed=3)
    weight, z = np.ones((4, 8)), case.problem.z.copy()
    weight[0, 0], weight[1, :5], z[0, 0], z[2, 3] = 0.0, 0.0, np.nan, np.nan
    problem = case.problem.with_rows(z=z, weight=weight)
    fix = solve(problem, "cauchy")
    assert fix.answered[0]
    assert fix.weights[0, 0] == 0.0
    assert not rejected(problem, fix)[0, 0]
    assert fix.code[1] == Status.TOO_FEW_ROWS
    assert fix.code[2] == Status.REJECTED
    assert np.isnan(fix.x[1:3]).all()


def test_rows_that_are_all_wrong_get_no_clean_answer():
    case = spoilt("toa", 5, 7)
    z = case.problem.z + 1e4 * np.random.default_rng(13).standard_normal((5, 7))
    fix = solve(case.problem.with_rows(z=z), "cauchy")
    assert not (fix.code == Status.OK).any()
    assert (~alone(fix) | (fix.p_value < 1e-3)).all()
    assert all(fix.reason[i] for i in np.flatnonzero(alone(fix)))


def test_one_problem_gives_the_same_as_many():
    case = spoilt("toa", 8, 8, bad=1)
    many = solve(case.problem, "cauchy")
    one = solve(case.problem.take(np.array([7])), "cauchy")
    np.testing.assert_allclose(one.x[0], many.x[7], atol=1e-3)
    np.testing.assert_allclose(one.weights[0], many.weights[7], atol=1e-5)


def test_a_large_batch_is_worked_on_in_parts_that_need_less_memory(monkeypatch):
    problem = spoilt("toa", 12, 8, bad=1).problem
    solve(problem.take(np.arange(2)), "cauchy")  # what a structure keeps is made
    fixes, most = [], []
    for rows in (8 * 12, 8 * 3):
        monkeypatch.setattr(pool, "_ROWS", rows)
        tracemalloc.start()
        fixes.append(solve(problem, "cauchy"))
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    np.testing.assert_allclose(fixes[1].x, fixes[0].x, atol=1e-3)
    np.testing.assert_array_equal(fixes[1].code, fixes[0].code)
    assert most[1] < 0.8 * most[0]
