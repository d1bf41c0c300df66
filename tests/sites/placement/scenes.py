"""Scenes of placements: sites in a hall, places around it, arrivals with an emission time, noise that grows."""

from itertools import combinations

import numpy as np

from formulations.placement import Design
from optloc import assemble, measured
from optloc.sites.placement.best_set import SearchTask

CRITERIA = ("A", "D", "E")
CASES = [(criterion, worst, fail) for criterion in CRITERIA for worst in (False, True) for fail in (False, True)]


def drawn(seed, n, places, height=6.0):
    """Return sites (n, 3) in 60 x 60 m and places (P, 3) in 80 x 80 x 9 m."""
    rng = np.random.default_rng(seed)
    sites = rng.uniform([-30, -30, 0], [30, 30, height], (n, 3))
    return sites, rng.uniform([-40, -40, 0], [40, 40, 9], (places, 3))


def design(seed, n, places, height=6.0):
    """Return the design of arrivals with sigma^2 = 1 + (r / 40 m)^2: u and 1 by hand, no code of optloc."""
    sites, at = drawn(seed, n, places, height)
    away = at[:, None] - sites
    r = np.linalg.norm(away, axis=-1)
    rows = (
        np.concatenate([away / r[..., None], np.ones((places, n, 1))], axis=-1) / np.sqrt(1 + (r / 40) ** 2)[..., None]
    )
    prior = np.tile(np.diag([1e-4, 1e-4, 1e-4, 1e-6]), (places, 1, 1))
    return Design(np.swapaxes(rows, 1, 2)[:, None], prior, np.full(places, 1 / places), 3)


def task(seed, n, k, places, criterion="A", worst=False, fail=False, rules=None, limits=None):
    """Return the choice of k of n sites, or by other rules."""
    rules = np.ones((1, n)) if rules is None else rules
    limits = np.array([float(k)]) if limits is None else limits
    return SearchTask(design(seed, n, places), criterion, worst, fail, rules, limits, np.full(n, -1))


def every_set(n, k):
    """Return all sets of k of n sites, (sets, n)."""
    members = np.array(list(combinations(range(n), k)))
    out = np.zeros((len(members), n), dtype=np.int64)
    np.put_along_axis(out, members, 1, axis=1)
    return out


def hall(seed=1, n=12, places=4, sigma=0.3, kind="toa"):
    """Return a problem of n stations, and places (P, 3)."""
    sites, at = drawn(seed, n, places)
    return assemble(sites, measured(kind, a=np.arange(n), sigma=sigma)), at
