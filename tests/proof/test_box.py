"""Nothing cheaper is ever cut off: random costs of all nodes over random boxes, weak and singular ones too."""

from dataclasses import dataclass

import numpy as np
import pytest
from proof.costs import WIDTH, beside, down_from, no_rivals
from proof.sampling import bounded, many, numbers, rotation, value
from proof.test_soundness import verdicts

from optloc import assemble, measured
from optloc.kernels.jit import enabled
from optloc.kernels.systems import inverse
from optloc.proof.atlas import atlas_of, set_centre
from optloc.proof.box import (
    contract_box,
    is_empty,
    least_residual,
    linearise_rows,
    reset_cut,
    rounding_error,
    station_cube,
)
from optloc.proof.convex_boxes import accuracy_floor_far
from optloc.proof.curvature import contract_to_minima, sum_up
from optloc.proof.enclosure import enclose
from optloc.proof.global_search import excludes_infimum, prove_globally
from optloc.proof.local_search import UNIQUE, VALUE
from optloc.proof.nodes.dispatch import bound_pieces, curve_pieces
from optloc.proof.nodes.node import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO, SLOPE0
from optloc.proof.search_space import LocalAxes, chart_at, cost_of, curve_box, empty_box, value_at

CODES = {"range": RANGE, "linear": LINEAR, "azimuth": AZIMUTH, "elevation": ELEVATION, "groa": RATIO, "height": HEIGHT}
NEAR = {2: ("range", "linear", "azimuth", "groa"), 3: tuple(CODES)}
# What stays finite at infinity.
FAR = {2: ("range", "azimuth", "groa"), 3: ("range", "azimuth", "elevation", "groa")}
BOXES = 1500, 100
PIECES = pytest.mark.usefixtures("form")


@dataclass
class Scene:
    """Nodes by name with their numbers, and whitened rows whose residual at x is given."""

    d: int
    names: list
    data: np.ndarray
    K: np.ndarray
    w: np.ndarray

    @property
    def kinds(self):
        return np.array([CODES[name] for name in self.names])

    def nodes(self, x):
        """Return the values (J,) of the nodes at a position (3,), by formulas of their own."""
        out = []
        for name, own in zip(self.names, self.data, strict=True):
            if name == "range":
                out.append(np.linalg.norm(x - own[:3]))
            else:
                out.append((x - own[:3]) @ own[3:6] if name == "linear" else value(name, self.d, own, x))
        return np.array(out, dtype=float)

    def slopes(self, x):
        """Return the gradients (J, 3) of the nodes at a position, per metre."""
        out, eye = [], np.eye(3) * (np.arange(3) < self.d)
        for name, own in zip(self.names, self.data, strict=True):
            if name == "range":
                out.append((x - own[:3]) / np.linalg.norm(x - own[:3]))
            else:
                out.append(own[3:6] if name == "linear" else bounded(name, own, x, eye, np.zeros(3))[1])
        return np.array(out)

    def residual(self, x):
        return self.K @ self.nodes(x) - self.w

    @property
    def cost(self):
        return cost_of(self.kinds, self.data, np.ascontiguousarray(self.K), self.w)


def some_rows(rng, names, balanced):
    """Return rows (q, J): one a node, mixed ones, a few that all say nearly the same, or most of no weight."""
    J = len(names)
    shape = rng.integers(0, 4)
    K = np.eye(J) if shape == 0 else rng.normal(size=(int(rng.integers(1, J + 2)), J))
    if shape == 2:
        K = K[:1] + 10.0 ** rng.uniform(-12.0, -3.0) * K
    # Angles and ratios say about as much as a thousandth of a range.
    unit = np.array([1.0 if name in ("range", "linear", "height") else 1e3 for name in names])
    K = K * unit * 10.0 ** (rng.uniform(-6.0, 0.0, J) if shape == 3 else rng.uniform(-1.0, 0.0, J))
    own = np.array([name == "range" for name in names])
    if balanced and own.any():
        K[:, own] -= K[:, own].mean(1, keepdims=True)
    return K


def scene(rng, d, table, balanced=False):
    """Return nodes of random kinds, some of them at one place, and their rows; nothing is measured yet."""
    names = [str(name) for name in rng.choice(table[d], size=rng.integers(2, 7))]
    if balanced and names.count("range") == 1:
        names.append("range")
    if "height" in names:  # one Earth
        names = [name for name in names if name != "height"] + ["height"]
    data = np.zeros((len(names), WIDTH))
    for j, name in enumerate(names):
        data[j] = numbers("groa" if name in ("range", "linear") else name, d, rng)
        if name == "range":
            data[j, 3:] = 0.0
        if name == "linear":
            data[j, 6:] = 0.0
            data[j, 3:6] /= 1e3
    shape = rng.integers(0, 3)
    for j, name in enumerate(names):
        if name != "height":
            data[j, :d] *= [1.0, 1e-3, 1.0][shape]
            data[j, d - 1] *= [1.0, 1.0, 1e-4][shape]  # all in one plane, or line
    K = some_rows(rng, names, balanced)
    return Scene(d, names, data, K, np.zeros(len(K)))


