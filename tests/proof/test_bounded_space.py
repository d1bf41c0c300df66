"""Rows that bound space, levels and disjoint pairs: fixes are proven, and no other search contradicts a proof."""

import numpy as np
import pytest
from proof.independent import Trial
from proof.layouts import BY_NAME, rows
from scipy.optimize import least_squares

from optloc import Frame, assemble, measured, solve
from optloc.problem import ECEF

EARTH = Frame("ecef")
# Latitude, longitude (degrees) and height of four receivers around London.
RECEIVERS = np.array([[51.5, -0.1, 50.0], [51.7, 0.4, 80.0], [51.2, 0.3, 30.0], [51.4, -0.8, 100.0]])


def geocentric(places):
    """Return Earth-centred coordinates of latitudes, longitudes (degrees) and heights (..., 3)."""
    return EARTH.from_geodetic(np.radians(places[..., 0]), np.radians(places[..., 1]), places[..., 2])


def bistatic(d, illuminators, trials, rng):
    """Return trials of a receiver with its angles, and range sums of illuminators within 30 km: 50 m, 10 mrad."""
    stations = rng.uniform(-3e4, 3e4, (trials, 1 + illuminators, d))
    stations[:, 0] = 0.0
    truth = rng.uniform(-3e4, 3e4, (trials, d))
    if d == 3:
        stations[:, 1:, 2], truth[:, 2] = rng.uniform(0.0, 500.0, (trials, illuminators)), rng.uniform(1e3, 9e3, trials)
    made = rows("range_sum", stations, truth, 50.0, rng)
    made += rows("aoa", stations[:, :1], truth, 10e-3, rng)[: d - 1]
    return assemble(stations[:, None], *made), truth


def multilateration(trials, sigma, rng):
    """Return trials of an aircraft: four arrivals (15 m), and a height whose error is 15 m, with a stated sigma."""
    places = np.column_stack([
        51.4 + 0.3 * rng.standard_normal(trials),
        -0.1 + 0.4 * rng.standard_normal(trials),
        9e3 + 1e3 * rng.standard_normal(trials),
    ])  # fmt: skip
    truth, stations = geocentric(places), geocentric(RECEIVERS)
    arrival = np.linalg.norm(truth[:, None] - stations, axis=-1) + 15.0 * rng.standard_normal((trials, 4))
    level = places[:, 2:] + 15.0 * rng.standard_normal((trials, 1))
    toa = measured("toa", arrival, a=np.arange(4), sigma=15.0)
    return assemble(stations, toa, measured("height", level, sigma=sigma), frame=ECEF), truth


def unlisted(fix, known, found):
    """Return the costs of minima (x, cost) that a certified fix of one problem excludes, and does not list."""
    proof, cost = fix.certificate, float(fix.cost)
    assert proof.proof == "global"
    margin = proof.margin if proof.unique else 0.0
    wrong = [value for _, value in found if value < cost - 1e-6 * (1.0 + cost)]
    for x, value in found:
        near = np.linalg.norm(known - x, axis=-1).min()
        if value < cost + margin - 0.1 and near > 1.0 + 1e-4 * np.linalg.norm(x):
            wrong.append(value)
    return wrong


def positions(problem, fix):
    """Return the positions of a fix and of its alternatives (n, d)."""
    others = problem.layout.take(fix.alternatives.x, "position")
    return np.concatenate([fix.position[None], others[np.isfinite(others).all(-1)]])


def counted(problem, truth, starts, rng):
    """Return how many trials are proven, or have another minimum beside; no proof may miss one of an own search."""
    fixes, proven = solve(problem), 0
    for i, label in enumerate(s.label for s in fixes.statuses):
        fix = fixes[i]
        if fix.certificate.proof != "global":
            continue
        proven += fix.certificate.unique or label == "ambiguous"
        trial = Trial(problem, i)
        found = [(x, cost) for x, cost, rest in trial.minima(truth[i], rng, starts) if rest < 1e-3]
        assert not unlisted(fix, positions(problem, fix), found), f"trial {i}"
    return proven, fixes


