"""Offsets of anchor pairs learnt while a tag's places are known or not, and applied to windows not learnt from.

Rows are independent and weighed by Cauchy's loss of 0.15 m, as in the set's README: one row in eight is off by more
than 0.5 m, and by plain least squares the offsets do not lower the error of the other half.
"""

import numpy as np
import pytest
from data.registration import calibrating, corrected, fixed, learnt, lines, part, robust
from data.windows import report
from often import few

from optloc import with_bias
from optloc.bounds.rank import observability
from optloc.lab.datasets import uwb
from optloc.problem import by_epoch

pytestmark = pytest.mark.data

LOSS, PRIOR = 0.15, 0.3
RING = [f"S{(i + 1) % 8}-S{i}" for i in range(8)]
# Medians by channel of all of F01 in the README, from 0-1 to 7-0.
README = dict(zip(RING, (-0.03, 0.04, 0.01, -0.09, 0.06, -0.05, 0.21, -0.16), strict=True))
# Median 3-D errors by Cauchy's loss in the README, metres, before and with channel medians of the same flight removed.
ERROR = {"F01": (0.19, 0.11), "F03": (0.15, 0.14)}


def offsets(data, windows, *, blind):
    """Return the problem of the offsets of all neighbouring pairs in some windows, and its fix."""
    problem = with_bias(part(data.problem, windows), "pair", per="pair", members=RING, sigma=PRIOR)
    problem = problem if blind else calibrating(problem, data.truth[windows])
    return problem, fixed(robust(problem, LOSS))


def errors(data, windows, values):
    """Return the 3-D errors of windows, each fixed alone with offsets taken as known."""
    fix = fixed(robust(by_epoch(corrected(part(data.problem, windows), values, per="pair")), LOSS))
    return np.linalg.norm(fix.position - data.truth[windows], axis=-1)


def crossed(name, data, *, blind):
    """Return errors before and after, (k,) each, where either half is corrected by what the other one says."""
    every = np.arange(len(data.windows))
    halves = (every[::2], every[1::2])
    values = [learnt(*offsets(data, half, blind=blind), "pair") for half in halves]
    after = np.concatenate([errors(data, half, other) for half, other in zip(halves, values[::-1], strict=True)])
    case = "blind" if blind else "calibration"
    return values, lines(f"UWB {name}", {"before": errors(data, every, {}), case: after})


@pytest.mark.parametrize("flight", few(ERROR, 1))
def test_offsets_learnt_on_either_half_help_the_other(data_dir, flight):
    data = uwb.load(data_dir / "util_uwb_tdoa", flight, shared=False)
    values, found = crossed(flight, data, blind=False)
    for known in values:
        report(f"   offsets {' '.join(f'{pair} {value:.2f}' for pair, value in known.items())} m")
        if flight == "F01":
            np.testing.assert_allclose(list(known.values()), [README[pair] for pair in known], atol=0.05)
    before, after = ERROR[flight]
    assert found["before"][0] == pytest.approx(before, abs=0.02)
    assert found["calibration"][0] == pytest.approx(after, abs=0.03)
    # F03 flies behind a shelf: what its pairs share with its other half hardly shows in the places.
    assert found["calibration"][0] < (0.8 if flight == "F01" else 1.1) * found["before"][0]


def test_a_blind_flight_learns_the_loop_and_little_else(data_dir):
    data = uwb.load(data_dir / "util_uwb_tdoa", "F01", shared=False)
    half = np.arange(1, len(data.windows), 2)
    problem, fix = offsets(data, half, blind=True)
    _, calibration = offsets(data, half, blind=False)
    assert not observability(problem, fix.x).open
    # No place changes the sum around the ring of anchors; all else trades against places, with errors that depend on
    # the pose and not on the pair alone.
    loop = np.ones(len(RING))
    sums = [loop @ f.take("pair") for f in (calibration, fix)]
    sure = np.sqrt(loop @ fix.covariance("pair") @ loop / len(RING))
    weak, best = (np.sqrt(np.linalg.eigvalsh(f.covariance("pair"))[-1]) for f in (fix, calibration))
    report(f"UWB F01, sum of offsets: calibration {sums[0]:.3f} m, blind {sums[1]:.3f} m")
    report(
        f"   sigma of combinations: blind {sure:.3f} m along the ring, {weak:.3f} m at worst; calibration {best:.3f} m"
    )
    assert abs(sums[1] - sums[0]) < 0.1
    assert sure < 1.5 * best
    assert weak > 4.0 * best
    _, found = crossed("F01", data, blind=True)
    assert found["blind"][0] > 0.95 * found["before"][0]
