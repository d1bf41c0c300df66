"""Losses counted: gross errors of several sizes, from no guess and from the truth, and what sigma is worth."""

from __future__ import annotations

import numpy as np
import pytest
from monte_carlo.tables import ledger
from often import few
from robust_cases import least_squares, nees, rmse, spoilt
from verdicts import alone

from optloc import solve
from optloc.problem.loss import LOSSES
from optloc.solvers import rejected

DEFAULT, FULL = 40, 400
# Name: kind, stations, wrong rows, their size in sigma, whether they are late.
CASES = {
    f"{kind}, {stations} stations, {label}": (kind, stations, bad, size, late)
    for kind, stations in (("toa", 8), ("range", 8))
    for label, bad, size, late in (
        ("clean", 0, 0.0, False),
        ("1 bad, 10 sigma", 1, 10.0, False),
        ("1 bad, 100 sigma", 1, 100.0, False),
        ("2 bad, 30 sigma", 2, 30.0, False),
        ("2 bad, 1000 sigma", 2, 1000.0, False),
        ("2 late, 30 sigma", 2, 30.0, True),
    )
}
NAMES = [f"{case}, {loss}" for case in CASES for loss in LOSSES]
HEADER = [
    "case, loss",
    "cheaper from the truth",
    "one place",
    "of these beyond 5 sigma",
    "bad rows rejected",
    "good rows rejected",
    "RMSE of these, m",
    "least squares, good rows, m",
    "NEES of these",
]


@pytest.fixture(scope="module")
def book():
    facts = f"{FULL} trials a case (seed 1 of `tests/robust_cases.py`), 10 m a row, emitter in the box of the stations"
    with ledger("losses", HEADER, NAMES, facts) as made:
        yield made


def counted(name: str, loss: str, trials: int) -> tuple[int, int, int, tuple[object, ...]]:
    """Return trials cheaper from the truth, with one place, with one beyond 5 sigma, and the other cells."""
    kind, stations, bad, size, late = CASES[name]
    case = spoilt(kind, trials, stations, bad=bad, size=size, late=late)
    fix, best = solve(case.problem, loss), solve(case.problem, loss, start=case.truth)
    worse = int((~(fix.cost <= best.cost + 1e-3) & np.isfinite(best.cost)).sum())
    ok, lost, own = alone(fix), rejected(case.problem, fix), nees(fix, case.truth)
    good = case.problem.with_rows(weight=np.where(case.wrong, 0.0, 1.0))
    honest = least_squares(type(case)(good, case.truth, case.wrong))
    far = int((3.0 * own[ok] > 25.0).sum())
    cells = (
        f"{100 * lost[ok][case.wrong[ok]].mean():.1f} %" if bad else "",
        f"{100 * lost[ok][~case.wrong[ok]].mean():.1f} %",
        f"{rmse(fix.position[ok], case.truth[ok]):.1f}",
        f"{rmse(honest[ok], case.truth[ok]):.1f}",
        f"{np.mean(own[ok]):.2f}",
    )
    return worse, int(ok.sum()), far, cells


@pytest.mark.parametrize("loss", ["cauchy", "truncated"])
@pytest.mark.parametrize("name", few(["toa, 8 stations, 1 bad, 100 sigma", "range, 8 stations, 2 bad, 1000 sigma"], 1))
def test_the_truth_hardly_ever_finds_better(name, loss):
    worse, ok, far, _ = counted(name, loss, DEFAULT)
    assert worse <= 1
    assert ok >= 0.7 * DEFAULT
    assert far <= 0.03 * DEFAULT


@pytest.mark.full
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("name", CASES)
def test_counts(name, loss, book):
    worse, ok, far, cells = counted(name, loss, FULL)
    book.add(f"{name}, {loss}", worse, ok, far, *cells)
    _, _, bad, size, late = CASES[name]
    # Errors that shorten ranges are none that the one-sided loss knows.
    if late or not bad or loss != "late":
        assert worse <= 0.01 * FULL
    # Small errors hide where the other rows hardly check them; large ones must not.
    if loss in ("cauchy", "truncated") and (not bad or size >= 100.0):
        assert ok >= 0.98 * FULL
        assert far <= 0.005 * FULL
