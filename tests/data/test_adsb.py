"""Airliners heard by five stations or three, with a known height: fixed without a guess against starts at the truth."""

import numpy as np
import pytest
from data import adsb
from data.reference import law, listed
from data.windows import quantiles, report

from optloc import Status, solve

pytestmark = pytest.mark.data

# Horizontal median and 95 % error in the set's README, metres, by whether refraction is corrected.
README = {False: (63.0, 314.0), True: (53.0, 301.0)}
BEST_TRIPLET, MEDIAN_TRIPLET = (28.0, 219.0), (108.0, 721.0)


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "locards_adsb"


@pytest.mark.parametrize("refraction", README, ids=["vacuum", "air"])
@pytest.mark.parametrize("given", ["exactly", "row"])
def test_five_stations_and_the_height(folder, given, refraction):
    data = adsb.heard(folder, refraction=refraction)
    assert len(data.truth) == 763
    fix, reference = solve(data.problem(given)), data.from_truth(given)
    ours, theirs = data.horizontal(fix.position), data.horizontal(reference.position)
    name = f"ADS-B, five stations, height {given}{', refraction' * refraction}"
    assert law(name, fix, ours, theirs, reference) == pytest.approx(README[refraction], rel=0.05)
    assert not _silent(fix, reference).any()


def test_three_stations_and_the_height(folder):
    # Refraction corrected, as in the README's table: each line of it adds to the one above.
    data = adsb.heard(folder, refraction=True).triplets()
    fix, reference = solve(data.problem("exactly")), data.from_truth("exactly")
    theirs, best = data.horizontal(reference.position), listed(fix, data.horizontal)
    name = "ADS-B, three stations and height"
    law(name, fix, best, theirs, reference)
    ten = theirs.reshape(-1, 10)
    for text, error, wanted in (
        ("best", ten.min(1), BEST_TRIPLET),
        ("median", np.median(ten, axis=1), MEDIAN_TRIPLET),
    ):
        report(f"   {text} triplet of the ten: {quantiles(error)}, README {wanted}")
    silent = np.flatnonzero(_silent(fix, reference))
    assert not len(silent), f"{name}: says ok and does not list the minimum that the truth leads to: {silent}"
    near = listed(fix, lambda x: np.linalg.norm(x - reference.position, axis=-1)) < 1.0
    lost = np.flatnonzero((fix.code == Status.AMBIGUOUS) & ~near & (reference.cost < fix.cost + 9.0))
    assert not len(lost), f"{name}: does not list the minimum that the truth leads to: {lost}"


def _silent(fix, reference):
    """Return where a fix says ok although the truth leads to another minimum that is about as good."""
    other = np.linalg.norm(fix.position - reference.position, axis=-1) > 10.0
    return (fix.code == Status.OK) & other & (reference.cost < fix.cost + 9.0)
