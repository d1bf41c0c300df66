"""Registration in full: every trial on the optimum next to the truth, errors as large as the bound and no larger."""

from functools import cache

import numpy as np
import pytest
from monte_carlo.counts import Case, Counts, around, counted, expected, judged
from monte_carlo.layouts import SEED
from monte_carlo.tables import ledger
from monte_carlo.test_consistency import band
from runs import run, truth

from optloc import Status
from optloc.lab.papers.registration import PRINTED, RegistrationSetting, rms, truth as printed_truth, wander

FULL, JOINT, GAUSSIAN = 2000, 2000, 500
PRIOR, WIDTH = 200.0, 20.0
TIE, RARE = 1e-3, 2e-3


def table(*cases: Case) -> dict[str, Case]:
    return {case.name: case for case in cases}


LONG = table(
    *(Case(f"600 s, {sigma:g} m", run(600, sigma=sigma)) for sigma in (3.0, 6.0, 9.0, 12.0)),
    Case("600 s, 3 m, stations 5 m", run(600, station=5.0)),
    *(Case(f"700 s, {sigma:g} m", run(700, sigma=sigma)) for sigma in (3.0, 12.0)),
)
SHORT = table(
    *(
        Case(f"{k} s, {sigma:g} m, prior", run(k, sigma=sigma, prior=PRIOR))
        for k in (60, 100, 200, 300)
        for sigma in (3.0, 12.0)
    )
)
MOVING = table(
    *(
        Case(f"moving, {k} s, {sigma:g} m", run(k, sigma=sigma, order=1))
        for k, sigma in [(600, 3.0), (800, 3.0), (600, 12.0)]
    )
)
AROUND = table(
    Case("anywhere, 600 s, 3 m", run(600), around),
    *(Case(f"anywhere, {k} s, 3 m, prior", run(k, prior=PRIOR), around) for k in (200, 100)),
)
RATIOS = table(*(Case(f"gain ratios {gain:g}, 600 s, 3 m", run(600, gain=gain)) for gain in (0.03, 3e-4)))
RECURSION, WITHOUT = "600 s, 3 m: two-step recursion from 20 sigma0", "600 s, 3 m: the same data without a guess"
CASES = {**LONG, **SHORT, **MOVING, **AROUND, **RATIOS}
NAMES = [*CASES, RECURSION, WITHOUT]
HEADER = [
    "case",
    "trials",
    "failures",
    "elsewhere, listed",
    "RMSE, m",
    "expected, m",
    "ratio",
    "NEES / d of the target",
    "NEES / d of the biases",
    "start, m",
    "ms a trial",
]


@pytest.fixture(scope="module")
def book():
    with ledger("registration", HEADER, NAMES, f"seed {SEED}") as made:
        yield made


def wanted(case: Case) -> float:
    """Return the root mean square position error to first order, metres; NaN where each trial has its own truth."""
    return float("nan") if case.truths else rms(expected(case.problem, truth(case.problem)))


def consistency(found: Counts, case: Case) -> list[tuple[float, float, float]]:
    """Return NEES / d of the target and of all families of biases, each with its 99 % band.

    With a prior, errors have the covariance of the fix only if biases are drawn from that prior, and a moving target is
    one of two: none then.
    """
    if case.problem.motions[0].order or any(bias.sigma is not None for bias in case.problem.biases):
        return []
    slots = case.problem.layout.shared
    sizes = (slots[0].size, sum(slot.size for slot in slots[1:]))
    squared = (found.nees[:, 0], found.nees[:, 1:].sum(1))
    return [(v.mean() / d, *band(len(v) * d)) for v, d in zip(squared, sizes, strict=True)]


