"""Constraints of tables and arguments: one for each target, merged bands, finished constraints."""

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, constraints, station_array
from optloc.base.frames import CARTESIAN
from optloc.base.types import Band
from optloc.files.constraint_reader import constraints_of, demands_of, stated_arguments
from optloc.files.constraint_table import ConstraintTable

STILL = (Motion(),)


def test_a_constraint_without_a_target_holds_for_each_that_is_estimated():
    stations, motions = station_array([[0.0, 0.0, 0.0]]), [Motion(0, "run")] * 2
    table = ConstraintTable(kind="box", min=[0.0, 0.0, -1.0], max=[1.0, 2.0, float("inf")], unit="km")
    found, kept = constraints_of(demands_of({"here": table}), stations, CARTESIAN, motions, ["a", "b"], np.zeros(1))
    assert kept == tuple(motions)
    assert all(isinstance(one, Band) for one in found)
    assert {one.target for one in found} == {0, 1}
    assert {name for name in ("a", "b") if any(one.name.endswith(f" of {name}") for one in found)} == {"a", "b"}


def of(demands, d=2, motions=STILL, names=("target",)):
    stations = station_array(np.zeros((2, d)) + np.arange(2.0)[:, None])
    return constraints_of(demands, stations, CARTESIAN, motions, names, np.zeros(1))


def test_tables_and_finished_constraints_are_joined():
    given = [
        constraints.box((0.0, -np.inf), (5.0, np.inf)),
        {"kind": "box", "min": [1.0, -np.inf]},
        *constraints.disc((0.0, 0.0), 9.0),
        {"kind": "disc", "x": 0, "y": 0, "radius": 8},
        constraints.polyline([[0, 0], [1, 1], [3, 1]], 1.0),
        {"kind": "polyline", "points": [[0, 0], [1, 1], [3, 1]], "tolerance": 1},
    ]
    found, _ = of(stated_arguments(given))
    assert [(c.name, float(c.lower), float(c.upper)) for c in found if isinstance(c, Band)] == [
        ("x", 1.0, 5.0),
        ("disc", -np.inf, 8.0),
    ]
    assert [c.name for c in found if not isinstance(c, Band)] == ["polyline"]


def test_the_bound_that_acts_keeps_its_name():
    box = constraints.box((0.0, 0.0), (9.0, 9.0))
    given = [
        box,
        constraints.half_plane((0.0, 1.0), 5.0, name="fence"),
        constraints.half_plane((1.0, 0.0), 99.0, name="no"),
    ]
    found, _ = of(stated_arguments(given))
    assert [(c.name, float(c.lower), float(c.upper)) for c in found] == [
        ("x", 0.0, 9.0),
        ("y", 0.0, np.inf),
        ("fence", -np.inf, 5.0),
    ]
    # two bounds that meet are one equality
    given = [constraints.half_plane((0.0, 1.0), 5.0, name="a"), constraints.band((0.0, 1.0), 5.0, 8.0, name="b")]
    assert [(float(c.lower), float(c.upper)) for c in of(stated_arguments(given))[0]] == [(5.0, 5.0)]


def test_one_constraint_needs_no_list():
    (band,) = constraints.disc((0.0, 0.0), 9.0)
    for given in (band, (band,), [band], {"kind": "disc", "x": 0.0, "y": 0.0, "radius": 9.0}):
        assert [c.name for c in of(stated_arguments(given))[0]] == ["disc"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (5, "constraints.0.: int is no constraint"),
        ([constraints.disc((0, 0), 1), "disc"], "constraints.1.: str is no constraint"),
        ([{"kind": "disk"}], "constraints.0.: there is no constraint 'disk'"),
        ([{"kind": "disc", "x": 0, "y": 0}], "constraints.0.: disc has no 'radius'"),
        ([{"kind": "separation", "between": ["a", "b"], "min": 1}], "needs two targets"),
        (
            [{"kind": "annulus", "x": 0, "y": 0, "inner": 3, "outer": 2}],
            "inner radius is above the outer radius; exchange",
        ),
        ([{"kind": "terrain", "x": [0, 1], "y": [0, 1], "height": [[0, 1]] * 2, "min": 0}], "three dimensions"),
    ],
)
def test_a_wrong_argument_is_one_sentence(given, words):
    with pytest.raises(InvalidProblem, match=words):
        of(stated_arguments(given))


def test_errors_of_constructors_get_the_place_of_the_table():
    table = ConstraintTable(kind="polyline", points=[[0.0, 0.0], [0.0, 0.0]], tolerance=1.0)
    with pytest.raises(InvalidProblem, match="1: point 2 repeats point 1"):
        of(demands_of({"p.toml, [[constraints]] 1": table}))
    two = [Motion(1), Motion(1)]
    for table, words in (
        (ConstraintTable(kind="separation", between=["a", "c"], min=1.0), "no row has the target 'c'"),
        (ConstraintTable(kind="separation", between=["a"], min=1.0), "between two targets"),
        (ConstraintTable(kind="separation", between=["a", "b"], min=1.0, target="a"), "has no target"),
    ):
        with pytest.raises(InvalidProblem, match=words):
            of(demands_of({"here": table}), motions=two, names=("a", "b"))
