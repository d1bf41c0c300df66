"""optloc.place: the house's own rows and bound, what becomes of a set, metamorphic relations, bad input by name."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from sites.placement.scenes import drawn, hall

import optloc
from formulations.placement import PlacementGround, PlacementRegion
from optloc import InvalidProblem, assemble, crlb, measured, place
from optloc.sites.placement import CountGroup, Draws, SiteSelection, chosen as chosen_module
from optloc.sites.placement.chosen import drawn as simulated
from optloc.sites.placement.refinement import refined
from optloc.sites.placement.sites import candidates_of

EDGES = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])


def selection(n=12, places=4, **more):
    problem, at = hall(n=n, places=places)
    return SiteSelection(problem, at, **({"choose": 5} | more))


def taken(candidates, found):
    return np.isin(candidates.names, (*found.chosen, *found.kept)).astype(float)


MIXED = {
    "toa": lambda n: [measured("toa", a=np.arange(n), sigma=0.3)],
    "range": lambda n: [measured("range", a=np.arange(n), sigma=0.3)],
    "azimuth and elevation": lambda n: [
        measured("azimuth", a=np.arange(n), sigma=0.01),
        measured("elevation", a=np.arange(n), sigma=0.02),
    ],
    "range_sum": lambda n: [measured("range_sum", a=np.arange(1, n), b=0, sigma=0.3)],
    "tdoa": lambda n: [measured("tdoa", a=np.arange(1, n), b=0, arrival_sigma=np.linspace(0.2, 0.5, n))],
    "toa and azimuth": lambda n: [
        measured("toa", a=np.arange(n), sigma=0.3),
        measured("azimuth", a=np.arange(n), sigma=0.01),
    ],
}


@pytest.mark.parametrize("kinds", MIXED)
def test_the_value_is_that_of_crlb(kinds):
    """Another code path: normal equations of the assembled problem, out-of-sight rows left out, M0 as its prior."""
    sites, at = drawn(2, 12, 5)
    r = np.linalg.norm(at[:, None] - sites, axis=-1)
    sight = np.where(r < 65.0, np.maximum(1.0, r / 30.0), 0.0)
    asked = SiteSelection(assemble(sites, *MIXED[kinds](12)), at, choose=6, sight=sight)
    found, candidates = place(asked), candidates_of(asked)
    bound = crlb(candidates.assembled(taken(candidates, found)), candidates.vectors)[:, :3, :3]
    assert np.trace(bound, axis1=1, axis2=2).mean() == pytest.approx(found.value, rel=1e-9)
    assert np.allclose(found.per_place, np.sqrt(np.trace(bound, axis1=1, axis2=2)), rtol=1e-9)


def test_differences_with_full_covariance_are_arrivals_for_each_reference():
    sites, at = drawn(3, 6, 1)
    sigma = np.linspace(0.2, 0.5, 6)
    arrivals = crlb(assemble(sites, measured("toa", a=np.arange(6), sigma=sigma)), np.append(at[0], 0.0))
    for b in range(6):
        a = np.setdiff1d(np.arange(6), b)
        pairs = crlb(assemble(sites, measured("tdoa", a=a, b=b, arrival_sigma=sigma)), at[0])
        assert np.allclose(pairs, arrivals, rtol=1e-9)
        # pairs in the place of arrivals, as if they were independent, would be seen
        alone = crlb(assemble(sites, measured("tdoa", a=a, b=b, sigma=np.hypot(sigma[a], sigma[b]))), at[0])
        assert abs(np.trace(alone) / np.trace(arrivals) - 1) > 0.01


def test_kept_forbidden_and_groups_are_met_and_the_gap_is_as_asked():
    groups = (CountGroup(("S0", "S1", "S2", "S3"), most=1), CountGroup(("S8", "S9", "S10"), least=2))
    found = place(selection(kept=("S4",), forbidden=("S5",), groups=groups))
    assert found.kept == ("S4",)
    assert len(found.chosen) == 5
    assert not {"S4", "S5"} & {*found.chosen}
    assert len({"S0", "S1", "S2", "S3"} & {*found.chosen}) <= 1
    assert len({"S8", "S9", "S10"} & {*found.chosen}) >= 2
    assert found.closed
    assert found.value * 0.99 * (1 - 1e-12) <= found.bound <= found.value


def test_scaled_noise_scales_the_value_and_leaves_the_set():
    asked = selection()
    first = place(replace(asked, problem=candidates_of(asked).problem.flat().take(np.array([0])), gap=1e-6))
    problem = asked.problem
    priors = tuple(replace(prior, covariance=9 * prior.covariance) for prior in candidates_of(asked).problem.priors)
    louder = assemble(problem.stations, measured("toa", a=np.arange(12), sigma=0.9), priors=priors)
    second = place(replace(asked, problem=louder, gap=1e-6))
    assert second.chosen == first.chosen
    assert second.value == pytest.approx(9 * first.value, rel=1e-9)


def test_a_turned_and_shifted_scene_has_the_same_set():
    sites, at = drawn(1, 12, 4)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    priors = candidates_of(
        SiteSelection(assemble(sites, measured("toa", a=np.arange(12), sigma=0.3)), at, choose=5)
    ).problem.priors
    found = []
    for move in (lambda x: x, lambda x: x @ turn.T + [100.0, -50.0, 3.0]):
        problem = assemble(move(sites), measured("toa", a=np.arange(12), sigma=0.3), priors=priors)
        found.append(place(SiteSelection(problem, move(at), choose=5, gap=1e-6)))
    assert found[0].chosen == found[1].chosen
    assert found[0].value == pytest.approx(found[1].value, rel=1e-6)


def test_doubled_weights_change_nothing_and_a_weight_of_zero_is_refused():
    asked = selection(weights=np.array([1.0, 2, 3, 4]))
    once, twice = place(asked), place(replace(asked, weights=2 * asked.weights))
    assert once.chosen == twice.chosen
    assert once.value == twice.value
    with pytest.raises(InvalidProblem, match="weight above 0"):
        place(replace(asked, weights=np.array([1.0, 0, 3, 4])))


def test_what_each_loss_costs_and_what_comes_next():
    found, candidates = place(asked := selection()), candidates_of(selection())
    names = np.array(candidates.names)
    for swap in found.swaps:
        left = np.isin(names, [*{*found.chosen} - {swap.name}]).astype(float)
        bound = crlb(candidates.assembled(left), candidates.vectors)[:, :3, :3]
        assert np.trace(bound, axis1=1, axis2=2).mean() == pytest.approx(swap.value, rel=1e-9)
        assert swap.replaced <= swap.value
    assert [swap.value for swap in found.swaps] == sorted((swap.value for swap in found.swaps), reverse=True)
    name, value = found.following[0]
    more = place(replace(asked, kept=found.chosen, choose=1, gap=1e-6))
    assert more.chosen == (name,)
    assert more.value == pytest.approx(value, rel=1e-9)


def test_which_of_the_stations_to_switch_on_and_which_row_next():
    problem, at = hall(n=9, places=1)
    rows = SiteSelection(problem, at[:1], choose=4, by="row")
    assert len(place(rows).chosen) == 4
    best = place(SiteSelection(problem, at[0], choose=4))
    assert {f"toa {name}" for name in best.chosen} == {*place(rows).chosen}


def test_criteria_are_variances_and_their_order_is_that_of_ellipsoids():
    values = {}
    for criterion in ("rms", "volume", "axis"):
        found = place(selection(criterion=criterion, gap=1e-6))
        values[criterion] = found.value
        assert found.closed
    # of any set: geometric mean of three variances <= largest <= sum; so of the least of each
    assert values["volume"] <= values["axis"] <= values["rms"]


@pytest.mark.parametrize("fail_one", [False, True])
@pytest.mark.parametrize("worst", [False, True])
def test_worst_and_failure_are_no_better_than_the_mean(worst, fail_one):
    plain = place(selection(gap=1e-6))
    hard = place(selection(worst=worst, fail_one=fail_one, gap=1e-6))
    assert hard.value >= plain.value * (1 - 1e-9)
    if worst and not fail_one:
        assert hard.value == pytest.approx((hard.per_place**2).max(), rel=1e-9)
        assert (hard.per_place**2).max() <= (plain.per_place**2).max() * (1 + 1e-9)


def test_simulated_fixes_tell_a_flat_array():
    """Six ranges from one plane fit the mirror image as well; a station above it ends that."""
    sites, at = drawn(5, 6, 1)
    sites = np.vstack([np.column_stack([sites[:, :2], np.zeros(6)]), [0.0, 0.0, 30.0]])
    candidates = candidates_of(
        SiteSelection(assemble(sites, measured("range", a=np.arange(7), sigma=0.03)), at, choose=4)
    )
    flat = simulated(candidates, np.array([1, 1, 1, 1, 0, 0, 0]), 10)
    assert flat.ambiguous[0] > 0.3  # others say that they cannot tell
    assert flat.flat[0] < 1e-6
    assert not flat.clean
    assert simulated(candidates, np.array([1, 1, 1, 1, 1, 1, 1]), 10).clean


def test_a_set_whose_fixes_are_ambiguous_is_given_up_for_the_next(monkeypatch):
    asked, first = selection(gap=1e-6), []

    def judge(candidates, chosen, count, seed):
        first.append(chosen)
        dirty = np.full(4, 1.0 if len(first) == 1 else 0.0)
        return Draws(count, dirty, dirty, dirty, dirty)

    monkeypatch.setattr(chosen_module, "drawn", judge)
    found, best = place(asked, draws=10), place(replace(asked, alternatives=2))
    assert found.banned == (best.alternatives[0][0],)
    assert found.chosen == best.alternatives[1][0]
    assert found.value == pytest.approx(best.alternatives[1][1], rel=1e-9)
    assert "except the rejected sets" in found.reason


@pytest.mark.parametrize("choose", [1, 4])
def test_the_best_set_is_returned_if_all_sets_are_ambiguous(monkeypatch, choose):
    asked = replace(selection(gap=1e-6), choose=choose)
    dirty = np.ones(4)
    monkeypatch.setattr(chosen_module, "drawn", lambda *args: Draws(10, dirty, dirty, dirty, dirty))
    found, best = place(asked, draws=10), place(asked)
    assert (found.chosen, found.banned, found.bound) == (best.chosen, (), best.bound)
    assert not found.draws.clean


@pytest.mark.parametrize("ground", few(["hill", None], 1))
@pytest.mark.parametrize(
    "more", [{}, {"criterion": "volume"}, {"criterion": "axis"}, {"worst": True}, {"fail_one": True}]
)
def test_refinement_never_worsens_and_stays_inside(more, ground):
    asked = selection(n=8, places=3, **more)
    found = place(asked)
    region = PlacementRegion(EDGES, np.full(4, 30.0), 0.0, 6.0)
    x = np.linspace(-40.0, 40.0, 7)
    surface = PlacementGround(x, x, np.add.outer(np.sin(x / 20), np.cos(x / 20))) if ground else None
    moved = refined(asked, found, [region], surface, starts=0)
    assert moved.refined.shape == (5, 3)
    assert all((region.excess(one, surface) <= 1e-5).all() for one in moved.refined)
    if surface is None:  # the grid's own set lies in the region
        assert moved.refined_value <= found.value * (1 + 1e-9)
        there = assemble(
            moved.refined, measured("toa", a=np.arange(5), sigma=0.3), priors=candidates_of(asked).problem.priors
        )
        whole = place(replace(asked, problem=there, seconds=10.0))
        assert whole.value == pytest.approx(moved.refined_value, rel=1e-6)


BAD = {
    "fewer candidates than k": ({"choose": 13}, "13 sites are wanted, but there are 12 candidates"),
    "no number of sites": ({"choose": None}, "the number of sites to take is missing"),
    "no cost": ({"choose": None, "budget": 3.0}, "a budget needs a cost"),
    "unknown site": ({"kept": ("S99",)}, "there is no site 'S99'"),
    "kept and forbidden": ({"kept": ("S1",), "forbidden": ("S1",)}, "kept and forbidden"),
    "groups that contradict k": (
        {"groups": (CountGroup(tuple(f"S{i}" for i in range(12)), least=6),)},
        "the groups need at least 6",
    ),
    "criterion": ({"criterion": "trace"}, "there is no criterion 'trace'"),
    "gap": ({"gap": 0.0}, "the gap 0 is not between"),
    "time": ({"seconds": 0.0}, "the time 0 s is not positive"),
    "place of another size": ({"places": np.zeros((3, 2))}, "the places have shape"),
    "sight": ({"sight": np.full((4, 12), 0.5)}, "with values 0 or at least 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_a_sentence(name):
    change, said = BAD[name]
    with pytest.raises(InvalidProblem, match=said):
        place(replace(selection(), **change))


def test_a_place_that_too_few_sites_see_is_named():
    sight = np.ones((4, 12))
    sight[2, 3:] = 0.0
    with pytest.raises(InvalidProblem, match="place '3' is in sight of 3 sites"):
        place(selection(sight=sight))


def test_places_and_sites_that_coincide_are_named():
    problem, at = hall()
    at[1] = problem.stations.position[0, 4]
    with pytest.raises(InvalidProblem, match="place 2 is at the position of station 'S4'"):
        place(SiteSelection(problem, at, choose=5))
    twice = assemble(np.vstack([problem.stations.position[0], problem.stations.position[0, 3]]), *MIXED["toa"](13))
    with pytest.raises(InvalidProblem, match="has the position of another station"):
        place(SiteSelection(twice, hall()[1], choose=5))


def test_pairs_without_arrivals_are_refused():
    sites, at = drawn(1, 8, 2)
    pairs = assemble(sites, measured("tdoa", a=np.arange(1, 8), b=0, sigma=0.3))
    with pytest.raises(InvalidProblem, match="each set of stations has other pairs"):
        place(SiteSelection(pairs, at, choose=4))


def test_a_weak_place_is_told_by_the_share_of_its_prior():
    problem, at = hall(n=8, places=2)
    few = place(SiteSelection(problem, at, choose=3))
    assert (few.share_of_prior > 0.01).all()
    assert (few.redundancy < 0).all()
    assert (place(SiteSelection(problem, at, choose=6)).share_of_prior < 0.05).all()


def test_the_front_page_has_it():
    assert "place" in optloc.__all__
