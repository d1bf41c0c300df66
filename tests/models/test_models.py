"""Every kind: numbers, symbols, derivatives and lifted rows of the one h agree, and are those of the textbook."""

import casadi as ca
import numpy as np
import pymap3d
import pytest
from cases import RATE, STATIONS, TARGET, plain_h, turn_matrix, turned

from optloc.models import MODELS, Point, lifted_row
from optloc.models.primitives import WGS84_A, WGS84_F, Jet, geodetic_height, geodetic_normal, rotate, wrap
from optloc.problem import ECEF

KINDS = [(kind, d) for kind, model in MODELS.items() for d in model.dimensions]
BATCH = 40


def numbers(kind, d, seed=1):
    """Inputs (n, BATCH) in the order position, velocity, a, its velocity, b, its velocity; axes (3 or none)."""
    rng = np.random.default_rng(seed)
    if kind == "height":
        lat, lon = np.arcsin(rng.uniform(-1, 1, BATCH)), rng.uniform(-np.pi, np.pi, BATCH)
        place = np.stack(pymap3d.geodetic2ecef(lat, lon, rng.uniform(0, 2e4, BATCH), deg=False))
    else:
        place = TARGET[d][:, None] + rng.normal(0.0, 2e3, (d, BATCH))
    rates = [rng.normal(0.0, 100.0, (d, BATCH)) for _ in range(3)]
    a, b = (rng.normal(0.0, 5e3, (d, BATCH)) for _ in range(2))
    axes = np.moveaxis(turned(seed, d, BATCH)[0], 0, -1)
    return np.concatenate([place, rates[0], a, rates[1], b, rates[2]]), axes


def points(kind, d, inputs, axes):
    """Three points from 6 d components, with what the kind asks for."""
    parts = [tuple(inputs[i * d : (i + 1) * d]) for i in range(6)]
    model = MODELS[kind]
    own = tuple(tuple(row) for row in axes) if model.axes else None

    def point(i, axes=None):
        return Point(
            parts[2 * i], parts[2 * i + 1] if model.velocity else None, axes, parts[2 * i] if model.ecef else None
        )

    return point(0), point(1, own), point(2)


def evaluate(kind, d, inputs, axes):
    return MODELS[kind].h(*points(kind, d, inputs, axes))


def symbols(kind, d):
    x, axes = ca.SX.sym("x", 6 * d), [[ca.SX.sym(f"e{i}{j}") for j in range(d)] for i in range(d)]
    h = evaluate(kind, d, [x[i] for i in range(6 * d)], axes)
    flat = ca.vertcat(*(e for row in axes for e in row))
    return ca.Function("h", [x, flat], [h, ca.jacobian(h, x)])


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_numpy_casadi_and_the_textbook_agree(kind, d):
    inputs, axes = numbers(kind, d)
    values = evaluate(kind, d, inputs, axes)
    function = symbols(kind, d)
    for i in range(BATCH):
        p, v, a, va, b, vb = inputs[:, i].reshape(6, d)
        symbolic = float(function(inputs[:, i], axes[:, :, i].ravel())[0])
        assert symbolic == pytest.approx(values[i], rel=1e-13, abs=2e-9 if kind == "height" else 1e-12)
        plain = plain_h(kind, p, v, a, va, b, vb, axes[:, :, i] if MODELS[kind].axes else None, ECEF)
        assert values[i] == pytest.approx(plain, rel=1e-9, abs=1e-6 if kind == "height" else 1e-9)


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_jet_partials_are_those_of_casadi_and_of_finite_differences(kind, d):
    inputs, axes = numbers(kind, d, seed=2)
    jets = [Jet(inputs[i], {i: np.ones(1)}) for i in range(6 * d)]
    jet = evaluate(kind, d, jets, axes)
    partials = np.stack([np.broadcast_to(jet.partials.get(i, 0.0), BATCH) for i in range(6 * d)])
    function = symbols(kind, d)
    exact = np.stack(
        [np.asarray(function(inputs[:, i], axes[:, :, i].ravel())[1]).ravel() for i in range(BATCH)], axis=-1
    )
    scale = np.abs(exact).max(axis=0)
    # Geodetic height subtracts numbers of the size of the Earth's radius.
    assert (np.abs(partials - exact) <= (1e-10 if kind == "height" else 1e-12) * scale).all()
    numeric = np.zeros_like(partials)
    for i in range(6 * d):
        step = 1.0 if i % (2 * d) < d else 0.1
        high, low = inputs.copy(), inputs.copy()
        high[i] += step
        low[i] -= step
        change = evaluate(kind, d, high, axes) - evaluate(kind, d, low, axes)
        numeric[i] = (wrap(change) if MODELS[kind].period else change) / (2.0 * step)
    assert np.abs(numeric - partials).max() <= 1e-6 * max(1.0, np.abs(partials).max())
    assert (np.abs(numeric - partials).max(axis=0) <= 1e-5 * scale).all()


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_h_works_on_other_arrays(kind, d):
    xp = pytest.importorskip("array_api_strict")
    inputs, axes = numbers(kind, d, seed=3)
    foreign = evaluate(kind, d, [xp.asarray(v) for v in inputs], [[xp.asarray(e) for e in row] for row in axes])
    assert type(foreign).__module__.startswith("array_api_strict")
    assert np.allclose(np.asarray(foreign), evaluate(kind, d, inputs, axes), rtol=1e-13, atol=2e-9)


