"""Proofs of a batch in one call: costs, absent nodes, and verdicts on right and wrong minima."""

import numpy as np
import pytest
from proof.costs import differences, down_from

from optloc.proof.batch import (
    ProofRequest,
    ProofResult,
    costs_at,
    empty_answer,
    plainly,
    prove_all,
    without_unused_nodes,
)
from optloc.proof.local_search import BETTER, STATIONARY, UNIQUE

pytestmark = pytest.mark.usefixtures("plainly")

STATIONS = np.array([[0.0, 0.0], [4e3, 0.0], [4e3, 3e3], [0.0, 3e3], [2e3, -500.0]])


@pytest.fixture
def case():
    return differences(STATIONS, np.array([1.5e3, 1.2e3]), 5.0, np.random.default_rng(1))


def asked(x, kappa=25.0):
    n, d = x.shape
    nowhere, none = np.full((n, 2, d), np.nan), np.zeros(n, dtype=np.int64)
    gaps = np.tile(down_from(kappa), (n, 1))
    region = np.stack([np.full((n, d), -1e4), np.full((n, d), 1e4)], axis=1)
    return ProofRequest(
        x,
        np.zeros((n, 0, d)),
        none,
        none,
        gaps,
        np.full(n, 1e-6),
        nowhere,
        region,
        np.full(n, 400),
        np.zeros((n, 0, 3)),
        np.zeros((n, 0)),
    )


def test_costs_are_those_of_plain_ranges(case):
    places = np.random.default_rng(2).uniform(-5e3, 5e3, (1, 6, 2))
    cost, blur = costs_at(case.batch, places)
    np.testing.assert_allclose(cost[0], case.cost(places[0]), rtol=1e-9)
    assert (blur < 1e-6 * np.sqrt(cost)).all()


def test_the_minimum_is_unique_and_no_other_point_is_proven(case):
    x = case.minimum(np.array([1.5e3, 1.2e3]))
    found = prove_all(case.batch, asked(x[None]))
    assert found.verdict[0] == UNIQUE
    assert found.bound[0] == pytest.approx(case.cost(x), abs=1e-5)
    away = prove_all(case.batch, asked(x[None] + 40.0))
    assert away.verdict[0] in (BETTER, STATIONARY)


def test_nodes_that_no_row_has_change_no_cost(case):
    cost, _ = case.tables
    K = np.insert(np.insert(case.K, 2, 0.0, axis=1), 1, 0.0, axis=0)
    wider = cost._replace(
        kinds=np.insert(cost.kinds, 2, cost.kinds[0]),
        data=np.insert(cost.data, 2, 7.0, axis=0),
        K=K,
        w=np.insert(case.w, 1, 0.0),
    )
    own = without_unused_nodes(wider)
    np.testing.assert_array_equal(own.K, case.K)
    np.testing.assert_array_equal(own.w, case.w)
    np.testing.assert_array_equal(own.data, cost.data)


def test_answers_are_taken_item_by_item():
    out = empty_answer(3, 2)
    out.gap[:] = [1.0, 2.0, 3.0]
    assert out.take(np.array([2, 0])).gap.tolist() == [3.0, 1.0]
    assert isinstance(out.take(slice(1)), ProofResult)
    assert plainly(np.arange(6.0).reshape(2, 3).T).flags.c_contiguous
