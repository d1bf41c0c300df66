"""Constraints together with losses, suspects and files; regions that the data contradict are said, with their name."""

from dataclasses import replace

import numpy as np
import pytest
from files.test_constraint_files import ranges, ranging, run
from linear.test_constraints import ENU, PLANE, SPACE, above, drawn, moving
from often import few
from scipy.optimize import minimize
from verdicts import alone

from optloc import Status, assemble, measured, simulate, solve
from optloc.linear.constraints import box, height, polygon, speed
from optloc.problem.loss import LOSSES
from optloc.solvers import suspects

RING = np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0.0, 2.0 * np.pi, 9)[:-1]]) * 3e3 + 2.5e3
CORNER = ((0.0, 0.0), (2000.0, 9e3))


def lying(*constraints, seed=0, truth=(2010.0, 2400.0), sigma=30.0):
    """Return ranges of eight stations of which the third is 1 km off, and those ranges."""
    rng = np.random.default_rng([3, seed])
    z = np.linalg.norm(RING - truth, axis=-1) + sigma * rng.standard_normal(8)
    z[2] += 1e3
    return assemble(RING, measured("range", z, a=np.arange(8), sigma=sigma), constraints=constraints), z


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
@pytest.mark.parametrize("seed", range(2))
def test_a_loss_in_a_box_is_minimal_there(loss, seed):
    problem, z = lying(*box(*CORNER), seed=seed)
    fix = solve(problem, loss)
    assert fix.answered, fix.reason

    def cost(u):
        return LOSSES[loss].rho((z - np.linalg.norm(RING - 1e3 * u, axis=-1)) / 30.0).sum()

    starts = np.array([[1.9, 2.3], [0.5, 5.0], [2.0, 0.5], [1.0, 2.0]])
    bounds = [(0.0, 2.0), (0.0, 9.0)]
    best = min((minimize(cost, s, bounds=bounds, method="L-BFGS-B", options={"ftol": 1e-15}) for s in starts),
               key=lambda found: found.fun)  # fmt: skip
    assert float(fix.cost) == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(fix.position, 1e3 * best.x, atol=0.5)


@pytest.mark.parametrize("method", ["huber", "cauchy", "truncated", "sparse+cauchy"])
def test_multipliers_of_a_loss_are_the_price_of_a_bound(method):
    problem, z = lying(*box(*CORNER), seed=1, truth=(2030.0, 2400.0))
    bands = (replace(problem.constraints[0], upper=np.array([1999.5, 2000.0, 2000.5])), problem.constraints[1])
    fix = solve(replace(problem.with_rows(z=np.tile(z, (3, 1))), constraints=bands), method)
    (active,) = fix.active[1]
    assert active.name == "x upper"
    assert active.multiplier == pytest.approx(float(fix.cost[0] - fix.cost[2]), rel=1e-3)
    assert (fix.weights[:, 2] < 0.1).all()
    assert (fix.cov[:, 0, 0] < 1e-9).all()
    assert (fix.cov[:, 1, 1] > 1.0).all()


def test_who_lies_is_named_within_a_region():
    problem, _ = lying(*box(*CORNER), seed=2, truth=(1800.0, 2400.0))
    fix = solve(problem, "robust")
    assert fix.status == Status.OK
    assert [suspect.name for suspect in fix.suspects] == ["station S2"]
    assert fix.position[0] <= 2000.0 + 1e-6


REGIONS = {
    "box": lambda: drawn(PLANE, np.array([2e3, 2e3]), np.random.default_rng(1), *box((0, 0), (1e3, 9e3)))[0],
    "polygon": lambda: drawn(
        PLANE, np.array([2e3, 2e3]), np.random.default_rng(1), *polygon([[3e3, 0], [5e3, 0], [5e3, 5e3], [3e3, 5e3]])
    )[0],
    "height band": lambda: drawn(
        SPACE, np.array([2e3, 2e3, 900.0]), np.random.default_rng(1), *height(3e3, 4e3), frame=ENU
    )[0],
    "speed": lambda: moving(np.random.default_rng(1), speed(5.0))[0],
}


