"""Six bearings of a marker from a moving camera, in the camera's own axes: fixed in space without a guess."""

import numpy as np
import pytest
from data import truths
from data.reference import law
from often import few

from optloc import solve
from optloc.lab.datasets import starloc

pytestmark = pytest.mark.data

# Run, attitude: median and 95 % error of plain least squares in the set's README, metres.
README = {("R1", "nom"): (0.072, 0.35), ("R1", "cal"): (0.042, 0.27)}


@pytest.mark.parametrize("groups", few([700, 1500], 1))
@pytest.mark.parametrize(("run", "attitude"), README)
def test_fixes_reach_the_published_accuracy(data_dir, run, attitude, groups):
    data = starloc.load(data_dir / "starloc_aoa", run, attitude, groups=groups, seed=6)
    fix, reference = solve(data.problem()), truths.starloc(data)
    ours, theirs = (np.linalg.norm(x - data.truth, axis=-1) for x in (fix.position, reference.position))
    found = law(f"STAR-loc {run} {attitude}", fix, ours, theirs, reference)
    assert found == pytest.approx(README[run, attitude], rel=0.25)
