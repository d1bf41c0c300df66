"""The atlas of all space: its nodes are bounded in every sample, and it leaves nothing out."""

import numpy as np
import pytest
from proof.sampling import numbers, value

from optloc.proof.atlas import atlas_of, contract_to_corners, is_near_minimum, piece_of, set_centre, write_position
from optloc.proof.box import station_cube
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.nodes.node import AZIMUTH, CURVE_WIDTH, ELEVATION, NODE_WIDTH, RANGE, RATIO

pytestmark = pytest.mark.usefixtures("form")

NAMES = {2: ("range", "azimuth", "groa"), 3: ("range", "azimuth", "groa", "elevation")}
CODES = {"range": RANGE, "azimuth": AZIMUTH, "groa": RATIO, "elevation": ELEVATION}


def scene(d, rng):
    """Return nodes of all kinds and an atlas with one known minimum of some cost outside the cube."""
    kinds = np.array([CODES[name] for name in NAMES[d]])
    data = np.stack([numbers("groa" if name == "range" else name, d, rng) for name in NAMES[d]])
    middle, radius = station_cube(kinds, data, np.zeros(d))
    atlas = atlas_of(middle, radius, d, 1)
    minima = atlas.minima
    x = middle[:d] + radius * rng.normal(size=d) * 2.0
    minima.home[0] = piece_of(atlas, x, minima.start[0])
    axes = np.zeros((3, 3))
    axes[:d, :d] = np.linalg.qr(rng.normal(size=(d, d)))[0] * 0.02 * minima.start[0, d - 1]
    minima.axes[0], minima.back[0, :d, :d] = axes, np.linalg.inv(axes[:d, :d])
    return kinds, data, atlas


def some_box(d, piece, rng):
    """Return centre and half-widths of one of the boxes that a piece is split into, or of one around the minimum."""
    at, half = np.zeros(3), np.zeros(3)
    if piece > 2 * d:
        half[:d] = rng.uniform(0.2, 1.0, d)
        at[:d] = rng.normal(size=d)
        return at, half
    level = rng.integers(0, 7, size=d)
    half[:d] = 0.5**level
    at[:d] = -1.0 + half[:d] * (2.0 * (rng.random(d) * 2.0**level).astype(int) + 1.0)
    if piece < 2 * d:
        at[d - 1], half[d - 1] = 0.5 * (at[d - 1] + 1.0), 0.5 * half[d - 1]
    return at, half


