"""Places where emitters may be: closed-form fixes of as few rows as it takes."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from optloc.equations import equations_at
from optloc.models import MODELS
from optloc.normal import covariance
from optloc.several.scene import Scene
from optloc.several.tuples import Tuples, nearby, nothing, of_picks
from optloc.solve import solve
from optloc.types import Array

# Fixes of few rows that are tried, and those of them that are followed.
_TRIED, _FOLLOWED = 800, 800
# Chi-square above which a point of a closed form is none that the rows have in common.
_FITS = 100.0


def proposed(scene: Scene, seed: int = 0) -> Tuples:
    """Return sets of rows around the closed-form fixes of d rows each; all of them, or a seeded draw where many."""
    picks = _few(scene, np.random.default_rng(seed))
    if not len(picks):
        return nothing(scene)
    problem = scene.scan.with_rows(z=of_picks(scene.z, picks), weight=(picks >= 0).astype(float))
    fix = solve(problem, "roots")
    x = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    which, slot = np.nonzero(np.isfinite(x).all(-1))
    with np.errstate(all="ignore"):  # some points of the closed form are stations
        equations = equations_at(problem.take(which), x[which, slot])
        cov = covariance(equations)[0]
    good = np.flatnonzero(np.isfinite(cov).all((-1, -2)) & (equations.cost < _FITS))[:_FOLLOWED]
    return nearby(scene, x[which, slot][good], cov[good], np.zeros_like(scene.z))


def _few(scene: Scene, rng: np.random.Generator) -> Array:
    """Return sets of d rows (q, m) that place an emitter."""
    d, count = scene.scan.dimension, scene.scan.count
    ends = _ends(scene)
    values = [np.flatnonzero(np.isfinite(channel)) for channel in scene.z]
    present = [i for i in range(count) if len(values[i])]
    subsets = [subset for subset in combinations(present, d) if _linked([ends[i] for i in subset])]
    picks = []
    for number in rng.permutation(len(subsets)):
        subset = subsets[number]
        for chosen in product(*(values[i] for i in subset)):
            one = np.full(count, -1)
            one[list(subset)] = chosen
            picks.append(one)
        if len(picks) >= _TRIED:
            break
    return np.array(picks).reshape(-1, count)


def _ends(scene: Scene) -> list[tuple[int, int] | None]:
    """Return the stations of each channel of two, None for channels of one."""
    found: list[tuple[int, int] | None] = []
    for block in scene.scan.rows:
        two = MODELS[block.kind].stations > 1
        found += [(int(a), int(b)) if two else None for a, b in zip(block.a, block.b, strict=True)]
    return found


def _linked(pairs: list[tuple[int, int] | None]) -> bool:
    """Return whether pairs of stations form one tree: only then do they fix a place in closed form."""
    own = [set(pair) for pair in pairs if pair is not None]
    while len(own) > 1:
        joined = next((other for other in own[1:] if own[0] & other), None)
        if joined is None or len(own[0] & joined) > 1:
            return False
        own = [own[0] | joined, *(other for other in own[1:] if other is not joined)]
    return True
