"""The stage "sparse": rows linear one by one, wrong ones named, and what cannot be done said."""

import numpy as np
import pytest
from verdicts import alone

from optloc import Motion, Status, assemble, measured, simulate, solve
from optloc.linear.evaluate import predict
from optloc.problem.noise import variances
from optloc.solvers.sparse import sparse_errors
from optloc.solvers.starts.sparse_rows import row_wise

BOX = np.array([10e3, 10e3, 6e3])
STATIONS = np.random.default_rng(7).uniform(-0.5, 0.5, (12, 3)) * BOX
TRUTH = np.array([1200.0, -2300.0, 900.0])
EACH = np.arange(12)
RING = {"a": EACH, "b": (EACH + 1) % 12}
KINDS = {
    "range": [measured("range", np.zeros(12), a=EACH, sigma=10.0)],
    "toa": [measured("toa", np.zeros(12), a=EACH, sigma=10.0)],
    "tdoa": [measured("tdoa", np.zeros(12), **RING, sigma=10.0)],
    "arrivals": [measured("tdoa", np.zeros(11), a=EACH[1:], b=0, arrival_sigma=10.0)],
    "range_sum": [measured("range_sum", np.zeros(12), **RING, sigma=10.0)],
    "groa": [measured("groa", np.zeros(12), **RING, sigma=1e-3)],
    "angles": [measured(kind, np.zeros(12), a=EACH, sigma=2e-3) for kind in ("azimuth", "elevation")],
    "mixed": [
        measured("toa", np.zeros(12), a=EACH, sigma=10.0),
        measured("range", np.zeros(3), a=[0, 1, 2], sigma=10.0),
        measured("azimuth", np.zeros(12), a=EACH, sigma=2e-3),
    ],
}
ALONE = ("range", "tdoa", "range_sum", "groa")


def blank(name):
    """Return a problem of one kind and its truth."""
    problem = assemble(STATIONS, *KINDS[name])
    truth = np.full(problem.layout.size, 5e3)
    truth[:3] = TRUTH
    return problem, truth


def drawn(name, trials=20, seed=3):
    problem, truth = blank(name)
    return simulate(problem, truth, seed, trials)


def lied(problem, rows, sigmas=50.0):
    """Return problems with row `rows[i]` of problem i off by so many sigmas."""
    z, sigma = problem.z.copy(), np.sqrt(variances(problem.noise, problem.count))
    item = np.arange(len(z))
    z[item, rows] += sigmas * np.broadcast_to(sigma, z.shape)[item, rows]
    return problem.with_rows(z=z)


@pytest.mark.parametrize("name", ["toa", *ALONE])
def test_rows_hold_exactly_at_the_truth(name):
    problem, truth = blank(name)
    flat = problem.with_rows(z=predict(problem, truth)[None])
    lifts = row_wise(flat)
    place = (truth[:3] - lifts.coordinates.origin[0]) / lifts.coordinates.scale[0]
    used = np.flatnonzero((lifts.rows[0] != 0.0).any(0))
    beyond = used[used > 2]
    rest = lifts.right[0] - lifts.rows[0, :, :3] @ place
    others, *_ = np.linalg.lstsq(lifts.rows[0][:, beyond], rest, rcond=None)
    np.testing.assert_allclose(lifts.rows[0][:, beyond] @ others, rest, atol=1e-9)
    y = np.zeros(lifts.rows.shape[-1])
    y[:3], y[beyond] = place, others
    for column, cone in lifts.cones(0):
        if column in used:  # the truth lies on every cone: it is the hull of the surface, and no tighter one exists
            vector = cone @ np.append(y, 1.0)
            assert np.linalg.norm(vector[:-1]) == pytest.approx(vector[-1], abs=1e-9)


@pytest.mark.parametrize("name", ALONE)
def test_one_wrong_measurement_is_one_wrong_row(name):
    problem = drawn(name, 1)
    good, bad = row_wise(problem), row_wise(lied(problem, np.array([4])))
    changed = (good.rows != bad.rows).any(-1) | (good.right != bad.right)
    assert np.flatnonzero(changed[0]).tolist() == [4]


@pytest.mark.parametrize("name", KINDS)
def test_clean_rows_lead_to_the_usual_fix(name):
    problem = drawn(name)
    fix, usual = solve(problem, "sparse+lsr"), solve(problem, "roots+lsr")
    assert alone(fix).all()
    np.testing.assert_allclose(fix.position, usual.position, atol=1e-2)
    # each trial names a clean row with a probability of 1 %
    assert (solve(problem, "sparse", refine=False).weights == 0.0).any(-1).sum() <= 3


