"""Rows of several emitters: fixes, proofs, and the statuses of degenerate epochs."""

import numpy as np
import pytest
from multi_target.brute import fitted
from multi_target.scenes import AZIMUTHS, RING, STAR, drawn, model

import optloc
from optloc import InvalidProblem, Status
from optloc.multi_target import Clutter, separate


@pytest.mark.parametrize("kind", [{}, AZIMUTHS], ids=["differences", "azimuths"])
def test_a_given_number_of_emitters_is_kept_and_priced(kind):
    drawn_scene = drawn(2, 2, **kind)
    (free,) = separate(drawn_scene.problem, drawn_scene.clutter)
    for count in (0, 1, 3):
        (found,) = separate(drawn_scene.problem, drawn_scene.clutter, count=count)
        assert found.count == count
        assert found.bound - 1e-6 <= found.cost
        assert found.cost >= free.cost - 1e-6


def test_more_emitters_than_rows_are_infeasible():
    drawn_scene = drawn(1, 1, false=0)
    (found,) = separate(drawn_scene.problem, drawn_scene.clutter, count=4)
    assert found.status == Status.INFEASIBLE
    assert "4 emitters" in found.reason
    assert (found.assignment == -1).all()


def test_every_row_is_accounted_for_and_fixes_have_covariances():
    drawn_scene = drawn(7, 2)
    (found,) = separate(drawn_scene.problem, drawn_scene.clutter)
    assert found.assignment.shape == (drawn_scene.problem.count,)
    for number, fix in enumerate(found.fixes):
        picks = np.full((1, 5), -1)
        for i, rows in enumerate(drawn_scene.values()):
            picks[0, i] = next((r for r in rows if found.assignment[r] == number), -1)
        chi2, x = fitted(drawn_scene, picks, fix.position[None])
        assert fix.cost == pytest.approx(chi2[0], abs=1e-5)
        assert np.abs(x[0] - fix.position).max() < 0.1
        assert (np.linalg.eigvalsh(fix.covariance()) > 0.0).all()


def test_one_emitter_without_false_rows_takes_every_row():
    drawn_scene = drawn(3, 1, false=0, detection=1.0)
    (found,) = separate(drawn_scene.problem, drawn_scene.clutter)
    assert found.status == Status.OK
    assert (found.assignment == 0).all()
    assert found.gap <= 0.5


def test_false_rows_alone_are_seldom_an_emitter_and_then_doubtful():
    count, sure = 0, 0
    for seed in range(40):
        drawn_scene = drawn(seed, 0)
        (found,) = separate(drawn_scene.problem, drawn_scene.clutter)
        count += found.count > 0
        sure += found.count > 0 and found.status == Status.OK
    assert sure == 0
    assert count <= 4


def test_absent_rows_say_too_few():
    drawn_scene = drawn(5, 2)
    problem = drawn_scene.problem
    (found,) = separate(problem.with_rows(weight=np.zeros(problem.count)), drawn_scene.clutter)
    assert (found.status, found.count, found.cost) == (Status.TOO_FEW_ROWS, 0, 0.0)
    two = np.isin(problem.rows[0].a, (1, 2)).astype(float)
    (found,) = separate(problem.with_rows(weight=two), drawn_scene.clutter)
    assert (found.status, found.count) == (Status.TOO_FEW_ROWS, 0)


def test_values_that_are_not_finite_are_nobodys():
    drawn_scene = drawn(3, 1, false=0, detection=1.0)
    z = drawn_scene.problem.z.copy()
    z[2] = np.nan
    (found,) = separate(drawn_scene.problem.with_rows(z=z), drawn_scene.clutter)
    assert found.assignment.tolist() == [0, 0, -1, 0, 0]


def test_clutter_in_which_rows_say_nothing_leaves_too_few():
    drawn_scene = drawn(3, 2)
    (found,) = separate(drawn_scene.problem, Clutter(0.9, 10.0))
    assert found.status == Status.TOO_FEW_ROWS
    assert found.count == 0


@pytest.mark.parametrize("apart", [0.0, 1.0, 10.0])
def test_emitters_nearer_than_the_resolution_do_not_crash(apart):
    places = [[2e3, 3e3], [2e3 + apart, 3e3]]
    drawn_scene = drawn(1, 2, places=places, detection=1.0)
    (found,) = separate(drawn_scene.problem, drawn_scene.clutter)
    assert found.count == 2
    assert found.bound <= found.cost
    assert np.abs(found.position - places[0]).max() < 200.0


CROSSED = np.array([[-3e3, 8e3], [3e3, 8e3]])
FROM = np.array([[-10e3, 0.0], [10e3, 0.0], [1e3, -9e3]])


