"""Claims from another problem hold only for fixes of the same cost and with as many other minima."""

from dataclasses import replace

import numpy as np

import optloc
from optloc.base.records import change
from optloc.problem.claims import GLOBAL, UNKNOWN
from optloc.solvers.certificates.mapped_claims import drop_lost, improved

ANCHORS = np.array([[0.0, 0.0], [8.0, 0.0], [0.0, 6.0], [8.0, 6.0]])


def fixes():
    rows = optloc.measured("range", a=np.arange(4), sigma=0.05)
    return optloc.solve(optloc.simulate(optloc.assemble(ANCHORS, rows), np.array([4.0, 2.0]), 1, 3))


def claims_of(fix):
    return change(fix.claims, lambda array, core: np.array(array))


def test_claims_about_fixes_of_another_cost_are_dropped():
    fix = fixes()
    claims = claims_of(fix)
    assert (claims.proof == GLOBAL).all()
    drop_lost(claims, replace(fix, cost=fix.cost + 2.0), fix, 2.0)
    assert (claims.proof == GLOBAL).all()
    drop_lost(claims, replace(fix, cost=fix.cost + np.array([0.0, 2.0, 0.0])), fix)
    assert claims.proof.tolist() == [GLOBAL, UNKNOWN, GLOBAL]


def test_a_lower_cost_or_one_more_minimum_improves_a_fix():
    fix = fixes()
    assert improved(fix, fix).tolist() == []
    assert improved(replace(fix, cost=fix.cost + np.array([1.0, 0.0, 5.0])), fix).tolist() == [0, 2]
    listed = replace(fix, alternatives=replace(fix.alternatives, gap=np.array([[np.inf], [3.0], [np.inf]])))
    assert improved(fix, listed).tolist() == [1]
