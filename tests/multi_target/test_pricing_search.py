"""The search for sets that are worth their price: its floor is below the cost of every set."""

from itertools import product

import numpy as np
import pytest
from multi_target.brute import every_set
from multi_target.scenes import AZIMUTHS, RING, drawn

import optloc
from optloc.multi_target.pricing_search import TOLERANCE, PricedRegion, search
from optloc.multi_target.set_packing import Prices
from optloc.multi_target.sets import of_picks, refine_sets as refined, scenes


@pytest.mark.parametrize("kind", [{}, AZIMUTHS], ids=["differences", "azimuths"])
@pytest.mark.parametrize("seed", range(3))
def test_the_floor_of_a_search_is_below_every_set(kind, seed):
    drawn_scene = drawn(seed, 2, **kind)
    scene, rng = next(scenes(drawn_scene.problem, drawn_scene.clutter, None)), np.random.default_rng(seed)
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
