"""A contributor follows the guide to the letter, outside optloc: what is added works wherever optloc's own does."""

import io
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from lab.study.texts import design
from monte_carlo.test_consistency import band
from progress import without_progress
from recipes import TABLES, files_of_the_page, installed, write_package
from typer.testing import CliRunner
from verdicts import alone

import optloc
from optloc import InvalidProblem, Motion, Status, solve
from optloc.cli import app
from optloc.kernels.sums import equations_at
from optloc.kernels.trace import evaluate, trace
from optloc.lab.study.trial import compute
from optloc.linear.evaluate import block_links, given
from optloc.linear.normal import linearise
from optloc.models import MODELS
from optloc.tracking import collected, polynomial, tracked

TRIALS = 200
RADIUS = 5e3 * np.array([1.0, 0.6, 1.2, 0.5, 1.0, 0.7, 1.1, 0.4])
ANGLE = 0.25 * np.pi * np.arange(8)
STATIONS = np.stack([RADIUS * np.cos(ANGLE), RADIUS * np.sin(ANGLE)], axis=-1)
# Nominal for every case of this file together.
BAND = 1.0 - 0.01 / 8


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory):
    """Install the package of the page for the tests of this file."""
    folder = tmp_path_factory.mktemp("extras")
    write_package(folder, files_of_the_page())
    with installed(folder), warnings.catch_warnings(action="error", category=RuntimeWarning):
        for table in TABLES.values():
            len(table)
        yield folder


def strengths(sigma=0.1, epochs=1, **more):
    """Return differences of received powers to the first station; the powers have independent errors of `sigma` dB."""
    s = len(STATIONS)
    epoch, a = np.repeat(np.arange(epochs), s - 1), np.tile(np.arange(1, s), epochs)
    rows = optloc.measured("rss_urban", a=a, b=0, epoch=epoch, sigma=1.0)
    shared = sigma**2 * (np.eye(s - 1) + 1.0)
    if epochs == 1:
        return optloc.assemble(STATIONS, rows, covariance=shared, **more)
    return optloc.assemble(STATIONS, optloc.measured("rss_urban", a=a, b=0, epoch=epoch, sigma=sigma), **more)


def squared(error, covariance):
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def places(count, seed=7, half=2.5e3):
    return np.random.default_rng(seed).uniform(-half, half, (count, 2))


# ------------------------------------------------------------------------------------------------------- the kind
def test_nothing_but_the_page_was_needed():
    assert files_of_the_page()["optloc_extras_kind.py"].count("Model(") == 1
    assert "rss_urban" in MODELS
    sources = Path(optloc.__file__).parent.rglob("*.py")
    assert not [path.name for path in sources if "rss_urban" in path.read_text(encoding="utf-8")]


def test_it_fixes_without_a_guess_on_the_bound():
    problem, truth = strengths(), places(TRIALS)
    drawn = optloc.simulate(problem, truth=truth, seed=3)
    fix = solve(drawn)
    assert alone(fix).all()  # the page gives no bounds over boxes: nothing is proven
    assert (fix.cost <= solve(drawn, "lsr", start=truth).cost + 1e-6).all()  # no better minimum near the truth
    error = fix.position - truth
    bound = np.stack([optloc.crlb(problem, place) for place in truth])
    covers = ~fix.has(Status.CURVED)  # close to a receiver it does not
    assert covers.mean() > 0.9
    low, high = band(2 * int(covers.sum()), BAND)
    assert low < squared(error, fix.covariance())[covers].mean() / 2 < high
    assert low < squared(error, bound)[covers].mean() / 2 < high


def test_its_bound_is_that_of_the_fisher_information_by_hand():
    place = np.array([800.0, -1100.0])
    away = place - STATIONS
    slope = -30.0 / np.log(10.0) * away / (away**2).sum(1)[:, None]  # of 30 log10(1 / r)
    design = slope[1:] - slope[0]
    fisher = design.T @ np.linalg.solve(0.1**2 * (np.eye(7) + 1.0), design)
    np.testing.assert_allclose(optloc.crlb(strengths(), place), np.linalg.inv(fisher), rtol=1e-9)


