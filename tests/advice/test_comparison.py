"""Explanations that are excluded without a fit are those that could neither be given nor listed."""

from dataclasses import replace

import numpy as np
import pytest
from advice.cases import at, range_case

from optloc.advice.change import Change
from optloc.advice.comparison import Comparison, compare_all
from optloc.advice.explanation_table import EXPLANATIONS
from optloc.advice.fits import fit
from optloc.advice.scores import GAP, least_score, scored
from optloc.advice.suspects import Suspects
from optloc.advice.wording import no_words

ROW = np.zeros((4, 7))
ROW[2, 5] = 80.0
ERRORS = {"offset": at(3, 90.0), "drift": np.outer(10.0 * np.arange(4), at(2, 4.0)), "outlier": ROW}


def known_case(error):
    """Return a case whose fixes and costs without a change are known."""
    case, _ = range_case(error, epochs=4)
    plain = fit(case, [Change("none", no_words)])
    return replace(case, x=plain.x[0], cost=plain.cost[0])


def listed(case, limit):
    """Return the causes with scores within the gap of the best."""
    comparison = Comparison(case, limit)
    compare_all(comparison)
    best = min(one.score for one in comparison.found)
    return {
        (one.change.cause, one.change.station, round(one.score, 2))
        for one in comparison.found
        if one.score < best + GAP
    }


@pytest.mark.parametrize("cause", ERRORS)
def test_the_limit_changes_no_explanation_that_is_listed(cause):
    case = known_case(ERRORS[cause])
    found = listed(case, float(case.cost.sum()))
    assert found == listed(case, np.inf)
    assert cause in {one[0] for one in found}


@pytest.mark.parametrize("cause", ERRORS)
def test_no_score_is_below_its_bound(cause):
    case = known_case(ERRORS[cause])
    suspects = Suspects(case)
    offers = [(c, e.price) for e in EXPLANATIONS.values() for c in e.changes(case, suspects) if c.base is None]
    changes, odds = zip(*offers, strict=True)
    bound = {id(change): least_score(case, change, price) for change, price in offers}
    for one in scored(case, changes, fit(case, changes), odds):
        assert one.score > bound[id(one.change)] - 0.01


def test_wrong_rows_change_only_the_fit_of_their_epoch():
    case = known_case(ROW)
    offers = [(c, 4.6) for c in EXPLANATIONS["outlier"].changes(case, Suspects(case))]
    whole, parts = Comparison(case, np.inf), Comparison(case, float(case.cost.sum()))
    whole.compare(offers)
    compare_all(parts)
    best = min(whole.found, key=lambda one: one.score)
    assert best.change.members == (19,)
    assert any(np.isclose(one.score, best.score, atol=0.01) for one in parts.found if one.change.members == (19,))
