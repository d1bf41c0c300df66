"""What `robust` says where stations lie: counted over kinds, stations, liars and sizes, and what is wrong but ok."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
import pytest
from monte_carlo.tables import ledger
from robust_cases import MILLIRADIANS, SIGMA, Spoilt, solve_apart, spoilt
from scipy.stats import beta, binom, chi2, ncx2, poisson
from verdict.test_gate import digest

from optloc import Fix, Status, solve
from optloc.kernels.least_squares import refine
from optloc.model_checks import reliability
from optloc.model_checks.groups import ROW_PRICE as PRICE
from optloc.solvers.policy import AMBIGUOUS_GAP

DEFAULT, FULL, MANY = 100, 200, 2000
DIMENSION = {"tdoa": 3, "toa": 3, "range": 3, "azimuth": 2}
SIZES = (3, 10, 30, 100, 10_000)


@dataclass(frozen=True)
class Cell:
    """Stations, liars and their errors in sigma; all other errors are `noise` times as large as is stated."""

    kind: str
    dimension: int
    stations: int
    bad: int
    size: float
    noise: float = 1.0

    @property
    def name(self) -> str:
        liars = f"{self.bad} of {self.size:g} sigma" if self.bad else "none"
        noise = f", noise x {self.noise:g}" if self.noise != 1.0 else ""
        return f"{self.kind} {self.dimension}-D, {self.stations} stations, {liars}{noise}"

    def drawn(self, trials: int) -> Spoilt:
        given = {"bad": self.bad, "size": self.size, "dimension": self.dimension, "noise": self.noise}
        return spoilt(self.kind, trials, self.stations, seed=20261122, **given)


# What is promised of a cell: shares of wrong but ok, and of ok, of 2 000 trials.
WRONG = {
    **{Cell("toa", 3, 6, 2, size): 0.004 for size in (100, 1000, 10_000)},
    **{Cell("toa", 3, 8, 1, size): 0.002 for size in (30, 100, 10_000)},
}
RIGHT = {
    **{Cell(kind, 3, 8, 1, size): 0.95 for kind in ("toa", "range") for size in (100, 10_000)},
    **{Cell(kind, d, 8, 2, size): 0.95 for kind, d in (("toa", 2), ("range", 3)) for size in (100, 10_000)},
}
# Of these the definition of `ok` was tried on first, with these shares of wrong but ok among 100.
TRIED = {
    Cell("toa", 3, 6, 1, 30): 0.03,
    Cell("toa", 3, 7, 1, 30): 0.01,
    Cell("toa", 3, 8, 1, 10): 0.04,
    Cell("tdoa", 2, 5, 1, 30): 0.02,
    Cell("tdoa", 2, 6, 2, 100): 0.04,
    Cell("toa", 3, 5, 1, 100): 0.07,
}
GRID = [
    Cell(kind, d, s, bad, size)
    for (kind, d), s in product(DIMENSION.items(), (5, 6, 8, 12))
    for bad, size in [(0, 0), *product((1, 2, 3), SIZES)]
]
LOUD = [
    Cell(kind, d, s, bad, size, 2.0)
    for (kind, d), s, (bad, size) in product(DIMENSION.items(), (5, 6, 8, 12), ((0, 0), (1, 100)))
]
CELLS = list(dict.fromkeys([*WRONG, *RIGHT, *TRIED, Cell("toa", 3, 8, 2, 100), *GRID, *LOUD]))
PROMISED = {*WRONG, *RIGHT, *TRIED, Cell("toa", 3, 8, 2, 100)}
HEADER = [
    "rows, stations, wrong stations",
    "trials",
    "ok",
    "ok, wrong",
    "of these named",
    "listed with the truth",
    "listed without the truth",
    "unproven",
    "contradictory",
    "others",
    "expected undetected",
    "median error of ok, m",
    "cauchy, the same trials",
    "good rows from the truth",
]


@pytest.fixture(scope="module")
def book():
    facts = f"{FULL} trials a case, {MANY} for promised cases, each problem fixed separately (`test_liars.py`)"
    with ledger("robust", HEADER, [cell.name for cell in CELLS], facts) as made:
        yield made


@dataclass(frozen=True)
class Counts:
    """What became of trials, see `HEADER`."""

    ok: int
    wrong: int
    named: int
    listed: int
    unlisted: int
    unproven: int
    contradictory: int
    others: int


def squared(fix: Fix, case: Spoilt) -> np.ndarray:
    """Return squared errors (N,) of positions in their own covariance; NaN where there is none."""
    d = fix.position.shape[-1]
    out, known = np.full(len(fix.x), np.nan), np.isfinite(fix.covariance()).all((-1, -2))
    error = (fix.position - case.truth[:, :d])[known]
    out[known] = (error * np.linalg.solve(fix.covariance()[known], error[..., None])[..., 0]).sum(-1)
    return out


def culprits(case: Spoilt, fix: Fix) -> np.ndarray:
    """Return whether the stations that lie, all of them and nobody else, are one of the explanations, (N,)."""
    names = [frozenset(f"S{j}" for j in np.flatnonzero(own)) for own in case.wrong]
    told = ([frozenset(name.rpartition(" ")[2] for name in one.names) for one in found] for found in fix.explanations)
    return np.array([own in found for own, found in zip(names, told, strict=True)])


def counted(case: Spoilt, fix: Fix) -> Counts:
    ok, d = fix.code == Status.OK, fix.position.shape[-1]
    wrong = ok & ~(squared(fix, case) <= chi2.isf(1e-4, d))
    named = np.array([bool(found) for found in fix.suspects])
    several, right = fix.code == Status.AMBIGUOUS, culprits(case, fix)
    kinds = [fix.code == status for status in (Status.UNPROVEN, Status.CONTRADICTORY)]
    others = ~(ok | several | kinds[0] | kinds[1])
    parts = (ok, wrong, wrong & named, several & right, several & ~right, *kinds, others)
    return Counts(*(int(part.sum()) for part in parts))


def noncentrality(case: Spoilt, cell: Cell) -> np.ndarray:
    """Return e'Q e (N,) of the errors of the liars: by how much they raise the expected cost, to first order.

    Q is what is left of the precision of arrivals once position and emission time have followed, from derivatives by
    hand.
    """
    d = cell.dimension
    apart = case.truth[:, None, :d] - case.problem.stations.position[:, 0]
    r = np.linalg.norm(apart, axis=-1, keepdims=True)
    if cell.kind == "azimuth":
        design = np.stack([-apart[..., 1], apart[..., 0]], axis=-1) / r**2 / MILLIRADIANS
    else:
        design = apart / r / SIGMA
    if cell.kind in ("toa", "tdoa"):
        design = np.concatenate([design, np.ones_like(r)], axis=-1)
    error = case.error[..., None]
    left = error - _project(design, error)
    return (left[..., 0] ** 2).sum(-1)


def _project(design: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the part (N, s, 1) of errors that unknowns take up."""
    basis, _ = np.linalg.qr(design)
    return basis @ (np.swapaxes(basis, -1, -2) @ error)


