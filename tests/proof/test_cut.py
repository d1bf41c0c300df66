"""Nothing cheaper is ever cut off: random costs of all nodes over random boxes, weak and singular ones too."""

from dataclasses import dataclass

import numpy as np
import pytest
from proof.costs import WIDTH
from proof.sampling import bounded, numbers, rotation, value

from optloc.compute.jit import enabled
from optloc.proof.box import least_residual, linearise_rows, rounding, shrink, uncut
from optloc.proof.chart import Chart, cost_of, curve_box, empty_box, value_at
from optloc.proof.curvature import clip_to_stationary, slopes_everywhere
from optloc.proof.nodes.node import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO

CODES = {"range": RANGE, "linear": LINEAR, "azimuth": AZIMUTH, "elevation": ELEVATION, "groa": RATIO, "height": HEIGHT}
NEAR = {2: ("range", "linear", "azimuth", "groa"), 3: tuple(CODES)}
# What stays finite at infinity.
FAR = {2: ("range", "azimuth", "groa"), 3: ("range", "azimuth", "elevation", "groa")}
# Plain Python takes a thousand times longer for a box.
BOXES = 2500 if enabled() else 25


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
    return Chart(x, sense, back, sense.T @ sense, np.zeros(3), floor), box


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
    noise = rounding(cost.K, cost.weight, chart.floor, box.nodes)
    assert not least_residual(cost.K, cost.weight, chart.floor, box.half, box.nodes, box.rows) > rho + noise
    uncut(box.half, box.cut)
    shrink(cost.K, cost.weight, rho + noise, box.half, d == 2, box.nodes, box.rows, box.cut, box.solve)
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
    uncut(box.half, box.cut)
    clip_to_stationary(cost.A, box.half, box.nodes, box.curves, box.sums, box.cut, box.solve)
    assert outside(box.cut, s) < 1e-9, made.names
    assert not slopes_everywhere(cost.A, box.half, box.nodes, box.curves, box.sums, box.solve) or (
        outside(box.cut, s) > -1e-9
    )
    return bool(((box.cut[:3] > -box.half) | (box.cut[3:] < box.half)).any())


@pytest.mark.parametrize("d", [2, 3])
def test_no_point_is_cut_off_at_its_own_cost(d, seed):
    rng = np.random.default_rng([seed, d, 1])
    assert sum(check_bounds(rng, d) for _ in range(BOXES)) > BOXES // 20


@pytest.mark.parametrize("d", [2, 3])
def test_no_stationary_point_is_cut_off(d, seed):
    rng = np.random.default_rng([seed, d, 2])
    assert sum(check_stationary(rng, d) for _ in range(BOXES)) > BOXES // 50


@pytest.mark.full
@pytest.mark.parametrize("d", [2, 3])
def test_nothing_is_cut_off_in_full(d, seed):
    rng = np.random.default_rng([seed, d, 3])
    for _ in range(40 * BOXES):
        check_bounds(rng, d)
        check_stationary(rng, d)
