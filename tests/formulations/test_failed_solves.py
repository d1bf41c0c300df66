"""A back end that refuses or fails gives no point: not that of the solve before, nor its own last iterate."""

from concurrent.futures import ThreadPoolExecutor

import casadi
import numpy as np
import pytest

from formulations.backend import Choice, recording, using
from formulations.bearing_ls import rays
from formulations.direction_sdp import directions
from formulations.lifted import lifted_ranges
from formulations.minimax_cone import common, extent, minimax
from formulations.nls import Program
from formulations.nuclear_norm import nuclear_offsets
from formulations.sparse_errors import sparse_fit
from formulations.squared_range import paraboloid
from formulations.squared_range_conic import hull, shor

STATIONS = np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 0.9], [-0.8, 0.5]])
SPACE = np.array([[0.0, 0.0, 0.1], [1.0, 0.1, 0.3], [0.2, 0.9, -0.2], [-0.8, 0.5, 0.6]])
# Each ends without an answer, whatever it is given. MOSEK has no licence where it is installed at all.
FAILING = {
    "one iteration of SCS": Choice("conic", "SCS", {"max_iters": 1}),
    "no time for SCS": Choice("conic", "SCS", {"time_limit_secs": 1e-9}),
    "a setting that SCS does not know": Choice("conic", "SCS", {"no_such_setting": 1}),
    "one iteration of Clarabel": Choice("conic", "CLARABEL", {"max_iter": 1}),
    "no time for Clarabel": Choice("conic", "CLARABEL", {"time_limit": 1e-9}),
    "a solver that is not installed": Choice("conic", "MOSEK"),
}
GOOD = [Choice("conic", "SCS", {"eps": 1e-8}), None]


def rows(place):
    """Return squared-range rows of a place in the plane."""
    r = np.linalg.norm(place - STATIONS, axis=1)
    return np.column_stack([STATIONS, -0.5 * np.ones(4)]), 0.5 * ((STATIONS**2).sum(1) - r**2)


def bearings(place):
    """Return directions and angles of a place in space."""
    line = place - SPACE
    angle = np.stack([np.arctan2(line[:, 1], line[:, 0]), np.arctan2(line[:, 2], np.hypot(*line[:, :2].T))], axis=-1)
    return rays(angle[:, 0], angle[:, 1]).ahead, angle


def by_arrivals(place):
    pulses = np.random.default_rng(1).uniform(-1.0, 1.0, (8, 2)) + place[:2]
    z = np.linalg.norm(pulses[:, None] - STATIONS, axis=-1)
    return nuclear_offsets(z - z.mean(1, keepdims=True), 2, passes=1).offset


PROGRAMS = {
    "shor": lambda place: shor(*rows(place[:2]), paraboloid(2)).y,
    "hull": lambda place: hull(*rows(place[:2]), paraboloid(2)).y,
    "sparse": lambda place: sparse_fit(*rows(place[:2])).y,
    "common": lambda place: common(bearings(place)[0], SPACE, np.full(4, 0.3)).point,
    "minimax": lambda place: minimax(bearings(place)[0], SPACE, np.full(4, 0.01)).point,
    "directions": lambda place: directions(bearings(place)[1], np.full((4, 2), 0.01), SPACE).point,
    "lifted": lambda place: lifted_ranges(
        np.eye(4), np.linalg.norm(place[:2] - STATIONS, axis=1), STATIONS
    ).point,
    "nuclear": by_arrivals,
}  # fmt: skip


@pytest.mark.parametrize("failing", FAILING)
@pytest.mark.parametrize("good", GOOD, ids=["after SCS", "after Clarabel"])
def test_the_answer_before_is_not_the_answer(failing, good):
    with using(good):
        before = shor(*rows(np.array([1.5, 2.0])), paraboloid(2))
    assert before.y[:2] == pytest.approx([1.5, 2.0], abs=1e-3)
    with using(FAILING[failing]), recording() as endings:
        found = shor(*rows(np.array([-3.0, 0.7])), paraboloid(2))
    assert np.isnan(found.y).all()
    assert np.isnan([found.value, found.rank_ratio]).all()
    assert not found.answer.solved
    (ending,) = endings
    assert (ending.backend, ending.found) == (FAILING[failing].name, False)
    assert ending.status == found.answer.status
    assert ending.status != "optimal"
    # a refusal is told in the back end's own words
    if ending.status == "solver_error":
        assert found.answer.message
    # and the program is as good as before
    with using(good):
        again = shor(*rows(np.array([-3.0, 0.7])), paraboloid(2))
    assert again.y[:2] == pytest.approx([-3.0, 0.7], abs=1e-3)