def cells(found: Counts, bound: float, ratios: list[tuple[float, float, float]]) -> list[str]:
    """Return the cells of one line."""
    elsewhere, listed = int(found.away.sum()), int((found.away & found.listed).sum())
    start = found.start[np.isfinite(found.start)]
    return [
        str(len(found)),
        str(int(found.failed.sum())),
        f"{elsewhere}, {listed}" if elsewhere else "0",
        f"{found.rmse:.2f}",
        f"{bound:.2f}" if np.isfinite(bound) else "",
        f"{found.rmse / bound:.3f}" if np.isfinite(bound) else "",
        *(f"{mean:.3f} ({low:.3f} to {high:.3f})" for mean, low, high in ratios),
        *[""] * (2 - len(ratios)),
        f"{np.median(start):.0f}, at most {start.max():.0f}" if len(start) else "",
        f"{1e3 * found.seconds.mean():.1f}",
    ]


@cache
def measured(name: str, trials: int) -> Counts:
    return counted(CASES[name], trials, starts=True)


def line(name: str, trials: int, book) -> tuple[Counts, float, list[tuple[float, float, float]]]:
    """Return the counts of a case, its expected error and its consistency, and put them into the table."""
    found, bound = measured(name, trials), wanted(CASES[name])
    ratios = consistency(found, CASES[name])
    book.add(name, *cells(found, bound, ratios))
    return found, bound, ratios


@pytest.mark.full
@pytest.mark.parametrize("name", LONG)
def test_long_runs_meet_the_bound(name, book):
    found, bound, ratios = line(name, FULL, book)
    assert not found.failed.any()
    assert not found.away.any()
    assert found.sure.all()
    assert found.rmse == pytest.approx(bound, rel=0.05)
    assert all(low < mean < high for mean, low, high in ratios), ratios


@pytest.mark.full
@pytest.mark.parametrize("name", SHORT)
def test_short_runs_with_a_prior_end_in_the_basin_of_the_truth(name, book):
    found, _, _ = line(name, FULL, book)
    assert not found.failed.any()
    assert not (found.away & ~found.listed).any()


@pytest.mark.full
@pytest.mark.parametrize("name", MOVING)
def test_moving_targets_have_two_branches(name, book):
    found, bound, _ = line(name, FULL, book)
    assert not found.failed.any()
    assert (found.code == Status.AMBIGUOUS).all()
    assert (~found.away | found.listed).all()
    assert (np.abs(found.gap) < TIE).all()
    assert found.rmse == pytest.approx(bound, rel=0.05)


@pytest.mark.full
@pytest.mark.parametrize("name", AROUND)
def test_targets_anywhere(name, book):
    """Short runs of far targets may have two minima in one valley, a few standard deviations apart."""
    found, _, _ = line(name, FULL, book)
    missed = int((found.failed | (found.away & ~found.listed)).sum())
    assert missed <= (RARE * FULL if "prior" in name else 0)


@pytest.mark.full
@pytest.mark.parametrize("name", RATIOS)
def test_gain_ratios_and_differences_together(name, book):
    found, bound, ratios = line(name, JOINT, book)
    assert not found.failed.any()
    assert not found.away.any()
    assert found.rmse == pytest.approx(bound, rel=0.1)
    assert all(low < mean < high for mean, low, high in ratios), ratios


@pytest.mark.full
def test_the_recursion_diverges_where_no_guess_is_needed(book):
    setting = RegistrationSetting(PRINTED, GAUSSIAN, SEED, 1)
    drawn, bound = setting.draw(600), setting.bound(600)
    (plain,) = wander(setting, drawn, (600,), (bound,), width=WIDTH)
    lost, size = int(plain.lost.sum()), rms(bound)
    ratio = f"{plain.rmse / size:.3f}"
    book.add(RECURSION, GAUSSIAN, f"{lost} diverged", "", f"{plain.rmse:.2f}", f"{size:.2f}", ratio, *[""] * 4)
    found = judged(drawn, np.tile(printed_truth(PRINTED, drawn), (GAUSSIAN, 1)), starts=True)
    book.add(WITHOUT, *cells(found, size, []))
    assert 0.02 <= lost / GAUSSIAN <= 0.07
    assert not found.failed.any()
    assert not found.away.any()
