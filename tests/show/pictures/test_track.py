"""Pictures of tracks: lines along the picture's axes, stations that fit, and the limit of the NIS."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2
from show.ranging import ENU, PLACES

from optloc import Motion, assemble, measured
from optloc.problem import ECEF
from optloc.show.pictures.track import PlottedTrack, _along_picture_axes, _is_near, plot_tracks


def drawn(frame=ENU, places=PLACES, origin=None):
    """Return a track of three scans along x, the second of which is not ok."""
    d = places.shape[-1]
    rows = measured("range", a=np.tile(np.arange(4), 3), epoch=np.repeat(np.arange(3), 4), sigma=1.0)
    problem = assemble(places, rows, motions=(Motion(1, "run"),), times=np.arange(3.0), frame=frame)
    entries = []
    for k, code in enumerate((0, 1, 0)):
        mean = np.concatenate([(np.zeros(d) if origin is None else origin) + 100.0 * k * np.eye(d)[0], np.zeros(d)])
        updated = SimpleNamespace(mean=mean, cov=np.diag(np.full(2 * d, 4.0)), nis=np.float64(3.0), count=4)
        entries.append(SimpleNamespace(time=float(k), updated=updated, event="started" if k == 0 else "", code=code))
    return PlottedTrack("target", problem, tuple(entries))


def test_a_picture_has_the_path_its_doubts_and_the_limit_of_the_nis():
    figure = plot_tracks([drawn()], "a track")
    plan, sigma, nis = figure.axes
    path = next(line for line in plan.lines if line.get_label() == "track")
    assert path.get_xydata().tolist() == [[0.0, 0.0], [100.0, 0.0], [200.0, 0.0]]
    stations = next(one for one in plan.collections if one.get_label() == "station, first scan")
    assert np.array_equal(stations.get_offsets(), PLACES)
    bad = next(one for one in plan.collections if one.get_label() == "status not ok")
    assert bad.get_offsets().tolist() == [[100.0, 0.0]]
    assert sigma.lines[0].get_ydata() == pytest.approx(np.full(3, np.sqrt(8.0)))
    limit = next(line for line in nis.lines if "99.9" in line.get_label())
    assert limit.get_ydata() == pytest.approx(np.full(3, chi2.ppf(0.999, 4)))


def test_tracks_in_ecef_are_drawn_along_east_north_and_up():
    origin = ECEF.from_geodetic(np.radians(47.0), np.radians(8.0), 400.0)
    places = origin + np.pad(PLACES, ((0, 0), (0, 1)))
    lines, stations, axes = _along_picture_axes([drawn(ECEF, places, origin)])
    turn = ECEF.enu_axes(origin)
    assert axes == ("east", "north", "up")
    assert lines[0].position == pytest.approx(100.0 * np.arange(3)[:, None] * turn[:, 0], abs=1e-6)
    assert stations == pytest.approx((places - origin) @ turn.T, abs=1e-6)


def test_stations_beyond_a_hundred_times_the_track_are_left_out():
    known = np.array([[0.0, 0.0], [10.0, 0.0]])
    assert _is_near(np.array([[500.0, 0.0], [2000.0, 0.0]]), known).tolist() == [True, False]
    assert _is_near(np.array([[500.0, 0.0]]), known[:0]).tolist() == [True]
