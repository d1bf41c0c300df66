"""Nodes of every kind at random, their values by the measurement functions themselves, and boxes that are sampled."""

import numpy as np
from proof.costs import WIDTH

from optloc.kernels.jit import enabled
from optloc.models import MODELS, Point, range_rate
from optloc.proof.nodes.angles import bound_azimuth, bound_elevation, curve_azimuth, curve_elevation
from optloc.proof.nodes.level import bound_height, curve_height
from optloc.proof.nodes.log_range import bound_logarithm, curve_logarithm
from optloc.proof.nodes.rate import VELOCITY, bound_rate, curve_rate
from optloc.proof.nodes.ratio import bound_ratio, curve_ratio

BOUND = {"azimuth": bound_azimuth, "elevation": bound_elevation, "groa": bound_ratio, "height": bound_height}
CURVE = {"azimuth": curve_azimuth, "elevation": curve_elevation, "groa": curve_ratio, "height": curve_height}
BOUND["range_rate"], CURVE["range_rate"] = bound_rate, curve_rate
BOUND["log range"], CURVE["log range"] = bound_logarithm, curve_logarithm
RADIUS = 6.37e6


def many(machine, plain):
    """Return how many boxes are sampled, by machine code or in plain Python, which takes a thousand times longer."""
    return machine if enabled() else plain


def rotation(rng, d):
    q = np.linalg.qr(rng.normal(size=(d, d)))[0]
    out = np.zeros((3, 3))
    out[:d, :d] = q * np.sign(np.linalg.det(q)) if d == 3 else q
    return out


def numbers(kind, d, rng):
    """Return the numbers of a node: stations within some kilometres, any axes; heights: an origin on the ground."""
    data = np.zeros(WIDTH)
    data[6:15] = rotation(rng, 3 if kind == "height" else d).ravel()
    if kind == "height":
        data[3:6] = _unit(rng) * RADIUS
        return data
    data[:d] = rng.normal(size=d) * 1e3
    if kind == "azimuth":
        data[15] = rng.uniform(-np.pi, np.pi)
    if kind == "groa":
        data[3 : 3 + d] = rng.normal(size=d) * 1e3
    if kind == "range_rate":  # any speed, up to a satellite's
        data[VELOCITY : VELOCITY + d] = rng.normal(size=d) * 10 ** rng.uniform(0.0, 4.0)
    return data


def _unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def value(kind, d, data, x):
    """Return the node at positions (..., 3) by the package's h; azimuths from their measured value, wrapped."""
    parts = tuple(x[..., i] for i in range(d))
    a = Point(tuple(data[:d]), None, tuple(tuple(data[6 + 3 * i : 6 + 3 * i + d]) for i in range(d)))
    if kind == "log range":  # what a station measures of which `rss_difference` is a difference
        return np.log(np.linalg.norm(x - data[:3], axis=-1))
    if kind == "range_rate":
        still, moving = (0.0,) * d, tuple(-data[VELOCITY : VELOCITY + d])
        return range_rate(Point(parts, still), Point(tuple(data[:d]), moving))
    if kind == "height":
        ecef = data[3:6] + x @ data[6:15].reshape(3, 3).T
        return MODELS[kind].h(Point(parts, ecef=tuple(ecef[..., i] for i in range(3))), a, a)
    out = MODELS[kind].h(Point(parts), a, Point(tuple(data[3 : 3 + d])))
    if kind == "azimuth":
        out = np.arctan2(np.sin(out - data[15]), np.cos(out - data[15]))
    return out


def centre(kind, d, data, rng, near):
    """Return the centre of a box: anywhere, or within metres of the first station."""
    out = np.zeros(3)
    out[:d] = data[:d] + rng.normal(size=d) * (10.0 if near else 1e3 * 10 ** rng.uniform(-1.0, 1.5))
    return out * 10 ** rng.uniform(0.0, 2.5) if kind == "height" else out


def axes(d, size, rng):
    """Return the derivative of a line with respect to search coordinates: any axes, of lengths up to a size."""
    out = np.zeros((3, 3))
    out[:d, :d] = rotation(rng, d)[:d, :d] * (size * 10 ** rng.uniform(-1.5, 0.0, d))
    return out