def crossed(stations):
    """Return two emitters seen by each of the stations without error, and where the wrong pairs of bearings meet."""
    channels = list(range(len(stations)))
    z = np.concatenate([model("azimuth", stations, channels, x) for x in CROSSED])
    rows = optloc.measured("azimuth", z, a=np.tile(channels, 2), sigma=2e-3, target=-1)
    ghosts = []
    for k in (0, 1):
        one, two = CROSSED[k] - FROM[0], CROSSED[1 - k] - FROM[1]
        ghosts.append(FROM[0] + one * np.linalg.solve(np.column_stack([one, -two]), FROM[1] - FROM[0])[0])
    return optloc.assemble(stations, rows), np.array(ghosts)


def test_two_bearings_of_two_emitters_cross_in_four_places_and_all_are_listed():
    problem, ghosts = crossed(FROM[:2])
    (found,) = separate(problem, Clutter(0.9, 0.05), count=2, penalty=0.0)
    assert found.status == Status.AMBIGUOUS
    places = np.concatenate([found.position, [ghost.position for ghost in found.ghosts]])
    for place in (*CROSSED, *ghosts):
        assert np.linalg.norm(places - place, axis=-1).min() < 1.0
    assert len(found.ghosts) == 2
    assert found.margin == pytest.approx(0.0, abs=2.0)


def test_a_third_bearing_tells_emitters_from_ghosts():
    problem, _ = crossed(FROM)
    (found,) = separate(problem, Clutter(0.9, 0.05), count=2)
    assert np.sort(found.position, axis=0) == pytest.approx(np.sort(CROSSED, axis=0), abs=1.0)
    assert found.margin > 2.0


def test_each_epoch_is_told_apart_by_itself():
    first, second = drawn(1, 1, false=0, detection=1.0), drawn(2, 1, false=0, detection=1.0)
    z = np.concatenate([first.problem.z, second.problem.z])
    a = np.tile(first.problem.rows[0].a, 2)
    rows = optloc.measured("tdoa", z, a=a, b=0, epoch=np.repeat([0, 1], 5), sigma=10.0, target=-1)
    found = separate(optloc.assemble(RING, rows, times=[0.0, 1.0]), first.clutter)
    assert [f.count for f in found] == [1, 1]
    assert found[0].assignment.tolist() == [0] * 5 + [-1] * 5
    assert found[1].assignment.tolist() == [-1] * 5 + [0] * 5


def test_rows_of_arrival_times_are_separated_and_bounded():
    rng, x = np.random.default_rng(2), np.array([[2e3, 3e3], [-4e3, 1e3]])
    arrival = 7.0 * rng.standard_normal((2, 6))
    true = np.array([model("tdoa", RING, STAR, p) for p in x]) + arrival[:, 1:] - arrival[:, :1]
    a = np.tile([1, 2, 3, 4, 5], 2)
    rows = optloc.measured("tdoa", true.ravel(), a=a, b=0, arrival_sigma=7.0, target=-1)
    (found,) = separate(optloc.assemble(RING, rows), Clutter(0.9, 5e-5), boxes=20_000)
    sets = {frozenset(found.rows(i).tolist()) for i in range(found.count)}
    assert sets == {frozenset(range(5)), frozenset(range(5, 10))}
    assert found.bound <= found.cost


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"count": -1}, "count"),
        ({"penalty": np.nan}, "penalty"),
        ({"region": ([0.0, 0.0], [0.0, 1.0])}, "region"),
        ({"region": ([0.0], [1.0])}, "region"),
    ],
)
def test_bad_arguments_are_named(change, words):
    drawn_scene = drawn(0, 1)
    with pytest.raises(InvalidProblem, match=words):
        separate(drawn_scene.problem, drawn_scene.clutter, **change)


def test_problems_that_cannot_be_scored_are_refused():
    clutter, tdoa = Clutter(0.9, 1e-4), {"a": [1, 2, 3], "b": 0, "target": -1}
    loop = {"a": [1, 2, 2], "b": [0, 0, 1], "target": -1, "arrival_sigma": 1.0}
    for stations, rows, words in (
        (RING, optloc.measured("groa", np.ones(3), sigma=0.1, **tdoa), "groa"),
        (RING, optloc.measured("tdoa", np.zeros((2, 3)), sigma=1.0, **tdoa), "batch"),
        (RING, optloc.measured("tdoa", np.zeros(3), **loop), "sums of others"),
    ):
        with pytest.raises(InvalidProblem, match=words):
            separate(optloc.assemble(stations, rows), clutter)