def unnoticed(case: Spoilt, cell: Cell) -> float:
    """Return how many trials are expected in which the liars hide: leaving them out does not pay its price."""
    if not cell.bad:
        return 0.0
    return float(ncx2.cdf(PRICE * cell.bad - AMBIGUOUS_GAP, cell.bad, noncentrality(case, cell)).sum())


def check(cell: Cell, trials: int) -> tuple[Counts, Spoilt, Fix]:
    """Return the counts of trials; nobody is named by an ok fix that has too little redundancy for it."""
    case = cell.drawn(trials)
    fix = solve_apart(case.problem)
    made = counted(case, fix)
    left = np.array([sum(len(one.rows) > 0 for one in found) for found in fix.suspects])
    assert (fix.dof[(fix.code == Status.OK) & (left > 0)] >= left[(fix.code == Status.OK) & (left > 0)] + 1).all()
    if cell in WRONG:
        assert trials < MANY or made.wrong <= binom.isf(0.01, trials, WRONG[cell])
        # all of these are errors that the geometry cannot see: their number is that which reliability expects
        assert made.wrong <= poisson.isf(1e-4, unnoticed(case, cell))
    if cell in RIGHT:
        assert made.ok >= binom.ppf(1e-4 if trials < MANY else 0.01, trials, RIGHT[cell])
    if cell in TRIED:  # its share is known from a hundred trials alone
        assert made.wrong <= binom.isf(1e-3, trials, binom_upper(TRIED[cell], 100))
    return made, case, fix


