"""Doppler shifts start a fix by a relaxation, and IPOPT finds the same minimum, at a known height on it."""

import numpy as np
import pytest
from often import few

from optloc import Frame, Motion, Stations, assemble, measured, simulate, solve
from optloc.base.frames import geodetic_to_ecef
from optloc.linear.constraints import height
from optloc.problem import ECEF, Bias
from optloc.solvers.starts.doppler import doppler_starts, has_doppler_of_rest

EARTH_RATE = 7.292115e-5  # rad/s


def aircraft(count=4, d=2, epochs=1, seed=0, motion=None):
    """Range-rate differences to the first of some aircraft, and an emitter on the ground."""
    rng = np.random.default_rng(seed)
    speed, first = rng.normal(0, 120, (count, d)), rng.uniform(-10e3, 10e3, (count, d))
    time = 10.0 * np.arange(epochs)
    place = first + speed * time[:, None, None]
    stations = Stations(place, tuple(f"s{i}" for i in range(count)), velocity=np.broadcast_to(speed, place.shape))
    a, epoch = np.tile(np.arange(1, count), epochs), np.repeat(np.arange(epochs), count - 1)
    rows = measured("fdoa", a=a, b=0 * a, epoch=epoch, sigma=0.1)
    bare = assemble(stations, rows, times=time, motions=(motion or Motion(),))
    return bare, rng.uniform(-30e3, 30e3, d)


def seen(bare, truth, seed=1):
    return simulate(bare, truth, np.random.SeedSequence(seed))


def satellite(rows, seconds=240.0, sigma=1.0, frame=ECEF, level=0.0):
    """Doppler shifts of a satellite in low orbit with an unknown offset, and an emitter of known height."""
    time = np.linspace(0.0, seconds, rows)
    radius, tilt = 7151e3, 1.5
    turn = 0.6 + np.sqrt(3.986e14 / radius**3) * (time - seconds / 2)
    rate = np.sqrt(3.986e14 / radius**3)
    place = radius * np.stack([np.cos(turn), np.sin(turn) * np.cos(tilt), np.sin(turn) * np.sin(tilt)], axis=-1)
    speed = radius * rate * np.stack([-np.sin(turn), np.cos(turn) * np.cos(tilt), np.cos(turn) * np.sin(tilt)], axis=-1)
    # the axes turn with the Earth, so that an emitter on the ground is at rest in them
    angle = EARTH_RATE * time
    c, s = np.cos(angle), np.sin(angle)
    place, speed = (
        np.stack([c * v[:, 0] + s * v[:, 1], c * v[:, 1] - s * v[:, 0], v[:, 2]], axis=-1) for v in (place, speed)
    )
    speed = speed - EARTH_RATE * np.stack([-place[:, 1], place[:, 0], 0 * time], axis=-1)
    place, speed = frame.from_ecef(place), speed @ frame.rotation_to_ecef()
    stations = Stations(place[:, None], ("low",), velocity=speed[:, None])
    own = np.arange(rows)
    bare = assemble(
        stations,
        measured("range_rate", a=0 * own, epoch=own, sigma=sigma),
        times=time,
        frame=frame,
        constraints=height(exactly=level),
        biases=(Bias("offset", ("emitter",), own, 0 * own, np.ones(rows)),),
    )
    return bare, np.append(frame.from_ecef(geodetic_to_ecef(0.62, 0.2, level)), 1234.0)


def test_differences_of_aircraft_lead_to_the_fix_from_the_truth():
    found = 0
    for seed in range(4):
        bare, truth = aircraft(seed=seed)
        problem = seen(bare, truth)
        fix, best = solve(problem, "sdp+lsr"), solve(problem, "lsr", start=truth)
        found += bool(fix.cost <= best.cost * (1 + 1e-6) + 1e-6)
    assert found == 4


def test_one_pair_over_its_epochs():
    bare, truth = aircraft(count=2, epochs=5, seed=3)
    problem = seen(bare, truth)
    fix, best = solve(problem, "sdp+lsr"), solve(problem, "lsr", start=truth)
    assert fix.cost <= best.cost * (1 + 1e-6) + 1e-6


