"""Airliners' messages with robust losses: where errors of the truth dominate, doubt must not do harm."""

import numpy as np
import pytest
from data import truths
from data.windows import quantiles, report, statuses

from optloc import solve
from optloc.lab.datasets import adsb

pytestmark = pytest.mark.data


def check(name, refraction, plain, fix, errors):
    """Compare answers where both have one; `errors` maps a fix and its numbers to horizontal errors."""
    both = np.flatnonzero(plain.answered & fix.answered)
    assert len(both) >= 0.98 * len(fix), statuses(fix)
    mine, other = (quantiles(errors(one, both)) for one in (fix, plain))
    report(
        f"ADS-B, {name}, {'air' if refraction else 'vacuum'}: {statuses(fix)}; horizontal median {mine[0]:.0f} m, "
        f"95 % {mine[1]:.0f} m; least squares {other[0]:.0f} / {other[1]:.0f} m"
    )
    assert mine[0] <= 1.05 * other[0]
    assert mine[1] <= 1.05 * other[1]


def test_a_loss_is_never_worse_than_least_squares_of_every_sixth_message(data_dir):
    data = adsb.heard(data_dir / "locards_adsb", refraction=True).take(np.arange(0, 763, 6))
    problem = data.problem("row")
    errors = truths.adsb_horizontal
    check(
        "cauchy", True, solve(problem, "searched"), solve(problem, "cauchy"),
        lambda fix, both: errors(data.take(both), fix.position[both]),
    )  # fmt: skip


@pytest.mark.full
@pytest.mark.parametrize("refraction", [False, True])
@pytest.mark.parametrize("name", ["cauchy", "huber"])
def test_a_loss_is_never_worse_than_least_squares(data_dir, name, refraction):
    data = adsb.load(data_dir / "locards_adsb", refraction=refraction)
    check(
        name, refraction, solve(data.problem, "searched"), solve(data.problem, name),
        lambda fix, both: data.horizontal(fix.position[both], both),
    )  # fmt: skip
