"""Sets of rows: enclosures of their residuals, and scores against the formula and the joint density."""

import numpy as np
import pytest
from multi_target.brute import true_sets
from multi_target.scenes import RING, STAR, drawn, model

import optloc
from optloc.multi_target import Clutter
from optloc.multi_target.sets import refine_sets as refined, scenes, value_changes, values_in_balls


def mixed(d):
    """Return one row of each kind at a station that has neighbours."""
    rng = np.random.default_rng(3)
    stations = rng.normal(0.0, 5e3, (4, d))
    rows = [
        optloc.measured("tdoa", a=[0, 1], b=[2, 3], sigma=10.0),
        optloc.measured("range", a=[0, 2], sigma=10.0),
        optloc.measured("range_sum", a=[1], b=[3], sigma=10.0),
        optloc.measured("azimuth", a=[1, 3], sigma=1e-3),
    ]
    if d == 3:
        rows.append(optloc.measured("elevation", a=[0, 2], sigma=1e-3))
    return optloc.assemble(stations, *rows), stations


@pytest.mark.parametrize("d", [2, 3])
def test_no_row_leaves_its_enclosure(d):
    problem, stations = mixed(d)
    rng = np.random.default_rng(1)
    centre = np.concatenate([rng.normal(0.0, 8e3, (300, d)), stations + rng.normal(0.0, 50.0, (4, d)), stations])
    half = 10.0 ** rng.uniform(0.0, 4.0, (len(centre), d))
    value, slope, remainder = values_in_balls(problem, centre, np.linalg.norm(half, axis=-1))
    change = value_changes(problem, slope, remainder, half)
    turn = np.concatenate([np.full(b.count, b.kind in ("azimuth", "elevation")) for b in problem.rows])
    touched = 0.0
    for _ in range(200):
        away = half * rng.choice([rng.uniform(-1.0, 1.0), 1.0, -1.0], half.shape) * rng.choice([0.1, 1.0])
        there = values_in_balls(problem, centre + away, np.zeros(len(centre)))[0]
        moved = there - value
        moved[:, turn] = (moved[:, turn] + np.pi) % (2.0 * np.pi) - np.pi
        sure = np.isfinite(moved)
        assert (np.abs(moved) <= change * (1.0 + 1e-9) + 1e-6)[sure].all()
        with np.errstate(invalid="ignore"):
            linear = np.abs(moved - (slope @ away[..., None])[..., 0])
        sure &= np.isfinite(remainder)
        assert (linear <= remainder * (1.0 + 1e-9) + 1e-6)[sure].all()
        touched = max(touched, float((np.abs(moved) / change)[np.isfinite(moved)].max()))
    assert touched > 0.9  # a bound that nothing comes near would prove nothing


def test_scores_are_those_of_the_formula():
    drawn_scene = drawn(4, 2)
    scene = next(scenes(drawn_scene.problem, drawn_scene.clutter, None))
    true, cost = true_sets(drawn_scene)
    picks = np.full(true.shape, -1)
    for k, i in np.argwhere(true >= 0):
        picks[k, i] = np.flatnonzero(scene.row[i] == true[k, i])[0]
    assert refined(scene, picks, drawn_scene.emitters)[0].cost == pytest.approx(cost, rel=1e-7)


def test_scores_of_correlated_rows_are_those_of_the_joint_density():
    x, z = np.array([2e3, 3e3]), []
    true = model("tdoa", RING, STAR, x)
    z = true + np.array([5.0, -8.0, 3.0, 0.0, 11.0])
    ends = {"a": [1, 2, 3, 4, 5], "b": 0, "target": -1}
    problem = optloc.assemble(RING, optloc.measured("tdoa", z, arrival_sigma=10.0, **ends))
    scene = next(scenes(problem, Clutter(0.9, 1e-4), 0.0))
    picks = np.array([[0, 0, -1, 0, 0]])
    found = refined(scene, picks, x[None])[0]
    used = [0, 1, 3, 4]
    R = 100.0 * (np.eye(4) + 1.0)
    r = z[used] - model("tdoa", RING, STAR, found.x[0])[used]
    wanted = r @ np.linalg.solve(R, r) + np.linalg.slogdet(2.0 * np.pi * R)[1]
    wanted += -8.0 * np.log(0.9 / 1e-4) - 2.0 * np.log(0.1)
    assert found.cost[0] == pytest.approx(wanted, rel=1e-9)
