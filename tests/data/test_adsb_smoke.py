"""Airliners' messages heard by five of 27 receivers: arrival times and height in ECEF, fixed without a guess."""

import numpy as np
import pytest
from data.windows import quantiles, report, statuses

from optloc import solve
from optloc.lab.datasets import adsb

pytestmark = pytest.mark.data

# Horizontal median and 95 % error of "5 stations + h_geo", started at the truth, in the set's README, metres.
README = (63.0, 314.0)


@pytest.mark.full  # test_adsb.py has every message of five stations in every run
@pytest.mark.parametrize("method", ["auto", "gtrs+lsr"])
def test_messages_are_fixed_as_one_batch(data_dir, method):
    data = adsb.load(data_dir / "locards_adsb")
    assert data.problem.epochs == 763
    fix = solve(data.problem, method)
    local = np.einsum("kij,kj->ki", data.problem.frame.enu_axes(data.truth), fix.position - data.truth)
    horizontal = np.linalg.norm(local[:, :2], axis=1)
    ours = quantiles(horizontal[fix.answered])
    seconds = sum(stage.seconds for stage in fix.stages)
    report(
        f"ADS-B by {method}: 763 messages ({statuses(fix)}), horizontal median {ours[0]:.0f} m, 95 % {ours[1]:.0f} m, "
        f"{1e3 * seconds / 763:.2f} ms a fix"
    )
    assert fix.answered.mean() >= 0.99, statuses(fix)
    assert ours[0] <= 75.0
    assert ours[1] <= 360.0
    assert ours == pytest.approx(README, rel=0.05)
    assert np.median(np.abs(local[fix.answered, 2])) < 30.0