@pytest.mark.parametrize("rows", few([120, 8], 1))
def test_a_pass_with_an_offset_has_both_sides(rows):
    bare, truth = satellite(rows)
    problem = seen(bare, truth)
    fix, best = solve(problem, "sdp+lsr"), solve(problem, "lsr", start=truth)
    assert fix.cost <= best.cost * (1 + 1e-6) + 1e-6
    ends = np.concatenate([fix.position[None], fix.alternatives.x[:, :3]])
    assert np.linalg.norm(ends - best.position, axis=1).min() < 1.0
    # one side fits as the Earth turns; the other is a minimum all the same, some hundred kilometres away
    starts = doppler_starts(problem.flat())[0]
    sides = {round(float(solve(problem, "lsr", start=x).position[1]) / 1e4) for x in starts}
    assert len(sides) == 2


def test_rows_beside_and_stations_by_the_dozen():
    rng = np.random.default_rng(4)
    place, speed = rng.uniform(-10e3, 10e3, (60, 2)), rng.normal(0, 120, (60, 2))
    stations = Stations(place[None], tuple(map(str, range(60))), velocity=speed[None])
    a = np.arange(1, 60)
    bare = assemble(
        stations,
        measured("fdoa", a=a, b=0 * a, sigma=0.1),
        measured("tdoa", a=a[:3], b=0 * a[:3], arrival_sigma=30.0),
        measured("azimuth", a=[0], sigma=0.3),
    )
    problem, truth = seen(bare, np.array([12e3, -21e3])), np.array([12e3, -21e3])
    assert np.linalg.norm(solve(problem, "sdp+lsr").position - truth) < 500.0


def test_who_is_served():
    bare, truth = aircraft()
    assert has_doppler_of_rest(bare)
    assert not has_doppler_of_rest(aircraft(motion=Motion(1))[0])
    assert not has_doppler_of_rest(assemble(np.eye(2), measured("range", a=[0, 1], sigma=1.0)))
    # without a row of rates that is present there is nothing to start from
    problem = seen(bare, truth).flat()
    assert np.isnan(doppler_starts(problem.with_rows(weight=np.zeros(problem.count)))).all()


def agrees(problem, truth, away):
    """Return the fix of IPOPT from beside the truth, which the damped iteration agrees with."""
    start = truth + away
    one, other = solve(problem, "nlp", start=start), solve(problem, "lsr", start=start)
    assert one.answered
    assert one.stages[-1].name == "nlp"
    np.testing.assert_allclose(one.x, other.x, rtol=1e-6, atol=1e-6 * np.linalg.norm(other.position))
    assert one.cost == pytest.approx(other.cost, rel=1e-6)
    return one


@pytest.mark.parametrize("d", [2, 3])
def test_ipopt_finds_the_minimum_of_differences(d):
    bare, truth = aircraft(count=6, d=d, seed=5)
    agrees(seen(bare, truth), truth, 300.0)
    # an emitter that moves, its speed told by differences of arrival beside
    moving = Motion(1)
    bare, truth = aircraft(count=6, d=d, seed=5, motion=moving)
    a = np.arange(1, 6)
    bare = assemble(
        bare.stations,
        measured("fdoa", a=a, b=0 * a, sigma=0.1),
        measured("tdoa", a=a, b=0 * a, arrival_sigma=5.0),
        motions=(moving,),
    )
    agrees(seen(bare, np.append(truth, np.full(d, 9.0))), np.append(truth, np.full(d, 9.0)), 20.0)


@pytest.mark.parametrize("frame", [ECEF, Frame.enu(lat_deg=35.0, lon_deg=11.0, height=20.0)])
def test_ipopt_stays_at_a_known_height(frame):
    bare, truth = satellite(8, frame=frame, level=350.0)
    fix = agrees(seen(bare, truth), truth, np.array([500.0, -800.0, 400.0, 3.0]))
    assert abs(bare.frame.to_geodetic(fix.position)[2] - 350.0) < 1e-6
    # far from it the start, by the relaxation
    found = solve(seen(bare, truth), "sdp+nlp")
    assert found.cost <= fix.cost * (1 + 1e-6)
    assert abs(bare.frame.to_geodetic(found.position)[2] - 350.0) < 1e-6
