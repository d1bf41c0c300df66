"""Without a guess, every fix ends in the global maximum-likelihood minimum, or says that it does not know."""

import numpy as np
import pytest
from monte_carlo.layouts import DAILY, NAMES, SEED
from monte_carlo.tables import ledger
from monte_carlo.trials import automatic, outcome, trials

from optloc import Status

DEFAULT, FULL = 60, 2000
HEADER = [
    "case",
    "reached",
    "listed",
    "reported",
    "missed, not reported",
    "no minimum, reported",
    "no minimum, not reported",
    "ambiguous",
    "reference beaten",
]


@pytest.fixture(scope="module")
def book():
    facts = f"seed {SEED}, {FULL} trials a case, reference: best of 21 starts a trial"
    with ledger("global", HEADER, NAMES, facts) as made:
        yield made


def check(name: str, count: int):
    """Return counts of one case after judging them."""
    run, fix = trials(name, count), automatic(name, count)
    found = outcome(run, fix)
    parts = (found.reached, found.listed, found.declined, found.silent, found.endless, found.claimed)
    counts = [int(part.sum()) for part in parts]
    assert sum(counts) == count
    return counts, [int(fix.has(Status.AMBIGUOUS).sum()), int(found.lower.sum())], found


def judge(name: str, counts: list[int], found) -> None:
    reached, listed, declined, silent, endless, claimed = counts
    total = sum(counts)
    where = {key: np.flatnonzero(getattr(found, key)).tolist() for key in ("declined", "silent", "claimed")}
    message = f"{name}: {reached} of {total} reached, {listed} listed, {endless} without a minimum; {where}"
    assert declined == silent == claimed == 0, message
    assert listed <= 0.002 * total, message


@pytest.mark.parametrize("name", DAILY)
def test_every_fix_is_the_global_minimum(name, record_property):
    counts, _, found = check(name, DEFAULT)
    record_property("reached", f"{counts[0]} of {DEFAULT}")
    judge(name, counts, found)


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_every_fix_is_the_global_minimum_in_full(name, book):
    counts, more, found = check(name, FULL)
    book.add(name, *counts, *more)
    judge(name, counts, found)