@pytest.mark.parametrize(("kind", "d"), KINDS)
def test_lifted_row_vanishes_at_h_and_its_factor_is_its_derivative(kind, d):
    model = MODELS[kind]
    inputs, axes = numbers(kind, d, seed=4)
    t, a, b = points(kind, d, inputs, axes)
    if kind in ("height", "range_rate", "fdoa"):
        assert lifted_row(model, model.h(t, a, b), a, b) is None
        return

    def row_at(m):
        row = lifted_row(model, m, a, b)
        ra = np.linalg.norm(np.array(t.position) - np.array(a.position), axis=0)
        rb = np.linalg.norm(np.array(t.position) - np.array(b.position), axis=0)
        linear = 0.0 if row.x is None else sum(u * p for u, p in zip(row.x, t.position, strict=True))
        return linear + row.ra * ra + row.rb * rb + row.constant, row

    m = model.h(t, a, b)
    value, row = row_at(m)
    assert np.abs(value).max() < 1e-9 * 1e4
    step = 1e-6 * (1.0 + np.abs(m))
    numeric = (row_at(m + step)[0] - row_at(m - step)[0]) / (2.0 * step)
    factor = row.factor(t, a, b) * np.ones(BATCH)
    assert np.allclose(numeric, factor, rtol=1e-6, atol=1e-6 * np.abs(factor).max())
    assert np.abs(factor).min() > 1e-6 * np.abs(factor).max()  # such a row can be weighted


def test_each_kind_says_truly_whether_it_is_a_sum_of_ranges():
    for kind, d in KINDS:
        model = MODELS[kind]
        inputs, axes = numbers(kind, d, seed=5)
        t, a, b = points(kind, d, inputs, axes)
        if model.ranges is not None:
            ranges = [np.linalg.norm(np.array(t.position) - np.array(q.position), axis=0) for q in (a, b)]
            assert np.allclose(model.h(t, a, b), model.ranges[0] * ranges[0] + model.ranges[1] * ranges[1], rtol=1e-13)
        assert (model.ranges is None or model.ranges[1] == 0) == (model.stations < 2) or model.ranges is None


def test_axes_are_used_by_the_kinds_that_say_so():
    for kind, d in KINDS:
        if not MODELS[kind].axes:
            continue
        inputs, axes = numbers(kind, d, seed=6)
        level = np.broadcast_to(np.eye(d)[..., None], axes.shape)
        assert not np.allclose(evaluate(kind, d, inputs, axes), evaluate(kind, d, inputs, level))


# --------------------------------------------------------------------------------------------- geodetic height
def grid():
    lat = np.radians(np.r_[np.linspace(-90, 90, 361), -1e-9, 1e-9, 89.999999, -89.999999])
    height = np.r_[-5e3, -100.0, 0.0, 1.0, 1e3, 1e4, 1e5, 4e5, 1e6]
    lat, height = (v.ravel() for v in np.meshgrid(lat, height))
    return lat, np.linspace(-np.pi, np.pi, lat.size), height


def test_geodetic_height_is_exact_from_the_sea_bed_to_orbit():
    lat, lon, height = grid()
    ecef = ECEF.from_geodetic(lat, lon, height)
    found = geodetic_height(tuple(ecef.T))
    assert np.abs(found - height).max() < 5e-9  # a few units in the last place of the Earth's radius
    assert np.abs(found - ECEF.to_geodetic(ecef)[2]).max() < 1e-6
    assert np.abs(found - pymap3d.ecef2geodetic(*ecef.T)[2]).max() < 1e-6


def test_gradient_of_height_is_the_normal_of_the_ellipsoid():
    lat, lon, height = grid()
    ecef = ECEF.from_geodetic(lat, lon, height)
    jet = geodetic_height(tuple(Jet(ecef[:, i], {i: np.ones(1)}) for i in range(3)))
    normal = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    assert np.abs(np.stack([jet.partials[i] for i in range(3)]) - normal).max() < 1e-8