def test_machine_code_symbols_and_numpy_agree():
    problem = optloc.simulate(strengths(), truth=[900.0, 400.0], seed=1)
    x = np.array([1200.0, -300.0])
    (only,) = block_links(problem)
    inputs = given(problem, only)
    tape = trace(problem, only, frozenset(inputs), frozenset(feed.seed for feed in only.feeds)).tape
    for feed in only.feeds:
        inputs[feed.seed] = inputs.get(feed.seed, 0.0) + x[feed.column] * feed.gain
    value, *partials = evaluate(tape, inputs)
    away = np.linalg.norm(x - STATIONS, axis=1)
    expected = 30.0 * np.log10(away[0] / away[1:])
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12)
    jet = linearise(problem, x)
    np.testing.assert_allclose(np.stack(partials, axis=-1), jet.shared, rtol=1e-12, atol=1e-15)
    batch = optloc.simulate(strengths(), truth=np.tile([900.0, 400.0], (64, 1)), seed=1)
    many = equations_at(batch, np.tile(x, (64, 1)))  # enough for machine code
    one = linearise(batch, np.tile(x, (64, 1)))
    white = np.linalg.inv(np.linalg.cholesky(0.1**2 * (np.eye(7) + 1.0)))
    plain = ((white @ one.residual[..., None])[..., 0] ** 2).sum(-1)
    np.testing.assert_allclose(many.cost, plain, rtol=1e-12)
    ipopt = solve(problem, "roots+nlp")
    np.testing.assert_allclose(ipopt.position, solve(problem).position, atol=1e-3)


def test_stations_on_a_circle_cannot_tell_a_place_from_its_inverse():
    ring = 5e3 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=-1)
    problem = optloc.assemble(ring, optloc.measured("rss_urban", a=np.arange(1, 8), b=0, sigma=0.1))
    truth = np.array([1e3, 2e3])
    fix = solve(optloc.simulate(problem, truth=truth, seed=4))
    assert fix.status == Status.AMBIGUOUS
    rivals = [fix.position, *fix.alternatives.x]
    for place in (truth, 25e6 * truth / (truth @ truth)):
        assert min(np.linalg.norm(found - place) for found in rivals) < 0.05 * np.linalg.norm(place)


def test_offsets_of_the_receivers_are_registered():
    trials, epochs = 60, 40
    run = strengths(0.5, epochs, times=np.arange(float(epochs)), motions=(Motion(1),))
    names = run.stations.names[1:]
    run = optloc.with_bias(run, "gain", members=names, kind="rss_urban")
    truth = np.concatenate([[-2e3, -1e3, 90.0, 50.0], np.linspace(-2.0, 2.0, len(names))])
    fix = solve(optloc.simulate(run, truth=np.tile(truth, (trials, 1)), seed=6))
    assert alone(fix).all()
    error = fix.x - truth
    low, high = band(len(truth) * trials, BAND)
    assert low < squared(error, fix.cov).mean() / len(truth) < high
    bound = optloc.crlb(run, truth)
    low, high = np.sqrt(band(2 * trials, BAND))
    assert low < np.sqrt((error[:, :2] ** 2).sum(1).mean() / np.trace(bound[:2, :2])) < high


def test_the_exponent_is_a_scale_that_registration_finds():
    """Rows with the exponent 3.3 under a kind of 3: a scale error of 10 %."""
    run = strengths(0.2, 60, times=np.arange(60.0), motions=(Motion(1),))
    run = optloc.with_bias(run, "exponent", per="kind", form="scale")
    truth = np.array([-2e3, -1e3, 70.0, 50.0, 0.1])
    fix = solve(optloc.simulate(run, truth=truth, seed=2))
    assert alone(fix)
    slot, _ = run.layout.find("exponent")
    sigma = np.sqrt(fix.cov[slot.start, slot.start])
    assert sigma < 0.02
    assert abs(fix.bias["exponent"].item() - 0.1) < 4.0 * sigma


