"""Rows of several emitters: the assignment against brute force, the truth, and the number of emitters."""

from collections import Counter
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pytest
from monte_carlo.tables import ledger
from multi_target.brute import every_set, grown_sets, packed, true_sets
from multi_target.scenes import EVERY, STAR, drawn
from often import few

from optloc import Status
from optloc.multi_target import separate

FULL, SEED = 500, 20_000
SAME = 1e-3


@dataclass(frozen=True)
class Case:
    name: str
    emitters: int
    scene: dict
    brute: object
    default: int


PLANAR, ANGLES, SPACE = (
    {"channels": STAR},
    {"kind": "azimuth", "channels": [0, 1, 2, 3, 4]},
    {"d": 3, "channels": EVERY},
)
CASES = {
    case.name: case
    for case in (
        Case("planar, 5 differences, 2 emitters", 2, PLANAR, every_set, 2),
        Case("planar, 5 differences, 3 emitters", 3, PLANAR, every_set, 2),
        Case("planar, 5 azimuths, 2 emitters", 2, ANGLES, every_set, 2),
        Case("planar, 5 azimuths, 3 emitters", 3, ANGLES, every_set, 2),
        Case("space, 15 differences, 2 emitters", 2, SPACE, grown_sets, 1),
        Case("space, 15 differences, 3 emitters", 3, SPACE, grown_sets, 1),
    )
}
HEADER = (
    "6 stations, detection 0.9, 1 false row a channel",
    "trials",
    "same as brute force",
    "cheaper",
    "more expensive",
    "truth cheaper than optloc",
    "bound above brute force",
    "gap above 2",
    "emitters too few",
    "too many",
    "wrong number, but ok",
    "ms",
    "brute force, ms",
)


def counted(case, trials, seed=SEED):
    """Return counts of what happens in seeded trials."""
    count = Counter()
    for trial in range(trials):
        scene = drawn(seed + trial, case.emitters, **case.scene)
        began = perf_counter()
        (found,) = separate(scene.problem, scene.clutter)
        middle = perf_counter()
        picks, cost = case.brute(scene)
        true_picks, true_cost = true_sets(scene)
        best, sets = packed(np.concatenate([picks, true_picks]), np.concatenate([cost, true_cost]))
        ended = perf_counter()
        ours = {frozenset(found.rows(i).tolist()) for i in range(found.count)}
        count["same"] += ours == sets and abs(found.cost - best) < SAME
        count["cheaper"] += found.cost < best - SAME
        count["dearer"] += found.cost > best + SAME
        count["truth"] += found.cost > true_cost.sum() + SAME
        count["bound"] += found.bound > best + SAME
        count["open"] += found.gap > 2.0
        count["few"] += found.count < case.emitters
        count["many"] += found.count > case.emitters
        count["unseen"] += found.count != case.emitters and found.status == Status.OK
        count["ours ms"] += 1e3 * (middle - began)
        count["brute ms"] += 1e3 * (ended - middle)
    return count


def cells(count, trials):
    """Return the cells of a row of the table."""
    numbers = [count[name] for name in HEADER_COUNTS]
    return (trials, *numbers, *(f"{count[name] / trials:.0f}" for name in ("ours ms", "brute ms")))


HEADER_COUNTS = ("same", "cheaper", "dearer", "truth", "bound", "open", "few", "many", "unseen")


def held(count, trials):
    assert count["same"] > 0.98 * trials
    for name in ("dearer", "truth", "bound"):
        assert count[name] == 0, name
    assert count["open"] <= 0.01 * trials


@pytest.mark.parametrize("name", few(reversed(CASES), 3))
def test_the_assignment_is_the_best_of_all(name):
    held(counted(CASES[name], CASES[name].default), CASES[name].default)


@pytest.fixture(scope="module")
def book():
    with ledger("several", HEADER, list(CASES), f"seeds from {SEED}") as book:
        yield book


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_table(name, book):
    count = counted(CASES[name], FULL)
    book.add(name, *cells(count, FULL))
    held(count, FULL)
