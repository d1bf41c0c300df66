"""Halls and fields with stations and pulses at random places, for tests of networks."""

import numpy as np

from optloc.calibration.likelihood import Estimate

HALL = np.array([20.0, 20.0, 6.0])


def hall(seed, m, n, sigma, *, clocks=False, box=HALL):
    """Return stations, pulses and times, as an estimate, and arrivals (N, M)."""
    rng = np.random.default_rng(seed)
    d = len(box)
    stations, pulses = rng.random((m, d)) * box, rng.random((n, d)) * box
    sent = rng.uniform(-100.0, 100.0, n)
    offsets = rng.uniform(-5.0, 5.0, m) if clocks else np.zeros(m)
    apart = np.linalg.norm(pulses[:, None] - stations, axis=-1)
    z = apart + sent[:, None] + offsets + sigma * rng.standard_normal((n, m))
    return Estimate(stations[None], offsets[None], pulses[None], sent[None]), z


def distances(points):
    """Return distances between all pairs of points."""
    i, k = np.tril_indices(len(points), -1)
    return np.linalg.norm(points[i] - points[k], axis=1)
