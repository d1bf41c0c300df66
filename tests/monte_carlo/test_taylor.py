"""From a wild start plain Taylor iteration fails, and damping cures half of it: why no guess is asked for."""

import numpy as np
import pytest
from monte_carlo.layouts import DAILY, NAMES, SEED
from monte_carlo.tables import ledger
from monte_carlo.trials import BY_NAME, Trials, automatic, outcome, position, trials
from verdicts import alone

from optloc import Fix, Status, solve

DEFAULT, FULL = 50, 2000
# An answer is finished within a thousandth of a standard deviation, and lies within 10 000 sizes of the array.
STEP, FAR = 1e-3, 1e4
HEADER = [
    "case",
    "undamped: global",
    "undamped: ok elsewhere",
    "undamped: not ok",
    "damped: global",
    "damped: ok elsewhere",
    "damped: not ok",
    "no guess: global",
    "undamped: ok at no minimum",
    "damped: ok at no minimum",
]


@pytest.fixture(scope="module")
def book():
    facts = f"seed {SEED}, {FULL} trials a case, starts uniform in a box of ±50 km (planar: ±1000 km)"
    with ledger("taylor", HEADER, NAMES, facts) as made:
        yield made


def shares(run: Trials, fix: Fix) -> tuple[float, float, float]:
    """Return the shares that reach the global minimum, claim another place, and claim nothing."""
    found = outcome(run, fix)
    reached, claimed = found.reached.mean(), (found.silent | found.listed | found.claimed).mean()
    return reached, claimed, 1.0 - reached - claimed


def not_minima(run: Trials, fix: Fix) -> list[int]:
    """Return the trials with nothing against their fix that is at infinity or off any minimum."""
    assert not (fix.code == Status.OK).any()  # nothing is proven from a start
    ok = alone(fix)
    x = np.where(ok[:, None], position(fix), run.truth)
    middle = run.model.stations.mean(1)
    size = np.linalg.norm(run.model.stations - middle[:, None], axis=-1).max(1)
    away = np.linalg.norm(x - middle, axis=-1) > FAR * size
    # Residuals of a thousand sigma, at a false minimum, leave fewer digits.
    small = STEP**2 * (1.0 + 1e-6 * run.model.cost(x, run.z))
    return np.flatnonzero(ok & (away | (run.model.decrement(x, run.z) > small))).tolist()


def compare(name: str, count: int) -> tuple[list[float], dict[str, list[int]]]:
    """Return the shares of undamped and damped iteration from wild starts and of no guess, and false claims of both."""
    run = trials(name, count)
    cells, false = [], {}
    for method in ("taylor", "lsr"):
        fix = solve(run.problem, method=method, start=run.wild)
        false[method] = not_minima(run, fix)
        cells += shares(run, fix)
    return [*cells, shares(run, automatic(name, count))[0]], false


def judge(name: str, cells: list[float], false: dict[str, list[int]]) -> None:
    assert not any(false.values()), f"{name}: at infinity or off any minimum: {false}"
    undamped, _, _, damped, _, _, free = cells
    assert free >= max(undamped, damped)
    if BY_NAME[name].kind in ("tdoa", "tdoa, white", "toa"):
        # A start tens of kilometres off is no guess at all for hyperbolas.
        assert undamped < 0.5
        assert undamped < damped < 1.0


@pytest.mark.parametrize("name", DAILY)
def test_a_wild_start_loses_the_answer(name):
    judge(name, *compare(name, DEFAULT))


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_a_wild_start_loses_the_answer_in_full(name, book):
    cells, false = compare(name, FULL)
    book.add(name, *(f"{100.0 * cell:.1f} %" for cell in cells), len(false["taylor"]), len(false["lsr"]))
    judge(name, cells, false)
