"""Airliners' messages with robust losses: where errors of the truth dominate, doubt must not do harm."""

import numpy as np
import pytest
from data.windows import quantiles, report, statuses

from optloc import solve
from optloc.datasets import adsb

pytestmark = pytest.mark.data


@pytest.mark.parametrize(
    ("name", "refraction"),
    [
        ("cauchy", True),
        *(
            pytest.param(name, air, marks=pytest.mark.full)
            for name, air in [("cauchy", False), ("huber", False), ("huber", True)]
        ),
    ],
)
def test_a_loss_is_never_worse_than_least_squares(data_dir, name, refraction):
    data = adsb.load(data_dir / "locards_adsb", refraction=refraction)
    plain, fix = solve(data.problem, "searched"), solve(data.problem, name)
    both = np.flatnonzero(plain.answered & fix.answered)
    assert len(both) >= 0.98 * len(data.truth), statuses(fix)
    mine, other = (quantiles(data.horizontal(one.position[both], both)) for one in (fix, plain))
    report(
        f"ADS-B, {name}, {'air' if refraction else 'vacuum'}: {statuses(fix)}; horizontal median {mine[0]:.0f} m, "
        f"95 % {mine[1]:.0f} m; least squares {other[0]:.0f} / {other[1]:.0f} m"
    )
    assert mine[0] <= 1.05 * other[0]
    assert mine[1] <= 1.05 * other[1]
