"""Runs of moving stations with biases, for the tests of registration: geometry in kilometres, written out."""

from dataclasses import replace

import numpy as np

import optloc
from optloc.base.types import Bias, Motion, Stations

PLACES = 1e3 * np.array([[0, 0, 10], [-15, 0, 10], [15, 0, 10], [-5, 30, 0], [5, 30, 0]])
SPEEDS = np.array([[0, 300, 0], [0, 300, 0], [0, 300, 0], [100, 300, 0], [-100, 300, 0]])
DELAYS = np.array([30.0, -40.0, 50.0, -30.0])
GAINS = np.array([0.3, -0.4, 0.5, -0.3])
# The same stations off their common plane, on courses that do not meet.
SPATIAL = PLACES + 1e3 * np.array([[0, 0, -2], [0, 3, 1], [0, -2, -6], [-6, 4, 3], [8, -5, 6]])
FIXED = np.array([200e3, 300e3, 0.0])
MOVING = np.array([200e3, 300e3, 5e3, -100.0, 0.0, 0.0])


def run(
    epochs,
    *,
    sigma=3.0,
    station=1.0,
    span="noise",
    order=0,
    prior=None,
    gain=None,
    places=PLACES,
    biased=True,
    step=1.0,
):
    """Return a run of range differences to the first station (and gain ratios), with a bias for each channel."""
    times = step * np.arange(epochs)
    position = places + SPEEDS * times[:, None, None]
    s = len(places)
    error = None if station == 0 else np.tile(station**2 * np.eye(3), (s, 1, 1))
    stations = Stations(position, tuple(f"S{i + 1}" for i in range(s)), covariance=error, span=span)
    epoch, a = np.repeat(np.arange(epochs), s - 1), np.tile(np.arange(1, s), epochs)
    rows = [optloc.measured("tdoa", a=a, b=0, epoch=epoch, arrival_sigma=sigma)]
    if gain is not None:
        rows.append(optloc.measured("groa", a=a, b=0, epoch=epoch, sigma=gain))
    names, count = tuple(f"S{i + 1}" for i in range(1, s)), len(a)
    biases = []
    for i, name in enumerate(("delay", "gain")[: len(rows)] if biased else ()):
        spread = None if prior is None or i else np.full(s - 1, prior)
        touched = i * count + np.arange(count)
        biases.append(Bias(name, names, touched, a - 1, np.ones(count), mean=np.zeros(s - 1), sigma=spread))
    return optloc.assemble(stations, *rows, times=times, motions=(Motion(order),), biases=biases)


def truth(problem):
    """Return the true vector of a run: target, then delays and gains where they are unknown."""
    state = MOVING if problem.motions[0].order else FIXED
    values = {"position": state[:3], "velocity": state[3:], "delay": DELAYS, "gain": GAINS}
    shared = np.concatenate([values[slot.name] for slot in problem.layout.shared])
    return np.concatenate([shared, np.zeros(problem.layout.size - len(shared))])


def drawn(problem, seed, trials):
    """Return trials of a run at its truth."""
    return optloc.simulate(problem, truth(problem), seed, trials=trials)


def estimated(problem):
    """Return a run whose station errors are unknowns of each epoch."""
    return replace(problem, stations=replace(problem.stations, span="epoch"))