@pytest.mark.parametrize("failing", ["one iteration of SCS", "one iteration of Clarabel"])
@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_answers_with_a_last_iterate(name, failing):
    program, place = PROGRAMS[name], np.array([0.3, 1.4, 0.9])
    assert np.isfinite(program(place)).all()
    with using(FAILING[failing]):
        assert np.isnan(program(place + 0.5)).all()


def test_reduced_tolerances_of_an_interior_point_solver_are_an_answer():
    tight = {"tol_gap_abs": 1e-16, "tol_gap_rel": 1e-16, "tol_feas": 1e-16}
    with using(Choice("conic", "CLARABEL", tight)):
        found = shor(*rows(np.array([-3.0, 0.7])), paraboloid(2))
    assert (found.answer.status, found.answer.solved) == ("AlmostSolved", False)
    assert found.y[:2] == pytest.approx([-3.0, 0.7], abs=1e-3)


@pytest.mark.parametrize("choice", GOOD, ids=["SCS", "Clarabel"])
def test_cones_that_do_not_meet_have_no_point_that_does(choice):
    away, stations = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    toward = np.array([[1.0, 0.2], [-1.0, 0.2]]) / np.sqrt(1.04)
    with using(choice):
        assert common(toward, stations, np.full(2, 0.1)).meet
        assert not common(away, stations, np.full(2, 0.1)).meet
        assert np.isfinite(extent(toward, stations, np.full(2, 0.1), np.eye(2))).all()
        assert np.isnan(extent(away, stations, np.full(2, 0.1), np.eye(2))).all()


def test_threads_that_fail_leave_nothing_to_those_that_do_not():
    places = np.random.default_rng(2).uniform(-3.0, 3.0, (40, 2))

    def solve(i):
        choice = FAILING["one iteration of SCS"] if i % 3 == 0 else GOOD[0] if i % 3 == 1 else None
        with using(choice):
            return shor(*rows(places[i]), paraboloid(2)).y[:2]

    with ThreadPoolExecutor(4) as pool:
        found = np.array(list(pool.map(solve, range(40))))
    fails = np.arange(40) % 3 == 0
    assert np.isnan(found[fails]).all()
    assert found[~fails] == pytest.approx(places[~fails], abs=1e-2)


def test_lists_of_endings_are_nested():
    with recording() as outer:
        with recording() as inner, using(FAILING["one iteration of SCS"]):
            hull(*rows(np.array([1.0, 1.0])), paraboloid(2))
        hull(*rows(np.array([1.0, 1.0])), paraboloid(2))
    assert [ending.found for ending in inner] == [False]
    assert [ending.found for ending in outer] == [False, True]
    assert str(outer[0]) == "SCS: optimal_inaccurate"


def ranged(name, settings=(), **constraints):
    import casadi as ca

    def residual(x, p, z):
        return [z[i] - ca.sqrt((x[0] - s[0]) ** 2 + (x[1] - s[1]) ** 2) for i, s in enumerate(STATIONS.tolist())]

    return Program(2, 4, residual=residual, choice=Choice("nonlinear", name, dict(settings)), **constraints)


Z = np.linalg.norm([0.6, 0.7] - STATIONS, axis=1)
NONLINEAR = [name for name in ("ipopt", "sqpmethod", "fatrop", "uno") if casadi.has_nlpsol(name)]


@pytest.mark.parametrize("name", NONLINEAR)
def test_a_point_that_solves_nothing_is_no_success(name):
    """A limit, no feasible point, a start without a gradient, data that are no numbers: some solvers claim success."""
    good = ranged(name).solve([0.4, 0.4], Z)
    assert good.success
    assert good.x == pytest.approx([0.6, 0.7], abs=1e-5)
    hopeless = [
        ranged(name, equalities=lambda x, p: [x[0] ** 2 + 1.0]).solve([0.4, 0.4], Z),
        ranged(name, inequalities=lambda x, p: [x[0] - 1.0, -x[0]]).solve([0.4, 0.4], Z),
        ranged(name).solve(STATIONS[0], Z),
        ranged(name).solve([0.4, 0.4], np.array([np.nan, 1.0, 1.0, 1.0])),
    ]
    if name in ("ipopt", "sqpmethod"):
        hopeless.append(ranged(name, {"max_iter": 1}).solve([30.0, -4.0], Z))
    for found in hopeless:
        assert not found.success
        assert found.status


def test_a_solver_without_a_status_is_a_failure():
    from formulations.backend import SolverError

    program = ranged("ipopt")
    own = program._solver

    class Silent:
        def __call__(self, **given):
            return own(**given)

        def stats(self):
            return {"success": True, "iter_count": 1}

    program._solver = Silent()
    with recording() as endings, pytest.raises(SolverError, match="reports no status"):
        program.solve([0.4, 0.4], Z)
    assert [ending.found for ending in endings] == [False]
