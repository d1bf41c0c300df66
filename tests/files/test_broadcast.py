"""Broadcast orbits against SciPy, and the delays of the atmosphere against the literature."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optloc.base.units import SPEED_OF_LIGHT as C
from optloc.files.broadcast import EARTH_RATE, Ephemeris, ionosphere, orbit, troposphere, turned
from optloc.files.rinex import WEEK


def elements(**given):
    held = dict.fromkeys(Ephemeris._fields, np.zeros(1))
    return Ephemeris(**held | {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in given.items()})


@pytest.mark.parametrize(("system", "gm"), [("G", 3.986005e14), ("E", 3.986004418e14)])
def test_an_orbit_without_perturbations_is_that_of_newton(system, gm):
    week, toe, e, a, i, node, arg = 2149 * WEEK, 2149 * WEEK + 7200.0, 0.08, 2.66e7, 0.96, 1.1, -2.0
    one = elements(
        m0=0.0, e=e, root_a=np.sqrt(a), i0=i, omega=arg, toe=toe, week=week, toc=toe,
        # nodes are counted in the Earth's axes of the beginning of the week
        omega0=node,
    )  # fmt: skip
    # perigee, in axes that do not turn
    turn = np.array([[np.cos(node), -np.sin(node), 0], [np.sin(node), np.cos(node), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, np.cos(i), -np.sin(i)], [0, np.sin(i), np.cos(i)]])
    within = np.array([[np.cos(arg), -np.sin(arg)], [np.sin(arg), np.cos(arg)], [0, 0]])
    place = turn @ tilt @ within @ [a * (1 - e), 0.0]
    speed = turn @ tilt @ within @ [0.0, np.sqrt(gm / a * (1 + e) / (1 - e))]

    def newton(_, state):
        return np.concatenate([state[3:], -gm * state[:3] / np.linalg.norm(state[:3]) ** 3])

    for since in (600.0, 7200.0, -7200.0):
        done = solve_ivp(newton, (0.0, since), [*place, *speed], method="DOP853", rtol=1e-13, atol=1e-6)
        angle = EARTH_RATE * (toe + since - week)
        x, y, z = done.y[:3, -1]
        expected = [x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle), z]
        found, clock = orbit(one, system, np.array([toe + since]))
        assert found[0] == pytest.approx(expected, abs=1e-3)
        # relativity: - 2 r.v / c^2
        assert clock[0] == pytest.approx(-2.0 * done.y[:3, -1] @ done.y[3:, -1] / C**2, abs=1e-15)


def test_turning_with_the_earth_keeps_the_distance_to_its_axis_and_goes_west():
    place = np.array([[2.6e7, 0.0, 1e6]])
    later = turned(place, np.array([0.07]))
    assert later[0, 1] == pytest.approx(-2.6e7 * EARTH_RATE * 0.07, rel=1e-9)
    assert np.linalg.norm(later) == pytest.approx(np.linalg.norm(place), rel=1e-15)


def test_the_atmosphere_is_as_others_have_it():
    flat, high = np.array([0.7]), np.array([np.pi / 2])
    assert troposphere(flat, np.array([0.0]), high) == pytest.approx(2.4, abs=0.1)  # textbook: 2.3 m dry, 0.1 m wet
    low = troposphere(flat, np.array([0.0]), np.radians([10.0]))
    assert low == pytest.approx(troposphere(flat, np.array([0.0]), high) / np.sin(np.radians(10.0)))
    coefficients = np.array([3.82e-8, 1.49e-8, -1.79e-7, 0.0, 1.43e5, 0.0, -3.28e5, 1.13e5])
    # A. Farah, "Comparison of GPS ...", and the example that goes with many programs: 40 N, 100 W, 20 deg high, 210 deg
    found = ionosphere(
        coefficients, (np.radians([40.0]), np.radians([-100.0])), np.radians([210.0]), np.radians([20.0]),
        np.array([593100.0]),
    )  # fmt: skip
    assert found == pytest.approx(23.784, abs=0.01)
    night = ionosphere(coefficients, (flat, flat), flat, high, np.array([0.0]))
    assert night == pytest.approx(5e-9 * C, rel=0.02)