def test_the_normal_turns_as_differences_of_it_say():
    lat, lon, height = grid()
    ecef = np.concatenate([ECEF.from_geodetic(lat, lon, height), [[0.0, 0.0, 6.4e6], [0.0, 0.0, -6.4e6]]])
    seeds = tuple(Jet(ecef[:, i], {i: np.ones(1)}) for i in range(3))
    for i, component in enumerate(geodetic_normal(seeds)):
        for j, step in enumerate(50.0 * np.eye(3)):
            ahead, back = (geodetic_normal(tuple((ecef + s * step).T))[i] for s in (1.0, -1.0))
            # rounding of a difference over 100 m, and its third derivative, of turns of 1.6e-7 a metre
            assert np.abs(component.partials[j] - (ahead - back) / 100.0).max() < 1e-15


def test_height_and_its_derivative_are_finite_on_the_axis():
    b = WGS84_A * (1.0 - WGS84_F)
    for z in (b + 100.0, -b - 100.0):
        jet = geodetic_height(tuple(Jet(np.array(v), {i: np.ones(())}) for i, v in enumerate((0.0, 0.0, z))))
        assert jet.value == pytest.approx(100.0, abs=1e-8)
        assert np.isfinite([jet.partials[i] for i in range(3)]).all()
        assert jet.partials[2] == pytest.approx(np.sign(z), abs=1e-9)


# ------------------------------------------------------------------------------------------------- turned axes
@pytest.mark.parametrize("d", [2, 3])
def test_rotation_is_a_rotation_and_exact_to_third_order(d):
    rng = np.random.default_rng(8)
    for size in (1e-4, 1e-2, 0.3, 2.0):
        axes = turned(3, d, 1)[0, 0]
        turn = rng.normal(0.0, 1.0, 1 if d == 2 else 3)
        turn *= size / np.linalg.norm(turn)
        found = np.array(rotate(tuple(map(tuple, axes)), tuple(turn)))
        assert np.allclose(found @ found.T, np.eye(d), atol=1e-14)
        assert np.allclose(found, turn_matrix(turn) @ axes, atol=1e-13)
        exact = turn * (2.0 * np.arctan(size / 2.0) / size)
        assert np.abs(exact - turn).max() <= size**3 / 12.0 + 1e-15


def test_wrap_keeps_the_angle_and_lands_in_one_turn():
    angle = np.linspace(-30.0, 30.0, 10001)
    assert np.abs(wrap(angle)).max() <= np.pi
    assert np.allclose(np.exp(1j * wrap(angle)), np.exp(1j * angle), atol=1e-13)


# --------------------------------------------------------------------------------------------------- Jet alone
def test_jet_arithmetic_and_functions_follow_the_rules_of_calculus():
    from optloc.models import primitives as functions

    x0, y0 = np.array([0.7, 1.3, 2.9]), np.array([1.1, -0.4, 0.6])

    def all_of(x, y, f):
        plain = (2.0 - x) * y / (3.0 + x) - 1.0 / x + x * 0.25 - (y - 4.0) / 2.0 - (-x)
        powers = f.sqrt(x) * f.sin(y) - f.cos(x * y) + f.log(x) * f.exp(y)
        return plain + powers + f.hypot(x, 2.0) * f.hypot(3.0, y) + f.atan2(y, x) + f.atan2(2.0, x) * f.atan2(y, 1.5)

    jet = all_of(Jet(x0, {0: np.ones(1)}), Jet(y0, {1: np.ones(1)}), functions)
    assert np.allclose(jet.value, all_of(x0, y0, np), rtol=1e-14)
    step = 1e-6
    assert np.allclose(
        jet.partials[0], (all_of(x0 + step, y0, np) - all_of(x0 - step, y0, np)) / 2e-6, rtol=1e-7, atol=1e-7
    )
    assert np.allclose(
        jet.partials[1], (all_of(x0, y0 + step, np) - all_of(x0, y0 - step, np)) / 2e-6, rtol=1e-7, atol=1e-7
    )


def test_an_array_on_the_left_of_a_jet_is_elementwise():
    jet = np.arange(3.0) * Jet(np.ones(3), {0: np.ones(1)}) + np.arange(3.0)
    assert isinstance(jet, Jet)
    assert np.array_equal(jet.value, 2.0 * np.arange(3.0))
    assert np.array_equal(jet.partials[0], np.arange(3.0))


def test_the_table_stations_are_not_degenerate():
    for d, place in STATIONS.items():
        assert np.linalg.svd(place - place.mean(0))[1].min() > 1e3
        assert len(RATE[d]) == d
