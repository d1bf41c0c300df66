"""Airliners heard by five stations or three, with a known height: fixed without a guess against starts at the truth."""

from functools import partial

import numpy as np
import pytest
from data import truths
from data.reference import law, listed
from data.windows import quantiles, report
from verdicts import alone

from optloc import Status, solve
from optloc.lab.datasets import adsb
from optloc.models import Atmosphere

pytestmark = pytest.mark.data

# Horizontal median and 95 % error in the set's README, metres, by whether refraction is corrected.
README = {False: (63.0, 314.0), True: (53.0, 301.0)}
BEST_TRIPLET, MEDIAN_TRIPLET = (28.0, 219.0), (108.0, 721.0)


@pytest.fixture(scope="module")
def folder(data_dir):
    return data_dir / "locards_adsb"


# The height as a row, in vacuum, is in test_adsb_smoke.py.
@pytest.mark.parametrize(
    ("given", "refraction"),
    [
        pytest.param("exactly", False, marks=pytest.mark.full),
        pytest.param("exactly", True, marks=pytest.mark.full),
        ("row", True),
    ],
    ids=["exact", "exact-air", "row-air"],
)
def test_five_stations_and_the_height(folder, given, refraction):
    data = adsb.heard(folder, refraction=refraction)
    assert len(data.truth) == 763
    fix, reference = solve(data.problem(given)), truths.adsb(data, given)
    ours, theirs = truths.adsb_horizontal(data, fix.position), truths.adsb_horizontal(data, reference.position)
    name = f"ADS-B, five stations, height {given}{', refraction' * refraction}"
    assert law(name, fix, ours, theirs, reference) == pytest.approx(README[refraction], rel=0.05)
    assert not _silent(fix, reference).any()


# A proof takes ten times as long as a fix.
@pytest.mark.parametrize(
    ("messages", "method"), [(15, "searched"), (3, "auto"), pytest.param(15, "auto", marks=pytest.mark.full)]
)
def test_three_stations_and_the_height(folder, messages, method):
    whole = adsb.heard(folder, refraction=True).unbiased()
    chosen = np.sort(np.random.default_rng(10).choice(len(whole.truth), messages, replace=False))
    data = whole.take(chosen).triplets()
    # Stations 147 and 632 are 22 m apart: three with both of them are two, and say nothing that can be judged.
    data = data.take(np.flatnonzero(truths.adsb_width(data) > 50.0))
    fix, reference = solve(data.problem("exactly"), method), truths.adsb(data, "exactly")
    name = "ADS-B, three stations and height"
    theirs, best = truths.adsb_horizontal(data, reference.position), listed(fix, partial(truths.adsb_horizontal, data))
    law(name, fix, best, theirs, reference, answered=0.97)
    near = listed(fix, lambda x: np.linalg.norm(x - reference.position, axis=-1)) < 1.0
    silent = np.flatnonzero(_silent(fix, reference))
    assert not len(silent), f"{name}: is alone and does not list the minimum that the truth leads to: {silent}"
    lost = np.flatnonzero(fix.has(Status.AMBIGUOUS) & ~near & (reference.cost < fix.cost + 9.0))
    assert not len(lost), f"{name}: does not list the minimum that the truth leads to: {lost}"


def test_the_reference_of_three_stations_is_the_published_one(folder):
    # Each line of the README's table adds to the one above: refraction, then the stations' biases.
    data = adsb.heard(folder, refraction=True).unbiased().take(np.arange(0, 763, 4)).triplets()
    ten = truths.adsb_horizontal(data, truths.adsb(data, "exactly").position).reshape(-1, 10)
    best, middle = quantiles(ten.min(1)), quantiles(np.median(ten, axis=1))
    report(f"ADS-B, of ten triplets started at the truth: best {best}, median {middle} m")
    assert best == pytest.approx(BEST_TRIPLET, rel=0.3)
    assert middle[0] == pytest.approx(MEDIAN_TRIPLET[0], rel=0.3)


def _silent(fix, reference):
    """Return where a fix is alone although the truth leads to one about as good, beyond three of its own sigma."""
    apart = fix.position - reference.position
    off = np.zeros(len(fix))
    good = alone(fix) & (reference.cost < fix.cost + 9.0)
    information = np.linalg.pinv(fix.covariance()[good], rcond=1e-12, hermitian=True)
    off[good] = np.sqrt(np.einsum("ki,kij,kj->k", apart[good], information, apart[good]))
    return off > 3.0


def test_refraction_without_the_truth(folder):
    # The paths through air are those of the unknown place: nothing of the truth but the height is used.
    data, air = adsb.heard(folder).take(np.arange(0, 763, 20)), Atmosphere(1e6 * adsb.REFRACTIVITY, adsb.SCALE_HEIGHT)
    corrected = adsb.heard(folder, refraction=True).take(np.arange(0, 763, 20))
    problems = (data.problem("exactly"), corrected.problem("exactly"), data.problem("exactly").in_medium(air))
    vacuum, known, own = (solve(problem, "gtrs+lsr").position for problem in problems)
    medians = [quantiles(truths.adsb_horizontal(data, place))[0] for place in (vacuum, known, own)]
    report(
        f"ADS-B, five stations: {medians[0]} m in vacuum, {medians[1]} m with the air on the true path, {medians[2]} m"
    )
    assert medians[2] == pytest.approx(medians[1], rel=0.03)
    assert medians[2] < medians[0]
    # The line dips below the straight course between both heights that the dataset's formula follows.
    assert np.median(np.linalg.norm(own - known, axis=1)) < 3.0
