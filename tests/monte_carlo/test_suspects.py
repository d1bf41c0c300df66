"""Explanations are those that an independent search of all sets of stations finds, and clean data accuse nobody."""

from dataclasses import dataclass
from itertools import combinations
from zlib import crc32

import numpy as np
import pytest
from monte_carlo.layouts import SEED, anywhere, inside
from monte_carlo.reference import Model, global_minimum
from monte_carlo.tables import ledger
from often import few
from robust_cases import solve_apart
from scipy.stats import binom, chi2

from optloc import Fix, Problem, Status, assemble, crlb, measured, solve

SIGMA = 10.0
# As the definition has them: the price of a row, the gap, the probability at which a rest is refuted.
PRICE, GAP, REFUTED = 16.0, 9.0, 1e-4
# Scores that differ from the gap by less may fall on either side of it.
EDGE = 1e-3
DEFAULT, FULL, CLEAN = 8, 500, 5000
HEADER = [
    "stations, bad, error",
    "same list",
    "one place",
    "of these named",
    "several, the truth among them",
    "several, without the truth",
    "none",
    "ok",
    "ok, wrong",
]
CASES = {f"{s}, {bad}, {size} sigma": (s, bad, size) for s, bad in ((6, 1), (8, 2)) for size in (10, 30, 100, 1000)}
CLEAN_HEADER = ["stations", "named in an ok fix", "listed", "contradictory", "RMSE / bound"]
_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)]) * [5e3, 5e3, 3e3]
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [5e3, 5e3, 3e3]
REGULAR = {"6, octahedron": _OCTAHEDRON, "8, corners of the box": _CORNERS}
EMITTER = np.array([1e3, 2e3, 1e3])


@pytest.fixture(scope="module")
def book():
    with ledger("suspects", HEADER, list(CASES), f"seed {SEED}, {FULL} trials a case") as made:
        yield made


@pytest.fixture(scope="module")
def clean_book():
    with ledger("suspects_clean", CLEAN_HEADER, list(REGULAR), f"seed {SEED}, {CLEAN} trials a layout") as made:
        yield made


@dataclass(frozen=True)
class Trials:
    """Arrival times (N, s) at stations (N, s, 3), of which those of `bad` (N, q) are wrong."""

    stations: np.ndarray
    arrival: np.ndarray
    truth: np.ndarray
    bad: np.ndarray
    seed: np.random.SeedSequence

    @property
    def problem(self) -> Problem:
        """Return the differences to the first station, with the noise that arrivals have."""
        a = np.arange(1, self.arrival.shape[1])
        z = self.arrival[:, 1:] - self.arrival[:, :1]
        return assemble(self.stations[:, None], measured("tdoa", z, a=a, b=0 * a, arrival_sigma=SIGMA))


def drawn(name: str, s: int, bad: int, size: float, count: int) -> Trials:
    seed = np.random.SeedSequence([SEED, crc32(name.encode())])
    draw, search = seed.spawn(2)
    rng = np.random.default_rng(draw)
    stations, truth = anywhere(s, rng, count), inside(rng, count)
    arrival = np.linalg.norm(stations - truth[:, None], axis=-1) + SIGMA * rng.standard_normal((count, s))
    who = np.argsort(rng.random((count, s)), axis=1)[:, :bad]
    np.put_along_axis(
        arrival, who, np.take_along_axis(arrival, who, 1) + SIGMA * size * rng.choice([-1.0, 1.0], who.shape), 1
    )
    return Trials(stations, arrival, truth, who, search)


def scores(run: Trials) -> dict[frozenset[int], np.ndarray]:
    """Return the scores (N,) of all sets of stations that leave redundancy, infinite where the rest is refuted."""
    out, s = {}, run.arrival.shape[1]
    for size in range(s - 4):
        for left in combinations(range(s), size):
            kept = [i for i in range(s) if i not in left]
            k = len(kept)
            white = (np.eye(k) - 1.0 / k) / SIGMA  # least squares over the time of emission takes the mean off
            own = Model(run.stations[:, kept], np.eye(k), white)
            cost = global_minimum(own, run.arrival[:, kept], run.truth, run.seed, spread=12).cost
            out[frozenset(left)] = np.where(cost <= chi2.isf(REFUTED, k - 4), cost + PRICE * size, np.inf)
    return out


def expected(score: dict[frozenset[int], np.ndarray], i: int) -> tuple[set[frozenset[int]], set[frozenset[int]]]:
    """Return the sets that must be listed for a trial, and those that may be: near the gap either is right."""
    own = {left: float(values[i]) for left, values in score.items()}
    least = min(own.values())
    if not np.isfinite(least):
        return set(), set()
    must = {left for left, value in own.items() if value <= least + GAP - EDGE}
    return must, {left for left, value in own.items() if value <= least + GAP + EDGE}


