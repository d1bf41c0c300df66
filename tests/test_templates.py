"""Problems that differ in their measurements alone share checked noise: they equal problems that are made anew."""

from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

import optloc
from optloc import InvalidProblem, assemble, constraints, measured
from optloc.base.cache import key_of
from optloc.base.types import Bias, Prior, Stations
from optloc.files import by_station, one_call as locating
from optloc.problem import build
from optloc.problem.problem import Problem

ENU = optloc.Frame.enu(lat_deg=47.0, lon_deg=11.0)
DERIVED = ("starts", "layout", "batch_shape", "structure")


def same(one, other):
    """Return whether two values are equal in every field and every bit of their arrays; NaN equals NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return one == other


def anew(*args, **options):
    """Assemble without templates."""
    kept, build._key = build._key, lambda *_: None
    try:
        return assemble(*args, **options)
    finally:
        build._key = kept


def stations(rng, d):
    """Return stations as arrays, or with names, velocities and errors of their positions."""
    place = np.round(rng.uniform(-1e3, 1e3, (rng.integers(4, 7), d)), 1)
    count, kind = len(place), rng.integers(4)
    if kind < 2:
        return place if kind else place.tolist(), count
    names = tuple(f"{rng.choice(list('PQ'))}{i}" for i in range(count))
    velocity = rng.standard_normal((1, count, d)) if kind == 2 else None
    covariance = np.broadcast_to(np.eye(d), (count, d, d)) if rng.integers(2) else None
    return Stations(
        place[None], names, velocity, covariance=covariance, span=str(rng.choice(["epoch", "noise"]))
    ), count


def measurements(rng, count, d, batch):
    """Return rows of one or two kinds, independent or of arrivals, some values missing, some rows absent."""
    for kind in rng.choice(["tdoa", "toa", "azimuth", "range", "fdoa"], rng.integers(1, 3), replace=False):
        rows = int(rng.integers(2, count))
        z = rng.standard_normal((*batch, rows))
        z[rng.random(z.shape) < 0.1] = np.nan
        sigma = float(rng.choice([1.0, 2.0]))
        noise = {"arrival_sigma": sigma} if kind == "tdoa" and rng.integers(2) else {"sigma": np.full(rows, sigma)}
        b = {"b": 0} if kind in ("tdoa", "fdoa") else {}
        weight = (rng.random(rows) < 0.8).astype(float) if rng.integers(2) else 1.0
        yield str(kind), z, {"a": np.arange(1, rows + 1), "weight": weight, **b, **noise}


def scene(seed):
    """Return a call of `assemble` of a random structure; of one seed in three the structure is wrong."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 4))
    where, count = stations(rng, d)
    rows = list(measurements(rng, count, d, [(), (3,)][rng.integers(2)]))
    options = {}
    if d == 3 and rng.integers(2):
        options = {"frame": ENU, "constraints": [constraints.height(lower=0.0)]}
    if rng.integers(3) == 0:
        options["priors"] = [Prior("position", np.zeros(d), np.eye(d) * 1e4)]
    if rng.integers(3) == 0:
        options["biases"] = [Bias("delay", ("one",), np.array([0]), np.array([0]), np.ones(1), sigma=np.ones(1))]
    if rng.integers(6) == 0:
        options["covariance"] = np.eye(int(rng.integers(3, 6)))
    return where, rows, options, rng


def made(build_problem, where, rows, options):
    """Return the problem, or the error."""
    try:
        return build_problem(where, *(measured(kind, z, **more) for kind, z, more in rows), **options)
    except InvalidProblem as error:
        return error


def test_problems_equal_those_that_are_made_anew():
    """Each structure comes three times with other values, the last time with one that is infinite."""
    build._TEMPLATES.clear()
    errors = 0
    for seed in range(300):
        where, rows, options, rng = scene(seed)
        for turn in range(3):
            rows = [(kind, rng.standard_normal(z.shape), more) for kind, z, more in rows]
            if turn == 2:
                rows[-1][1][..., -1] = np.inf
            one, other = (made(work, where, rows, options) for work in (assemble, anew))
            assert type(one) is type(other), seed
            if isinstance(one, Problem):
                assert same(one, other), seed
                assert all(same(getattr(one, name), getattr(other, name)) for name in DERIVED), seed
            else:
                errors += 1
                assert str(one) == str(other)
    assert 300 <= errors < 600  # the third of each, and structures that are wrong
    assert len(build._TEMPLATES) > 100


def simple(place, z, **more):
    return assemble(place, measured("range", z, a=[0, 1, 2], **({"sigma": 1.0} | more)))


