"""P and S picks of `locate`: a simulated earthquake is found with one call."""

import numpy as np
import pandas as pd
import pytest

from optloc import InvalidProblem, locate
from optloc.models import Layers

STATIONS = {
    "AA": (0.0, 0.0, 0.0),
    "BB": (9e3, 1e3, 0.0),
    "CC": (1e3, 9e3, 0.0),
    "DD": (9e3, 8e3, 0.0),
    "EE": (4e3, -6e3, 0.0),
}
QUAKE, ORIGIN, VP, VS = np.array([4e3, 3e3, -6e3]), 12.0, 6000.0, 3500.0


def times(speed, names):
    """Return the arrival times at stations, seconds."""
    return {name: ORIGIN + float(np.linalg.norm(QUAKE - STATIONS[name])) / speed for name in names}


def test_p_and_s_picks_give_the_hypocentre():
    p, s = times(VP, "AA BB CC DD".split()), times(VS, "AA EE".split())
    fix = locate(STATIONS, p=p, s=s, vp="6 km/s", vs="3.5 km/s", sigma={"p": 0.02, "s": 0.05})
    assert np.abs(fix.position[:2] - QUAKE[:2]).max() < 1.0
    assert abs(abs(fix.position[2]) - 6e3) < 1.0  # stations in one plane do not tell up from down
    bare = locate(STATIONS, p=p, s=s, vp=6000, vs=3500, sigma="20 ms", height=(-20e3, 0.0))
    assert np.abs(bare.position - QUAKE).max() < 1.0


def test_dates_and_one_time_of_several_events():
    zero = np.datetime64("2024-05-01T10:00:00", "ns")
    dates = {
        wave: {name: zero + np.timedelta64(round(t * 1e9), "ns") for name, t in times(speed, STATIONS).items()}
        for wave, speed in (("p", VP), ("s", VS))
    }
    fix = locate(STATIONS, **dates, vp="6 km/s", vs="3.5 km/s", sigma="10 ms", height=(-20e3, 0.0))
    assert np.abs(fix.position - QUAKE).max() < 1.0
    frames = {w: pd.DataFrame([times(v, STATIONS)] * 3) + 7.0 for w, v in (("p", VP), ("s", VS))}
    fixes = locate(STATIONS, **frames, vp="6 km/s", vs="3.5 km/s", sigma="10 ms", height=(-20e3, 0.0))
    assert fixes.shape == (3,)
    assert np.abs(fixes.position - QUAKE).max() < 1.0


def test_layers_bend_the_rays_of_both_waves(tmp_path):
    crust = Layers((0.0, 5e3), (5000.0, 6500.0), "constant", 0.0)
    file = tmp_path / "crust.csv"
    file.write_text("depth km,vp km/s\n0,5\n5,6.5\n")
    places = {name: (x, y, -10.0 - i) for i, (name, (x, y, _)) in enumerate(STATIONS.items())}

    def arrivals(ratio):
        from optloc.models.layers import first_arrival

        return {
            name: ORIGIN
            + ratio
            * float(
                first_arrival(
                    crust, np.array([np.hypot(x - QUAKE[0], y - QUAKE[1])]), np.array([6e3]), np.array([-z])
                ).time[0]
            )
            for name, (x, y, z) in places.items()
        }

    p, s = arrivals(1.0), arrivals(1.73)
    for vp in (crust, str(file)):
        fix = locate(places, p=p, s=s, vp=vp, vs="vp/1.73", sigma="10 ms")
        assert np.abs(fix.position - QUAKE).max() < 30.0, fix


def test_layers_with_two_ratios_have_separate_rays(tmp_path):
    from optloc.models.layers import first_arrival
    from optloc.models.phase_layers import PhaseLayers

    file = tmp_path / "crust.csv"
    file.write_text("depth km,vp km/s,vs km/s\n0,5,2.7\n3,6.5,3.75\n")
    crust = PhaseLayers((0.0, 3e3), (5000.0, 6500.0), "constant", 0.0, None, (2700.0, 3750.0))
    places = {name: (x, y, -10.0 - i) for i, (name, (x, y, _)) in enumerate(STATIONS.items())}

    def arrivals(layers, names):
        found = {}
        for name in names:
            x, y, z = places[name]
            across = np.array([np.hypot(x - QUAKE[0], y - QUAKE[1])])
            found[name] = ORIGIN + float(first_arrival(layers, across, np.array([6e3]), np.array([-z])).time[0])
        return found

    p, s = arrivals(crust, STATIONS), arrivals(crust.shear, "AA BB EE".split())
    for vp in (str(file), crust):
        fix = locate(places, p=p, s=s, vp=vp, sigma="10 ms")
        assert np.abs(fix.position - QUAKE).max() < 30.0, fix
    with pytest.raises(InvalidProblem, match="the layers have the speeds of S waves"):
        locate(places, p=p, s=s, vp=crust, vs="vp/1.73", sigma="10 ms")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "vp: the speed of the P waves is unknown"),
        ({"vp": "6 km/s"}, "vs: the speed of the S waves is unknown"),
        ({"vp": "6 km/s", "vs": "7 km/s"}, "not faster"),
        ({"vp": "6 km/s", "vs": "3.5 km/s", "wave_speed": 343}, "vp and vs"),
        ({"vp": "6 km/s", "vs": "3.5 km/s", "unit": {"p": "s", "s": "ms"}}, "different units"),
        ({"vp": "6 km/s", "vs": "3.5 km/s", "toa": {"AA": 1.0}}, "no common origin time"),
    ],
)
def test_wrong_arguments_are_named(options, words):
    p, s = times(VP, STATIONS), times(VS, STATIONS)
    with pytest.raises(InvalidProblem, match=words):
        locate(STATIONS, p=p, s=s, sigma="10 ms", **options)


def test_exchanged_picks_and_speeds_without_picks_are_named():
    p, s = times(VP, STATIONS), times(VS, STATIONS)
    with pytest.raises(InvalidProblem, match="not after the P wave of station 'AA'"):
        locate(STATIONS, p=s, s=p, vp="6 km/s", vs="3.5 km/s", sigma="10 ms")
    with pytest.raises(InvalidProblem, match="there are no picks"):
        locate(STATIONS, toa=p, vp="6 km/s", sigma="10 ms")
    gaps = {name: [t, np.nan if name == "AA" else t] for name, t in p.items()}
    with pytest.raises(InvalidProblem, match="picks at different stations"):
        locate(STATIONS, p=gaps, vp="6 km/s", sigma="10 ms")
