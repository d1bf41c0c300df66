"""Halls and fields with stations and pulses at random places, for tests of networks."""

from dataclasses import replace

import numpy as np

from optloc.sites.calibration.likelihood import NetworkEstimate

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
    return NetworkEstimate(stations[None], offsets[None], pulses[None], sent[None]), z


def distances(points):
    """Return distances between all pairs of points."""
    i, k = np.tril_indices(len(points), -1)
    return np.linalg.norm(points[i] - points[k], axis=1)


DEGENERATE = ("stations flat", "pulses flat", "one plane", "parallel planes", "in line", "few")


def degenerate(case, seed):
    """Return arrivals (N, M) to 3 cm of a hall whose stations or pulses do not determine it."""
    truth, _ = hall(seed, 5 if case == "few" else 9, 6 if case == "few" else 20, 0.0)
    stations, pulses = truth.stations[0].copy(), truth.pulses[0].copy()
    if case in ("stations flat", "one plane", "parallel planes"):
        stations[:, 2] = 0.0
    if case in ("pulses flat", "one plane", "parallel planes"):
        pulses[:, 2] = 3.0 if case == "parallel planes" else 0.0
    if case == "in line":
        stations[:, 1:] = 0.0
    z = np.linalg.norm(pulses[:, None] - stations, axis=-1) + truth.emission[0][:, None]
    return z + 0.03 * np.random.default_rng(seed + 50).standard_normal(z.shape)


def thin(seed, which, thickness):
    """Return a hall of 9 x 20 with stations or pulses near a plane, metres to either side, and arrivals to 3 cm."""
    truth, _ = hall(seed, 9, 20, 0.0)
    points = getattr(truth, which).copy()
    points[..., 2] = 3.0 + thickness * (points[..., 2] - 3.0) / 3.0
    truth = replace(truth, **{which: points})
    z = np.linalg.norm(truth.pulses[0][:, None] - truth.stations[0], axis=-1) + truth.emission[0][:, None]
    return truth, z + 0.03 * np.random.default_rng(seed + 7).standard_normal(z.shape)


def reflected(truth):
    """Return an estimate with the station that is farthest from the pulses' best plane on its other side, and which."""
    stations, centre = truth.stations.copy(), truth.pulses[0].mean(axis=0)
    normal = np.linalg.svd(truth.pulses[0] - centre)[2][-1]
    i = int(np.abs((stations[0] - centre) @ normal).argmax())
    stations[0, i] -= 2.0 * ((stations[0, i] - centre) @ normal) * normal
    return NetworkEstimate(stations, truth.clocks, truth.pulses, truth.emission), i