def check_bistatic(d, illuminators, trials, seed):
    rng = np.random.default_rng([seed, d, illuminators])
    problem, truth = bistatic(d, illuminators, trials, rng)
    proven, fixes = counted(problem, truth, 12, rng)
    # two in a hundred targets in the plane are so near the line of sight of transmitter and receiver that the sum does
    # not depend on the place
    assert proven >= 0.95 * trials
    labels = [s.label for s in fixes.statuses]
    assert set(labels) <= {"ok", "curved", "ambiguous", "misfit", "unproven", "singular geometry"}
    assert sum(label in ("unproven", "singular geometry") for label in labels) <= 0.05 * trials


@pytest.mark.parametrize("illuminators", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_bistatic_fixes_are_proven(d, illuminators, seed):
    check_bistatic(d, illuminators, 40, seed)


@pytest.mark.full
@pytest.mark.parametrize("illuminators", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_bistatic_fixes_are_proven_in_full(d, illuminators, seed):
    check_bistatic(d, illuminators, 500, seed)


def check_multilateration(sigma, trials, seed):
    """Compare fixes with minima by formulas of heights and of derivatives that are not the package's own."""
    rng = np.random.default_rng([seed, int(sigma)])
    problem, truth = multilateration(trials, sigma, rng)
    stations, fixes = geocentric(RECEIVERS), solve(problem)
    for i in range(trials):
        fix = fixes[i]
        if fix.certificate.proof != "global":
            continue
        z, level = problem.z[i, :4], problem.z[i, 4]

        def residual(u, z=z, level=level):
            r = np.linalg.norm(1e3 * u - stations, axis=-1) - z
            return np.append((r - r.mean()) / 15.0, (EARTH.to_geodetic(1e3 * u)[2] - level) / sigma)

        around = geocentric(np.column_stack([rng.uniform(-90, 90, 3), rng.uniform(-180, 180, 3), np.full(3, 9e3)]))
        near = truth[i] + 1e5 * rng.standard_normal((3, 3))
        done = [least_squares(residual, start / 1e3, x_scale=10.0) for start in (truth[i], *around, *near)]
        found = [(1e3 * one.x, 2.0 * one.cost) for one in done if one.optimality < 1e-3]
        assert not unlisted(fix, positions(problem, fix), found), f"trial {i}"
    assert sum(s.label == "ok" for s in fixes.statuses) >= 0.9 * trials


@pytest.mark.parametrize("sigma", [15.0, 75.0])
def test_four_arrivals_and_a_measured_height_are_ok(sigma, seed):
    check_multilateration(sigma, 8, seed)


@pytest.mark.full
@pytest.mark.parametrize("sigma", [15.0, 75.0])
def test_four_arrivals_and_a_measured_height_are_ok_in_full(sigma, seed):
    check_multilateration(sigma, 100, seed)


CELLS = [
    "RSS, 6 stations, inside, 0.1 dB",
    "RSS in the plane, 5 stations, 0.5 dB",
    "TDOA, 3 disjoint pairs, inside, 3 m",
    "TDOA in the plane, 2 disjoint pairs, 3 m",
]


def check_cell(name, trials, seed):
    problem, truth = BY_NAME[name].drawn(trials, 5, seed)
    proven, fixes = counted(problem, truth, 12, np.random.default_rng([seed, 11]))
    # a search found a minimum, or the reason names what is not determined: there a proof has no place to prove
    labels = [s.label for s in fixes.statuses]
    assert "disconnected" not in labels
    unique = sum(label not in ("unbounded", "singular geometry") for label in labels)
    assert proven >= 0.95 * unique > 0.7 * trials


@pytest.mark.parametrize("name", CELLS)
def test_levels_and_disjoint_pairs_are_proven(name, seed):
    check_cell(name, 40, seed)


@pytest.mark.full
@pytest.mark.parametrize("name", CELLS)
def test_levels_and_disjoint_pairs_are_proven_in_full(name, seed):
    check_cell(name, 500, seed)
