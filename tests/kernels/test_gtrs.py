"""The compiled squared-range minimiser against the one that knows every case."""

import numpy as np
import pytest

from formulations.squared_range import cone, minimiser, paraboloid
from optloc.kernels.gtrs import minimise, scratch
from optloc.kernels.jit import enabled
from optloc.kernels.systems import LANES

BLOCKS = 40 if enabled() else 1


def on_lanes(B, g, on_cone):
    """Return the kernel's answers (N, n) and which are settled (N,); N is a multiple of the lanes."""
    n = B.shape[2]
    rows = np.concatenate([B, g[..., None]], axis=2)
    y, settled = np.empty((len(B), n)), np.empty(len(B), dtype=bool)
    found, flag, work = np.empty((n, LANES)), np.empty(LANES), np.empty((scratch(n), LANES))
    for first in range(0, len(B), LANES):
        part = slice(first, first + LANES)
        minimise(np.ascontiguousarray(rows[part].transpose(1, 2, 0)), on_cone, found, flag, work)
        y[part], settled[part] = found.T, flag == 1.0
    return y, settled


def drawn(seed, d, quadric, noise, q=None):
    """Return rows and right sides of points on the quadric, with noise."""
    rng = np.random.default_rng(seed)
    count = BLOCKS * LANES
    x = rng.uniform(-2.0, 2.0, (count, d))
    last = np.linalg.norm(x, axis=1) if quadric.shape == "cone" else (x**2).sum(1)
    B = rng.standard_normal((count, q or d + 3, d + 1))
    g = np.einsum("Nqn,Nn->Nq", B, np.concatenate([x, last[:, None]], axis=1))
    return B, g + noise * rng.standard_normal(g.shape)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("shape", [cone, paraboloid])
@pytest.mark.parametrize("d", [2, 3])
def test_equals_the_other_form(d, shape, noise):
    quadric = shape(d)
    B, g = drawn([d, int(100 * noise)], d, quadric, noise)
    y, settled = on_lanes(B, g, quadric.shape == "cone")
    other, ok = minimiser(B, g, quadric)
    assert ok.all()
    assert settled.mean() > 0.8
    size = np.abs(other).max(1)
    assert (np.abs(y - other).max(1)[settled] <= 1e-10 * (1.0 + size[settled])).all()


@pytest.mark.parametrize("shape", [cone, paraboloid])
def test_answers_are_stationary_points_on_the_quadric(shape):
    """By themselves: on the quadric, and the gradient of the cost is that of the constraint times one number."""
    quadric = shape(3)
    B, g = drawn(5, 3, quadric, 0.05)
    y, settled = on_lanes(B, g, quadric.shape == "cone")
    y, B, g = y[settled], B[settled], g[settled]
    assert (np.abs(quadric.value(y)) < 1e-9 * (1.0 + (y**2).sum(1))).all()
    slope = np.einsum("Nqn,Nq->Nn", B, np.einsum("Nqn,Nn->Nq", B, y) - g)
    across = quadric.square * y + quadric.linear
    part = (slope * across).sum(1) / (across**2).sum(1)
    assert (np.abs(slope - part[:, None] * across).max(1) < 1e-9 * (1.0 + np.abs(slope).max(1))).all()


@pytest.mark.parametrize("shape", [cone, paraboloid])
def test_hard_cases_are_flagged_or_right(shape):
    """Fewer rows than unknowns, doubled rows, far emitters, great noise: settled answers are the global ones."""
    quadric, on_cone = shape(3), shape is cone
    few, doubled, wild = drawn(1, 3, quadric, 0.1, q=3), drawn(2, 3, quadric, 0.1), drawn(3, 3, quadric, 5.0)
    doubled[0][:, 3:], doubled[1][:, 3:] = doubled[0][:, :3], doubled[1][:, :3]
    for B, g in (few, doubled, wild):
        y, settled = on_lanes(B, g, on_cone)
        other, ok = minimiser(B, g, quadric)
        assert not (settled & ~ok).any()
        mine, theirs = (((np.einsum("Nqn,Nn->Nq", B, p) - g) ** 2).sum(1)[settled] for p in (y, other))
        assert (mine <= theirs * (1.0 + 1e-9) + 1e-12).all()
        assert (np.abs(quadric.value(y[settled])) < 1e-7 * (1.0 + (y[settled] ** 2).sum(1))).all()
    assert not on_lanes(*few, on_cone)[1].any()


def test_bad_lanes_change_nothing_in_the_others():
    quadric = cone(3)
    B, g = drawn(4, 3, quadric, 0.05)
    y, settled = on_lanes(B, g, on_cone=True)
    bad = np.arange(0, len(B), 7)
    B[bad[::3]], g[bad[1::3]], B[bad[2::3], :, 0] = 0.0, np.nan, np.inf
    with np.errstate(all="ignore"):
        again, still = on_lanes(B, g, on_cone=True)
    good = np.setdiff1d(np.arange(len(B)), bad)
    assert not still[bad].any()
    assert np.array_equal(settled[good], still[good])
    assert np.array_equal(y[good], again[good])
