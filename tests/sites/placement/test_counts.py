"""A number of sites that groups do not allow is refused with how many they do allow; one that they allow is taken."""

import numpy as np
import pytest

from optloc import InvalidProblem, assemble, measured, place
from optloc.sites.placement.sites import CountGroup, SiteSelection

SITES = 8


def selection(seed=0, kind="range", names=None, **asked):
    """Return what is asked of eight sites and three places in the plane."""
    rng = np.random.default_rng(seed)
    stations, places = rng.uniform(-30.0, 30.0, (SITES, 2)), rng.uniform(-40.0, 40.0, (3, 2))
    problem = assemble(stations, measured(kind, a=np.arange(SITES), sigma=0.3))
    return SiteSelection(problem, places, **asked)


def at_most(count, *numbers):
    return CountGroup(tuple(f"S{i}" for i in numbers), most=count)


def at_least(count, *numbers):
    return CountGroup(tuple(f"S{i}" for i in numbers), least=count)


@pytest.mark.parametrize(
    ("choose", "groups", "kept", "said"),
    [
        (7, (at_most(1, 0, 5, 6, 7),), (), r"7 sites are wanted, but the groups allow at most 5 .*S0, S5, S6, S7"),
        (6, (at_most(1, 0, 1, 2), at_most(1, 2, 3, 4)), (), "6 sites are wanted, but the groups allow at most 5"),
        (8, tuple(at_most(1, 0, i) for i in range(1, 8)), (), "8 sites are wanted, but the groups allow at most 7"),
        (5, (at_most(1, 0, 5, 6, 7),), ("S0",), "5 sites are wanted, but the groups allow at most 4"),
        (3, (at_least(2, 0, 1), at_least(2, 2, 3)), (), "3 sites are wanted, but the groups need at least 4"),
        (4, (at_least(3, 0, 1),), (), "at least 3 of S0, S1 are wanted, but only 2 of them can be taken"),
        (2, (at_most(1, 0, 5),), ("S0", "S5"), "at most 1 of S0, S5 may be taken, but 2 of them are kept"),
        (4, (at_least(2, 0, 1), at_most(0, 1, 2)), (), "no set of sites meets the rules of groups 1, 2 together"),
    ],
)
def test_a_number_that_groups_do_not_allow_is_refused(choose, groups, kept, said):
    with pytest.raises(InvalidProblem, match=said):
        place(selection(choose=choose, groups=groups, kept=kept))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("choose", "groups"),
    [
        (5, (at_most(1, 0, 5, 6, 7),)),
        # a site that rules out all others is never among seven, however much it says
        (7, tuple(at_most(1, 0, i) for i in range(1, 8))),
        (4, (at_most(2, 0, 1, 2, 3), at_least(1, 4, 5))),
    ],
)
def test_as_many_as_were_asked_for_are_taken(seed, choose, groups):
    found = place(selection(seed, choose=choose, groups=groups))
    assert len(found.chosen) == choose
    assert found.closed
    for group in groups:
        count = len(set(group.members) & set(found.chosen))
        assert count <= (SITES if group.most is None else group.most)
        assert count >= (group.least or 0)


def test_a_budget_that_pays_for_fewer_is_told():
    found = place(selection(choose=7, budget=3.0, cost=np.ones(SITES), groups=(at_most(1, 0, 5),)))
    assert len(found.chosen) == 3
    assert "only 3 of the 7 wanted sites" in found.reason
    assert "wanted" not in place(selection(budget=3.0, cost=np.ones(SITES))).reason
