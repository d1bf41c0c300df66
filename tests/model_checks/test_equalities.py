"""Runs whose epochs have a place and an equality of their own: refits, score tests and what a command says of them."""

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc.base.frames import Frame
from optloc.cli import app
from optloc.linear.constraints import box, height, violation
from optloc.linear.equalities import Equalities, spare_rows
from optloc.linear.redundancy import degrees_of_freedom
from optloc.model_checks.score import descend, explain_misfit
from optloc.problem.epochs import by_epoch

FREE = (optloc.Motion(0, span="epoch"),)
ANCHORS = np.array([[0.0, 0, 2.5], [6, 0, 2.4], [6, 8, 2.6], [0, 8, 2.5], [3, 4, 2.9], [3, 1, 1.9]])
TOWN = Frame("enu", (0.84, 0.2, 500.0))


def held(axis, value):
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    low[axis] = high[axis] = value
    return box(low, high)


def run(kind="range", axis=2, seed=0, epochs=5, level=6.0, offset=0.0, constraints=None, frame=None, scale=1.0):
    """Return a run of free places on a plane, whose noise is so many times as large as stated, and the places."""
    rng = np.random.default_rng(seed)
    places = scale * rng.uniform(1.0, 5.0, (epochs, 3))
    places[:, axis] = scale
    z = np.linalg.norm(places[:, None] - scale * ANCHORS, axis=-1) + 0.05 * level * rng.standard_normal((epochs, 6))
    z += rng.uniform(0.0, 900.0, (epochs, 1)) if kind == "toa" else 0.0
    z[:, 1] += offset
    rows = optloc.measured(
        kind, z.ravel(), a=np.tile(np.arange(6), epochs), sigma=0.05, epoch=np.repeat(np.arange(epochs), 6)
    )
    more = {} if frame is None else {"frame": frame}
    constraints = held(axis, scale) if constraints is None else constraints
    return optloc.assemble(scale * ANCHORS, rows, motions=FREE, constraints=constraints, **more), places


def joined(problem, places):
    """Return the vector of a run whose emission times, where there are some, are zero."""
    slots = {slot.name: slot.size for slot in problem.layout.local}
    parts = [places if name == "position" else np.zeros((problem.epochs, size)) for name, size in slots.items()]
    return np.concatenate(parts, axis=1).reshape(1, -1)


@pytest.mark.parametrize(
    ("kind", "axis", "seed", "more"),
    [
        ("range", 2, 0, {}),
        ("range", 0, 1, {}),
        ("toa", 2, 2, {}),
        ("toa", 1, 3, {"scale": 300.0}),
        ("range", 2, 4, {"frame": TOWN, "constraints": height(exactly=501.0)}),
        ("range", 2, 5, {"constraints": (*held(2, 1.0), *held(0, 3.0))}),
    ],
)
def test_a_run_is_refined_as_its_epochs_are(kind, axis, seed, more):
    problem, places = run(kind, axis, seed, **more)
    start = joined(problem, places) + 0.2 * np.random.default_rng(9).standard_normal((1, problem.layout.size))
    x, cost = descend(problem.flat(), start)
    batch = by_epoch(problem).flat()
    layout, local = problem.layout, problem.layout.split(x)[1][0]
    alone = np.zeros((problem.epochs, batch.layout.size))
    for slot in layout.local:
        there, shared = batch.layout.find(slot.name)
        start_at = there.start + (0 if shared else batch.layout.n_shared)
        alone[:, start_at : start_at + slot.size] = local[:, slot.start : slot.start + slot.size]
    assert violation(batch, alone).max() < 1e-9
    _, each = descend(batch, alone)
    assert cost[0] == pytest.approx(each.sum(), rel=1e-6)
    assert spare_rows(problem.flat())[0] == degrees_of_freedom(batch).sum()


@pytest.mark.parametrize(("kind", "seed"), [("range", 0), ("range", 1), ("toa", 2)])
def test_an_offset_of_a_station_is_found_under_an_equality(kind, seed):
    problem, places = run(kind, seed=seed, epochs=8, level=1.0, offset=0.6)
    told = explain_misfit(problem.flat(), joined(problem, places))
    assert told[0].candidate.bias.members == ("S1",)
    assert told[0].value[0] == pytest.approx(0.6, abs=5.0 * told[0].sigma[0])


def test_an_epoch_without_rows_has_no_equality_to_count():
    problem, _ = run(epochs=4)
    silent = problem.with_rows(weight=np.where(problem.epoch == 2, 0.0, problem.weight))
    assert spare_rows(silent.flat())[0] == spare_rows(problem.flat())[0] - 4
    assert Equalities.of(optloc.assemble(ANCHORS, optloc.measured("range", a=np.arange(6), sigma=1.0))).single is None


TABLE = """t_s,A1_m,A2_m,A3_m,A4_m,A5_m
0,2.73,5.55,8.15,6.30,3.04
1,3.62,5.90,7.32,5.40,2.06
2,4.20,5.60,5.44,4.99,1.47
3,5.06,5.66,5.15,4.76,1.94
4,6.15,6.60,4.17,4.47,2.19
5,7.13,6.45,3.26,4.16,2.62
"""
SITES = "anchor,x_m,y_m,z_m\nA1,0,0,2.5\nA2,6,0,2.5\nA3,6,8,2.5\nA4,0,8,2.5\nA5,3,4,2.5\n"


def test_a_command_tells_misfits_under_an_exact_height(tmp_path):
    (tmp_path / "r.csv").write_text(TABLE)
    (tmp_path / "s.csv").write_text(SITES)
    words = ["fix", str(tmp_path / "r.csv"), "--stations", str(tmp_path / "s.csv"), "--as", "range", "--sigma", "5 cm"]
    done = CliRunner().invoke(app, [*words, "--box=-inf,-inf,1:inf,inf,1"])
    said = " ".join(done.output.split()).lower()
    assert done.exit_code == 1, done.output
    assert said.count("misfit") >= 6, said
    assert "the noise level is the suspect: 6 of 6 fixes do not fit" in said
    # the equality decides between a place and its mirror image already
    assert "mirror image" not in said
    free = CliRunner().invoke(app, words)
    assert "mirror image" in " ".join(free.output.split())