def halves(d, rng):
    out = np.zeros(3)
    out[:d] = rng.uniform(0.2, 1.0, d)
    return out


def lines(kind, data, x, sense):
    return (x - data[:3], sense, x - data[3:6], sense) if kind == "groa" else (x - data[:3], sense)


def bounded(kind, data, x, sense, half):
    """Return value, slope, and both ends of the remainder."""
    slope = np.zeros(3)
    middle, low, high = BOUND[kind](data, *lines(kind, data, x, sense), half, slope)
    return middle, slope, low, high


def curved(kind, data, x, sense, half):
    """Return the Hessian, and bounds of the change of gradient and Hessian."""
    hessian, turn = np.zeros((3, 3)), np.zeros(3)
    chi = CURVE[kind](data, *lines(kind, data, x, sense), half, hessian, turn)
    return hessian, turn, chi


def samples(half, count, rng):
    """Return points (count, 3) of a box, a tenth of them corners."""
    s = rng.uniform(-1.0, 1.0, (count, 3))
    s[: count // 10] = np.sign(s[: count // 10])
    return s * half


def remainders(kind, d, rng, box, near, count=2000):
    """Return how far the remainder leaves its enclosure (<= 0: nowhere) and how wide it is beside what is sampled."""
    data = numbers(kind, d, rng)
    x = centre(kind, d, data, rng, near)
    sense, half = axes(d, max(np.linalg.norm(x - data[:3]), 1.0) * box, rng), halves(d, rng)
    middle, slope, low, high = bounded(kind, data, x, sense, half)
    s = samples(half, count, rng)
    rest = value(kind, d, data, x + s @ sense.T) - middle - s @ slope
    # What the rounding of the values and of the slopes leaves.
    slack = 1e-8 if kind == "height" else 1e-12 * max(1.0, abs(middle))
    leaves = max((low - rest).max(), (rest - high).max()) - slack
    width = (high - low) / max(np.ptp(rest), 1e-300) if slope.any() and high < np.inf else np.nan
    return leaves, width


def changes(kind, d, rng, box, count=40):
    """Return change over bound for the Hessian and for the gradient's components, largest sampled; NaN: no bound."""
    data = numbers(kind, d, rng)
    x = centre(kind, d, data, rng, near=False)
    sense, half = axes(d, max(np.linalg.norm(x - data[:3]), 1.0) * box, rng), halves(d, rng)
    hessian, turn, chi = curved(kind, data, x, sense, half)
    if not chi < np.inf:
        return np.nan, np.nan
    point = np.zeros(3)
    slope = bounded(kind, data, x, sense, point)[1]
    most, worst = 0.0, np.zeros(3)
    for s in samples(half, count, rng):
        there = x + sense @ s
        most = max(most, np.abs(np.linalg.eigvalsh(curved(kind, data, there, sense, point)[0] - hessian)).max())
        worst = np.maximum(worst, np.abs(bounded(kind, data, there, sense, point)[1] - slope))
    floor = 1e-9 * np.abs(slope).max()
    return most / (chi + 1e-9 * np.abs(hessian).max()), (worst / (turn + floor))[:d].max()


def differences(kind, d, rng):
    """Return the error of gradient and Hessian beside central differences of values and gradients, relative."""
    data = numbers(kind, d, rng)
    x = centre(kind, d, data, rng, near=False)
    sense, point, step = axes(d, 0.3 * np.linalg.norm(x - data[:3]), rng), np.zeros(3), 1e-4
    _, slope, _, _ = bounded(kind, data, x, sense, point)
    hessian = curved(kind, data, x, sense, point)[0]
    first, second = np.zeros(3), np.zeros((3, 3))
    for k in range(d):
        ends = [x + sense[:, k] * sign for sign in (step, -step)]
        first[k] = np.subtract(*(value(kind, d, data, end) for end in ends)) / (2 * step)
        second[k] = np.subtract(*(bounded(kind, data, end, sense, point)[1] for end in ends)) / (2 * step)
    return np.abs(first - slope).max() / np.abs(slope).max(), np.abs(second - hessian).max() / np.abs(hessian).max()
