"""The share of each status at a place agrees with fixes that are simulated and counted here."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc import InvalidProblem, Status, assemble, measured, simulate, solve, station_array
from optloc.cli import app
from optloc.solvers import status_shares
from optloc.solvers.shares import status_map

PLACE = np.array([[0.0, 0.0], [40.0, 5.0], [35.0, 45.0], [-5.0, 30.0], [20.0, -15.0]])
RUN = CliRunner()


def template(sigma=1.5):
    rows = measured("tdoa", a=np.arange(1, 5), b=0, arrival_sigma=sigma)
    return assemble(station_array(PLACE), rows)


@pytest.mark.parametrize("truth", [[10.0, 12.0], [90.0, 40.0], [300.0, -80.0]])
def test_shares_agree_with_a_direct_simulation(truth):
    problem, many = template(), 400
    told = status_shares(problem, np.array(truth), many, seed=1)
    assert told.share.sum() == pytest.approx(1.0)
    code = solve(simulate(problem, np.array(truth), seed=99, trials=many)).code
    for status in Status:
        one, other = float(told.of(status)), float((code == status).mean())
        error = np.sqrt((one * (1.0 - one) + other * (1.0 - other)) / many + 1.0 / many**2)
        assert abs(one - other) <= 4.0 * error, status


def test_ok_fixes_cover_and_the_share_falls_with_the_distance():
    told = status_shares(template(), np.array([[12.0, 14.0], [400.0, 0.0]]), 300)
    near, far = told.of(Status.OK)
    assert near > 0.9
    assert far < 0.5
    assert told.covered[0] == pytest.approx(0.95, abs=0.05)
    assert told.share.shape == (2, len(told.statuses))
    assert told.deviation.max() < 0.03


def test_the_draws_at_a_place_depend_on_its_number_alone():
    places = np.array([[12.0, 14.0], [100.0, 0.0], [60.0, 60.0]])
    whole = status_shares(template(), places, 50, seed=3)
    part = status_shares(template(), places[:2], 50, seed=3)
    for status in Status:
        np.testing.assert_array_equal(whole.of(status)[:2], part.of(status))


def test_biases_and_priors_are_drawn():
    problem = template(0.5)
    prior = optloc.problem.Prior("position", np.zeros(2), np.diag([4.0, 4.0]))
    known = assemble(problem.stations, measured("range", a=np.arange(2), sigma=1.0), priors=(prior,))
    told = status_shares(known, np.array([15.0, 20.0]), 300)
    # the mean of the prior moves with the truth: a fix far from it would be a misfit
    assert told.of(Status.MISFIT) < 0.02


def test_bad_arguments_are_refused_in_a_sentence():
    with pytest.raises(InvalidProblem, match="0 trials"):
        status_shares(template(), np.zeros(2), 0)
    with pytest.raises(InvalidProblem, match="does not fit"):
        status_shares(template(), np.zeros(3))


def test_a_map_holds_the_shares_of_its_places():
    found = status_map(template(), np.zeros(2), np.linspace(-20.0, 60.0, 4), np.linspace(0.0, 40.0, 3), trials=20)
    assert found.shares.share.shape[:2] == (3, 4)
    assert found.shares.of(Status.OK).max() > 0.8


def test_the_command_prints_shares_and_writes_maps(tmp_path):
    done = RUN.invoke(app, ["crlb", "demo", "--status", "--at", "1200,800,300", "--trials", "40", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert sum(told["share"].values()) == pytest.approx(1.0)
    assert told["trials"] == 40
    text = RUN.invoke(app, ["crlb", "demo", "--status", "--at", "1200,800,300", "--trials", "40"]).stdout
    assert "ok" in text
    out = tmp_path / "share.geojson"
    done = RUN.invoke(app, ["crlb", "demo", "--status", "--map", str(out), "--height", "1200 m", "--trials", "2"])
    assert done.exit_code == 0, done.output
    places = [one for one in json.loads(out.read_text())["features"] if one["properties"]["role"] == "status"]
    assert len(places) == 24 * 24
    done = RUN.invoke(app, ["crlb", "demo", "--status", "--map", str(tmp_path / "a.html"), "--height", "1200 m"])
    assert done.exit_code == 2
    assert "status maps of type '.html' are unknown" in done.output