def some_box(rng, made):
    """Return a chart and a box in it: any size and shape, around a station, its vertical, or anywhere."""
    d = made.d
    x = np.zeros(3)
    x[:d] = made.data[0, :d] * (rng.random() < 0.5) + rng.normal(size=d) * 10.0 ** rng.uniform(-3.0, 5.0)
    if "height" in made.names:
        x *= 10.0
    turn = rotation(rng, d)
    length = np.where(np.arange(3) < d, 10.0 ** (rng.uniform(-3.0, 4.5) + rng.uniform(-3.0, 0.0, 3)), 0.0)
    sense = turn * length
    back = np.where(length > 0.0, 1.0 / np.where(length > 0.0, length, 1.0), 0.0)[:, None] * turn.T
    box = empty_box(len(made.K), len(made.names))
    box.half[:d] = 10.0 ** rng.uniform(-2.0, 0.3, d)
    floor = 2.0 * (np.abs(x).sum() + np.abs(made.data[:, :6]).sum()) * np.abs(made.K).sum()
    return LocalAxes(x, sense, back, sense.T @ sense, np.zeros(3), floor, np.zeros(0), False, x), box


def some_point(rng, half):
    """Return a point of a box, often on its boundary or at its centre, in search coordinates."""
    s = np.clip(rng.uniform(-1.3, 1.3, 3), -1.0, 1.0) * (rng.random() < 0.95)
    return s * half


def measured_at(rng, made, x, jacobian=None):
    """Let a position have a residual of some length; stationary ones are orthogonal to a Jacobian (q, n)."""
    rest = rng.normal(size=len(made.K))
    if jacobian is not None:
        u, s, _ = np.linalg.svd(jacobian, full_matrices=False)
        u = u[:, s > 1e-17 * max(s[0], 1e-300)]  # weak directions too: the gradient along them must vanish as well
        rest -= u @ (u.T @ rest)
        rest -= u @ (u.T @ rest)
    rest *= 10.0 ** rng.uniform(-6.0, 3.0)
    made.w = made.K @ made.nodes(x) - rest
    return float(np.linalg.norm(rest))


def filled(cost, chart, box):
    """Fill all tables of a box of the near chart."""
    value_at(cost, chart, box)
    linearise_rows(cost.K, cost.w, box.nodes, box.rows)
    curve_box(cost, chart, box)


def outside(cut, s):
    """Return how far a point is outside what is left of a box, in units of its sides."""
    width = np.maximum(cut[3:] - cut[:3], 1e-300)
    return max(((cut[:3] - s) / width).max(), ((s - cut[3:]) / width).max())


def check_bounds(rng, d):
    """Check one box: a point in it is never bounded or cut away at its own level; return whether any was cut."""
    made = scene(rng, d, NEAR)
    chart, box = some_box(rng, made)
    s = some_point(rng, box.half)
    rho = measured_at(rng, made, chart.origin + chart.sense @ s)
    cost = made.cost
    filled(cost, chart, box)
    noise = rounding_error(cost.K, cost.weight, chart.floor, box.nodes)
    assert not least_residual(cost.K, cost.weight, chart.floor, box.half, box.nodes, box.rows) > rho + noise
    reset_cut(box.half, box.cut)
    contract_box(cost.K, cost.weight, rho + noise, box.half, d == 2, box.nodes, box.rows, box.cut, box.solve)
    assert outside(box.cut, s) < 1e-9, made.names
    return bool(((box.cut[:3] > -box.half) | (box.cut[3:] < box.half)).any())