def positions(atlas, piece, u):
    """Return the positions of coordinates u (n, 3) of a piece, by the definition, not by the compiled code."""
    d, middle, radius, minima = atlas.dimension, atlas.middle, atlas.radius, atlas.minima
    if piece > 2 * d:
        u, piece = minima.start[0] + u @ minima.axes[0].T, int(minima.home[0])
    if piece == 2 * d:
        return np.where(np.arange(3) < d, middle + radius * u, 0.0)
    p = np.insert(u[:, : d - 1], piece // 2, 1.0 if piece % 2 else -1.0, axis=1)
    out = np.zeros((len(u), 3))
    out[:, :d] = middle[:d] + radius * p / u[:, [d - 1]]
    return out


def exact(name, d, data, atlas, x):
    if name == "range":
        return np.linalg.norm(x - data[:3], axis=-1) - np.linalg.norm(x - atlas.middle, axis=-1)
    return value(name, d, data, x)


@pytest.mark.parametrize("d", [2, 3])
def test_no_sample_leaves_its_enclosure_in_any_piece(d):
    rng = np.random.default_rng(1)
    widths = {name: [] for name in NAMES[d]}
    for n in range(160):
        kinds, data, atlas = scene(d, rng)
        piece = n % (2 * d + 2)
        at, half = some_box(d, piece, rng)
        nodes = np.zeros((len(kinds), NODE_WIDTH))
        set_centre(atlas, piece, at)
        bound_pieces(atlas, kinds, data, half, nodes)
        s = rng.uniform(-1.0, 1.0, (800, 3))
        s[:100] = np.sign(s[:100])
        s *= half
        if piece < 2 * d:
            s = s[at[d - 1] + s[:, d - 1] > 1e-6]
        x = positions(atlas, piece, at + s)
        for row, name, own in zip(nodes, NAMES[d], data, strict=True):
            slack = (1e-9 if piece < 2 * d else 1e-12) * (atlas.radius if name == "range" else max(1.0, abs(row[0])))
            rest = exact(name, d, own, atlas, x) - row[0] - s @ row[1:4]
            assert rest.min() >= row[4] - slack
            assert rest.max() <= row[5] + slack
            if row[1:4].any() and piece != 2 * d:
                widths[name].append((row[5] - row[4]) / np.ptp(rest))
    assert all(np.median(width) < 4.0 for width in widths.values())


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_and_hessians_change_no_more_than_bounded(d):
    rng = np.random.default_rng(2)
    counted = 0
    for n in range(60):
        kinds, data, atlas = scene(d, rng)
        piece = n % (2 * d + 2)
        at, half = some_box(d, piece, rng)
        nodes, curves, there, bent = (np.zeros((len(kinds), size)) for size in (NODE_WIDTH, CURVE_WIDTH) * 2)
        set_centre(atlas, piece, at)
        bound_pieces(atlas, kinds, data, half, nodes)
        curve_pieces(atlas, kinds, data, half, nodes, curves)
        bound_pieces(atlas, kinds, data, np.zeros(3), nodes)
        for _ in range(20):
            set_centre(atlas, piece, at + rng.uniform(-1.0, 1.0, 3) * half)
            bound_pieces(atlas, kinds, data, np.zeros(3), there)
            curve_pieces(atlas, kinds, data, np.zeros(3), there, bent)
            for j in np.flatnonzero(curves[:, 9] < np.inf):
                counted += 1
                change = np.abs(np.linalg.eigvalsh(full(bent[j] - curves[j]))).max()
                assert change <= curves[j, 9] * (1.0 + 1e-9) + 1e-9 * np.abs(curves[j, :6]).max()
                slack = 1e-9 * np.abs(nodes[j, 1:4]).max()
                assert (np.abs(there[j, 1:4] - nodes[j, 1:4]) <= curves[j, 6:9] * (1.0 + 1e-9) + slack).all()
    assert counted > 2000


def full(six):
    return np.array([[six[0], six[1], six[2]], [six[1], six[3], six[4]], [six[2], six[4], six[5]]])


@pytest.mark.parametrize("d", [2, 3])
def test_every_position_has_a_home(d):
    rng = np.random.default_rng(3)
    _, _, atlas = scene(d, rng)
    seen = set()
    for _ in range(300):
        x, u, back = rng.normal(size=d) * atlas.radius * 10 ** rng.uniform(-1.0, 4.0), np.zeros(3), np.zeros(d)
        home = piece_of(atlas, x, u)
        seen.add(home)
        assert np.abs(u[:d]).max() <= 1.0 + 1e-12
        assert home == 2 * d or u[d - 1] > 0.0
        set_centre(atlas, home, u)
        write_position(atlas, back)
        assert back == pytest.approx(x, rel=1e-9, abs=1e-9 * atlas.radius)
    assert seen == set(range(2 * d + 1))


@pytest.mark.parametrize("d", [2, 3])
def test_a_box_within_another_has_all_its_points_there(d):
    rng = np.random.default_rng(4)
    inside, beside = 0, 0
    for _ in range(200):
        _, _, atlas = scene(d, rng)
        minima, home = atlas.minima, int(atlas.minima.home[0])
        at, half, sides = np.zeros(3), np.zeros(3), np.zeros(3)
        half[:d], sides[:d] = rng.uniform(0.0, 0.004, d) * abs(minima.start[0, d - 1]), rng.uniform(0.1, 0.5, d)
        at[:d] = minima.start[0, :d] + rng.normal(size=d) * half[:d]
        set_centre(atlas, home, at)
        u = at + rng.uniform(-1.0, 1.0, (500, 3)) * half
        s = (u - minima.start[0]) @ minima.back[0].T
        minima.sides[0], minima.core[0, 0], minima.core[0, 1] = sides, -2.0 * sides, np.inf
        minima.core[0, 0, d - 1] = -np.inf
        convex, core = is_near_minimum(atlas, half, 0)
        inside, beside = inside + convex, beside + (core and not convex)
        assert not convex or (np.abs(s) <= sides).all()
        assert not core or (s[:, : d - 1] >= -2.0 * sides[: d - 1]).all()
    assert min(inside, beside) > 10


@pytest.mark.parametrize("d", [2, 3])
def test_no_position_between_the_corners_is_cut_off(d):
    """On faces and inside, near the corners and far off: what is left of a box holds all that lies between them."""
    rng, parts, lost = np.random.default_rng(5), 0, 0
    for _ in range(300):
        atlas = atlas_of(rng.standard_normal(3) * (np.arange(3) < d), float(rng.uniform(0.5, 2.0)), d, 0)
        piece, half = int(rng.integers(2 * d + 1)), np.zeros(3)
        half[:d] = rng.uniform(0.01, 0.5, d)
        at = np.zeros(3)
        at[:d] = rng.uniform(-0.5, 0.5, d)
        if piece < 2 * d:
            at[d - 1] = half[d - 1] * rng.choice([1.0, 2.0])  # infinity is its end, or near
        back, origin, corners = np.zeros((3, 3)), np.zeros(3), np.zeros((2, 3))
        back[:d, :d], origin[:d] = rng.standard_normal((d, d)), rng.standard_normal(d)
        corners[:, :d] = np.sort(rng.standard_normal((2, d)) * 10.0 ** rng.uniform(-1.0, 2.0), axis=0)
        cut = np.concatenate([-half, half])
        set_centre(atlas, piece, at)
        contract_to_corners(atlas, origin, back, corners, half, cut)
        parts += int((cut[:3] > -half).any() or (cut[3:] < half).any())
        for u in rng.uniform(-1.0, 1.0, (100, 3)) * half:
            x = np.zeros(d)
            set_centre(atlas, piece, at + u)
            if atlas.scale[0] > 0.0:
                write_position(atlas, x)
                s = back[:, :d] @ (x - origin[:d])
                inside = (corners[0] <= s).all() and (s <= corners[1]).all()
                lost += int(inside and ((u < cut[:3]).any() or (u > cut[3:]).any()))
    assert parts > 100
    assert lost == 0
