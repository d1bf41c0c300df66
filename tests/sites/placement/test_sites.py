"""Candidate sites as numbers: whitened rows by hand, rules, sight and reach, and selections that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from sites.placement.scenes import hall

from optloc import InvalidProblem, assemble, measured
from optloc.sites.placement import SiteSelection
from optloc.sites.placement.counts import CountGroup
from optloc.sites.placement.sites import candidates_of


@pytest.fixture
def selection():
    problem, places = hall(n=6, places=3, sigma=0.5)
    return SiteSelection(problem, places, choose=4)


def test_rows_are_lines_of_sight_over_the_noise_and_a_one_for_the_emission_time(selection):
    found = candidates_of(selection)
    away = selection.places[:, None] - selection.problem.stations.position[0]
    lines = away / np.linalg.norm(away, axis=-1, keepdims=True)
    np.testing.assert_allclose(np.moveaxis(found.design.rows[:, 0, :3], 1, -1), lines / 0.5, atol=1e-12)
    np.testing.assert_allclose(found.design.rows[:, 0, 3], 1.0 / 0.5)
    assert found.design.weight.tolist() == pytest.approx([1 / 3] * 3)


def test_what_is_out_of_sight_or_reach_has_no_row_and_what_is_dim_a_smaller_one(selection):
    sight = np.ones((3, 6))
    sight[0, 1], sight[1, 2] = 0.0, 2.0
    bright, dim = candidates_of(selection).design.rows, candidates_of(replace(selection, sight=sight)).design.rows
    assert (dim[0, :, :, 1] == 0.0).all()
    np.testing.assert_allclose(dim[1, ..., 2], bright[1, ..., 2] / 2.0)
    np.testing.assert_array_equal(dim[2], bright[2])
    away = np.linalg.norm(selection.places[:, None] - selection.problem.stations.position[0], axis=-1)
    reach = np.full(6, 1e9)
    reach[2] = np.median(away[:, 2])
    near = candidates_of(replace(selection, reach=reach)).design.rows
    np.testing.assert_array_equal((near != 0.0).any(axis=(1, 2)), away <= reach)


def test_rules_count_cost_and_group_the_free_sites(selection):
    names = selection.problem.stations.names
    asked = replace(
        selection,
        choose=2,
        kept=(names[0],),
        forbidden=(names[5],),
        groups=(CountGroup(names[1:3], most=1, least=None),),
    )
    found = candidates_of(asked)
    assert found.state.tolist() == [1, -1, -1, -1, -1, 0]
    for chosen, fits in (([1, 1, 0, 1, 0, 0], True), ([1, 1, 1, 0, 0, 0], False), ([1, 1, 0, 1, 1, 0], False)):
        assert (found.rules @ np.array(chosen) <= found.limits + 1e-9).all() == fits
    paid = candidates_of(replace(selection, choose=None, budget=30.0, cost=np.arange(6.0) * 10.0))
    assert (paid.rules @ np.array([1, 1, 1, 0, 0, 0]) <= paid.limits + 1e-9).all()
    assert not (paid.rules @ np.array([0, 1, 0, 1, 0, 0]) <= paid.limits + 1e-9).all()


def test_sets_of_sites_are_problems_without_the_other_rows(selection):
    found = candidates_of(selection)
    weight = found.assembled(np.array([1, 0, 1, 1, 0, 1])).weight
    assert (weight > 0.0).tolist() == [[True, False, True, True, False, True]] * 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"choose": 7}, "7 sites are wanted, but there are 6 candidates"),
        ({"choose": None}, "the number of sites to take is missing"),
        ({"gap": 1.0}, "the gap 1 is not between 0 and 1"),
        ({"criterion": "rmse"}, "there is no criterion 'rmse'; did you mean 'rms'"),
        ({"kept": ("Z",)}, "there is no site 'Z'"),
        ({"weights": np.array([1.0, 0.0, 1.0])}, "the weights are not 3 positive numbers"),
    ],
)
def test_what_cannot_be_selected_is_one_sentence(selection, change, said):
    with pytest.raises(InvalidProblem, match=said):
        candidates_of(replace(selection, **change))


def test_a_station_without_a_row_of_its_own_is_no_site():
    problem, places = hall(n=6, places=1)
    stations = problem.stations.position[0]
    rows = measured("toa", a=np.arange(5), sigma=0.3)
    found = candidates_of(SiteSelection(assemble(stations, rows), places, choose=4))
    assert len(found.names) == 5
