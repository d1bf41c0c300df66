"""Three satellites and a known height, tracked: range differences of fixed receivers, satellites that really move."""

import numpy as np
import pytest
from data.reference import horizontal
from data.windows import report
from often import few

from optloc.lab.datasets import gnss
from optloc.problem import ECEF
from optloc.tracking import UPDATES, collected, polynomial, tracked

pytestmark = pytest.mark.data

CASES = [("K078", "prc_l1_m"), ("K078", "prc_if_m"), ("N176", "prc_l1_m"), ("N176", "prc_if_m")]


@pytest.mark.parametrize("dynamics", [polynomial(0, 0.01), polynomial(1, 0.001)], ids=lambda d: d.name)
@pytest.mark.parametrize("case", few(CASES, 1), ids="-".join)
def test_three_satellites_and_the_height_are_tracked(data_dir, case, dynamics):
    session = gnss.load(data_dir / "gnss_static", *case)
    problem = session.three()
    entries = list(tracked(problem, dynamics))
    track = collected(entries, 3)
    labels = [entry.label for entry in entries]
    first = labels.index("started")
    lat, lon, height = session.geodetic
    off = horizontal(track.position[first:], session.truth, np.asarray(lat), np.asarray(lon))
    report(
        f"GNSS {case}, {dynamics.name}: {len(entries)} scans, started at scan {first}, horizontal rms "
        f"{np.sqrt(np.mean(off**2)):.2f} m, largest {off.max():.2f} m"
    )
    assert first <= 2
    assert set(labels[first + 1 :]) == {"ok"}
    np.testing.assert_allclose(ECEF.to_geodetic(track.position[first:])[2], height, atol=0.05)
    assert np.sqrt(np.mean(off**2)) < 5.0
    assert off.max() < 10.0


@pytest.mark.slow
def test_all_filters_agree_from_a_fix(data_dir):
    problem = gnss.load(data_dir / "gnss_static", "K078", "prc_l1_m").three()
    ends = [collected(list(tracked(problem, polynomial(0), name)), 3).position[-1] for name in UPDATES]
    np.testing.assert_allclose(ends, np.broadcast_to(ends[0], (len(ends), 3)), atol=0.05)
