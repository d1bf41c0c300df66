"""Degrees of freedom: unknowns of an epoch count where a row that is present depends on them."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import optloc
from optloc.base.types import Motion
from optloc.cli import app
from optloc.linear.redundancy import degrees_of_freedom, present_unknowns
from optloc.problem.epochs import by_epoch

STATIONS = np.array([[0, 0], [1000, 0], [1000, 1000], [0, 1000], [400, -500], [1500, 500]], dtype=float)
PLACES = np.array([[300.0, 400.0], [700.0, 200.0], [500.0, 800.0]])


def owner(epochs, targets, mode="blocks"):
    """Return whose transmission each epoch is."""
    if mode == "blocks":
        return np.repeat(np.arange(targets), -(-epochs // targets))[:epochs]
    return np.arange(epochs) % targets


def heard(epochs=10, targets=2, *, sigma=3.0, seed=0, mode="blocks", stations=6, weight=1.0, **more):
    """Return a run of arrival times in which each epoch is a transmission of one target."""
    rng = np.random.default_rng(seed)
    epoch, a = np.repeat(np.arange(epochs), stations), np.tile(np.arange(stations), epochs)
    target = owner(epochs, targets, mode)[epoch]
    z = np.linalg.norm(PLACES[target] - STATIONS[a], axis=1) + 1e4 * epoch + rng.normal(0, sigma, len(a))
    rows = optloc.measured("toa", z, a=a, epoch=epoch, target=target, sigma=sigma, weight=weight)
    motions = [Motion(0)] * targets
    return optloc.assemble(STATIONS, rows, times=np.arange(float(epochs)), motions=motions, **more)


@pytest.mark.parametrize(
    ("epochs", "targets", "mode", "stations"),
    [(10, 1, "blocks", 6), (10, 2, "blocks", 6), (9, 3, "turns", 5), (200, 2, "turns", 6), (7, 2, "blocks", 4)],
)
def test_emission_times_are_those_of_the_pairs_that_occur(epochs, targets, mode, stations):
    problem = heard(epochs, targets, mode=mode, stations=stations)
    assert int(degrees_of_freedom(problem)) == stations * epochs - epochs - 2 * targets
    assert int(present_unknowns(problem)) == epochs + 2 * targets


def test_the_cost_is_that_of_the_degrees_of_freedom():
    """46 of two targets in ten epochs: the mean of 100 costs is within three of its standard errors."""
    template, count = heard(), 100
    z = np.stack([heard(seed=seed).z for seed in range(count)])
    fix = optloc.solve(template.with_rows(z=z), "roots+lsr")
    assert (fix.dof == 46).all()
    assert abs(fix.cost.mean() - 46) < 3 * np.sqrt(2 * 46 / count)
    assert np.mean(fix.p_value < 0.05) < 0.1


def test_a_long_run_of_two_targets_is_no_misfit():
    fix = optloc.solve(heard(200, seed=4), "roots+lsr")
    assert fix.dof == 996
    assert fix.p_value > 1e-3
    assert fix.status.label != "misfit"


def test_several_targets_in_one_epoch_count_each():
    """Both targets are received in every epoch: two emission times each."""
    epochs, a = 4, np.tile(np.arange(6), 8)
    epoch, target = np.repeat(np.arange(epochs), 12), np.tile(np.repeat(np.arange(2), 6), epochs)
    rows = optloc.measured("toa", np.zeros(48), a=a, epoch=epoch, target=target, sigma=1.0)
    problem = optloc.assemble(STATIONS, rows, times=np.arange(4.0), motions=[Motion(0)] * 2)
    assert int(degrees_of_freedom(problem)) == 48 - 8 - 4


def test_epochs_of_absent_rows_have_no_emission_time():
    weight = np.ones((3, 60))
    weight[0, 12:18] = 0.0  # an epoch of the first target
    weight[1, 30:] = 0.0  # all of the second target
    weight[2, [0, 59]] = 0.0  # single rows
    problem = heard().with_rows(weight=weight)
    # the position of a target that is not received stays an unknown
    assert degrees_of_freedom(problem).tolist() == [54 - 9 - 4, 30 - 5 - 4, 58 - 10 - 4]


def test_rows_of_other_kinds_have_no_emission_time():
    """Bearings alone in the last epoch: it has no emission time to be found."""
    epoch, a = np.repeat([0, 1], 6), np.tile(np.arange(6), 2)
    toa = optloc.measured("toa", np.zeros(12), a=a, epoch=epoch, sigma=1.0)
    angles = optloc.measured("azimuth", np.zeros(9), a=[0, 1, 2] * 3, epoch=np.repeat([0, 1, 2], 3), sigma=0.01)
    problem = optloc.assemble(STATIONS, toa, angles, times=np.arange(3.0), motions=[Motion(0)])
    assert int(degrees_of_freedom(problem)) == 12 + 9 - 2 - 2


def test_a_position_of_each_epoch_counts_where_its_target_is_received():
    epoch, a = np.repeat(np.arange(6), 5), np.tile(np.arange(5), 6)
    target = np.repeat([0, 0, 1, 1, 0, 1], 5)
    rows = optloc.measured("range", np.zeros(30), a=a, epoch=epoch, target=target, sigma=1.0)
    motions = [Motion(0, span="epoch"), Motion(0, span="epoch")]
    problem = optloc.assemble(STATIONS, rows, times=np.arange(6.0), motions=motions)
    assert int(degrees_of_freedom(problem)) == 30 - 12
    assert int(present_unknowns(problem)) == 12


def test_a_known_emission_time_is_no_unknown():
    prior = optloc.problem.Prior("emission[1]", np.zeros(1), np.eye(1))
    problem = heard(priors=[prior])
    assert int(degrees_of_freedom(problem)) == 60 - 5 - 4


def test_epochs_of_single_targets_are_counted_one_by_one():
    """Of a batch of epochs each has its own number."""
    epoch, a = np.repeat(np.arange(3), [6, 4, 5]), np.concatenate([np.arange(6), np.arange(4), np.arange(5)])
    rows = optloc.measured("toa", np.zeros(15), a=a, epoch=epoch, sigma=1.0)
    problem = optloc.assemble(STATIONS, rows, times=np.arange(3.0), motions=[Motion(0, span="epoch")])
    assert degrees_of_freedom(by_epoch(problem).flat()).tolist() == [3, 1, 2]


def test_check_counts_as_a_fix_does(tmp_path):
    lines = ["epoch,a,target,z"]
    for epoch in range(6):
        place = PLACES[epoch % 2]
        far = np.linalg.norm(place - STATIONS, axis=1) + 1e3 * epoch
        lines += [f"{epoch},S{s},T{epoch % 2},{value}" for s, value in enumerate(far.tolist())]
    (tmp_path / "rows.csv").write_text("\n".join(lines))
    stations = "\n".join(f'  {{ name = "S{s}", x = {x}, y = {y} }},' for s, (x, y) in enumerate(STATIONS.tolist()))
    text = f'format = 2\n[stations]\nrows = [\n{stations}\n]\n[target]\nmotion = "static"\n'
    text += '[[measurements]]\nkind = "toa"\nfile = "rows.csv"\nunit = "m"\nsigma = "1 m"\n'
    (tmp_path / "two.toml").write_text(text)
    found = CliRunner().invoke(app, ["check", str(tmp_path / "two.toml"), "--json"])
    about = json.loads(found.stdout)
    assert about["redundancy"]["least"] == 36 - 6 - 4
    assert about["unknowns"] == 6 + 4
