"""The best assignment by trying them all, written apart from optloc: its own fits, scores and packing."""

from itertools import product

import numpy as np
from multi_target.scenes import DETECTION, model


def costs(scene, picks, chi2):
    """Return the score of sets of rows (q, m), -1 for none, from their chi-squares: the formula, for equal rows."""
    d, n, m = scene.stations.shape[1], (picks >= 0).sum(-1), picks.shape[1]
    spread = np.log(2.0 * np.pi * scene.sigma**2)
    penalty = d * (-2.0 * np.log(scene.density) - spread)
    row = spread - 2.0 * np.log(DETECTION / scene.density)
    return chi2 + n * row - 2.0 * (m - n) * np.log(1.0 - DETECTION) + penalty


def residuals(scene, picks, x):
    """Return residuals (..., m) in sigmas of sets at places; zero where there is no row."""
    z = np.where(picks >= 0, scene.problem.z[picks], 0.0)
    away = z - model(scene.kind, scene.stations, scene.channels, x)
    if scene.kind == "azimuth":
        away = (away + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(picks >= 0, away / scene.sigma, 0.0)


def fitted(scene, picks, x, steps=40):
    """Return least chi-squares and places from starts x (q, d): damped Gauss-Newton with numerical derivatives."""
    x, d = x.copy(), x.shape[1]
    damping = np.full(len(x), 1e-3)
    r = residuals(scene, picks, x)
    cost = (r**2).sum(-1)
    for _ in range(steps):
        J = np.stack(
            [(residuals(scene, picks, x + e) - residuals(scene, picks, x - e)) / 0.2 for e in 0.1 * np.eye(d)], -1
        )
        N = np.swapaxes(J, -1, -2) @ J
        N = N + (damping[:, None] * np.trace(N, axis1=-2, axis2=-1)[:, None] + 1e-12)[..., None] * np.eye(d)
        new = x - np.linalg.solve(N, (np.swapaxes(J, -1, -2) @ r[..., None]))[..., 0]
        after = residuals(scene, picks, new)
        better = (after**2).sum(-1) < cost
        x, r = np.where(better[:, None], new, x), np.where(better[:, None], after, r)
        cost = (r**2).sum(-1)
        damping = np.where(better, damping / 5.0, damping * 5.0)
    return cost, x


def every_set(scene, half=30e3, cells=45, blocks=3):
    """Return all sets of the rows of a planar scene that can pay, with their least chi-squares.

    Each is refined a little from the best point of a grid in each block of the plane, the best two of these fully.
    """
    picks = np.array(list(product(*([-1, *rows] for rows in scene.values()))))
    picks = picks[costs(scene, picks, 0.0) < 0.0]
    axis = (np.arange(cells) + 0.5) / cells * 2.0 * half - half
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    block = ((grid + half) // (2.0 * half / blocks)).astype(int) @ [blocks, 1]
    single = residuals(scene, np.arange(scene.problem.count)[:, None].repeat(len(scene.channels), 1)[:, None], grid)
    total = np.zeros((len(picks), len(grid)))
    for i in range(picks.shape[1]):
        total += np.where(picks[:, i, None] >= 0, single[picks[:, i], :, i] ** 2, 0.0)
    starts = [np.flatnonzero(block == k)[total[:, block == k].argmin(1)] for k in range(blocks**2)]
    begun = [fitted(scene, picks, grid[start], 6) for start in starts]
    first, chi2 = np.argsort([cost for cost, _ in begun], axis=0)[:2], np.full(len(picks), np.inf)
    places, rows = np.array([x for _, x in begun]), np.arange(len(picks))
    for order in first:
        chi2 = np.minimum(chi2, fitted(scene, picks, places[order, rows], 20)[0])
    return picks, costs(scene, picks, chi2)


def grown_sets(scene, seed=0):
    """Return sets grown from all sets of three rows of stations with a common reference, for scenes in space."""
    values, found = scene.values(), []
    for common in range(len(scene.stations)):
        star = [i for i, c in enumerate(scene.channels) if common in c]
        for i, j, k in [(i, j, k) for i in star for j in star for k in star if i < j < k]:
            for rows in product(values[i], values[j], values[k]):
                one = np.full(len(scene.channels), -1)
                one[[i, j, k]] = rows
                found.append(one)
    picks, rng = np.array(found), np.random.default_rng(seed)
    x = [rng.uniform([-10e3, -10e3, 0.0], [10e3, 10e3, 10e3], (len(picks), 3)) for _ in range(3)]
    fits = [fitted(scene, picks, start, 15) for start in x]
    x = np.concatenate([at[cost < 1.0] for cost, at in fits])
    picks = np.unique(np.concatenate([nearest(scene, x, width) for width in (10.0, 40.0)]), axis=0)
    picks = picks[costs(scene, picks, 0.0) < 0.0]
    start = x[rng.integers(len(x), size=len(picks))] if len(x) else np.zeros((0, 3))
    return refined(scene, picks, start) if len(picks) else (picks, np.zeros(0))


def nearest(scene, x, width):
    """Return the nearest row of each channel within so many sigmas of places, or -1."""
    out = np.full((len(x), len(scene.channels)), -1)
    for i, rows in enumerate(scene.values()):
        picks = np.full((len(rows), 1, len(scene.channels)), -1)
        picks[:, 0, i] = rows
        away = np.abs(residuals(scene, picks, x[None])[..., i]) if len(rows) else np.full((1, len(x)), np.inf)
        out[:, i] = np.where(away.min(0) < width, rows[away.argmin(0)] if len(rows) else -1, -1)
    return out


def refined(scene, picks, start, turns=4):
    """Return sets after turns of fits and choices of the nearest rows, all sets met, and those less one row."""
    kept, costs_of = [picks], [costs(scene, picks, fitted(scene, picks, start)[0])]
    for turn in range(turns):
        chi2, x = fitted(scene, picks, start)
        good = chi2 < 1e4
        picks, start = nearest(scene, x[good], 10.0 if turn < 2 else 4.0), x[good]
        picks, first = np.unique(picks, axis=0, return_index=True)
        start = start[first]
        kept.append(picks)
        costs_of.append(costs(scene, picks, fitted(scene, picks, start)[0]))
    best = np.argsort(costs_of[-1])[:40]
    which, channel = np.nonzero(picks[best] >= 0)
    less = picks[best][which]
    less[np.arange(len(which)), channel] = -1
    kept.append(less)
    costs_of.append(costs(scene, less, fitted(scene, less, start[best][which])[0]))
    return np.concatenate(kept), np.concatenate(costs_of)


def true_sets(scene):
    """Return the rows of the true emitters, fitted from the truth."""
    picks = np.full((len(scene.emitters), len(scene.channels)), -1)
    for i, rows in enumerate(scene.values()):
        for row in rows[scene.owner[rows] >= 0]:
            picks[scene.owner[row], i] = row
    return picks, costs(scene, picks, fitted(scene, picks, scene.emitters)[0])


def packed(picks, cost, most=6):
    """Return the least sum of costs of sets that share no row, and the sets, by trying all in order of cost."""
    order = [i for i in np.argsort(cost, kind="stable") if cost[i] < 0.0]
    rows, value = [frozenset(picks[i][picks[i] >= 0].tolist()) for i in order], [float(cost[i]) for i in order]
    best = (0.0, ())

    def extend(first, used, total, chosen):
        nonlocal best
        if total < best[0]:
            best = (total, chosen)
        for i in range(first, len(order)):
            if total + value[i] * (most - len(chosen)) >= best[0]:
                return
            if not used & rows[i]:
                extend(i + 1, used | rows[i], total + value[i], (*chosen, i))

    extend(0, frozenset(), 0.0, ())
    return best[0], {rows[i] for i in best[1]}