def test_the_arrays_of_a_caller_stay_its_own():
    """Neither a change of what a problem was made of, nor of its rows, reaches the next problem."""
    place, cov = np.array([[0.0, 0], [9, 0], [0, 9]]), np.eye(3)
    first = simple(place, np.ones(3), sigma=None, covariance=cov)
    first.rows[0].a[0], first.rows[0].weight[1] = 2, 0.0
    cov[0, 0] = 7.0
    second = simple(place, np.ones(3), sigma=None, covariance=np.eye(3))
    assert same(second, anew(place, measured("range", np.ones(3), a=[0, 1, 2], covariance=np.eye(3))))
    third = simple(place, np.ones(3), sigma=None, covariance=cov)
    assert third.noise.blocks[0].covariance[0, 0, 0] == 7.0
    place[0] = 1.0
    assert simple(place, np.ones(3)).stations.position[0, 0, 0] == 1.0


def test_what_differs_has_another_key():
    """Every number but the measured values is part of the key."""
    place = np.array([[0.0, 0], [9, 0], [0, 9]])
    build._TEMPLATES.clear()
    simple(place, np.ones(3))
    simple(place, np.zeros(3))
    assert len(build._TEMPLATES) == 1
    others = ({"sigma": 2.0}, {"weight": [1, 1, 0]}, {"correction": 1.0}, {"epoch": [0, 0, 1]})
    for i, more in enumerate(others):
        simple(place, np.ones(3), **more)
        assert len(build._TEMPLATES) == 2 + i
    simple(place + 1.0, np.ones(3))
    simple(place, np.ones((2, 3)))
    assemble(Stations(place[None], ("a", "b", "c")), measured("range", np.ones(3), a=[0, 1, 2], sigma=1.0))
    assert len(build._TEMPLATES) == 5 + 3


def test_large_problems_have_no_template():
    many = 5000
    place = np.random.default_rng(0).uniform(0.0, 1e3, (many, 2))
    build._TEMPLATES.clear()
    assemble(place, measured("range", np.ones(many), a=np.arange(many), sigma=1.0))
    assert not len(build._TEMPLATES)


@pytest.mark.parametrize("value", [object(), np.array([None]), {1.0}, [np.zeros(5000)], type])
def test_what_has_no_key(value):
    assert key_of(value) is None


def test_keys_tell_shapes_types_and_names_apart():
    bias = Bias("a", ("x",), np.array([0]), np.array([0]), np.ones(1))
    values = [
        *(np.zeros(2), np.zeros((2, 1)), np.zeros(2, dtype=int), np.array([0.0, -0.0]), [0.0, 0.0], (0.0, 0.0)),
        *("0", {"a": 1.0}, {"b": 1.0}, np.float64(1.0), bias, replace(bias, sigma=np.ones(1)), None, np.nan),
    ]
    keys = [key_of(value) for value in values]
    assert None not in keys
    assert len(set(keys)) == len(keys)
    assert key_of(np.arange(3.0), ["a", bias]) == key_of(np.arange(3.0), ["a", replace(bias)])


# One call from receivers to a fix: what it reads of stations, units and names is kept.