def check_stationary(rng, d):
    """Check one box: a stationary point in it is never cut away; return whether anything was cut."""
    made = scene(rng, d, NEAR)
    chart, box = some_box(rng, made)
    s = some_point(rng, box.half)
    x = chart.origin + chart.sense @ s
    slopes = made.slopes(x) @ chart.sense
    if not np.isfinite(slopes).all():
        return False
    measured_at(rng, made, x, made.K @ slopes)
    cost = made.cost
    filled(cost, chart, box)
    reset_cut(box.half, box.cut)
    contract_to_minima(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
    assert outside(box.cut, s) < 1e-9, made.names
    assert not is_empty(box.cut) or outside(box.cut, s) > -1e-9
    return bool(((box.cut[:3] > -box.half) | (box.cut[3:] < box.half)).any())


@PIECES
@pytest.mark.parametrize("d", [2, 3])
def test_no_point_is_cut_off_at_its_own_cost(d, seed):
    rng = np.random.default_rng([seed, d, 1])
    count = many(*BOXES)
    assert sum(check_bounds(rng, d) for _ in range(count)) > count // 20


@PIECES
@pytest.mark.parametrize("d", [2, 3])
def test_no_stationary_point_is_cut_off(d, seed):
    rng = np.random.default_rng([seed, d, 2])
    count = many(*BOXES)
    assert sum(check_stationary(rng, d) for _ in range(count)) > count // 50


def check_leaves(rng, d):
    """Check one box of an atlas: one that holds an infimum, finite or at infinity, never counts as left.

    Returns whether a box beside it does, so that the test is seen to say something.
    """
    made = scene(rng, d, FAR, balanced=True)
    middle, radius = station_cube(made.kinds, made.data, np.ones(d))
    atlas, box = atlas_of(middle, radius, d, 0), empty_box(len(made.K), len(made.names))
    piece, level = int(rng.integers(0, 2 * d + 1)), rng.integers(0, 14, size=d)
    far = piece < 2 * d
    box.half[:d] = 0.5**level
    box.at[:d] = -1.0 + box.half[:d] * (2.0 * (rng.random(d) * 2.0**level).astype(int) + 1.0)
    if far:  # the last coordinate is the scale, from infinity on
        box.half[d - 1] *= 0.5
        first = 0 if rng.random() < 0.5 else int(rng.random() * 2.0 ** level[d - 1])
        box.at[d - 1] = box.half[d - 1] * (2.0 * first + 1.0)
    at, half, touching = box.at.copy(), box.half.copy(), far and box.at[d - 1] <= box.half[d - 1]
    u = at + some_point(rng, half)
    if touching and rng.random() < 0.7:
        u[d - 1] = 0.0
    set_centre(atlas, piece, u)
    bound_pieces(atlas, made.kinds, made.data, np.zeros(3), box.nodes)
    values, slopes = box.nodes[:, 0].copy(), box.nodes[:, SLOPE0 : SLOPE0 + 3]
    if not (np.isfinite(values).all() and np.isfinite(slopes).all()):
        return False
    J = made.K @ slopes
    rest, ends = rng.normal(size=len(made.K)), touching and u[d - 1] == 0.0
    span = np.linalg.svd(J[:, : d - 1] if ends else J, full_matrices=False)[0]
    for _ in range(2):
        rest = rest - span @ (span.T @ rest)
    rest *= 10.0 ** rng.uniform(-6.0, 1.0)
    if ends:  # the cost rises from infinity inwards
        rest = rest if rest @ J[:, d - 1] >= 0.0 else -rest
    made.w = made.K @ values - rest
    cost = made.cost
    floor = accuracy_floor_far(cost, atlas)
    if not ends or d == 3:  # a minimum, not a saddle
        curve_pieces(atlas, made.kinds, made.data, np.zeros(3), box.nodes, box.curves)
        sum_up(cost.K, cost.w, cost.weight, 0.0, box.nodes, box.curves, box.sums)
        keep = d - 1 if ends else d
        H = box.sums[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]][:keep, :keep]
        if not np.linalg.eigvalsh(H)[0] > -1e-12 * np.abs(H).max():
            return False
    box.at[:], box.half[:] = at, half
    set_centre(atlas, piece, box.at)
    bound_pieces(atlas, made.kinds, made.data, box.half, box.nodes)
    assert not excludes_infimum(cost, atlas, box, touching, floor), (made.names, ends)
    box.half[:] *= 0.25
    set_centre(atlas, piece, box.at)
    bound_pieces(atlas, made.kinds, made.data, box.half, box.nodes)
    return bool((np.abs(u - at) > box.half).any() and excludes_infimum(cost, atlas, box, False, floor))


@PIECES
@pytest.mark.parametrize("d", [2, 3])
def test_no_box_with_an_infimum_counts_as_left(d, seed):
    rng = np.random.default_rng([seed, d, 4])
    count = many(*BOXES)
    assert sum(check_leaves(rng, d) for _ in range(count)) > count // 50


def check_enclosure(rng, d):
    """Check one enclosure: it holds a point, near or far, at the level of that point; return whether there is one."""
    made = scene(rng, d, NEAR)
    x = np.zeros(3)
    x[:d] = rng.normal(size=d) * 10.0 ** rng.uniform(1.0, 4.5)
    measured_at(rng, made, x + np.where(np.arange(3) < d, rng.normal(size=3) * 10.0 ** rng.uniform(-2.0, 3.0), 0.0))
    y = x + np.where(np.arange(3) < d, rng.normal(size=3), 0.0) * 10.0 ** rng.uniform(-2.0, 5.5)
    cost, box, low, high = made.cost, empty_box(*made.K.shape), np.empty(3), np.empty(3)
    chart, good = chart_at(cost, x[:d], box)
    rho = float(np.linalg.norm(made.residual(y)))
    if not good or not enclose(cost, chart, box, rho, low, high):
        return False
    s = chart.back @ (y - chart.origin)
    slack = chart.slip * np.abs([x, y]).sum() + 1e-9 * (1.0 + np.abs(s))
    assert ((s >= low - slack) & (s <= high + slack)).all(), (made.names, s, low, high)
    return True


