"""A robot among landmarks in the plane: bearings, ranges and both, fixed without a guess epoch by epoch."""

import numpy as np
import pytest
from data import mrclam
from data.reference import law

from optloc import solve

pytestmark = pytest.mark.data

AOA, RANGE = ("azimuth",), ("range",)

# Set, kinds: median and 95 % error in the set's README, metres.
README = {
    (1, AOA): (0.05, 0.19),
    (1, RANGE): (0.36, 1.2),
    (1, AOA + RANGE): (0.08, 0.18),
    (2, AOA): (0.05, 0.30),
    (2, RANGE): (0.34, 1.1),
    (2, AOA + RANGE): (0.08, 0.18),
    (5, AOA): (0.07, 0.41),
    (5, RANGE): (0.39, 1.1),
    (5, AOA + RANGE): (0.08, 0.19),
}


@pytest.mark.parametrize(("number", "kinds"), README)
def test_fixes_reach_the_published_accuracy(data_dir, number, kinds):
    data = mrclam.load(data_dir / "mrclam_aoa2d", number)
    assert len(data.truth) == {1: 690, 2: 2306, 5: 2708}[number]
    fix, reference = solve(data.problem(kinds)), data.from_truth(kinds)
    ours, theirs = (np.linalg.norm(x - data.truth, axis=-1) for x in (fix.position, reference.position))
    found = law(f"MRCLAM {number} by {' and '.join(kinds)}", fix, ours, theirs, reference)
    assert found == pytest.approx(README[number, kinds], rel=0.1, abs=0.01)
