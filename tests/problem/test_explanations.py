"""Explanations of data that contradict each other."""

import numpy as np

from optloc.problem.explanations import Explanation, Suspect


def suspect(name):
    return Suspect(name, "station", (0,), np.zeros(1), np.ones(1), 0.1, 0.9)


def test_an_explanation_has_the_names_of_its_suspects_in_their_order():
    found = Explanation((suspect("station B"), suspect("row 3")), np.zeros(2), 1.0, 3, 0.8)
    assert found.names == ("station B", "row 3")
    assert np.isnan(found.score)
