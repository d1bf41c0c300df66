"""Families of biases by name: who is touched by what, with which sign and prior."""

import numpy as np
import pytest
from cases import STATIONS
from often import few

from optloc import (
    InvalidProblem,
    Motion,
    Stations,
    assemble,
    constraints,
    crlb,
    measured,
    simulate,
    solve,
    station_array,
    with_bias,
)
from optloc.engine import predict
from optloc.linear.evaluate import differentiate
from optloc.problem import ECEF, with_known_bias

A, B = np.array([1, 2, 3, 2]), np.array([0, 0, 0, 1])
NAMES = ("ref", "north", "east", "west")
PLACE = np.array([[0.0, 0.0], [5e3, 1e3], [-2e3, 6e3], [3e3, -4e3]])


def stations(axes=None):
    return Stations(PLACE[None], NAMES, axes=axes)


def problem_of(*extra, place=None):
    rows = extra or (measured("tdoa", a=A, b=B, sigma=1.0),)
    return assemble(place or stations(), *rows, times=np.arange(1.0 + max(int(m.rows.epoch.max()) for m in rows)))


def effect(problem, name, values):
    """Return what given biases add to every row."""
    x = np.zeros(problem.layout.size)
    x[: problem.dimension] = 700.0
    base = predict(problem, x)
    slot, _ = problem.layout.find(name)
    x[slot.start : slot.start + slot.size] = values
    return predict(problem, x) - base


def test_stations_enter_with_the_sign_of_their_arrival():
    problem = with_bias(problem_of(), "clock")
    assert problem.layout.find("clock")[0].members == NAMES
    np.testing.assert_allclose(effect(problem, "clock", [1.0, 10.0, 100.0, 1000.0]), [9, 99, 999, 90], atol=1e-9)
    np.testing.assert_allclose(
        effect(with_bias(problem_of(), "c", members=["west", "north"]), "c", [1.0, 10.0]), [10, 0, 1, -10], atol=1e-9
    )
    ranges = problem_of(measured("range_sum", a=A, b=B, sigma=1.0))
    np.testing.assert_allclose(effect(with_bias(ranges, "c"), "c", [1.0, 10.0, 100.0, 1000.0]), [11, 101, 1001, 110])


def test_stations_of_a_group_share_one():
    problem = with_bias(problem_of(), "system", members={"hill": ["north", "east"], "plain": ["west"]})
    assert problem.layout.labels()[-2:] == ("system hill", "system plain")
    np.testing.assert_allclose(effect(problem, "system", [1.0, 10.0]), [1, 1, 10, 0], atol=1e-9)


def test_pairs_and_kinds():
    problem = with_bias(problem_of(), "pair", per="pair", members=["east-north", "north-ref"])
    np.testing.assert_allclose(effect(problem, "pair", [1.0, 10.0]), [10, 0, 0, 1], atol=1e-9)
    every = with_bias(problem_of(), "pair", per="pair")
    assert every.layout.find("pair")[0].members == ("north-ref", "east-ref", "east-north", "west-ref")
    np.testing.assert_allclose(effect(every, "pair", [1.0, 2.0, 3.0, 4.0]), [1, 2, 4, 3], atol=1e-9)
    both = problem_of(measured("range", a=[0, 1], sigma=1.0), measured("azimuth", a=[2], sigma=0.1))
    np.testing.assert_allclose(effect(with_bias(both, "d", per="kind", kind="range"), "d", [5.0]), [5, 5, 0])
    alone = with_bias(both, "d", per="pair", kind="range")
    assert alone.layout.find("d")[0].members == ("ref", "north")


def test_forms_multiply_and_grow_with_time():
    problem = assemble(stations(), measured("range", a=[0, 0], epoch=[0, 1], sigma=1.0), times=[3.0, 8.0])
    drift = with_bias(problem, "drift", form="drift", per="kind")
    np.testing.assert_allclose(effect(drift, "drift", [2.0]), [0.0, 10.0], atol=1e-9)
    scale = with_bias(problem, "scale", form="scale", per="kind")
    np.testing.assert_allclose(effect(scale, "scale", [0.01]), np.full(2, 7.0 * np.sqrt(2.0)))
    turned = with_bias(problem_of(measured("azimuth", a=[0], sigma=0.1)), "mount", form="rotation")
    np.testing.assert_allclose(effect(turned, "mount", [1e-3]), [-1e-3], rtol=1e-6)


