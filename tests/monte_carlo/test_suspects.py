"""Bad stations are named where the data allow only one explanation, and listed among all of them elsewhere."""

from dataclasses import dataclass
from itertools import combinations
from zlib import crc32

import numpy as np
import pytest
from monte_carlo.layouts import SEED, anywhere, inside
from monte_carlo.reference import Model, global_minimum
from monte_carlo.tables import ledger
from scipy.stats import binom, chi2

from optloc import Fix, Problem, Status, assemble, crlb, measured, solve

SIGMA, TEST = 10.0, 0.01
DEFAULT, FULL, CLEAN = 30, 500, 5000
HEADER = [
    "stations, bad, error",
    "not noticed",
    "one explanation",
    "named",
    "several",
    "all listed",
    "fewer would do",
    "truth fails the test",
    "claimed wrongly",
]
CASES = {f"{s}, {bad}, {size} sigma": (s, bad, size) for s, bad in ((6, 1), (8, 2)) for size in (10, 30, 100, 1000)}
CLEAN_HEADER = ["stations", "accused", "several accused", "contradictory", "RMSE / bound"]
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


def passing(run: Trials, size: int) -> dict[tuple[int, ...], np.ndarray]:
    """Return for every set of stations in which trials (N,) the rest passes the test: brute force, from many places."""
    out, s = {}, run.arrival.shape[1]
    for left in combinations(range(s), size):
        kept = [i for i in range(s) if i not in left]
        k = len(kept)
        white = (np.eye(k) - 1.0 / k) / SIGMA  # least squares over the time of emission takes the mean off
        own = Model(run.stations[:, kept], np.eye(k), white)
        best = global_minimum(own, run.arrival[:, kept], run.truth, run.seed, spread=12)
        out[left] = best.cost <= chi2.isf(TEST, k - 4)  # a rest that fits at infinity only has no position
    return out


def sets(fix: Fix, i: int) -> list[frozenset[int]]:
    """Return the stations of each explanation of one fix."""
    return [frozenset(int(name.removeprefix("station S")) for name in one.names) for one in fix.explanations[i]]


@dataclass(frozen=True)
class Counts:
    """What became of N trials: sums of them, see `HEADER`."""

    unnoticed: int
    clear: int
    named: int
    several: int
    listed: int
    fewer: int
    refused: int
    wrong: int


def counted(run: Trials, fix: Fix) -> Counts:
    """Return the counts of trials; what explains the data is found by brute force, apart from the package."""
    size = run.bad.shape[1]
    allowed = [passing(run, q) for q in range(size + 1)]
    count = dict.fromkeys(Counts.__dataclass_fields__, 0)
    for i, bad in enumerate(run.bad):
        true, found = frozenset(bad.tolist()), sets(fix, i)
        smaller = any(ok[i] for q in range(1, size) for ok in allowed[q].values())
        rivals = [left for left, ok in allowed[size].items() if ok[i]]
        right = tuple(sorted(true)) in rivals
        if allowed[0][()][i]:
            count["unnoticed"] += 1
        elif smaller:
            count["fewer"] += 1
        elif not right:
            count["refused"] += 1
            count["wrong"] += int(fix.code[i] == Status.OK and not any(true <= one for one in found))
        elif len(rivals) == 1:
            count["clear"] += 1
            count["named"] += found == [true]
            count["wrong"] += int(fix.code[i] == Status.OK and found != [true])
        else:
            count["several"] += 1
            count["listed"] += set(found) >= {frozenset(left) for left in rivals}
            count["wrong"] += int(fix.code[i] == Status.OK)
    return Counts(**count)


def check(name: str, count: int) -> Counts:
    s, bad, size = CASES[name]
    run = drawn(name, s, bad, size, count)
    found = counted(run, solve(run.problem, "robust"))
    assert found.named >= 0.99 * found.clear
    assert found.listed >= 0.99 * found.several
    assert found.wrong <= 0.01 * count
    assert sum((found.unnoticed, found.clear, found.several, found.fewer, found.refused)) == count
    return found


@pytest.mark.parametrize("name", ["6, 1, 10 sigma", "6, 1, 1000 sigma", "8, 2, 30 sigma"])
def test_bad_stations_are_named(name):
    assert check(name, DEFAULT).clear


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_bad_stations_are_named_in_full(name, book):
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
    """Return how often someone was named, several were listed, and nobody explained it."""
    number = np.array([len(found) for found in fix.explanations])
    return int((number == 1).sum()), int((number > 1).sum()), int((fix.code == Status.CONTRADICTORY).sum())


@pytest.mark.parametrize("name", REGULAR)
def test_clean_data_accuse_nobody(name):
    fix, ratio = clean(name, 200)
    assert sum(accused(fix)) <= binom.isf(1e-4, 200, TEST)
    assert ratio == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 200))


@pytest.mark.full
@pytest.mark.parametrize("name", REGULAR)
def test_clean_data_accuse_nobody_in_full(name, clean_book):
    fix, ratio = clean(name, CLEAN)
    named, several, contradictory = accused(fix)
    clean_book.add(name, named, several, contradictory, f"{ratio:.3f}")
    assert named < 0.01 * CLEAN
    assert named + several + contradictory <= binom.isf(1e-3, CLEAN, TEST)
    assert ratio == pytest.approx(1.0, abs=0.05)
