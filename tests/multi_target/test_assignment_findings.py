"""Findings against an assignment of rows to emitters."""

import re

import numpy as np
import pytest

import optloc
from optloc.multi_target.assignment_findings import Assigned, count_in_words, verdict

RING = 1e3 * np.array([[0.0, 0], [10, 0], [0, 10], [9, 9]])


def fix():
    problem = optloc.assemble(RING, optloc.measured("range", a=np.arange(4), sigma=2.0))
    return optloc.solve(optloc.simulate(problem, np.array([4e3, 5e3]), 1))


def found(**changes):
    clean = Assigned((fix(),), (), np.array([60.0, 5.0, 20.0]), 5.0, 4.9, None, 4, 4, 2)
    return clean._replace(**changes)


@pytest.mark.parametrize(
    ("changes", "status", "words"),
    [
        ({}, "ok", "clean"),
        ({"gaps": (3.0, 8.0, 40.0)}, "ambiguous", "another position costs only 3.0 more .2 in total"),
        ({"costs": np.array([60.0, 5.0, 6.5])}, "ambiguous", "2 emitters would cost only 1.5 more"),
        ({"costs": np.array([60.0, 5.0, 6.5]), "wanted": 1}, "ok", "clean"),
        ({"bound": 1.0}, "unproven", "another assignment may cost 4.0 less"),
        ({"fixes": (), "cost": np.inf, "wanted": 2}, "infeasible", "no 2 emitters were found that share no row"),
        (
            {"fixes": (), "present": 1},
            "too few rows",
            "rows in 1 channels cannot separate an emitter .* an emitter needs 2",
        ),
    ],
)
def test_each_finding_has_its_status_and_sentence(changes, status, words):
    code, reason = verdict(found(**changes), "clean")
    assert code.label == status
    assert re.search(words, reason)


def test_a_doubtful_emitter_counts_against_all():
    problem = optloc.assemble(RING[:2], optloc.measured("range", a=np.arange(2), sigma=2.0))
    doubtful = optloc.solve(optloc.simulate(problem, np.array([4e3, 5e3]), 1))
    code, reason = verdict(found(fixes=(fix(), doubtful), costs=np.array([90.0, 60.0, 5.0, 30.0])), "clean")
    assert code == doubtful.status
    assert f"emitter 1: {doubtful.status.label}" in reason


def test_numbers_of_emitters_in_words():
    assert [count_in_words(n) for n in range(3)] == ["no emitter", "one emitter", "2 emitters"]