@pytest.mark.parametrize("update", ["iekf", "fading"])
def test_tracks_start_without_a_guess(update):
    epochs = 60
    run = strengths(0.3, epochs, times=np.arange(float(epochs)), motions=(Motion(1),))
    drawn = optloc.simulate(run, truth=[-2e3, -1.5e3, 60.0, 40.0], seed=8)
    track = collected(list(tracked(drawn, polynomial(1, 0.1), update)), 2)
    course = np.array([-2e3, -1.5e3]) + np.arange(epochs)[:, None] * [60.0, 40.0]
    error = track.position - course
    late = slice(epochs // 2, None)
    sigma = np.sqrt(np.trace(track.cov[late, :2, :2], axis1=1, axis2=2))
    assert np.isfinite(error[late]).all()
    assert (np.linalg.norm(error[late], axis=1) < 5.0 * sigma).all()


STUDY = """
format = 1
name = "strengths"
seed = 5
trials = 40

[[scenario]]
name = "houses"
layout = { stations = 8, kinds = ["rss_urban"] }
truth = { kind = "hull" }
noise = ["0.05 dB"]

[[method]]
method = "gtrs+lsr"
"""


def test_studies_take_it_in_a_layout():
    (made,) = design(STUDY).chunks
    found = compute(made).table.to_pandas()
    assert len(found) == 40
    assert np.isfinite(found["crlb"]).all()
    good = found[found["status"] == "unproven"]
    assert len(good) >= 36
    assert (good["error"] < 6.0 * good["crlb"]).all()


FILE = """
format = 1

[stations]
rows = [
{stations}
]

[[measurements]]
kind = "rss_urban"
unit = "dB"
sigma = "0.1 dB"
b = "A"
rows = [
{rows}
]
"""


@pytest.fixture
def file(tmp_path):
    """A problem file of one fix, written out."""
    names, truth = "ABCDEFGH", np.array([900.0, -700.0])
    away = np.linalg.norm(truth - STATIONS, axis=1)
    values = 30.0 * np.log10(away[0] / away) + np.random.default_rng(3).normal(0.0, 0.1, 8)
    stations = "\n".join(f'{{ name = "{n}", x = {x}, y = {y} }},' for n, (x, y) in zip(names, STATIONS, strict=True))
    rows = "\n".join(f'{{ a = "{n}", z = {z} }},' for n, z in list(zip(names, values, strict=True))[1:])
    path = tmp_path / "houses.toml"
    path.write_text(FILE.replace("{stations}", stations).replace("{rows}", rows), encoding="utf-8")
    return path, truth


def run(*arguments, code=0):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result.stdout


def test_files_and_commands_know_it(file, tmp_path):
    path, truth = file
    assert '"unproven"' in run("fix", path, "--json", code=1)
    fix = solve(optloc.load(path))
    assert np.linalg.norm(fix.position - truth) < 5.0 * np.sqrt(np.trace(fix.cov))
    assert "rss_urban" in run("check", path)
    run("fix", path, "--method", "robust", "--allow", "unproven", "--json")
    run("crlb", path, "--at", "900,-700")
    drawn = tmp_path / "drawn.toml"
    run("simulate", path, "--truth", "900,-700", "--seed", "1", "--out", drawn)
    run("fix", drawn, "--allow", "unproven", "--json")
    assert "rss_urban" in run("list", "kinds", "--json")
    assert "dB" in next(
        row["units"] for row in json.loads(run("list", "kinds", "--json")) if row["kind"] == "rss_urban"
    )
    assert "rss_urban" in run("schema")


def test_it_is_drawn(file):
    from optloc.show.pictures import plot_fixes

    path, _ = file
    problem = optloc.load(path)
    figure = plot_fixes(problem, solve(problem), title="houses")
    picture = io.BytesIO()
    figure.savefig(picture, format="svg")
    assert len(picture.getvalue()) > 5_000


def test_an_unknown_name_is_answered_with_those_of_packages():
    with pytest.raises(InvalidProblem, match="rss_urban"):
        optloc.from_table({"a": ["B"], "b": ["A"], "z": [1.0]}, {"A": (0, 0), "B": (9, 0)}, kind="rss_urbn", sigma=1.0)


@pytest.mark.slow
def test_other_processes_find_it_too(package, file):
    words = "['optloc', 'fix', sys.argv[1], '--allow', 'unproven', '--json']"
    code = f"import sys, optloc.cli; sys.argv = {words}; optloc.cli.main()"
    environment = os.environ | {"PYTHONPATH": str(package)}
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(file[0])],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    assert without_progress(found.stderr) == []


# --------------------------------------------------------------------------- formulation, loss, solver and tracker
def test_the_formulation_is_listed():
    assert optloc.solvers.FORMULATIONS["discs"].source.endswith("2001")
    assert any(row["formulation"] == "discs" for row in json.loads(run("list", "formulations", "--json")))


