"""The paper `bistatic`: its numbers, the bounds beside them, and the page."""

import numpy as np
import pytest
from typer.testing import CliRunner

from optloc.cli import app
from optloc.lab.papers import bistatic
from optloc.lab.papers.bistatic import (
    BASELINE,
    COURSE,
    ELEVATION,
    TRACKERS,
    bound_moving,
    bound_single,
    bound_still,
    place,
    polar,
    printed_angles,
    problem,
    run_batches,
    run_still,
    truth,
)
from optloc.lab.papers.report import Study

RUN = CliRunner()


def sequence(key):
    return np.random.SeedSequence(key)


def test_the_scene_is_that_of_the_paper():
    at = place()
    assert at / 1e3 == pytest.approx([10.031, 79.960, 9.962], abs=1e-3)
    excess = np.linalg.norm(at) + np.linalg.norm(at - [BASELINE, 0, 0]) - BASELINE
    assert excess / 299.792458 == pytest.approx(309.234, abs=1e-3)
    assert COURSE @ at / np.linalg.norm(at) == pytest.approx(11.08, abs=5e-3)
    assert polar(truth(3, slow=True)[2]) == pytest.approx(polar(at + 2 * COURSE))
    assert polar(at) == pytest.approx([81.2e3, 1.446, 0.123])
    assert problem(4, order=1).layout.size == 6


def test_bounds_of_a_target_that_stays():
    found = bound_still(np.array([1, 10, 50, 200]))
    assert found[:, 0] == pytest.approx([934.0, 295.3, 132.1, 66.0], abs=0.5)
    assert found[:, 1] == pytest.approx(np.radians(1.0) / np.sqrt([1, 10, 50, 200]), rel=1e-3)
    assert found[:, 2] == pytest.approx(found[:, 1])


def test_bounds_of_the_slow_target():
    found = bound_moving(np.array([10, 50, 200]))
    assert found[:, 0] == pytest.approx([549.0, 253.0, 110.0], abs=0.7)
    assert found[2, 1:] == pytest.approx([0.0020, 0.0022], abs=1e-4)
    assert bound_moving(np.array([10]), 10 * 5.99584916)[0, 0] == pytest.approx(550.0, abs=1.0)


@pytest.mark.parametrize(
    ("azimuth", "wanted"),
    [(0.05, 9.83), (0.2, 5.59), (0.5, 2.64), (1.0, 1.40), (1.446, 0.934), (2.0, 0.563), (2.6, 0.257), (3.1, 0.060)],
)
def test_the_range_is_best_behind_the_receiver(azimuth, wanted):
    assert bound_single(azimuth, ELEVATION) / 1e3 == pytest.approx(wanted, rel=0.01)


def test_the_printed_sign_diverges():
    spread = np.sqrt((printed_angles(200, 2000, sequence(1)) ** 2).mean(0))
    assert spread[[0, 9, 199]] == pytest.approx([np.radians(1.0), 0.10, 1.85], rel=0.05)


def test_claims_for_ten_epochs_are_those_of_one_run():
    found = run_still(10, 600, sequence(2))["simplified"]
    last = np.abs(found.error[:, -1])
    assert (last[:, 0] < 1e3).mean() == pytest.approx(0.992, abs=0.012)
    assert (last[:, 1] < 0.005).mean() == pytest.approx(0.64, abs=0.06)
    assert (last[:, 2] < 0.008).mean() == pytest.approx(0.84, abs=0.05)


def test_short_records_beat_their_bound_where_the_path_is_good():
    good, poor = (run_batches(10, 300, sequence(3), path=p * 5.99584916)["batch maximum likelihood"] for p in (1, 10))
    assert good.rms(10)[0] == pytest.approx(405.0, rel=0.12)
    assert poor.rms(10)[0] == pytest.approx(548.0, rel=0.12)
    assert abs(good.mean(10)[0]) < 4 * 405.0 / np.sqrt(300)


def test_a_ground_repairs_the_height_only():
    found = {name: errors / 1e3 for name, errors in bistatic.fix_grounded(1.446, 0.002463, 200, sequence(4)).items()}
    assert found["free"] == pytest.approx([0.945, 1.416, 2.218], rel=0.15)
    assert found["above ground"][1] == pytest.approx(1.019, rel=0.15)
    assert found["above ground"][0] == pytest.approx(found["free"][0], rel=0.01)
    assert found["known height"][1] < 1e-3


TINY = bistatic.BistaticSample(20, 4, 4, epochs=60)


@pytest.fixture(scope="module")
def report():
    ticks, ready = [], bistatic.STUDY.reproduction(TINY, 3)
    made = ready.run(lambda: ticks.append(1))
    assert len(ticks) == ready.work
    return made


@pytest.mark.full
def test_a_reproduction_has_every_table_and_figure(report):
    names = [table.name for table in report.tables]
    assert names == ["still", "claims", "slow", "short", "directions", "ground", "printed"]
    assert [picture.name for picture in report.pictures] == ["still", "slow", "run"]
    rows = {table.name: table.rows for table in report.tables}
    assert len(rows["still"]) == 9
    assert [row[0] for row in rows["slow"]][: len(TRACKERS)] == list(TRACKERS)
    assert len(rows["slow"]) == len(TRACKERS) + 3
    assert all(len(row) == len(table.header) for table in report.tables for row in table.rows)
    assert "nan" not in report.markdown()


@pytest.mark.full
def test_reproduce_writes_the_page(report, tmp_path, monkeypatch):
    cheap = Study(bistatic.STUDY.sizes, lambda _: 1, lambda *_: report)
    monkeypatch.setattr(bistatic, "STUDY", cheap)
    result = RUN.invoke(app, ["reproduce", "bistatic", "--out", str(tmp_path / "new"), "--seed", "3"])
    assert result.exit_code == 0, result.output
    page = (tmp_path / "new" / "README.md").read_text(encoding="utf-8")
    assert all(text in page for text in ("seed 3", "(slow.png)", "107.4", "## What is wrong in the paper"))