def sets(fix: Fix, i: int) -> list[frozenset[int]]:
    """Return the stations of each explanation of one fix."""
    return [frozenset(int(name.removeprefix("station S")) for name in one.names) for one in fix.explanations[i]]


@dataclass(frozen=True)
class Counts:
    """What became of N trials: sums of them, see `HEADER`."""

    same: int
    alone: int
    named: int
    listed: int
    missed: int
    none: int
    ok: int
    wrong: int


def counted(run: Trials, fix: Fix) -> Counts:
    """Return the counts of trials; what explains the data is found by brute force, apart from the package."""
    score, count = scores(run), dict.fromkeys(Counts.__dataclass_fields__, 0)
    for i, bad in enumerate(run.bad):
        true, found = frozenset(bad.tolist()), sets(fix, i)
        must, may = expected(score, i)
        if found or fix.code[i] == Status.CONTRADICTORY:
            count["same"] += must <= set(found) <= may
        else:  # the fix of all data stands: others may come near, but at the same place
            count["same"] += frozenset() in may and min(must, key=lambda left: score[left][i]) == frozenset()
        several = fix.code[i] == Status.AMBIGUOUS and len(found) > 1
        count["none"] += fix.code[i] == Status.CONTRADICTORY
        count["listed"] += several and true in found
        count["missed"] += several and true not in found
        count["alone"] += not several and fix.code[i] != Status.CONTRADICTORY
        count["named"] += not several and bool(found) and found[0] == true
        if fix.code[i] == Status.OK:
            count["ok"] += 1
            count["wrong"] += not fix[i].covers(run.truth[i], 0.9999)
    return Counts(**{key: int(value) for key, value in count.items()})


def check(name: str, count: int) -> Counts:
    s, bad, size = CASES[name]
    run = drawn(name, s, bad, size, count)
    found = counted(run, solve_apart(run.problem))
    assert found.same >= 0.99 * count
    return found


@pytest.mark.parametrize("name", few(["6, 1, 10 sigma", "6, 1, 1000 sigma", "8, 2, 30 sigma"], 2))
def test_explanations_are_all_that_come_near(name):
    check(name, DEFAULT)


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_explanations_are_all_that_come_near_in_full(name, book):
    made = check(name, FULL)
    book.add(name, *(getattr(made, field) for field in Counts.__dataclass_fields__))


def clean(name: str, count: int):
    """Return the fixes of clean data of a regular layout, asked for suspects, and their errors over the bound."""
    stations = REGULAR[name]
    a = np.arange(1, len(stations))
    rng = np.random.default_rng(np.random.SeedSequence([SEED, crc32(name.encode())]))
    arrival = np.linalg.norm(stations - EMITTER, axis=-1) + SIGMA * rng.standard_normal((count, len(stations)))
    rows = measured("tdoa", arrival[:, 1:] - arrival[:, :1], a=a, b=0 * a, arrival_sigma=SIGMA)
    problem = assemble(stations, rows)
    fix = solve(problem, "robust")
    bound = np.sqrt(np.trace(crlb(problem, np.broadcast_to(EMITTER, (count, 3)))[0]))
    return fix, float(np.sqrt(((fix.position - EMITTER) ** 2).sum(1).mean()) / bound)


def accused(fix: Fix) -> tuple[int, int, int]:
    """Return how often someone was named by an ok fix, someone was listed at all, and nobody explained it."""
    listed = np.array([any(one.names for one in found) for found in fix.explanations])
    named = np.array([bool(found and found[0].names) for found in fix.explanations]) & (fix.code == Status.OK)
    return int(named.sum()), int(listed.sum()), int((fix.code == Status.CONTRADICTORY).sum())


@pytest.mark.parametrize("name", REGULAR)
def test_clean_data_accuse_nobody(name):
    fix, ratio = clean(name, 200)
    named, listed, contradictory = accused(fix)
    assert named <= binom.isf(1e-4, 200, 0.01)
    assert listed <= binom.isf(1e-4, 200, 0.03)
    assert contradictory <= 1
    assert ratio == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 200))


@pytest.mark.full
@pytest.mark.parametrize("name", REGULAR)
def test_clean_data_accuse_nobody_in_full(name, clean_book):
    fix, ratio = clean(name, CLEAN)
    named, listed, contradictory = accused(fix)
    clean_book.add(name, named, listed, contradictory, f"{ratio:.3f}")
    assert named < 0.01 * CLEAN
    assert listed < 0.03 * CLEAN
    assert contradictory <= binom.isf(1e-3, CLEAN, 2e-4)
    assert ratio == pytest.approx(1.0, abs=0.05)
