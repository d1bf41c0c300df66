"""One call from measurements to a fix: exact ranges and times meet the truth in every unit; bad words are named."""

import numpy as np
import pytest

from optloc import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files.one_call import locate

STATIONS = {"A": (0.0, 0.0), "B": (1000.0, 0.0), "C": (0.0, 1000.0), "D": (900.0, 1100.0)}
TRUTH = np.array([300.0, 400.0])
RANGES = {name: float(np.linalg.norm(TRUTH - place)) for name, place in STATIONS.items()}


def test_exact_measurements_meet_the_truth_whatever_their_unit():
    metres = locate(STATIONS, ranges=RANGES, sigma=1.0)
    feet = locate(STATIONS, ranges={name: r / 0.3048 for name, r in RANGES.items()}, sigma="1 m", unit="ft")
    times = locate(STATIONS, toa={name: r / SPEED_OF_LIGHT * 1e9 for name, r in RANGES.items()}, sigma=3.0, unit="ns")
    for fix in (metres, feet, times):
        assert fix.position == pytest.approx(TRUTH, abs=1e-4)
    assert feet.covariance() == pytest.approx(metres.covariance(), rel=1e-6)


def test_bearings_are_those_of_a_compass_unless_the_axes_are_named():
    away = {name: TRUTH - place for name, place in STATIONS.items() if name in "ABC"}
    compass = {name: float(np.degrees(np.arctan2(x, y)) % 360.0) for name, (x, y) in away.items()}
    axes = {name: float(np.degrees(np.arctan2(y, x))) for name, (x, y) in away.items()}
    for bearings, options in (
        (compass, {}),
        ({name: b - 5.0 for name, b in compass.items()}, {"declination": "5 deg"}),
        (axes, {"azimuth": "east-counterclockwise"}),
    ):
        fix = locate(STATIONS, bearings=bearings, sigma=0.5, unit="deg", **options)
        assert fix.position == pytest.approx(TRUTH, abs=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"ranges": RANGES}, "sigma"),
        ({"sigma": 1.0}, "measure"),
        ({"ranges": RANGES | {"E": 1.0}, "sigma": 1.0}, "no station 'E'"),
        ({"ranges": RANGES, "sigma": -1.0}, "positive"),
        ({"ranges": RANGES, "sigma": 1.0, "azimuth": "left"}, "left"),
    ],
)
def test_arguments_that_say_no_problem_are_named(options, words):
    with pytest.raises(InvalidProblem, match=words):
        locate(STATIONS, **options)