@PIECES
@pytest.mark.parametrize("d", [2, 3])
def test_every_point_is_enclosed_at_its_own_cost(d, seed):
    rng = np.random.default_rng([seed, d, 5])
    count = many(*BOXES)
    assert sum(check_enclosure(rng, d) for _ in range(count)) > count // 20


@pytest.mark.full
@pytest.mark.parametrize("d", [2, 3])
def test_nothing_is_cut_off_in_full(d, seed):
    rng = np.random.default_rng([seed, d, 3])
    for _ in range(40 * many(*BOXES)):
        check_bounds(rng, d)
        check_stationary(rng, d)
        check_leaves(rng, d)
        check_enclosure(rng, d)


# Six gain ratios whose least cost is 2.68: beside their second station all of them but one are flat.
STATIONS = """
    0x1.3f9fcd1c792b8p+10 -0x1.d661ed82031e7p+11 0x1.04f26005fe3ecp+8
    -0x1.a3637f950670fp+10 0x1.130c2ae90084ap+11 -0x1.0f4a8fc661f09p+8
    0x1.78ec9753b3fd7p+11 0x1.0a2c4042bc846p+12 -0x1.58032582879eap+10
    -0x1.67d10fba36499p+10 0x1.c18ac8292a328p+11 -0x1.28819345c9ac2p+6
    0x1.4f04f996fbf2cp+10 0x1.839179aafad07p+10 0x1.fbb49bf977457p+6
    -0x1.ed0815d98b438p+11 0x1.511d31f5d3a49p+11 -0x1.d2657ae4bdd8ap+10
"""
RATIOS = """
    0x1.64244ecd853dfp-1 0x1.4767c02d123cfp-1 0x1.90344aec912c3p-1 0x1.dd4c57df2ab90p-3 0x1.238716460df87p+0
"""
WRONG = "0x1.04d007edb8f40p+11 0x1.cac3563d12074p+10 0x1.26a46c72f443bp+10"
BETTER_PLACE = (1711.77817131, 1242.16090502, -985.25639557)


def numbers_of(text):
    return np.array([float.fromhex(word) for word in text.split()])


@pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
@pytest.mark.parametrize("budget", [300, 8000])
def test_a_stationary_point_of_cost_1553_is_not_certified(budget):
    S, z, x = numbers_of(STATIONS).reshape(6, 3), numbers_of(RATIOS), numbers_of(WRONG)
    problem = assemble(S, measured("groa", z, a=np.arange(1, 6), b=0, sigma=1.0 / 500.0)).flat()
    assert verdicts(problem, [0], x[None], 0.0, budget)[0] not in (UNIQUE, VALUE)


@pytest.mark.full
@pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
@pytest.mark.parametrize("budget", [300, 8000])
def test_no_bound_is_above_what_another_place_costs(budget):
    S, z = numbers_of(STATIONS).reshape(6, 3), numbers_of(RATIOS)
    data = np.zeros((5, WIDTH))
    data[:, :3], data[:, 3:6], data[:, 15], data[:, 16] = S[1:], S[0], z, 1.0
    K, x, found = 500.0 * np.eye(5), numbers_of(WRONG), np.zeros(3)
    cost, box = cost_of(np.full(5, RATIO), data, K, 500.0 * z), empty_box(5, 5)
    eps = 1e-6 * (1.0 + 1553.19)
    args = beside([]), down_from(0.0), eps, budget, no_rivals(), found
    verdict, _, bound, *_ = prove_globally(cost, box, x, *args)
    assert verdict not in (UNIQUE, VALUE)
    r = np.linalg.norm(np.array(BETTER_PLACE) - S, axis=1)
    assert bound <= (((r[1:] / r[0] - z) * 500.0) ** 2).sum() + 1e-6


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_matrix_of_rank_one_has_no_inverse(scale, seed):
    rng, out = np.random.default_rng([seed, 6]), np.empty((3, 3))
    for _ in range(200):
        u = scale * rng.normal(size=3) * 10.0 ** rng.uniform(-4.0, 4.0, 3)
        a = np.outer(u, u)
        assert not inverse(a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2], out)


def test_a_small_determinant_of_scales_alone_is_regular():
    out, size = np.empty((3, 3)), np.array([1e-9, 1.0, 1e9])
    a = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 2.0]]) * size * size[:, None]
    assert inverse(a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2], out)
    np.testing.assert_allclose(out * size * size[:, None] @ (a / size / size[:, None]), np.eye(3), atol=1e-12)