@pytest.mark.parametrize("method", few(["auto", "cauchy", "gtrs+lsr"], 2))
@pytest.mark.parametrize("name", few(REGIONS, 2))
def test_a_region_that_the_data_contradict_is_named(name, method):
    fix = solve(REGIONS[name](), method)
    if (name, method) == ("speed", "cauchy") and fix.status in (Status.MAX_ITERATIONS, Status.STALLED):
        return  # that no answer was reached is said, too; which of both hangs on the last bit of a step
    assert fix.status == Status.CONTRADICTORY
    assert {"box": "x upper", "polygon": "polygon edge 3", "height band": "height lower", "speed": "speed upper"}[
        name
    ] in fix.reason[()]
    assert not fix.answered


def test_a_region_that_is_right_is_rarely_accused():
    truth = np.array([2e3, 1.5e3])
    bands = box((0.0, 0.0), (2e3, 9e3))  # the truth stands on its edge
    blank = assemble(PLANE, measured("range", np.zeros(5), a=np.arange(5), sigma=30.0), constraints=bands)
    fix = solve(simulate(blank, truth, 5, 4000), "gtrs+lsr")
    held = np.array([len(active) for active in fix.active])
    assert 0.4 < (held > 0).mean() < 0.6
    # one side of the noise is held: half of one in a thousand
    assert (fix.code == Status.CONTRADICTORY).sum() <= 8
    refuted = fix.code == Status.MISFIT
    assert refuted.sum() <= 4  # one in ten thousand
    assert (alone(fix) | refuted | (fix.code == Status.CONTRADICTORY)).all()


def test_regions_that_do_not_meet_are_named_and_give_no_position():
    problem, _ = lying(*box((0, 0), (1e3, 1e3)), *polygon([[3e3, 3e3], [5e3, 3e3], [4e3, 5e3]]))
    for method in ("auto", "cauchy", "robust", "sparse+lsr"):
        fix = solve(problem, method)
        assert fix.status == Status.INFEASIBLE, method
        assert all(name in fix.reason[()] for name in ("x", "y", "polygon"))
        assert np.isnan(fix.position).all()


def test_a_height_known_to_some_metres_is_weighed_and_may_be_a_lie():
    truth = np.array([2e3, 1.5e3, 700.0])
    known = float(above(truth))
    rows = measured("tdoa", np.zeros(4), a=[1, 2, 3, 4], b=0, arrival_sigma=5.0)

    def with_height(sigma, off=0.0, trials=200):
        blank = assemble(SPACE, rows, measured("height", np.zeros(1), sigma=sigma), frame=ENU)
        drawn = simulate(blank, truth, 4, trials)
        z = drawn.z.copy()
        z[:, 4] += off
        return drawn.with_rows(z=z)

    exact = assemble(SPACE, rows, frame=ENU, constraints=height(exactly=known))
    close, held = with_height(1e-3), simulate(exact, truth, 4, 200)
    z = np.concatenate([held.z, np.full((200, 1), known)], axis=1)
    one, two = solve(close.with_rows(z=z), "roots+lsr"), solve(held, "roots+lsr")
    np.testing.assert_allclose(one.position, two.position, atol=1e-2)
    np.testing.assert_allclose(one.cov, two.cov, rtol=1e-3, atol=1e-3)
    loose = solve(with_height(20.0), "roots+lsr")
    error = loose.position - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(loose.cov), error)
    assert nees.mean() == pytest.approx(3.0, rel=0.2)
    lie = suspects(with_height(5.0, off=2e3, trials=10), together=False)
    named = [{s.name for e in each for s in e.suspects} for each in lie.explanations]
    assert all(any("height" in name for name in names) for names in named), named


@pytest.mark.parametrize("method", ["auto", "cauchy", "robust", "sparse+lsr"])
def test_files_with_a_region_take_every_method(tmp_path, method):
    truth = np.array([1500.0, 2200.0, 900.0])
    path = tmp_path / "p.toml"
    path.write_text(ranging(ranges(truth)) + '[[constraints]]\nkind = "box"\nmin = [0.0, 0.0, 0.0]\n', "utf-8")
    text = run("fix", path, "--method", method, "--allow", "unproven").stdout
    assert "bound reached" not in text
    path.write_text(ranging(ranges(truth)) + '[[constraints]]\nkind = "box"\nmax = [1000.0, inf, inf]\n', "utf-8")
    text = run("fix", path, "--method", method, code=1).stdout
    assert "x upper bound reached" in text
    assert "lowers the cost by" in " ".join(text.replace("│", " ").split())
