"""Plans of structures: what they serve, when they are shared, and that a run minimises the cost."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, plain_cost
from scipy.optimize import minimize

from optloc import Motion, assemble, measured, simulate
from optloc.engine.plan import blank_answer, is_planned, key_of, plan_of
from optloc.kernels.jit import enabled, plain
from optloc.linear.constraints import box

machine_code = pytest.mark.skipif(not enabled(), reason="there are no plans without machine code")
RANGES = CASES["range-2d"].problem


def test_keys_do_not_depend_on_measurements_but_on_noise_and_weights():
    other = RANGES.with_rows(z=RANGES.z + 1.0)
    assert key_of(other) == key_of(RANGES)
    assert key_of(RANGES.with_rows(weight=np.array([1, 1, 0, 1, 1, 1.0]))) != key_of(RANGES)
    louder = assemble(RANGES.stations, measured("range", RANGES.z, a=np.arange(6), sigma=6.0))
    assert key_of(louder) != key_of(RANGES)


def test_moving_targets_and_known_ones_have_no_plan():
    assert is_planned(RANGES)
    for motion in (Motion(1), Motion(span="epoch"), Motion(known=np.zeros((1, 1, 2)))):
        assert not is_planned(replace(RANGES, motions=(motion,)))
    with plain():
        assert plan_of(RANGES) is None


@machine_code
def test_problems_of_one_structure_share_a_plan():
    assert plan_of(RANGES) is plan_of(RANGES.with_rows(z=RANGES.z + 1.0))
    assert plan_of(RANGES).dof == 4
    assert plan_of(RANGES).ranged
    assert not plan_of(CASES["tdoa+azimuth-2d"].problem).ranged


@machine_code
@pytest.mark.parametrize("name", ["range-2d", "tdoa+azimuth-2d"])
def test_a_run_ends_at_the_least_cost_with_the_inverse_information(name):
    problem = simulate(CASES[name].problem, CASES[name].truth, 3, 2)
    plan = plan_of(problem)
    answer, steps = plan.run(plan.load(problem), problem.observed)
    assert answer.settled.all()
    assert steps >= 1
    for i in range(2):
        one = problem.take(np.array(i))
        least = minimize(
            lambda x, one=one: plain_cost(one, x), answer.x[i], method="Nelder-Mead", options={"xatol": 1e-3}
        )
        assert answer.cost[i] <= least.fun + 1e-9
        np.testing.assert_allclose(answer.x[i], least.x, atol=0.02)
        step = 0.1 * np.linalg.cholesky(answer.covariance[i])[:, 0]  # a tenth of a standard deviation costs a hundredth
        rise = 0.5 * (plain_cost(one, least.x + step) + plain_cost(one, least.x - step)) - least.fun
        assert rise == pytest.approx(0.01, rel=0.01)


@machine_code
def test_a_load_is_cut_where_its_problems_differ():
    places = np.arange(3.0)[:, None, None] + RANGES.stations.position[0]
    batch = replace(RANGES, stations=replace(RANGES.stations, position=places[:, None]))
    load = plan_of(batch).load(batch)
    assert load.take(np.array([2, 0])).place.tolist() == places[[2, 0]].tolist()
    shared = plan_of(RANGES).load(RANGES)
    assert shared.take(np.array([2, 0])).place is shared.place


@machine_code
def test_levels_of_constraints_are_arguments_of_a_run():
    held = [replace(RANGES, constraints=box([-np.inf, y], [np.inf, y])) for y in (5e3, 7e3)]
    plan = plan_of(held[0])
    assert plan is plan_of(held[1])
    for problem, y in zip(held, (5e3, 7e3), strict=True):
        answer, _ = plan.run(plan.load(problem), np.atleast_2d(problem.observed))
        assert answer.x[0, 1] == pytest.approx(y, abs=1e-6)
    assert len(blank_answer(3, *plan.widths).x) == 3
