"""Calibrations with targets at known positions: linear problems have one minimum, and other problems no such claim."""

import numpy as np
import pytest

import optloc
from optloc.base.types import Motion, Status
from optloc.linear.evaluate import predict
from optloc.solvers.certificates.known_positions import REASON, is_linear

STATIONS = np.array([[0.0, 0.0], [5000.0, 300.0], [-400.0, 6000.0], [5200.0, 5700.0]])
BEACON = np.array([1500.0, 2500.0])
RANGES = np.sqrt(((STATIONS - BEACON) ** 2).sum(1))


def calibration(kind, *, form="offset", members=("B",), epochs=6, seed=1):
    """Return the problem of a beacon at a known position, with noise of 1 m and an error of 50 of the members."""
    rng, a = np.random.default_rng(seed), np.tile(np.arange(4), epochs)
    z = RANGES[a] + rng.standard_normal(4 * epochs) + 50.0 * (a == 1)
    rows = optloc.measured(kind, z, a=a, sigma=1.0, epoch=np.repeat(np.arange(epochs), 4))
    motion = Motion(known=BEACON[None, None])
    stations = optloc.station_array(STATIONS, ["A", "B", "C", "D"])
    problem = optloc.assemble(stations, rows, motions=(motion,), times=np.arange(float(epochs)))
    return optloc.with_bias(problem, "clock", members=list(members), form=form)


@pytest.mark.parametrize("kind", ["toa", "range"])
def test_the_clock_of_a_calibration_is_proven_and_equals_the_closed_form(kind):
    problem = calibration(kind)
    fix = optloc.solve(problem)
    assert fix.status is Status.OK
    assert (fix.certificate.proof, fix.certificate.reason) == ("global", REASON)
    error = (problem.z - RANGES[np.tile(np.arange(4), 6)]).reshape(6, 4)
    others = error[:, [0, 2, 3]].mean(1) if kind == "toa" else 0.0
    assert abs(float(fix.bias["clock"][0]) - (error[:, 1] - others).mean()) < 1e-6


@pytest.mark.parametrize("form", ["offset", "drift", "scale"])
@pytest.mark.parametrize("kind", ["toa", "range"])
def test_rows_of_a_linear_problem_are_linear(kind, form):
    problem = calibration(kind, form=form).flat()
    assert is_linear(problem)
    x = np.random.default_rng(2).normal(size=(3, 1, problem.layout.size))
    at = [predict(problem, v) for v in (x[0], x[1], 0.3 * x[0] + 0.7 * x[1])]
    assert np.abs(0.3 * at[0] + 0.7 * at[1] - at[2]).max() < 1e-8


def test_clocks_of_all_stations_are_not_determined():
    fix = optloc.solve(calibration("toa", members=("A", "B", "C", "D")))
    assert fix.status.label == "singular geometry"


def test_angles_displaced_stations_and_unknown_positions_are_not_linear():
    motion, station = Motion(known=BEACON[None, None]), np.arange(4)
    bearings = optloc.measured("azimuth", np.ones(4), a=station, sigma=0.1)
    angles = optloc.with_bias(optloc.assemble(STATIONS, bearings, motions=(motion,)), "mount", per="kind")
    assert not is_linear(angles.flat())
    moving = optloc.station_array(STATIONS, velocity=np.ones((4, 2)))
    ranges = optloc.measured("range", RANGES, a=station, sigma=1.0)
    late = optloc.with_bias(optloc.assemble(moving, ranges, motions=(motion,)), "late", form="time", sigma=1.0)
    assert not is_linear(late.flat())
    assert not is_linear(optloc.assemble(STATIONS, ranges).flat())


def test_a_loss_is_not_proven_as_least_squares():
    fix = optloc.solve(calibration("toa"), "huber")
    assert fix.certificate.reason != REASON