def test_the_formulation_starts_fixes_from_ranges_over_blocked_paths():
    truth = places(20, seed=2)
    template = optloc.assemble(STATIONS, optloc.measured("range", a=np.arange(8), sigma=5.0))
    drawn = optloc.simulate(template, truth=truth, seed=1)
    rough, fine = solve(drawn, "discs", refine=False), solve(drawn, "discs+lsr")
    assert (np.linalg.norm(rough.position - truth, axis=1) < 1e3).all()
    assert alone(fine).all()
    np.testing.assert_allclose(fine.position, solve(drawn).position, atol=1e-4)
    # By its definition: no other point is deeper in the discs.
    for i in range(3):
        depth = (drawn.z[i] - np.linalg.norm(rough.position[i] - STATIONS, axis=1)).min()
        around = rough.position[i] + np.random.default_rng(i).normal(0.0, 50.0, (500, 2))
        others = (drawn.z[i] - np.linalg.norm(around[:, None] - STATIONS, axis=-1)).min(1)
        assert others.max() <= depth + 1e-2


def test_the_formulation_leaves_other_rows_without_an_answer():
    drawn = optloc.simulate(strengths(), truth=[900.0, 400.0], seed=1)
    assert not solve(drawn, "discs+lsr").answered.any()


def test_one_entry_is_enough_for_a_formulation_and_for_a_loss():
    text = files_of_the_page()["pyproject.toml"]
    assert text.count("optloc.formulations") == text.count("optloc.losses") == 1
    words = [row["solver"] for row in json.loads(run("list", "solvers", "--json"))]
    assert {"discs", "welsch", "simplex"} <= set(words)


def test_the_formulation_starts_each_of_several_epochs():
    truth = places(4, seed=5)
    epoch, a = np.repeat(np.arange(4), 8), np.tile(np.arange(8), 4)
    run_of_four = optloc.assemble(
        STATIONS,
        optloc.measured("range", a=a, epoch=epoch, sigma=1.0),
        times=np.arange(4.0),
        motions=(Motion(span="epoch"),),
    )
    drawn = optloc.simulate(run_of_four, truth=truth.reshape(1, -1)[0], seed=2)
    fix = solve(drawn, "discs+lsr")
    assert np.linalg.norm(fix.position - truth, axis=-1).max() < 5.0


def test_the_loss_leaves_a_liar_aside():
    truth = places(50, seed=9)
    template = optloc.assemble(STATIONS, optloc.measured("range", a=np.arange(8), sigma=5.0))
    drawn = optloc.simulate(template, truth=truth, seed=1)
    z = np.array(drawn.z)
    z[:, 3] += 500.0
    fix, plain = solve(drawn.with_rows(z=z), "welsch"), solve(drawn)
    assert (fix.weights[:, 3] < 1e-3).all()
    assert (np.linalg.norm(fix.position - plain.position, axis=-1) < 20.0).all()
    # By its definition: the derivative of the cost is twice the weighted residual.
    loss, u = optloc.problem.LOSSES["welsch"], np.linspace(-6.0, 6.0, 121)
    slope = (loss.rho(u + 1e-6) - loss.rho(u - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, 2.0 * u * loss.weight(u), atol=1e-6)
    assert abs(loss.efficiency - 0.95) < 2e-3


def test_the_solver_descends_to_the_minimum():
    drawn = optloc.simulate(strengths(), truth=[900.0, 400.0], seed=1)
    rough, fine = solve(drawn, "gtrs+simplex"), solve(drawn, "gtrs+simplex+lsr")
    best = solve(drawn)
    np.testing.assert_allclose(rough.position, best.position, atol=1.0)
    assert alone(fine)
    np.testing.assert_allclose(fine.position, best.position, atol=1e-4)
    assert [stage.name for stage in fine.stages][-1] == "lsr"


def test_the_filter_is_the_kalman_update_of_a_larger_prediction():
    scan = optloc.simulate(strengths(), truth=[900.0, 400.0], seed=1)
    mean, cov = np.array([950.0, 380.0]), np.diag([60.0**2, 40.0**2])
    done = TABLES["trackers"]["fading"](scan, mean, cov)
    at = equations_at(scan, mean[None])
    information = np.linalg.inv(1.1 * cov) + np.asarray(at.shared)[0]
    np.testing.assert_allclose(done.cov, np.linalg.inv(information), rtol=1e-9)
