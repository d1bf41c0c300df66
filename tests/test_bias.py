"""Families of biases by name: who is touched by what, with which sign and prior."""

import numpy as np
import pytest
from cases import STATIONS

from optloc import InvalidProblem, Motion, Stations, assemble, measured, predict, with_bias

A, B = np.array([1, 2, 3, 2]), np.array([0, 0, 0, 1])
NAMES = ("ref", "north", "east", "west")
PLACE = np.array([[0.0, 0.0], [5e3, 1e3], [-2e3, 6e3], [3e3, -4e3]])


def stations(axes=None):
    return Stations(PLACE[None], NAMES, axes=axes)


def posed(*extra, place=None):
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
    problem = with_bias(posed(), "clock")
    assert problem.layout.find("clock")[0].members == NAMES
    np.testing.assert_allclose(effect(problem, "clock", [1.0, 10.0, 100.0, 1000.0]), [9, 99, 999, 90], atol=1e-9)
    np.testing.assert_allclose(
        effect(with_bias(posed(), "c", members=["west", "north"]), "c", [1.0, 10.0]), [10, 0, 1, -10], atol=1e-9
    )
    ranges = posed(measured("range_sum", a=A, b=B, sigma=1.0))
    np.testing.assert_allclose(effect(with_bias(ranges, "c"), "c", [1.0, 10.0, 100.0, 1000.0]), [11, 101, 1001, 110])


def test_stations_of_a_group_share_one():
    problem = with_bias(posed(), "system", members={"hill": ["north", "east"], "plain": ["west"]})
    assert problem.layout.labels()[-2:] == ("system hill", "system plain")
    np.testing.assert_allclose(effect(problem, "system", [1.0, 10.0]), [1, 1, 10, 0], atol=1e-9)


def test_pairs_and_kinds():
    problem = with_bias(posed(), "pair", per="pair", members=["east-north", "north-ref"])
    np.testing.assert_allclose(effect(problem, "pair", [1.0, 10.0]), [10, 0, 0, 1], atol=1e-9)
    every = with_bias(posed(), "pair", per="pair")
    assert every.layout.find("pair")[0].members == ("north-ref", "east-ref", "east-north", "west-ref")
    np.testing.assert_allclose(effect(every, "pair", [1.0, 2.0, 3.0, 4.0]), [1, 2, 4, 3], atol=1e-9)
    both = posed(measured("range", a=[0, 1], sigma=1.0), measured("azimuth", a=[2], sigma=0.1))
    np.testing.assert_allclose(effect(with_bias(both, "d", per="kind", kind="range"), "d", [5.0]), [5, 5, 0])
    alone = with_bias(both, "d", per="pair", kind="range")
    assert alone.layout.find("d")[0].members == ("ref", "north")


def test_forms_multiply_and_grow_with_time():
    problem = assemble(stations(), measured("range", a=[0, 0], epoch=[0, 1], sigma=1.0), times=[3.0, 8.0])
    drift = with_bias(problem, "drift", form="drift", per="kind")
    np.testing.assert_allclose(effect(drift, "drift", [2.0]), [0.0, 10.0], atol=1e-9)
    scale = with_bias(problem, "scale", form="scale", per="kind")
    np.testing.assert_allclose(effect(scale, "scale", [0.01]), np.full(2, 7.0 * np.sqrt(2.0)))
    turned = with_bias(posed(measured("azimuth", a=[0], sigma=0.1)), "mount", form="rotation")
    np.testing.assert_allclose(effect(turned, "mount", [1e-3]), [-1e-3], rtol=1e-6)


def test_priors_are_one_for_all_or_one_each():
    problem = with_bias(posed(), "clock", mean=[1.0, 2.0, 3.0, 4.0], sigma=200.0)
    np.testing.assert_array_equal(problem.biases[0].mean, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(problem.biases[0].sigma, np.full(4, 200.0))
    assert with_bias(posed(), "clock").biases[0].sigma is None
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
    "no members": ({"members": []}, "members.*no one"),
    "a member twice": ({"members": ["north", "north"]}, "north is named twice"),
    "two groups": ({"members": {"a": ["north"], "b": ["north"]}}, "'b'.*north is in two groups"),
    "members of a kind": ({"per": "kind", "members": ["tdoa"]}, "no members"),
    "groups of pairs": ({"per": "pair", "members": {"a": ["north-ref"]}}, "no groups"),
    "turned differences": ({"form": "rotation"}, "axes"),
    "turned differences by name": ({"form": "rotation", "kind": "tdoa"}, "tdoa has no axes"),
    "negative prior": ({"sigma": -1.0}, "sigma is not positive"),
    "prior of another size": ({"sigma": [1.0, 2.0]}, "sigma has 2 entries for 4 members"),
    "prior that is no number": ({"sigma": "200 m"}, "'200 m'.*sigma|sigma.*'200 m'"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_mistakes_are_named(name):
    options, words = BAD[name]
    with pytest.raises(InvalidProblem, match=f"bias 'clock'.*({words})|{words}") as error:
        with_bias(posed(), "clock", **options)
    assert "clock" in str(error.value)


@pytest.mark.parametrize("name", ["position", "velocity[2]", "emission", "stations", ""])
def test_names_of_other_unknowns_are_taken(name):
    with pytest.raises(InvalidProblem, match=r"taken|empty"):
        with_bias(posed(), name)


def test_a_name_is_given_once_and_a_member_touches_a_row():
    with pytest.raises(InvalidProblem, match="'clock' is taken twice"):
        with_bias(with_bias(posed(), "clock"), "clock")
    with pytest.raises(InvalidProblem, match="west touches no row"):
        with_bias(posed(measured("tdoa", a=[1, 2], b=0, sigma=1.0)), "clock", members=["north", "west"])
    mixed = posed(measured("range", a=[0], sigma=1.0), measured("azimuth", a=[2], sigma=0.1))
    with pytest.raises(InvalidProblem, match="different quantities; name the kind"):
        with_bias(mixed, "clock")
