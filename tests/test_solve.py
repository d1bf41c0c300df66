"""Solve without a guess against an independent multi-start, and the statuses of what has no answer."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import (
    CASES,
    ENU,
    STATIONS,
    TARGET,
    dense_covariance,
    kitchen_sink,
    plain_cost,
    quick,
    random_vector,
    stations,
)
from scipy.optimize import least_squares
from verdicts import alone

from optloc import InvalidProblem, Motion, NoSolution, Status, assemble, crlb, measured, simulate, solve, station_array
from optloc.solvers import METHODS

STARTED = sorted(name for name, case in CASES.items() if case.start)

TRIALS, STARTS = 4, 8
TOLERANCE = 1e-5


def truths(case, rng):
    """Inside and outside of the array, up to 25 km away."""
    out = np.tile(case.truth, (TRIALS, 1))
    d = case.problem.dimension
    centre = STATIONS[d].mean(0)
    direction = rng.standard_normal((TRIALS, d))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    radius = np.where(np.arange(TRIALS) % 2, rng.uniform(0.0, 6e3, TRIALS), rng.uniform(8e3, 25e3, TRIALS))
    out[:, :d] = centre + direction * radius[:, None]
    return out


@cache
def fixed(name):
    """The fix of a case."""
    return solve(CASES[name].problem)


@cache
def scattered(name):
    """A case with targets inside and outside of the array, and their fixes."""
    case = CASES[name]
    many = simulate(case.problem, truths(case, np.random.default_rng([3, *name.encode()])), 31)
    return many, solve(many)


def best_of_many(problem, rng):
    """The least cost that MINPACK reaches from random starts, and where."""
    residual, d = quick(problem), problem.dimension
    found = (np.inf, None)
    for i in range(STARTS):
        x = np.zeros(problem.layout.size)
        x[:d] = STATIONS[d].mean(0) + rng.normal(0.0, 4e3 if i % 2 else 15e3, d)
        with np.errstate(all="ignore"):
            end = least_squares(residual, x, method="lm", x_scale="jac", max_nfev=400)
        if 2.0 * end.cost < found[0]:
            found = (2.0 * end.cost, end.x)
    return found


@pytest.mark.parametrize("name", STARTED)
def test_no_silent_miss_of_the_global_minimum(name):
    case, rng = CASES[name], np.random.default_rng([5, *name.encode()])
    many, fix = scattered(name)
    answered = fix.answered & ~fix.has(Status.MISFIT, Status.UNBOUNDED, Status.SEARCHED)
    assert answered.sum() >= TRIALS - 1, [fix.reason[i] for i in np.flatnonzero(~answered)]
    for i in np.flatnonzero(answered):
        problem = case.problem.with_rows(z=many.z[i])
        value, where = best_of_many(problem, rng)
        assert fix.cost[i] == pytest.approx(plain_cost(problem, fix.x[i]), rel=1e-6, abs=1e-6)
        listed = fix.alternatives.gap[i] + fix.cost[i]
        hit = fix.cost[i] <= value + TOLERANCE * (1.0 + value)
        if fix.has(Status.AMBIGUOUS)[i]:
            hit = hit or np.any(np.abs(listed - value) < 1e-3)
        assert hit, f"{fix.cost[i]} at {fix.x[i]} but {value} at {where} ({Status(int(fix.code[i])).label})"


@pytest.mark.parametrize("name", STARTED)
def test_alternatives_are_other_minima_cheapest_first(name):
    case = CASES[name]
    many, fix = scattered(name)
    gap = np.where(np.isnan(fix.alternatives.gap), np.inf, fix.alternatives.gap)
    assert (np.diff(gap, axis=1) >= 0.0)[np.isfinite(gap[:, 1:])].all()
    assert ((gap >= -1e-6) | ~np.isfinite(gap)).all()
    for i, q in np.argwhere(np.isfinite(gap)):
        problem = case.problem.with_rows(z=many.z[i])
        point = fix.alternatives.x[i, q]
        assert plain_cost(problem, point) == pytest.approx(fix.cost[i] + gap[i, q], rel=1e-5, abs=1e-5)
        again = least_squares(quick(problem), point, method="lm", x_scale="jac")
        assert 2.0 * again.cost == pytest.approx(fix.cost[i] + gap[i, q], rel=1e-4, abs=1e-4)
        assert np.linalg.norm(again.x - point) < 1e-2 * np.linalg.norm(point - fix.x[i])
    near = np.where(np.isfinite(gap), gap, np.inf).min(axis=1, initial=np.inf) < 9.0
    assert fix.has(Status.AMBIGUOUS)[near & fix.answered].all()


@pytest.mark.parametrize("name", STARTED)
def test_the_covariance_is_the_inverse_information_at_the_estimate(name):
    case, fix = CASES[name], fixed(name)
    assert fix.status == Status.OK
    assert np.allclose(fix.cov, crlb(case.problem, fix.x), rtol=1e-9)
    assert fix.p_value > 1e-6
    bound = np.sqrt(np.diag(crlb(case.problem, case.truth)))
    assert (np.abs(fix.x[: len(bound)] - case.truth[: len(bound)]) < 6.0 * bound).all()


@pytest.mark.parametrize("name", sorted(set(CASES) - set(STARTED)))
def test_kinds_without_a_closed_form_say_so_and_refine_a_start(name):
    case = CASES[name]
    fix = solve(case.problem)
    assert fix.status not in (Status.OK, Status.AMBIGUOUS) or fix.cost == pytest.approx(
        best_of_many(case.problem, np.random.default_rng(1))[0], rel=1e-4
    )
    refined = solve(case.problem, "lsr", start=case.truth)
    assert alone(refined)
    assert refined.cost <= plain_cost(case.problem, case.truth)


@pytest.mark.parametrize("method", ["gtrs+lsr", "roots+lsr", *METHODS])
def test_methods_agree_where_the_geometry_is_good(method):
    case = CASES["tdoa-3d"]
    many = simulate(case.problem, case.truth, 5, trials=10)
    assert np.allclose(solve(many, method).position, solve(many).position, atol=1e-5)


# ------------------------------------------------------------------------------------------------------ statuses
def differences(place, truth, *, seed=1, sigma=1.0, pairs=None):
    place = np.asarray(place, dtype=float)
    a, b = (np.arange(1, len(place)), 0) if pairs is None else np.array(pairs).T
    return simulate(assemble(place, measured("tdoa", a=a, b=b, sigma=sigma)), np.asarray(truth, float), seed)


def ranged(place, truth, *, seed=1, sigma=1.0):
    place = np.asarray(place, dtype=float)
    return simulate(
        assemble(place, measured("range", a=np.arange(len(place)), sigma=sigma)), np.asarray(truth, float), seed
    )


def test_too_few_rows_are_counted():
    fix = solve(differences(STATIONS[3][:3], TARGET[3]))
    assert fix.status == Status.TOO_FEW_ROWS
    assert "1" in fix.reason.item()
    assert np.isnan(fix.x).all()
    assert np.isnan(fix.cov).all()
    one = solve(assemble(STATIONS[2], measured("range", [5e3], a=0, sigma=1.0)))
    assert one.status == Status.TOO_FEW_ROWS


def test_rows_that_repeat_are_not_new():
    """Six rows, but only two differences."""
    fix = solve(differences(STATIONS[3][:3], TARGET[3], pairs=[(1, 0), (2, 0)] * 3))
    assert fix.status in (Status.SINGULAR_GEOMETRY, Status.TOO_FEW_ROWS)
    assert np.isnan(fix.cov).all()


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("build", [differences, ranged])
def test_coincident_stations(d, build):
    fix = solve(build(np.tile(STATIONS[d][:1], (5, 1)), TARGET[d]))
    assert fix.status == Status.SINGULAR_GEOMETRY
    assert fix.reason.item()
    assert np.isnan(fix.cov).all()


@pytest.mark.parametrize("build", [differences, ranged])
def test_collinear_stations_in_space(build):
    line = np.arange(6)[:, None] * np.array([2e3, 1e3, 500.0])
    fix = solve(build(line, TARGET[3]))
    assert fix.status == Status.SINGULAR_GEOMETRY
    assert fix.reason.item()
    assert np.isnan(fix.cov).all()


def flat(d):
    place = STATIONS[d][:6].copy()
    place[:, -1] = 100.0
    return place


@pytest.mark.parametrize("build", [differences, ranged])
def test_stations_in_one_plane_leave_a_mirror(build):
    truth = np.array([3e3, 4e3, 2500.0])
    fix = solve(build(flat(3), truth))
    assert fix.status == Status.AMBIGUOUS
    both = np.stack([fix.position, fix.alternatives.x[0]])
    assert fix.alternatives.gap[0] == pytest.approx(0.0, abs=1e-6)
    assert np.allclose(both[0, :2], both[1, :2], atol=1e-3)
    assert both[:, 2].sum() == pytest.approx(200.0, abs=1e-3)
    assert np.abs(both[:, 2] - truth[2]).min() < 50.0
    assert "another position" in fix.reason.item()


@pytest.mark.parametrize("build", [differences, ranged])
def test_stations_on_one_line_of_the_plane_leave_a_mirror(build):
    place = np.stack([np.linspace(-5e3, 5e3, 5), np.zeros(5)], axis=1)
    fix = solve(build(place, np.array([1.2e3, 4e3])))
    assert fix.status == Status.AMBIGUOUS
    assert fix.alternatives.x[0, 1] == pytest.approx(-fix.position[1], abs=1e-3)


def test_a_height_or_an_angle_resolves_the_mirror():
    truth = np.array([3e3, 4e3, 2500.0])
    a = np.arange(1, 6)
    low = simulate(
        assemble(flat(3), measured("tdoa", a=a, b=0, sigma=1.0), measured("height", sigma=30.0), frame=ENU), truth, 3
    )
    up = simulate(
        assemble(flat(3), measured("tdoa", a=a, b=0, sigma=1.0), measured("elevation", a=[0], sigma=0.01)), truth, 3
    )
    for problem in (low, up):
        fix = solve(problem)
        # heights above the Earth are proven in a region about the stations only
        assert fix.status == (Status.UNPROVEN if problem is low else Status.OK)
        assert alone(fix)
        assert np.linalg.norm(fix.position - truth) < 60.0


def test_groups_without_a_common_station_are_named_and_searched():
    place = station_array(STATIONS[2][:4], ["north", "east", "south", "west"])
    problem = simulate(assemble(place, measured("tdoa", a=[0, 2], b=[1, 3], sigma=1.0)), TARGET[2], 1)
    fix = solve(problem, "gtrs+lsr")
    assert fix.status == Status.DISCONNECTED
    assert fix.reason == "no measurement links {north, east} with {south, west}"
    # two differences do fix a point of the plane: a search finds the right one
    fix = solve(problem)
    assert fix.status in (Status.OK, Status.AMBIGUOUS)
    points = np.concatenate([fix.x[None], fix.alternatives.x])
    assert np.linalg.norm(points - TARGET[2], axis=1).min() < 20.0


def test_a_nan_in_one_item_is_rejected_and_the_others_are_untouched():
    for name in ("tdoa-3d", "toa+tdoa-2d", "azimuth-2d", "tdoa~groa-3d"):
        case = CASES[name]
        many = simulate(case.problem, case.truth, 8, trials=5)
        clean = solve(many)
        z = many.z.copy()
        z[2, 1] = np.nan
        fix = solve(many.with_rows(z=z))
        assert fix.code[2] == Status.REJECTED
        assert np.isnan(fix.x[2]).all()
        assert np.isnan(fix.cov[2]).all()
        keep = [0, 1, 3, 4]
        assert np.array_equal(fix.x[keep], clean.x[keep])
        assert np.array_equal(fix.cov[keep], clean.cov[keep])
        assert np.array_equal(fix.code[keep], clean.code[keep])


def test_singular_items_leave_the_others_untouched():
    place = np.stack([STATIONS[2], np.tile(STATIONS[2][:1], (6, 1)), STATIONS[2] + 50.0])[:, None]
    many = simulate(assemble(place, measured("tdoa", a=np.arange(1, 6), b=0, sigma=1.0)), TARGET[2], 3)
    fix = solve(many)
    assert fix.code.tolist() == [Status.OK, Status.SINGULAR_GEOMETRY, Status.OK]
    for i in (0, 2):
        single = solve(assemble(place[i], measured("tdoa", many.z[i], a=np.arange(1, 6), b=0, sigma=1.0)))
        assert np.allclose(fix.x[i], single.x, rtol=1e-12, atol=1e-8)


def test_absent_rows_can_make_an_item_too_small():
    case = CASES["range-2d"]
    weight = np.ones((3, 6))
    weight[1, 1:] = 0.0
    weight[2] = 0.0
    fix = solve(case.problem.with_rows(weight=weight))
    assert fix.code.tolist() == [Status.OK, Status.TOO_FEW_ROWS, Status.TOO_FEW_ROWS]
    assert np.isnan(fix.x[1:]).all()


def test_wild_measurements_are_finite_statuses():
    """Nothing finite fits 1e12 m differences between stations 10 km apart; whatever comes, it is no clean fix."""
    case = CASES["tdoa-2d"]
    for scale in (1e6, 1e12):
        z = np.random.default_rng(1).normal(0.0, scale, (3, case.problem.count))
        fix = solve(case.problem.with_rows(z=z))
        assert not (fix.code == Status.OK).any()


def test_a_far_emitter_seen_by_two_parallel_bearings():
    place = np.array([[0.0, 0.0], [1e3, 0.0], [2e3, 0.0]])
    outward = assemble(place, measured("azimuth", np.radians([91.0, 90.0, 89.0]), a=[0, 1, 2], sigma=0.01))
    fix = solve(outward)
    if fix.status == Status.OK:
        front = fix.position[1] > 0.0
        assert front, "an intersection behind the stations is no answer to bearings that look forward"
    diverging = assemble(place, measured("azimuth", np.radians([100.0, 90.0, 80.0]), a=[0, 1, 2], sigma=0.001))
    far = solve(diverging)
    assert far.status != Status.OK


# --------------------------------------------------------------------------------------------------- from a start
def test_refinement_from_a_near_start_is_the_fix():
    for name in STARTED:
        case, fix = CASES[name], fixed(name)
        refined = solve(case.problem, "lsr", start=case.truth)
        assert refined.status == Status.UNPROVEN  # nothing looked elsewhere
        assert np.allclose(refined.x, fix.x, atol=1e-4)
        assert [stage.name for stage in refined.stages] == ["start", "lsr"]


def test_starts_of_a_batch():
    case = CASES["range-2d"]
    many = simulate(case.problem, case.truth, 3, trials=4)
    starts = case.truth + np.random.default_rng(1).normal(0, 100, (4, 2))
    fix = solve(many, "lsr", start=starts)
    assert fix.shape == (4,)
    assert np.allclose(fix.x, solve(many).x, atol=1e-4)
    starts[1] = np.nan
    part = solve(many, "lsr", start=starts)
    assert not part.answered[1]
    assert np.array_equal(part.x[[0, 2, 3]], fix.x[[0, 2, 3]])


@pytest.mark.parametrize("name", ["tdoa-2d", "tdoa-3d", "range-3d", "azimuth-2d", "toa-3d", "groa-2d"])
@pytest.mark.parametrize("method", ["taylor", "lsr"])
def test_wild_starts_never_raise_and_an_unfinished_run_is_never_ok(name, method):
    case = CASES[name]
    rng = np.random.default_rng(7)
    d, count = case.problem.dimension, 40
    starts = np.zeros((count, case.problem.layout.size))
    starts[:, :d] = STATIONS[d].mean(0) + rng.standard_normal((count, d)) * 10.0 ** rng.uniform(3, 8, (count, 1))
    starts[0, :d] = STATIONS[d][0]  # on a station: a range of zero
    starts[1, :d] = 1e200
    many = simulate(case.problem, case.truth, 5, trials=count)
    fix = solve(many, method, start=starts)
    reference = solve(many)
    assert not (fix.code == Status.OK).any()  # without a proof nothing is
    ok = alone(fix)
    assert not ok.all()
    for i in np.flatnonzero(ok):
        problem = case.problem.with_rows(z=many.z[i])
        gradient = least_squares(quick(problem), fix.x[i], method="lm", x_scale="jac")
        assert 2.0 * gradient.cost >= fix.cost[i] * (1.0 - 1e-6) - 1e-6, "ok, yet not a minimum"
    assert (fix.cost[ok] >= reference.cost[ok] - 1e-6 * (1.0 + reference.cost[ok])).all()
    if method == "lsr":
        hit = np.abs(fix.cost - reference.cost) < 1e-6 * (1.0 + reference.cost)
        assert hit.mean() > 0.1


def test_undamped_taylor_fails_where_damping_does_not():
    case = CASES["tdoa-3d"]
    rng = np.random.default_rng(9)
    many = simulate(case.problem, case.truth, 5, trials=100)
    starts = STATIONS[3].mean(0) + rng.normal(0.0, 2e4, (100, 3))
    best = solve(many).cost

    def hits(method):
        fix = solve(many, method, start=starts)
        return (alone(fix) & (fix.cost < best + 1e-3)).sum()

    assert hits("taylor") < hits("lsr")


# ------------------------------------------------------------------------------------------- more than one position
def test_a_target_that_moves_steadily():
    rng = np.random.default_rng(3)
    k = 8
    a, epoch = np.tile(np.arange(6), k), np.repeat(np.arange(k), 6)
    problem = assemble(
        STATIONS[2], measured("range", a=a, epoch=epoch, sigma=3.0), motions=(Motion(1),), times=np.arange(k) * 2.0
    )
    truth = np.array([3e3, 6e3, 80.0, -40.0])
    fix = solve(simulate(problem, truth, 4, trials=5))
    assert (fix.code == Status.UNPROVEN).all()  # the proof is for targets that stay
    error = fix.x - truth
    squared = np.einsum("ij,ijk,ik->i", error, np.linalg.inv(fix.cov), error)
    assert squared.max() < 25.0
    assert rng is not None


def test_targets_are_fixed_together_as_they_would_be_alone():
    a, target = np.tile(np.arange(6), 2), np.repeat([0, 1], 6)
    both = assemble(STATIONS[2], measured("range", a=a, target=target, sigma=3.0), motions=(Motion(), Motion()))
    truth = np.r_[TARGET[2], TARGET[2] - 2e3]
    drawn = simulate(both, truth, 2)
    fix = solve(drawn)
    assert fix.status == Status.UNPROVEN
    for i in range(2):
        single = solve(assemble(STATIONS[2], measured("range", drawn.z[target == i], a=np.arange(6), sigma=3.0)))
        assert np.allclose(fix.take(f"position[{i}]"), single.position, atol=1e-4)


def test_everything_at_once_refines_from_near():
    problem = kitchen_sink(3)
    truth = random_vector(problem)
    fix = solve(simulate(problem, truth, 3), "lsr", start=truth)
    assert fix.status in set(Status)
    assert fix.x.shape == truth.shape


def tied(**more):
    a, epoch = np.tile(np.arange(6), 3), np.repeat([0, 1, 2], 6)
    full = np.kron(np.array([[9.0, 6.0, 0.0], [6.0, 9.0, 3.0], [0.0, 3.0, 9.0]]), np.eye(6))
    return assemble(STATIONS[2], measured(more.pop("kind", "range"), a=a, epoch=epoch, covariance=full), **more)


@pytest.mark.parametrize("order", [0, 1])
def test_noise_may_tie_epochs_that_share_all_unknowns(order):
    problem = tied(motions=(Motion(order),))
    truth = np.r_[TARGET[2], 30.0, -50.0][: 2 + 2 * order]
    drawn = simulate(problem, truth, 2)
    fix = solve(drawn)
    assert fix.status == (Status.UNPROVEN if order else Status.OK)
    assert fix.cost == pytest.approx(plain_cost(drawn, fix.x))
    for shift in np.random.default_rng(1).normal(0.0, 1.0, (20, len(truth))) * np.sqrt(np.diag(fix.cov)):
        assert plain_cost(drawn, fix.x + 0.1 * shift) > fix.cost


@pytest.mark.parametrize(
    "more", [{"kind": "toa"}, {"motions": (Motion(0, span="epoch"),)}], ids=["emission", "position"]
)
def test_noise_may_not_tie_unknowns_of_an_epoch(more):
    """The elimination epoch by epoch would be silently wrong."""
    with pytest.raises(InvalidProblem, match=r"different epochs are correlated.*(emission|position)"):
        tied(**more)


def test_one_covariance_over_uncorrelated_epochs_is_cut():
    """All pairs at three epochs: singular, so that its eigenvectors would mix the epochs."""
    a, b = np.triu_indices(6, 1)
    single = assemble(STATIONS[2], measured("tdoa", a=a, b=b, arrival_sigma=3.0))
    full = np.kron(np.eye(3), dense_covariance(single))
    epoch = np.repeat([0, 1, 2], len(a))
    at = {"a": np.tile(a, 3), "b": np.tile(b, 3), "epoch": epoch}
    spread = np.tile(4.0 * np.eye(2), (6, 1, 1))
    whole = assemble(stations(2, covariance=spread), measured("tdoa", covariance=full, **at))
    apart = assemble(stations(2, covariance=spread), measured("tdoa", arrival_sigma=3.0, **at))
    truth = np.r_[TARGET[2], np.zeros(36)]
    assert np.allclose(crlb(whole, truth), crlb(apart, truth), rtol=1e-9)


def test_uncertain_stations_widen_the_covariance():
    case = CASES["range-3d"]
    spread = np.tile(100.0 * np.eye(3), (len(STATIONS[3]), 1, 1))
    unsure = replace(case.problem, stations=stations(3, covariance=spread))
    sure, wide = solve(case.problem), solve(unsure)
    assert wide.status == Status.OK
    assert (np.linalg.eigvalsh(wide.covariance() - sure.covariance()) > 0.0).all()


def test_require_and_failure_as_data():
    good, bad = CASES["range-2d"].problem, differences(STATIONS[3][:3], TARGET[3])
    assert solve(good).require().status == Status.OK
    with pytest.raises(NoSolution, match="fewer measurements"):
        solve(bad).require()
    with pytest.raises(InvalidProblem):
        solve(good, "nonsense")


def test_unit_directions_have_nothing_to_say_in_the_plane():
    """It was an exception: a method that does not apply is a status."""
    stations = np.array([[0.0, 0.0], [5e3, 0.0], [0.0, 4e3]])
    template = assemble(stations, measured("azimuth", a=[0, 1, 2], sigma=1e-3))
    fix = solve(simulate(template, truth=[3e3, 2e3], seed=1), "directions+lsr")
    assert not fix.answered
    assert fix.reason[()]
