"""The paper `satellites`: its numbers, the bounds beside them, and the page."""

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc import crlb
from optloc.cli import app
from optloc.engine import predict
from optloc.lab.papers import satellites
from optloc.lab.papers.report import Study
from optloc.lab.papers.satellites import (
    COURSE,
    FILTERS,
    SATELLITES,
    START,
    far,
    orbits,
    problem,
    root_trace,
    run_climbing,
    run_fixed,
    run_heights,
    run_wild,
    surface_course,
    truth,
)
from optloc.problem import ECEF

RUN = CliRunner()


def sequence(key):
    return np.random.SeedSequence(key)


def test_the_scene_is_that_of_the_paper():
    sides = [np.linalg.norm(SATELLITES[i] - SATELLITES[j]) / 1e3 for i, j in ((0, 1), (0, 2), (1, 2))]
    assert sorted(sides) == pytest.approx([88.4, 89.0, 97.1], abs=0.1)
    assert np.linalg.norm(START - SATELLITES, axis=1) / 1e3 == pytest.approx([847.9, 824.3, 829.1], abs=0.1)
    assert predict(problem(1, order=0), START)[:2] == pytest.approx([23600.0, 18840.1], abs=0.1)
    assert ECEF.enu_axes(START) @ COURSE == pytest.approx([-28.03, -1.63, 3.38], abs=0.01)
    assert ECEF.enu_axes(START)[2] @ surface_course() == pytest.approx(0.0, abs=1e-12)
    high = predict(problem(101), truth(1)[0])[-1]
    assert high == pytest.approx(339.0, abs=1.0)


def test_the_printed_height_is_off_by_the_difference_of_the_radii():
    f, equator = 1 / 298.257223563, 6378137.0
    printed = np.sqrt((1 - f) ** 2 * (START[0] ** 2 + START[1] ** 2) + START[2] ** 2)
    assert printed - equator == pytest.approx(-21384.7, abs=0.1)
    assert printed - equator * (1 - f) == pytest.approx(0.0, abs=1e-6)


def test_bounds_of_one_fix():
    found = [
        float(root_trace(crlb(problem(1, order=0, height=height, correlated=correlated), START)))
        for height in (500.0, None)
        for correlated in (False, True)
    ]
    assert found == pytest.approx([571.9, 560.5, 231.8, 201.9], abs=0.1)
    axes = ECEF.enu_axes(START)
    own = np.sqrt(np.diagonal(axes @ crlb(problem(1, order=0), START) @ axes.T))
    assert own == pytest.approx([190.9, 201.6, 500.0], abs=0.1)


def test_a_fix_is_worth_less_and_less_away_from_the_satellites():
    assert far(np.radians([0.0, 5.0, 10.0, 20.0])) == pytest.approx([220, 354, 927, 6600], rel=0.05)
    assert far(np.radians([25.0]))[0] == pytest.approx(30e3, rel=0.1)


def test_filters_from_fixes_meet_the_bound():
    found, bound = run_fixed(60, 60, sequence(1))
    assert bound[[0, 9, 49]] == pytest.approx([522.1, 310.5, 156.3], abs=0.05)
    for name in FILTERS:
        assert found[name].rms[[9, 49]] == pytest.approx(bound[[9, 49]], rel=0.25)
        assert found[name].claimed[0] == pytest.approx(bound, rel=0.02)


def test_far_starts_order_the_filters():
    found, bound = run_wild(100e3, 60, 60, sequence(2))
    last = {name: run.error[:, -1] for name, run in found.items()}
    median = {name: np.median(error) for name, error in last.items()}
    assert median["iekf"] == pytest.approx(median["quartic + ekf"], rel=0.1)
    assert median["mgekf"] == pytest.approx(median["quartic + ekf"], rel=0.15)
    assert median["ekf"] > 2 * median["iekf"]
    assert median["mvekf"] > 1.5 * median["iekf"]
    assert (last["mvekf"] < last["iekf"]).mean() < 0.3
    assert bound[-1] < 200.0


@pytest.mark.full  # the reproduction has its table in every run
def test_what_a_wrong_height_does():
    found = run_heights(60, 40, sequence(3))
    careless, honest = (found[f"constant error of 500 m, {how}"] for how in ("taken for white", "as a state"))
    assert careless.rms[-1] > 2.0 * careless.claimed[:, -1].mean()
    assert honest.rms[-1] == pytest.approx(honest.claimed[:, -1].mean(), rel=0.3)
    assert found["known: the ellipsoid itself"].rms[-1] < 0.6 * found["white, 500 m"].rms[-1]
    lifted = run_climbing(200, 20, sequence(4))
    assert lifted.rms[-1] == pytest.approx(712.0, rel=0.05)
    assert lifted.claimed[:, -1].mean() == pytest.approx(80.2, abs=0.5)


def test_orbits_keep_the_formation_and_its_height():
    path = orbits(100, 0.7)
    assert path[0] == pytest.approx(SATELLITES)
    assert np.linalg.norm(path, axis=-1) == pytest.approx(
        np.broadcast_to(np.linalg.norm(SATELLITES, axis=-1), (100, 3))
    )
    speed = np.linalg.norm(np.diff(path.mean(1), axis=0), axis=-1)
    assert speed == pytest.approx(np.full(99, 7.4e3), rel=1e-3)
    east, north, _ = ECEF.enu_axes(SATELLITES.mean(0))
    step = path[1].mean(0) - path[0].mean(0)
    assert np.arctan2(step @ east, step @ north) == pytest.approx(0.7, abs=1e-2)


TINY = satellites.SatellitesSample(4, 4, (100e3,), steps=20, far=12)


@pytest.fixture(scope="module")
def report():
    ticks, ready = [], satellites.STUDY.reproduction(TINY, 3)
    made = ready.run(lambda: ticks.append(1))
    assert len(ticks) == ready.work
    return made


@pytest.mark.slow
def test_a_reproduction_has_every_table_and_figure(report):
    rows = {table.name: table.rows for table in report.tables}
    assert list(rows) == ["fixed", "relative", "starts", "pairs", "heights", "moving", "one-shot"]
    assert [picture.name for picture in report.pictures] == ["filters", "heights"]
    assert [row[0] for row in rows["fixed"]] == ["EKF", "IEKF", "MGEKF", "MVEKF", "posterior bound"]
    assert rows["fixed"][-1][1:3] == ("522.1", "310.5")
    assert [len(rows[name]) for name in ("starts", "pairs", "heights", "moving", "one-shot")] == [5, 1, 6, 5, 10]
    assert all(len(row) == len(table.header) for table in report.tables for row in table.rows)
    assert "nan" not in report.markdown()


@pytest.mark.slow
def test_reproduce_writes_the_page(report, tmp_path, monkeypatch):
    cheap = Study(satellites.STUDY.sizes, lambda _: 1, lambda *_: report)
    monkeypatch.setattr(satellites, "STUDY", cheap)
    result = RUN.invoke(app, ["reproduce", "satellites", "--out", str(tmp_path / "new"), "--seed", "3"])
    assert result.exit_code == 0, result.output
    page = (tmp_path / "new" / "README.md").read_text(encoding="utf-8")
    assert all(text in page for text in ("seed 3", "(filters.png)", "571.9", "## What is wrong in the paper"))
