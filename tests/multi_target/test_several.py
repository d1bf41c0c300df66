"""Rows of several emitters: bounds, scores, proofs, and what is said of degenerate epochs."""

from itertools import product

import numpy as np
import pytest
from multi_target.brute import every_set, fitted, packed, true_sets
from multi_target.scenes import RING, STAR, drawn, model

import optloc
from optloc import InvalidProblem, Status
from optloc.multi_target import Clutter, evenly, separate
from optloc.multi_target.pricing_search import TOLERANCE, PricedRegion, search
from optloc.multi_target.set_packing import Prices, cheapest_sets, price_rows
from optloc.multi_target.sets import Tuples, around, changes, of_picks, refine_sets as refined, scenes

AZIMUTHS = {"kind": "azimuth", "channels": [0, 1, 2, 3, 4]}


def scene_of(drawn_scene, penalty=None):
    return next(scenes(drawn_scene.problem, drawn_scene.clutter, penalty))


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
    value, slope, remainder = around(problem, centre, np.linalg.norm(half, axis=-1))
    change = changes(problem, slope, remainder, half)
    turn = np.concatenate([np.full(b.count, b.kind in ("azimuth", "elevation")) for b in problem.rows])
    touched = 0.0
    for _ in range(200):
        away = half * rng.choice([rng.uniform(-1.0, 1.0), 1.0, -1.0], half.shape) * rng.choice([0.1, 1.0])
        there = around(problem, centre + away, np.zeros(len(centre)))[0]
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


@pytest.mark.parametrize("kind", [{}, AZIMUTHS], ids=["differences", "azimuths"])
@pytest.mark.parametrize("seed", range(3))
def test_the_floor_of_a_search_is_below_every_set(kind, seed):
    drawn_scene = drawn(seed, 2, **kind)
    scene, rng = scene_of(drawn_scene), np.random.default_rng(seed)
    picks, cost = every_set(drawn_scene)
    price = rng.uniform(0.0, 12.0, scene.z.shape)
    by_row = np.zeros(drawn_scene.problem.count)
    by_row[scene.row[scene.row >= 0]] = price[scene.row >= 0]
    reduced = cost + np.where(picks >= 0, by_row[picks], 0.0).sum(-1)
    found = search(scene, Prices(price, 0.0), PricedRegion(np.full(2, -30e3), np.full(2, 30e3)), 200_000)
    if reduced.min() < -TOLERANCE:
        assert len(found.places)  # it must not miss what pays
        assert found.floor < reduced.min() + 1e-6
    else:
        assert not len(found.places)


@pytest.mark.parametrize("seed", range(3))
def test_the_floor_holds_for_correlated_rows_too(seed):
    drawn_scene = drawn(seed, 2)
    block = drawn_scene.problem.rows[0]
    rows = optloc.measured("tdoa", block.z, a=block.a, b=block.b, arrival_sigma=7.0, target=-1)
    scene = next(scenes(optloc.assemble(RING, rows), drawn_scene.clutter, None))
    picks = np.array(list(product(*([-1, *np.flatnonzero(np.isfinite(z))] for z in scene.z))))
    picks = picks[(picks >= 0).sum(-1) >= 3]
    grid = [np.full((len(picks), 2), at) for at in product((-8e3, 0.0, 8e3), repeat=2)]
    cost = np.min([refined(scene, picks, start)[0].cost for start in grid], axis=0)
    price = np.random.default_rng(seed).uniform(4.0, 12.0, scene.z.shape)
    reduced = cost + of_picks(price, picks).sum(-1)
    found = search(scene, Prices(price, 0.0), PricedRegion(np.full(2, -30e3), np.full(2, 30e3)), 5_000)
    assert found.floor <= max(reduced.min(), -TOLERANCE) + 1e-6
    assert len(found.places) or reduced.min() > -TOLERANCE


def test_scores_are_those_of_the_formula():
    drawn_scene = drawn(4, 2)
    scene = scene_of(drawn_scene)
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


def test_the_packing_is_the_best_and_its_prices_bound_it():
    rng = np.random.default_rng(0)
    picks = np.array([[rng.integers(-1, 3) for _ in range(4)] for _ in range(60)])
    picks = np.unique(picks[(picks >= 0).sum(-1) > 1], axis=0)
    cost = rng.normal(-3.0, 4.0, len(picks))
    tuples = Tuples(picks, np.zeros((len(picks), 2)), cost)
    numbered = np.where(picks >= 0, picks + 3 * np.arange(4), -1)
    taken, total = cheapest_sets(tuples, 3, None)
    assert total == pytest.approx(packed(numbered, cost)[0])
    for count in (None, 1, 2):
        taken, total = cheapest_sets(tuples, 3, count)
        prices = price_rows(tuples, taken, np.ones((4, 3)), count)
        reduced = prices.reduced(tuples).min()
        assert reduced > -1e-6
        assert prices.bound(count, 6, reduced) <= total + 1e-6


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


def test_false_rows_are_spread_over_what_is_possible():
    stations = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 300.0]])
    tdoa = optloc.measured("tdoa", [1.0, 2.0], a=[1, 2], b=0, sigma=1.0)
    problem = optloc.assemble(stations, tdoa, optloc.measured("azimuth", [0.1], a=0, sigma=0.01))
    density = evenly(problem, 0.9, 2.0).density
    assert density == {"tdoa": pytest.approx(2.0 / 400.0), "azimuth": pytest.approx(1.0 / np.pi)}
    with pytest.raises(InvalidProblem, match="false"):
        evenly(problem, 0.9, 0.0)
    with pytest.raises(InvalidProblem, match="range"):
        evenly(optloc.assemble(stations, optloc.measured("range", [1.0], a=0, sigma=1.0)), 0.9, 1.0)
