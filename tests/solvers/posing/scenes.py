"""Random problems for each formulation that can be posed, at any scale of lengths."""

import numpy as np

from optloc import Frame, Motion, Stations, assemble, measured, simulate
from optloc.base.frames import geodetic_to_ecef
from optloc.linear.constraints import height
from optloc.problem import ECEF, Bias


def seen(bare, truth, seed):
    return simulate(bare, truth, np.random.SeedSequence(seed))


def differences(seed, scale=1e4, d=2, count=6, noise=1e-3):
    """Range differences to the first of some stations, of a target around them."""
    rng = np.random.default_rng(seed)
    a = np.arange(1, count)
    bare = assemble(scale * rng.uniform(-1, 1, (count, d)), measured("tdoa", a=a, b=0 * a, arrival_sigma=noise * scale))
    return seen(bare, scale * rng.uniform(-1.0, 1.0, d), seed)


def ranged(seed, scale=1e4, d=2, count=5, noise=1e-3):
    """Ranges from some stations."""
    rng = np.random.default_rng(seed)
    bare = assemble(scale * rng.uniform(-1, 1, (count, d)), measured("range", a=np.arange(count), sigma=noise * scale))
    return seen(bare, scale * rng.uniform(-1.0, 1.0, d), seed)


def sighted(seed, scale=1e4, count=4, noise=2e-3):
    """Azimuths and elevations of some stations in space."""
    rng = np.random.default_rng(seed)
    a = np.arange(count)
    rows = (measured("azimuth", a=a, sigma=noise), measured("elevation", a=a, sigma=noise))
    place = scale * rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.3]
    return seen(assemble(place, *rows), scale * np.append(rng.uniform(-1, 1, 2), rng.uniform(0.5, 1.5)), seed)


def levelled(seed, noise=30.0):
    """Range differences of three satellites, and the height of a target below them."""
    rng = np.random.default_rng(seed)
    degrees = np.array([[24.4, 125.2], [25.1, 125.7], [23.8, 126.0]]) + rng.uniform(-1, 1, (3, 2))
    place = geodetic_to_ecef(*np.radians(degrees).T, np.full(3, 8e5))
    a = np.array([1, 2])
    bare = assemble(
        place, measured("tdoa", a=a, b=0 * a, arrival_sigma=noise), frame=ECEF, constraints=height(exactly=0.0)
    )
    return seen(bare, geodetic_to_ecef(*np.radians([24.0 + rng.uniform(-3, 3), 125.0 + rng.uniform(-3, 3)]), 0.0), seed)


def registered(seed, scale=1e3, noise=1e-3, epochs=12):
    """Range differences of moving stations with unknown offsets, and a target at rest."""
    rng = np.random.default_rng(seed)
    time, d, count = np.arange(float(epochs)), 2, 4
    first, speed = scale * rng.uniform(-1, 1, (count, d)), 0.15 * scale * rng.normal(size=(count, d))
    place = first + speed * time[:, None, None]
    a, epoch = np.tile(np.arange(1, count), epochs), np.repeat(np.arange(epochs), count - 1)
    row = np.arange(len(a))
    bias = Bias("clock", ("1", "2", "3"), row, a - 1, np.ones(len(a)), sigma=np.full(3, 20.0 * noise * scale))
    stations = Stations(place, tuple(f"s{i}" for i in range(count)))
    rows = measured("tdoa", a=a, b=0 * a, epoch=epoch, arrival_sigma=noise * scale)
    bare = assemble(stations, rows, times=time, motions=(Motion(),), biases=(bias,))
    truth = np.concatenate([scale * rng.uniform(-1.5, 1.5, d), 20.0 * noise * scale * rng.normal(size=3)])
    return seen(bare, truth, seed)


def shifted(seed, scale=1e4, noise=1e-3):
    """Differences of range rates to the first of some aircraft, of a source at rest."""
    rng = np.random.default_rng(seed)
    count, d = 4, 2
    speed = 120.0 * rng.normal(size=(1, count, d))
    stations = Stations(scale * rng.uniform(-1, 1, (1, count, d)), tuple(f"s{i}" for i in range(count)), velocity=speed)
    a = np.arange(1, count)
    bare = assemble(stations, measured("fdoa", a=a, b=0 * a, sigma=120.0 * noise), motions=(Motion(),))
    return seen(bare, scale * rng.uniform(-1.5, 1.5, d), seed)


def pair_of_targets(seed, scale=1e4, noise=1e-3):
    """Range differences of two targets with unknown offsets that both share."""
    rng = np.random.default_rng(seed)
    count, d = 6, 2
    a = np.tile(np.arange(1, count), 2)
    target = np.repeat([0, 1], count - 1)
    row = np.arange(len(a))
    bias = Bias("clock", tuple("12345"), row, a - 1, np.ones(len(a)), sigma=np.full(5, 10.0 * noise * scale))
    rows = measured("tdoa", a=a, b=0 * a, target=target, arrival_sigma=noise * scale)
    bare = assemble(scale * rng.uniform(-1, 1, (count, d)), rows, motions=(Motion(), Motion()), biases=(bias,))
    truth = np.concatenate([scale * rng.uniform(-1, 1, 2 * d), 10.0 * noise * scale * rng.normal(size=5)])
    return seen(bare, truth, seed)


SCENES = {
    "squared_range_conic: shor": (differences, ranged),
    "squared_range_conic: hull": (differences, ranged),
    "sparse_errors": (differences, ranged),
    "range_height_conic": (levelled,),
    "direction_sdp": (sighted,),
    "moment_sdp": (differences, ranged),
    "minimax_cone": (sighted,),
    "registration_sdp": (registered,),
    "doppler_sdp": (shifted,),
    "lifted": (differences, ranged),
    "nls": (differences, ranged, sighted, registered, shifted, pair_of_targets),
}
"""Functions ``(seed, scale) -> Problem`` for each formulation."""

METHODS = {
    "squared_range_conic: shor": "sdp",
    "squared_range_conic: hull": "socp",
    "sparse_errors": "sparse",
    "range_height_conic": "sdp",
    "direction_sdp": "directions",
    "minimax_cone": "minimax",
    "registration_sdp": "sdp",
    "doppler_sdp": "sdp",
    "nls": "gtrs+nlp+lsr+certify",
}
"""Method of the same name."""

FRAME = Frame