def binom_upper(share: float, trials: int) -> float:
    """Return the greatest share of which so few in so many are seen in one case of forty (Clopper, Pearson 1934)."""
    return float(beta.ppf(0.975, share * trials + 1, trials - share * trials))


@pytest.mark.parametrize(
    "cell",
    [Cell("toa", 3, 6, 2, 100), Cell("toa", 3, 8, 1, 30), Cell("toa", 2, 8, 2, 100), Cell("tdoa", 2, 6, 2, 100)],
    ids=lambda cell: cell.name,
)
def test_what_liars_do(cell):
    check(cell, DEFAULT)


def test_two_liars_of_eight_arrivals_are_never_ok_with_a_culprit():
    trials = 40
    made, _, fix = check(Cell("toa", 3, 8, 2, 100), trials)
    named = np.array([bool(found) for found in fix.suspects])
    assert not (named & (fix.code == Status.OK)).any()
    assert made.listed + made.unproven >= 0.9 * trials


def test_reliability_figures_are_the_noncentrality_of_an_error():
    cell = Cell("toa", 3, 8, 1, 30)
    case = cell.drawn(20)
    for i, size in enumerate(noncentrality(case, cell)):
        told = reliability(case.problem.take(np.array([i])), case.truth[i])
        share = SIGMA * cell.size / told.least[np.flatnonzero(case.wrong[i])[0]]
        # of the least size one in twenty stays below what is noticed
        assert ncx2.cdf(PRICE - AMBIGUOUS_GAP, 1, size / share**2) == pytest.approx(0.05, rel=0.01)


@pytest.mark.full
@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.name)
def test_what_liars_do_in_full(cell, book, pytestconfig):
    """Cells are stored as they are done: a run that was stopped goes on where it was."""
    stored = pytestconfig.cache.get(f"optloc/liars/{cell.name}", {})
    if stored.get("code") != digest():
        stored = {"code": digest(), "row": row(cell, MANY if cell in PROMISED else FULL)}
        pytestconfig.cache.set(f"optloc/liars/{cell.name}", stored)
    book.add(cell.name, *stored["row"])


def row(cell: Cell, trials: int) -> list[str]:
    """Return the cells of the table."""
    made, case, fix = check(cell, trials)
    ok, d = fix.code == Status.OK, cell.dimension
    # differences to the first station are the same arrivals, and of these a liar is one
    arrivals = replace(cell, kind="toa").drawn(trials) if cell.kind == "tdoa" else case
    good = arrivals.problem.with_rows(weight=np.where(arrivals.wrong, 0.0, 1.0))
    places = fix.position, solve(case.problem, "cauchy").position, refine(good, arrivals.truth).x[:, :d]
    hidden = f"{unnoticed(case, cell):.1f}" if cell.bad and cell.noise == 1.0 else ""
    told = (_median(place[ok], case.truth[ok, :d]) for place in places)
    return [str(one) for one in (trials, *(getattr(made, one.name) for one in fields(made)), hidden, *told)]


def _median(place: np.ndarray, truth: np.ndarray) -> str:
    return f"{np.median(np.linalg.norm(place - truth, axis=1)):.1f}" if len(truth) else "-"