@pytest.mark.parametrize("name", [name for name in KINDS if name != "arrivals"])
def test_a_wrong_row_of_any_kind_is_named(name):
    problem = drawn(name, 40)
    rows = np.random.default_rng(1).integers(problem.count, size=40)
    found = sparse_errors(lied(problem, rows))
    assert found.wrong[np.arange(40), rows].all()
    one = found.wrong.sum(1) == 1
    assert one.mean() >= 0.9
    # the second point is the fix without the row
    weight = np.ones(found.wrong.shape)
    weight[np.arange(40), rows] = 0.0
    honest = solve(problem.with_rows(weight=weight), "lsr", start=blank(name)[1])
    assert ((np.linalg.norm(found.position[:, 1] - honest.position, axis=1) < 1e-2) == one).all()


def test_a_station_that_lies_is_one_row_of_arrivals_even_if_it_is_the_reference():
    problem = drawn("arrivals", 40)
    z = problem.z.copy()
    z -= 500.0  # the reference is late
    start = solve(problem.with_rows(z=z), "sparse", refine=False)
    assert (start.weights == 0.0).all()  # every difference was made with it
    usual = solve(problem, "roots+lsr").position
    assert np.median(np.linalg.norm(start.alternatives.x[:, 0, :3] - usual, axis=1)) < 20.0


def test_twenty_stations_four_lying():
    rng, count = np.random.default_rng(5), 100
    stations, place = rng.uniform(-0.5, 0.5, (count, 20, 3)) * BOX, rng.uniform(-0.5, 0.5, (count, 3)) * BOX
    lies = np.zeros((count, 20))
    for each in lies:
        each[rng.permutation(20)[:4]] = 500.0 * rng.choice([-1.0, 1.0], 4)
    z = np.linalg.norm(stations - place[:, None], axis=-1) + 10.0 * rng.standard_normal((count, 20)) + lies
    problem = assemble(stations[:, None], measured("toa", z, a=np.arange(20), sigma=10.0))
    found = sparse_errors(problem)
    named = (found.wrong == (lies != 0.0)).all(1)
    assert named.mean() > 0.95, f"{int(named.sum())} of {count}"
    # a wrong row not in the support would keep the fix off: the support may only be too large
    assert (found.raw | (lies == 0.0)).all(1).mean() > 0.95


def test_bad_input_is_a_status():
    problem = drawn("range", 4)
    z, weight = problem.z.copy(), np.ones((4, 12))
    z[1, 5] = np.nan
    weight[2, 2:] = 0.0
    weight[3] = 0.0
    fix = solve(problem.with_rows(z=z, weight=weight), "sparse+lsr")
    assert fix.code[:2].tolist() == [Status.UNPROVEN, Status.REJECTED]
    assert np.isin(fix.code[2:], (Status.TOO_FEW_ROWS, Status.SINGULAR_GEOMETRY)).all()
    assert np.isnan(fix.position[1:]).all()
    wild = problem.with_rows(z=np.random.default_rng(0).uniform(0.0, 1e5, (4, 12)))
    assert (solve(wild, "sparse+lsr").p_value < 1e-3).all()


def test_absent_rows_and_batches():
    problem, truth = blank("tdoa")
    batch = simulate(problem, truth, 9, 6)
    weight = np.ones((6, 12))
    weight[np.arange(6), np.arange(6)] = 0.0
    some = batch.with_rows(weight=weight)
    fix = solve(some, "sparse+lsr")
    assert fix.position.shape == (6, 3)
    for i in range(6):
        single = solve(some.take(np.array([i])), "sparse+lsr")
        np.testing.assert_allclose(fix.position[i], single.position[0], atol=1e-3)


def test_a_moving_target_is_started_from_its_pieces():
    times = np.arange(6.0) * 10.0
    a, epoch = np.tile(EACH, 6), np.repeat(np.arange(6), 12)
    problem = assemble(
        STATIONS, measured("range", np.zeros(72), a=a, epoch=epoch, sigma=5.0), times=times, motions=(Motion(1),)
    )
    truth = np.array([*TRUTH, 30.0, -20.0, 5.0])
    run = simulate(problem, truth, 2)
    fix = solve(run, "sparse+lsr")
    assert alone(fix)
    np.testing.assert_allclose(fix.x, solve(run).x, atol=1e-2)
