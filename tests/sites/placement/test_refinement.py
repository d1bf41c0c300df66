"""Refinement: the information in symbols is that of the candidates, and sites find their regions."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from sites.placement.scenes import hall

from optloc import InvalidProblem
from optloc.sites.placement import SiteSelection
from optloc.sites.placement.areas import region_of
from optloc.sites.placement.refinement import _check_refinable, _criterion_at, _information, _inside, _nearest_region
from optloc.sites.placement.sites import candidates_of


@pytest.fixture(scope="module")
def candidates():
    problem, places = hall(n=6, places=2)
    return candidates_of(SiteSelection(problem, places, choose=4, kept=(problem.stations.names[0],)))


def test_information_in_symbols_is_that_of_the_rows_where_sites_stand(candidates):
    sites, design = np.array([1, 3, 4, 5]), candidates.design
    position = candidates.problem.stations.position.reshape(-1, 3)
    symbols = [ca.SX.sym(f"s{i}", 3) for i in sites]
    total = ca.Function("total", symbols, _information(candidates, sites, symbols))
    found = total(*position[sites])
    chosen = np.array([1.0, 1, 0, 1, 1, 1])  # with the site that is kept
    wanted = design.prior + np.einsum("prmn,n,prkn->pmk", design.rows, chosen, design.rows)
    for place in range(2):
        np.testing.assert_allclose(np.array(found[place]), wanted[place], rtol=1e-9, atol=1e-12)


def test_the_value_at_the_places_of_the_candidates_is_that_of_their_set(candidates):
    sites = np.array([1, 3, 4, 5])
    position = candidates.problem.stations.position.reshape(-1, 3)
    design, chosen = candidates.design, np.array([1.0, 1, 0, 1, 1, 1])
    matrix = design.prior + np.einsum("prmn,n,prkn->pmk", design.rows, chosen, design.rows)
    wanted = np.trace(np.linalg.inv(matrix)[:, :3, :3], axis1=1, axis2=2).mean()
    assert _criterion_at(candidates, sites, position[sites]) == pytest.approx(wanted, rel=1e-9)


def test_a_site_moves_to_the_nearest_region():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    near, far = region_of(square, 0.0, 2.0), region_of(square + 10.0, 0.0, 2.0)
    region, place = _nearest_region(np.array([2.0, 0.5, 3.0]), [far, near], None)
    assert region is near
    assert place == pytest.approx([1.0, 0.5, 2.0], abs=1e-6)
    assert _inside(np.array([0.5, 0.5, 1.0]), near, None)
    assert not _inside(np.array([0.5, 0.5, 2.1]), near, None)


def test_single_rows_cannot_be_refined(candidates):
    _check_refinable(candidates)
    with pytest.raises(InvalidProblem, match="cannot be refined"):
        _check_refinable(candidates_of(replace(candidates.selection, by="row", kept=())))