def test_priors_are_one_for_all_or_one_each():
    problem = with_bias(problem_of(), "clock", mean=[1.0, 2.0, 3.0, 4.0], sigma=200.0)
    np.testing.assert_array_equal(problem.biases[0].mean, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(problem.biases[0].sigma, np.full(4, 200.0))
    assert with_bias(problem_of(), "clock").biases[0].sigma is None
    space = assemble(STATIONS[3], measured("azimuth", a=[0, 1], sigma=0.1))
    for sigma in (0.1, [0.1, 0.1], np.full((2, 3), 0.1), np.full(6, 0.1)):
        np.testing.assert_array_equal(
            with_bias(space, "mount", form="rotation", sigma=sigma).biases[0].sigma, np.full((2, 3), 0.1)
        )


def test_earlier_biases_stay_and_entries_are_named():
    place = Stations(
        np.zeros((1, 2, 3)) + np.eye(3)[:2] * 1e3, ("P", "Q"), covariance=np.stack([np.eye(3)] * 2), span="run"
    )
    problem = assemble(place, measured("azimuth", a=[0, 1], sigma=0.1), motions=[Motion(1)])
    problem = with_bias(with_bias(problem, "mount", form="rotation", members=["Q"]), "all", per="kind")
    assert problem.layout.labels() == (
        *(f"{name} {axis}" for name in ("position", "velocity") for axis in "xyz"),
        *("mount Q x", "mount Q y", "mount Q z", "all azimuth"),
        *(f"stations {name} {axis}" for name in "PQ" for axis in "xyz"),
    )


BAD = {
    "unknown station": ({"members": ["nroth"]}, "members.*'nroth'.*'north'"),
    "unknown pair": ({"per": "pair", "members": ["ref-north"]}, "members.*pair 'ref-north'.*north-ref"),
    "unknown kind": ({"kind": "taoa"}, "kind.*'taoa'.*tdoa"),
    "unknown form": ({"form": "ofset"}, "'ofset'.*did you mean 'offset'"),
    "unknown per": ({"per": "stations"}, "'stations'.*did you mean 'station'"),
    "no members": ({"members": []}, "members.*no name is given"),
    "a member twice": ({"members": ["north", "north"]}, "north is named twice"),
    "two groups": ({"members": {"a": ["north"], "b": ["north"]}}, "'b'.*north is in two groups"),
    "members of a kind": ({"per": "kind", "members": ["tdoa"]}, "no members"),
    "groups of pairs": ({"per": "pair", "members": {"a": ["north-ref"]}}, "no groups"),
    "turned differences": ({"form": "rotation"}, "axes"),
    "turned differences by name": ({"form": "rotation", "kind": "tdoa"}, "tdoa has no axes"),
    "negative prior": ({"sigma": -1.0}, "sigma is not positive"),
    "time of pairs": ({"form": "time", "per": "pair"}, "a time along a course belongs to one station"),
    "time of stations that stay": ({"form": "time"}, "needs velocities"),
    "prior of another size": ({"sigma": [1.0, 2.0]}, "sigma has 2 entries for 4 members"),
    "prior that is no number": ({"sigma": "much"}, "sigma: 'much' is no amount"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_mistakes_are_named(name):
    options, words = BAD[name]
    with pytest.raises(InvalidProblem, match=f"bias 'clock'.*({words})|{words}") as error:
        with_bias(problem_of(), "clock", **options)
    assert "clock" in str(error.value)


@pytest.mark.parametrize("name", ["position", "velocity[2]", "emission", "stations", ""])
def test_names_of_other_unknowns_are_taken(name):
    with pytest.raises(InvalidProblem, match=r"taken|empty"):
        with_bias(problem_of(), name)


def test_a_name_is_given_once_and_a_member_touches_a_row():
    with pytest.raises(InvalidProblem, match="'clock' is used twice"):
        with_bias(with_bias(problem_of(), "clock"), "clock")
    with pytest.raises(InvalidProblem, match="west affects no row"):
        with_bias(problem_of(measured("tdoa", a=[1, 2], b=0, sigma=1.0)), "clock", members=["north", "west"])
    mixed = problem_of(measured("range", a=[0], sigma=1.0), measured("azimuth", a=[2], sigma=0.1))
    with pytest.raises(InvalidProblem, match="different quantities; name the kind"):
        with_bias(mixed, "clock")


# Seconds along a course: satellites whose elements put them too far ahead, to the first order.

GM, TURN, TIMES = 3.986004418e14, 7.292115e-5, np.arange(-120.0, 121.0, 10.0)
EMITTER = ECEF.from_geodetic(np.radians(47.8), np.radians(11.2), 600.0)
AHEAD = 0.13  # s: a kilometre


def turned(place, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * place[:, 0] - s * place[:, 1], s * place[:, 0] + c * place[:, 1], place[:, 2]], axis=-1)


def orbit(times, up, ahead):
    """Return places and velocities of a satellite 780 km high over the turning Earth."""
    up = np.array(up) / np.linalg.norm(up)
    ahead = np.array(ahead) - np.dot(ahead, up) * up
    ahead, radius = ahead / np.linalg.norm(ahead), 7158e3
    angle = (np.sqrt(GM / radius**3) * times)[:, None]
    place = turned(radius * (np.cos(angle) * up + np.sin(angle) * ahead), -TURN * times)
    speed = np.sqrt(GM / radius) * (np.cos(angle) * ahead - np.sin(angle) * up)
    return place, turned(speed, -TURN * times) - np.cross([0.0, 0.0, TURN], place)


def passing(*kinds, shift=(0.0, 0.0)):
    """Return rows of two satellites, each so many seconds further than its orbit says."""
    k, orbits = len(TIMES), (((0.62, 0.3, 0.7), (-0.6, -0.1, 0.8)), ((0.75, -0.1, 0.6), (0.3, 0.9, 0.2)))
    places, rates = zip(*(orbit(TIMES + s, *each) for s, each in zip(shift, orbits, strict=True)), strict=True)
    stations = station_array(np.stack(places, axis=1), ("one", "two"), velocity=np.stack(rates, axis=1))
    each = {"a": np.repeat([0, 1], k), "epoch": np.tile(np.arange(k), 2)}
    rows = [measured(kind, sigma=5.0 if kind == "range" else 0.2, **each) for kind in kinds]
    rows.append(measured("fdoa", a=[0] * k, b=[1] * k, epoch=np.arange(k), sigma=0.2))
    held = constraints.height(exactly=600.0)
    return assemble(stations, *rows, times=TIMES, motions=[Motion()], frame=ECEF, constraints=held)


def test_a_time_moves_ranges_and_rates_as_the_orbit_does():
    shift = np.array([AHEAD, -0.2])
    problem = with_bias(passing("range_rate", "range"), "ahead", form="time", sigma=AHEAD)
    x = np.append(EMITTER, shift)
    modelled = predict(problem, x)
    moved = predict(passing("range_rate", "range", shift=shift), EMITTER)
    assert np.abs(moved - predict(problem, np.append(EMITTER, [0.0, 0.0]))).max() > 1000.0
    # what is left is of the second order, half of 8 m/s^2 times 0.2^2, and the rate of the acceleration
    np.testing.assert_allclose(modelled[:50], moved[:50], atol=0.003)
    np.testing.assert_allclose(modelled[50:100], moved[50:100], atol=0.3)
    np.testing.assert_allclose(modelled[100:], moved[100:], atol=0.003)
    np.testing.assert_allclose(predict(with_known_bias(problem, "ahead", shift), EMITTER), modelled, atol=1e-6)
    steps = 1e-3 * np.eye(5)[3:]
    slopes = np.stack([(predict(problem, x + h) - predict(problem, x - h)) / 2e-3 for h in steps], axis=-1)
    np.testing.assert_allclose(differentiate(problem, x)[1][:, 3:], slopes, atol=1e-4)


@pytest.mark.parametrize("count", few([100, 300], 1))
def test_a_time_and_its_covariance_are_those_of_draws(count):
    problem = with_bias(passing("range_rate"), "ahead", form="time", sigma=AHEAD)
    problem = with_bias(problem, "frequency", per="kind", kind="range_rate")
    rng = np.random.default_rng(7)
    truth = np.zeros((count, 6))
    truth[:, :3], truth[:, 3:5] = EMITTER, AHEAD * rng.standard_normal((count, 2))
    fixes = solve(simulate(problem, truth=truth, seed=8), start=truth)
    east, north = ECEF.enu_axes(EMITTER)[:2]
    seen = np.zeros((5, 6))
    seen[0, :3], seen[1, :3], seen[2:, 3:] = east, north, np.eye(3)
    bound = seen @ crlb(problem, np.append(EMITTER, np.zeros(3))) @ seen.T
    error = (fixes.x - truth) @ seen.T
    # the data tell three quarters of what is known of the times: they are not their prior
    assert (np.sqrt(np.diag(bound))[2:4] < 0.5 * AHEAD).all()
    nees = np.einsum("ni,ij,nj->n", error, np.linalg.inv(bound), error)
    assert abs(nees.mean() - 5.0) < 4.0 * np.sqrt(10.0 / count)
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(np.diag(bound)), rtol=0.2)
    own = np.sqrt(np.diagonal(seen @ fixes.cov @ seen.T, axis1=-2, axis2=-1))
    np.testing.assert_allclose(own, np.broadcast_to(np.sqrt(np.diag(bound)), own.shape), rtol=0.02)


def test_stations_that_stay_have_no_time_along_a_course():
    problem = passing("range_rate")
    velocity = problem.stations.velocity.copy()
    velocity[:, 1] = 0.0
    still = assemble(
        station_array(problem.stations.position, ("one", "two"), velocity=velocity),
        measured("range_rate", a=[0, 1], epoch=[0, 0], sigma=1.0),
        times=TIMES,
        motions=[Motion()],
        frame=ECEF,
    )
    with pytest.raises(InvalidProblem, match=r"two does not move, so it has no time.*; name the stations"):
        with_bias(still, "ahead", form="time")
    assert with_bias(still, "ahead", form="time", members=["one"]).layout.find("ahead")[0].unit == "s"


def test_equal_structures_with_other_velocities_are_told_apart():
    shift, problem = np.array([0.5, 0.5]), with_bias(passing("range_rate"), "ahead", form="time")
    other = with_bias(passing("range_rate", shift=(30.0, 30.0)), "ahead", form="time")
    x = np.append(EMITTER, shift)
    for each in (problem, other, problem):
        np.testing.assert_allclose(predict(each, x), predict(with_known_bias(each, "ahead", shift), EMITTER), atol=1e-6)
