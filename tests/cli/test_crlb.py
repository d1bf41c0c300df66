"""Truths that options give as vectors, the bound of a growing run, and unnoticed errors as records."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import InvalidProblem, Motion, assemble, crlb, measured
from optloc.cli import app
from optloc.cli.crlb import courses, reliability_json, vector
from optloc.model_checks.evidence import Reliability
from optloc.problem import ECEF

PLACES = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 1000.0]])


def run(k, order=0):
    rows = measured("range", a=np.tile(np.arange(4), k), epoch=np.repeat(np.arange(k), 4), sigma=2.0)
    return assemble(PLACES, rows, motions=(Motion(order, "run"),), times=np.arange(float(k)))


def test_a_truth_is_the_parameter_vector():
    assert vector(run(3, order=1), "1,2", "3,4", geodetic=False).tolist() == [1.0, 2.0, 3.0, 4.0]
    with pytest.raises(InvalidProblem, match="does not move"):
        vector(run(3), "1,2", "3,4", geodetic=False)
    with pytest.raises(InvalidProblem, match="3 coordinates do not fit 2"):
        vector(run(3), "1,2,3", None, geodetic=False)
    with pytest.raises(InvalidProblem, match="need a geodetic frame"):
        vector(run(3), "47,8", None, geodetic=True)


def test_a_truth_in_degrees_is_a_place_of_the_frame():
    stations = ECEF.from_geodetic(np.radians([47.0, 47.1, 47.2, 47.0]), np.radians([8.0, 8.1, 8.0, 8.2]), np.zeros(4))
    problem = assemble(stations, measured("range", a=np.arange(4), sigma=1.0), frame=ECEF)
    found = vector(problem, "47.05,8.05,500", None, geodetic=True)
    assert found == pytest.approx(ECEF.from_geodetic(np.radians(47.05), np.radians(8.05), 500.0))


def test_the_bound_of_a_resting_target_falls_with_the_root_of_the_epochs():
    problem, truth = run(9), np.array([300.0, 400.0])
    course, known = courses(problem, truth)
    assert known is None
    sigma = course.total("position")
    assert sigma == pytest.approx(sigma[0] / np.sqrt(course.counts))
    assert course.covariance[-1] == pytest.approx(crlb(problem, truth))
    assert courses(run(1), truth) is None


def test_unnoticed_errors_are_records():
    told = Reliability(("range of A", "range of B"), np.array([8.0, np.inf]), np.array([3.0, np.inf]))
    assert reliability_json(told)[0] == {"channel": "range of A", "least_noticed": 8.0, "moves_position": 3.0}
    assert reliability_json(None) == []


HALL = """format = 2
[stations]
rows = [
  { name = "A", x = 0.0, y = 0.0, z = 3.0 }, { name = "B", x = 24.0, y = 1.0, z = 2.5 },
  { name = "C", x = 25.0, y = 16.0, z = 3.2 }, { name = "D", x = -1.0, y = 15.0, z = 2.2 },
  { name = "E", x = 12.0, y = 8.0, z = 5.0 },
]
[[measurements]]
kind = "range"
sigma = "5 cm"
rows = [{ a = "A" }, { a = "B" }, { a = "C" }, { a = "D" }, { a = "E" }]
"""


def test_an_exact_constraint_lowers_the_bound_and_a_limit_does_not(tmp_path):
    (tmp_path / "hall.toml").write_text(HALL)
    words = ["crlb", str(tmp_path / "hall.toml"), "--at", "7,5,1.2", "--json"]

    def sigma(*more):
        result = CliRunner().invoke(app, [*words, *more])
        return np.array(json.loads(result.stdout)["bounds"][0]["sigma"])

    free, limited = sigma(), sigma("--constraint", "height max=2 m")
    held = sigma("--constraint", "height exactly=1.2 m")
    assert limited == pytest.approx(free)
    assert held[2] == pytest.approx(0.0, abs=1e-9)
    assert (held[:2] < free[:2]).all()


def test_a_map_follows_an_exact_constraint(tmp_path, monkeypatch):
    (tmp_path / "hall.toml").write_text(HALL)
    drawn = []
    monkeypatch.setattr("optloc.cli.crlb._write_map", lambda found, *_, **__: drawn.append(found))
    words = ["crlb", str(tmp_path / "hall.toml"), "--map", "m.svg", "--at", "7,5,1.2", "--extent", "0,20,0,15"]
    for more in ([], ["--constraint", "height exactly=1.2 m"]):
        assert CliRunner().invoke(app, [*words, *more]).exit_code == 0
    free, held = drawn
    assert (held.sigma < free.sigma).all()
    assert held.vertical == pytest.approx(0.0, abs=1e-9)
