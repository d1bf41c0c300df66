"""Findings of a network: each sentence has at most 200 characters and names a next step."""

from types import SimpleNamespace

import numpy as np
from trades.messages import LONGEST, names_step

from optloc import Status
from optloc.sites.calibration.network_findings import NETWORK_FINDINGS, mirror_words, rival_words, shorten
from optloc.solvers import objections


def facts(**changes):
    """Return the facts of a network without an objection, with changes."""
    found = SimpleNamespace(agreeing=5, made=16)
    net = SimpleNamespace(names=("Church", "Bridge", "School"), stations=3, dimension=2, synchronised=True)
    motions = SimpleNamespace(open=np.zeros((6, 0)))
    values = {
        "net": net, "found": found, "motions": motions, "p": 0.4, "sides": (), "departure": np.nan, "elsewhere": (),
        "twofold": np.zeros(4, dtype=bool), "refuted": [], "unproven": [], "mirror": "",
    }  # fmt: skip
    return SimpleNamespace(**(values | changes))


def test_a_network_without_an_objection_has_no_finding():
    assert objections(NETWORK_FINDINGS, facts()) == []


def test_each_finding_is_short_and_names_a_next_step():
    many = [f"station Anchor-{i}" for i in range(9)]
    net = SimpleNamespace(names=("Church tower",), place_sigma=np.full((1, 3), np.inf))
    mirror = mirror_words(net, np.array([[1234.5678, 0.0, 1.0]]), np.array([[-1234.5678, 0.0, 1.0]]), 3.21)
    worst = facts(
        mirror=mirror,
        motions=SimpleNamespace(open=np.ones((6, 3))), departure=20.0, p=0.0, elsewhere=(("Pulse 7 elsewhere", 3.2),),
        twofold=np.ones(400, dtype=bool), refuted=many, found=SimpleNamespace(agreeing=1, made=144),
    )  # fmt: skip
    found = objections(NETWORK_FINDINGS, worst) + objections(NETWORK_FINDINGS, facts(unproven=many))
    assert {status for status, _ in found} == {
        Status.SINGULAR_GEOMETRY, Status.CURVED, Status.MISFIT, Status.AMBIGUOUS, Status.UNPROVEN, Status.SEARCHED,
    }  # fmt: skip
    assert [words for _, words in found if len(words) > LONGEST or not names_step(words)] == []


def test_more_than_three_names_are_counted():
    assert shorten(list("abc")) == "a, b, c"
    assert shorten(list("abcdef")) == "a, b, c and 3 more"


def test_a_rival_without_a_difference_of_cost_is_not_decided():
    assert rival_words("another network", 2e-12).startswith(
        "Another network fits equally well, so the data do not decide"
    )
    assert "raises chi-square by 3.2, so the data do not decide" in rival_words("another network", 3.21)
