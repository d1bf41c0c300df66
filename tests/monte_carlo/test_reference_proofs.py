"""Lower bounds by relaxations beside branch and bound and the best of many starts, on the same fixes."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pytest
from monte_carlo.layouts import SEED
from monte_carlo.tables import ledger
from monte_carlo.trials import automatic, outcome, trials

import optloc
from optloc import Fix
from optloc.solvers.certificates.relaxations import Reference, reference_bound

DEFAULT, FULL = 6, 100
SLACK = 1e-6
CASES = {
    "TDOA, 5 stations, inside, 1 m": "moment",
    "TDOA, 5 stations, inside, 30 m": "moment",
    "TDOA, 5 stations, outside, 1 m": "moment",
    "TDOA, 5 stations, outside, 30 m": "moment",
    "TDOA, 6 stations, inside, 30 m": "moment",
    "TDOA, 6 stations, outside, 1 m": "moment",
    "TDOA, 6 stations, outside, 30 m": "moment",
    "planar TDOA, 3 targets, 10 ns": "moment",
    "planar TDOA, random, 1000 ns": "moment",
    "range, 5 stations, outside, 30 m": "moment",
    "TOA, 6 stations, outside, 30 m": "moment",
    "range sum, 6 stations, outside, 30 m": "moment",
    "azimuth and elevation, 4 stations, inside, 5 mrad": "directions",
    "azimuth and elevation, 4 stations, outside, 20 mrad": "directions",
    "azimuth and elevation, 4 stations, outside, 50 mrad": "directions",
}
DAILY = [name for name in CASES if "1000 ns" in name or "5 stations, outside, 30 m" in name or "20 mrad" in name]
HEADER = [
    "case",
    "relaxation",
    "bounded",
    "tight",
    "median gap",
    "largest gap",
    "above the best of 21 starts",
    "ms a fix",
    "branch and bound: global",
    "both",
    "neither",
    "disagree",
    "ms a fix ",
]


@dataclass(frozen=True)
class Compared:
    """Two proofs of the same fixes."""

    fix: Fix
    found: Reference
    best: np.ndarray
    proven: np.ndarray
    milliseconds: tuple[float, float]

    @property
    def tight(self) -> np.ndarray:
        return (self.found.scope == "global") & self.found.tight(self.fix.cost)

    @property
    def gap(self) -> np.ndarray:
        return (self.fix.cost - self.found.bound)[self.found.scope == "global"]

    @property
    def above(self) -> int:
        """Bounds above a cost that some point has: there must be none."""
        with np.errstate(invalid="ignore"):
            return int((self.found.bound > self.best + SLACK * (1.0 + self.best)).sum())

    @property
    def disagree(self) -> int:
        """Fixes that one proof calls global while the other bounds the cost below them with a better point known."""
        beaten = self.fix.cost > self.best + SLACK * (1.0 + self.best)
        return int(((self.tight | self.proven) & beaten).sum())


def compared(name: str, count: int) -> Compared:
    run, fix = trials(name, count), automatic(name, count)
    reference_bound(run.problem.take(np.arange(1)), fix[np.arange(1)], CASES[name])  # built before the clock runs
    began = perf_counter()
    found = reference_bound(run.problem, fix, CASES[name])
    middle = perf_counter()
    certified = optloc.certify(run.problem, fix, margin=0.0)
    end = perf_counter()
    same = np.abs(certified.cost - fix.cost) <= SLACK * (1.0 + fix.cost)
    proven = same & np.array([certificate.proof == "global" for certificate in certified.certificate])
    times = (1e3 * (middle - began) / count, 1e3 * (end - middle) / count)
    # costs of the reference's own code: its best point, or ours where that is lower
    own = run.model.cost(fix.x[:, : run.truth.shape[1]], run.z)
    best = np.fmin(run.best.infimum, own)
    settled = outcome(run, fix).reached
    assert np.allclose(own[settled], fix.cost[settled], rtol=1e-6, atol=1e-6)
    return Compared(fix, found, best, proven, times)


def judge(seen: Compared) -> None:
    assert seen.above == 0
    assert seen.disagree == 0
    assert (seen.gap >= -SLACK * (1.0 + np.nan_to_num(seen.fix.cost).max())).all()


@pytest.mark.parametrize("name", DAILY)
def test_no_bound_exceeds_the_cost_of_any_point(name):
    judge(compared(name, DEFAULT))


@pytest.fixture(scope="module")
def book():
    facts = f"seed {SEED}, {FULL} trials a case; bounds of the maximum-likelihood cost over all positions"
    with ledger("reference_proofs", HEADER, list(CASES), facts) as made:
        yield made


@pytest.mark.full
@pytest.mark.parametrize("name", list(CASES))
def test_relaxations_and_branch_and_bound_in_full(name, book):
    seen = compared(name, FULL)
    judge(seen)
    tight, proven, (one, two) = seen.tight, seen.proven, seen.milliseconds
    bounded = int((seen.found.scope == "global").sum())
    gap = seen.gap if len(seen.gap) else np.array([np.nan])
    book.add(
        name,
        CASES[name],
        bounded,
        int(tight.sum()),
        f"{np.median(gap):.1e}",
        f"{gap.max():.2g}",
        seen.above,
        f"{one:.0f}",
        int(proven.sum()),
        int((tight & proven).sum()),
        int((~tight & ~proven).sum()),
        seen.disagree,
        f"{two:.2f}",
    )
