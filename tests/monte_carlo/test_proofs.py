"""How often what is proven: by kind of rows, layout and noise, and for what reasons not more."""

from collections import Counter

import numpy as np
import pytest
from monte_carlo.tables import ledger
from proof.layouts import BY_NAME, CELLS, SEED

from optloc import Status, solve
from optloc.kernels.jit import enabled

DEFAULT, FULL = 60, 2000
HEADER = [
    "case",
    "global",
    "unique",
    "region",
    "ambiguous",
    "no fix",
    "replaced",
    "boxes, median",
    "boxes, 99 %",
    "other reasons",
]
NAMES = [cell.name for cell in CELLS]
# The least share of fixes with a global proof, or with one for a region; what is not named here is reported only.
GLOBAL = {"TDOA, 6 stations, inside": 0.99, "TDOA, 6 stations, outside": 0.95}
GLOBAL |= {"TDOA, 5 stations, inside": 0.92, "TDOA, 5 stations, outside": 0.90}
EITHER = {
    "range, 5": 0.9,
    "TOA, 6": 0.9,
    "AOA, 4": 0.9,
    "bistatic": 0.9,
    "three satellites": 0.9,
    "GROA + TDOA": 0.7,
    "AOA + TDOA": 0.7,
}
DAILY = [
    "TDOA, 6 stations, inside, 10 m",
    "TDOA, 5 stations, outside, 30 m",
    "range, 5 stations, inside, 10 m",
    "three satellites and a height, 15 m",
]


@pytest.fixture(scope="module")
def book():
    with ledger("proofs", HEADER, NAMES, f"seed {SEED}, {FULL} trials a case, method auto") as made:
        yield made


def counted(name: str, trials: int) -> tuple[list[str], float, float]:
    """Return the cells of a row of the table, and the shares of global proofs and of those or proofs of a region."""
    problem, _ = BY_NAME[name].drawn(trials)
    fix = solve(problem)
    answered = fix.answered
    proofs = [c for c, good in zip(fix.certificate, answered, strict=True) if good]
    counts = Counter(c.proof for c in proofs)
    boxes = np.array([c.boxes for c in proofs if c.proof in ("global", "region")] or [0])
    replaced = sum(_first_number(stage.detail, "fix") for stage in fix.stages if stage.name == "certify")
    reasons = Counter(c.reason for c in proofs if c.proof not in ("global", "region"))
    cells = [
        str(counts["global"]),
        str(sum(c.unique for c in proofs)),
        str(counts["region"]),
        str(int(fix.has(Status.AMBIGUOUS).sum())),
        str(int((~answered).sum())),
        str(replaced),
        f"{np.median(boxes):.0f}",
        f"{np.percentile(boxes, 99):.0f}",
        "; ".join(f"{n} × {reason}" for reason, n in reasons.most_common()),
    ]
    total = max(len(proofs), 1)
    return cells, counts["global"] / total, (counts["global"] + counts["region"]) / total


def _first_number(detail: str, word: str) -> int:
    """Return the number before a word in a list such as "3 global, 1 fixes replaced"."""
    found = [part.split()[0] for part in detail.split(", ") if part.split()[1].startswith(word)]
    return int(found[0]) if found else 0


def judge(name: str, sure: float, either: float, trials: int) -> None:
    """Fail where a share is below what is asked by more than two standard deviations of so many trials."""
    for table, share in ((GLOBAL, sure), (EITHER, either)):
        for start, least in table.items():
            if name.startswith(start) and "coplanar" not in name:
                assert share >= least - 2.0 * np.sqrt(least * (1.0 - least) / trials), f"{name}: {share:.3f}"


@pytest.mark.skipif(not enabled(), reason="budgets of boxes are smaller in plain Python")
@pytest.mark.parametrize("name", DAILY)
def test_fixes_are_proven(name, record_property):
    cells, sure, either = counted(name, DEFAULT)
    record_property("proofs", ", ".join(cells))
    judge(name, sure, either, DEFAULT)


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_fixes_are_proven_in_full(name, book):
    cells, sure, either = counted(name, FULL)
    book.add(name, *cells)
    judge(name, sure, either, FULL)
