"""Tracks that begin at an ambiguous start: they are not `ok` before the other states are refuted."""

import numpy as np
import pytest

from optloc import Motion, Status, assemble, measured
from optloc.tracking import polynomial, tracked

LINE = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0]])


def ranges(stations, heard, seed):
    """Return a run by ranges with a sigma of 1 m, `heard` (k, s) says of which stations, and the places (k, 2)."""
    rng = np.random.default_rng(seed)
    place = np.array([20.0, 50.0]) + np.arange(len(heard))[:, None] * np.array([1.5, 0.4])
    epoch, station = np.nonzero(heard)
    z = np.linalg.norm(place[epoch] - stations[station], axis=1) + rng.standard_normal(len(epoch))
    rows = measured("range", z, a=station, sigma=1.0, epoch=epoch)
    return assemble(stations, rows, times=np.arange(len(heard), dtype=float), motions=(Motion(1),)), place


@pytest.mark.parametrize("seed", range(3))
def test_a_mirror_image_that_no_scan_refutes_keeps_a_track_ambiguous(seed):
    problem, _ = ranges(LINE, np.ones((40, 3), dtype=bool), seed)
    entries = list(tracked(problem, polynomial(1, 0.3)))
    followed = [entry for entry in entries if entry.event == ""]
    assert followed
    assert {entry.code for entry in followed} == {Status.AMBIGUOUS}
    assert "other state" in followed[-1].reason


@pytest.mark.parametrize("seed", range(6))
def test_a_station_off_the_line_refutes_the_mirror_image(seed):
    # The fourth station is heard after the longest stretch that a start takes.
    stations = np.vstack([LINE, [60.0, 90.0]])
    heard = np.ones((70, 4), dtype=bool)
    heard[:40, 3] = False
    problem, place = ranges(stations, heard, seed)
    entries = list(tracked(problem, polynomial(1, 0.3)))
    assert all(entry.code != Status.OK for entry in entries[:40] if entry.event == "")
    late = entries[-10:]
    assert all(entry.code == Status.OK for entry in late)
    for entry, there in zip(late, place[-10:], strict=True):
        apart = entry.updated.mean[:2] - there
        assert apart @ np.linalg.solve(entry.updated.cov[:2, :2], apart) < 25.0