PLACES = {"A": (0.0, 0.0, 10.0), "B": (900.0, 0.0, 0.0), "C": (0.0, 900.0, 50.0), "D": (800.0, 900.0, 0.0)}
GLOBE = {"A": (47.0, 11.0), "B": (47.01, 11.0), "C": (47.0, 11.01), "D": (47.01, 11.01)}
LENGTHS = {"A": 500.0, "B": 640.0, "C": 640.0, "D": 700.0}
TIMES = {name: length / 299792458.0 for name, length in LENGTHS.items()}
ANGLES = {"A": 40.0, "B": -50.0, "C": 140.0, "D": float("nan")}
CALLS = {
    "ranges": ((PLACES,), {"ranges": LENGTHS, "sigma": 30.0}),
    "whole numbers": ((PLACES,), {"ranges": {name: int(r) for name, r in LENGTHS.items()}, "sigma": 30}),
    "lists": (([*PLACES.values()],), {"ranges": [*LENGTHS.values()], "sigma": "3e1 m"}),
    "arrays": ((np.array([*PLACES.values()]),), {"ranges": np.array([[*LENGTHS.values()]] * 2), "sigma": 30.0}),
    "stations": ((Stations(np.array([[*PLACES.values()]]), tuple(PLACES)),), {"ranges": LENGTHS, "sigma": 30.0}),
    "other names": (({f"{name}1": p for name, p in PLACES.items()},), {"ranges": [*LENGTHS.values()], "sigma": 30.0}),
    "numbers as names": (
        (dict(enumerate(PLACES.values())),),
        {"ranges": dict(enumerate(LENGTHS.values())), "sigma": 9},
    ),
    "names that look like them": (
        (dict(zip([False, 1.0, 2, 3], PLACES.values(), strict=True)),),
        {"ranges": dict(zip([False, 1.0, 2, 3], LENGTHS.values(), strict=True)), "sigma": 9},
    ),
    "arrivals": ((PLACES,), {"toa": TIMES, "sigma": "100 ns"}),
    "nanoseconds": ((PLACES,), {"toa": {n: round(1e9 * t) for n, t in TIMES.items()}, "unit": "ns", "sigma": 100.0}),
    "differences": ((PLACES,), {"tdoa": {(n, "A"): 1e-7 for n in "BCD"}, "sigma": 1e-7, "height": (0.0, 500.0)}),
    "reference": ((PLACES,), {"tdoa": dict.fromkeys("ACD", 1e-7), "reference": "B", "sigma": 1e-7}),
    "on Earth": ((), {"latlon": GLOBE, "toa": TIMES, "sigma": 1e-7}),
    "bearings": ((), {"latlon": GLOBE, "bearings": ANGLES, "sigma": 2.0, "declination": "4 deg"}),
    "anticlockwise": ((), {"latlon": GLOBE, "bearings": ANGLES, "sigma": 2.0, "azimuth": "north-counterclockwise"}),
    "two kinds": ((PLACES,), {"ranges": LENGTHS, "bearings": ANGLES, "sigma": {"ranges": 30.0, "bearings": "2 deg"}}),
    "no such unit": ((PLACES,), {"ranges": LENGTHS, "sigma": 30.0, "unit": "parsec"}),
    "no such station": ((PLACES,), {"ranges": {"A": 1.0, "E": 2.0}, "sigma": 30.0}),
    "no sigma": ((PLACES,), {"ranges": LENGTHS}),
    "a list as sigma": ((PLACES,), {"ranges": LENGTHS, "sigma": [30.0]}),
    "sigma of a boolean": ((PLACES,), {"ranges": LENGTHS, "sigma": True}),
    "no such frame": ((PLACES,), {"ranges": LENGTHS, "sigma": 30.0, "frame": "moon"}),
    "no stations": (({},), {"ranges": LENGTHS, "sigma": 30.0}),
    "infinite": ((PLACES,), {"ranges": {"A": np.inf, "B": 2.0}, "sigma": 30.0}),
    "an infinite instant": ((PLACES,), {"toa": {"A": np.inf, "B": np.nan}, "sigma": 1e-7}),
    "too coarse": ((PLACES,), {"toa": {name: 1.7e9 + t for name, t in TIMES.items()}, "sigma": 1e-7}),
    "too far": ((PLACES,), {"tdoa": {"B": 1.0, "C": 2.0}, "sigma": 1e-7}),
}


def posed(monkeypatch, args, options):
    """Return the problem that `locate` makes, or the error."""
    found = []

    def solved(problem, method):
        found.append(problem)
        return SimpleNamespace(code=np.int8(optloc.Status.OK), shape=())

    monkeypatch.setattr(locating, "solve", solved)
    try:
        locating.locate(*args, **options)
    except InvalidProblem as error:
        return str(error)
    return found[0]


def test_locate_reads_the_same_again(monkeypatch):
    """Calls of all forms, one after the other, twice: a problem equals that of a process without anything kept."""
    alone = {}
    for name, (args, options) in CALLS.items():
        for kept in (locating._PLACES, locating._SCALES, by_station._ENDS, build._TEMPLATES):
            kept.clear()
        alone[name] = posed(monkeypatch, args, options)
    for _ in range(2):
        for name, (args, options) in CALLS.items():
            assert same(posed(monkeypatch, args, options), alone[name]), name
    assert sum(isinstance(found, str) for found in alone.values()) == 11
    assert alone["names that look like them"].stations.names == ("False", "1.0", "2", "3")
    assert alone["numbers as names"].stations.names == ("0", "1", "2", "3")


def test_locate_does_not_keep_what_a_caller_changes(monkeypatch):
    place, names = np.array([*PLACES.values()]), [*LENGTHS.values()]
    first = posed(monkeypatch, (place,), {"ranges": names, "sigma": 30.0})
    place[0] = 77.0
    second = posed(monkeypatch, (place,), {"ranges": names, "sigma": 30.0})
    assert (first.stations.position[0, 0] == PLACES["A"]).all()
    assert (second.stations.position[0, 0] == 77.0).all()
