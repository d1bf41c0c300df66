"""What a certificate claims beside a bound: gaps on surfaces and towards infinity, and that it is about its own fix."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, ENU, STATIONS, TARGET
from descent import levenberg
from proof.plain import node_values

from optloc import Motion, Stations, assemble, certify, measured, simulate, solve
from optloc.base.types import Band
from optloc.kernels.jit import enabled
from optloc.linear.constraints import height
from optloc.models.primitives import WGS84_A, WGS84_F
from optloc.proof.global_search import UNBOUNDED
from optloc.proof.local_search import BUDGET
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates import branch_and_bound

machine_code = pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
TRIALS, FULL, STARTS = 5, 200, 16
# Least sine of the elevation of stations above a place that the Earth surely does not hide: lines may dip 50 km.
HORIZON = -0.1


# Equalities: other minima are those on the surface, which the free cost does not show.


def on_plane(rng):
    """Return the constraint, positions (n, 3) on it from coordinates (n, 2), and derivatives (3, 2) at one (2,)."""
    normal = rng.standard_normal(3) * [0.5, 0.5, 1.0]
    normal /= np.linalg.norm(normal)
    value, axes = float(rng.uniform(-2e3, 2e3)), np.linalg.qr(np.column_stack([normal, np.eye(3)[:, :2]]))[0][:, 1:]
    band = Band("plane", np.array(value), np.array(value), normal, "slope", 0)
    return (band,), lambda y: value * normal + y @ axes.T, lambda y: axes


def on_height(rng):
    value, e2 = float(rng.uniform(0.0, 4e3)), WGS84_F * (2.0 - WGS84_F)

    def angles(y):  # coordinates are metres of latitude and longitude
        return np.radians(47.3) + y[..., 1] / 6.37e6, np.radians(8.5) + y[..., 0] / 4.32e6

    def place(y):
        lat, lon = angles(y)
        across = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon)])
        prime = WGS84_A / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
        ecef = np.stack([*((prime + value) * across), ((1.0 - e2) * prime + value) * np.sin(lat)], axis=-1)
        return (ecef - ENU.origin_ecef()) @ ENU.rotation_to_ecef()

    def along(y):
        lat, lon = angles(y)
        bent = 1.0 - e2 * np.sin(lat) ** 2
        east = np.array([-np.sin(lon), np.cos(lon), 0.0]) * np.cos(lat) * (WGS84_A / np.sqrt(bent) + value)
        north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
        north *= WGS84_A * (1.0 - e2) / bent**1.5 + value
        return ENU.rotation_to_ecef().T @ np.stack([east / 4.32e6, north / 6.37e6], axis=-1)

    return height(exactly=value), place, along


def on_height_from_space(rng):
    return on_height(rng)


# Powers of ten of metres from where to start elsewhere: on the whole Earth from above.
REACH = {on_plane: 5.0, on_height: 6.3, on_height_from_space: 7.3}


def predicted(kind, S, x):
    """Return what is measured of a place: range differences whitened as they are correlated, ranges, or azimuths."""
    r = np.linalg.norm(x - S, axis=1)
    if kind == "tdoa":
        return np.linalg.solve(np.linalg.cholesky(np.eye(len(S) - 1) + 1.0), r[1:] - r[0])
    return r if kind == "range" else np.arctan2(x[1] - S[:, 1], x[0] - S[:, 0])


def residuals(kind, S, z, x, sigma):
    """Return whitened residuals."""
    off = predicted(kind, S, x) - z
    return (np.arctan2(np.sin(off), np.cos(off)) if kind == "azimuth" else off) / sigma


def slope_of(kind, S, x, sigma):
    """Return the derivatives of whitened residuals by the place."""
    if kind == "azimuth":
        way = x - S
        return np.stack([-way[:, 1], way[:, 0], 0.0 * way[:, 0]], axis=-1) / (way[:, :2] ** 2).sum(1)[:, None] / sigma
    line = (x - S) / np.linalg.norm(x - S, axis=1)[:, None]
    if kind == "tdoa":
        line = np.linalg.solve(np.linalg.cholesky(np.eye(len(S) - 1) + 1.0), line[1:] - line[0])
    return line / sigma


def least_on(place, along, kind, S, z, sigma, rng, reach):
    """Return the distinct minima (cost, position) that SciPy reaches on a surface from places up to a distance."""
    found = []
    for start in rng.uniform(-1.0, 1.0, (STARTS, 2)) * 10.0 ** rng.uniform(3.0, reach, (STARTS, 1)):
        done = levenberg(
            lambda y: residuals(kind, S, z, place(1e4 * y[None])[0], sigma),
            1e-4 * start,
            lambda y: 1e4 * slope_of(kind, S, place(1e4 * y[None])[0], sigma) @ along(1e4 * y),
            most=200,
            fine=1e-12,
        )
        bend, grad = done.jac.T @ done.jac, done.jac.T @ done.fun
        slope = np.sqrt(max(grad @ np.linalg.pinv(bend) @ grad, 0.0))
        x = place(1e4 * done.x[None])[0]
        if slope < 1e-3 and all(np.linalg.norm(x - other) > 1.0 for _, other in found):
            found.append((2.0 * done.cost, x))
    return sorted(found, key=lambda each: each[0])


def drawn_on(surface, place, rng):
    """Return what is measured of a place on a surface: kind, stations, whitened values, noise, and the rows."""
    space = surface is on_height_from_space
    kind = str(rng.choice(["tdoa", "range"] if space else ["tdoa", "range", "azimuth"]))
    sigma = float(10.0 ** -rng.uniform(1.0, 3.0) if kind == "azimuth" else rng.choice([0.1, 1.0, 5.0, 50.0, 500.0]))
    count = int(rng.integers(4, 6)) if kind == "tdoa" else int(rng.integers(2, 5))
    S = rng.uniform(-5e3, 5e3, (count, 3)) * [1.0, rng.choice([0.2, 1.0]), 0.3]  # nearly in line: images compete
    truth = place(rng.standard_normal((1, 2)) * 10.0 ** rng.uniform(3.0, 4.5))[0]
    if space:  # images half around the Earth
        way, sigma = rng.standard_normal((count, 3)) * [1.0, 1.0, 0.3], 1e3 * sigma
        way[:, 2] = np.abs(way[:, 2]) + 0.3
        S = 2e7 * way / np.linalg.norm(way, axis=1, keepdims=True)
    z = predicted(kind, S, truth) + sigma * rng.standard_normal(len(S) - (kind == "tdoa"))
    if kind == "tdoa":
        told = np.linalg.cholesky(np.eye(count - 1) + 1.0) @ z
        rows = measured("tdoa", told, a=np.arange(1, count), b=np.zeros(count - 1, dtype=int), arrival_sigma=sigma)
    else:
        rows = measured(kind, z, a=np.arange(count), sigma=sigma)
    return kind, S, z, sigma, rows


def elevations(S, x):
    """Return the sines of the elevations of stations above a place on the Earth, taken for a ball."""
    up = x - -ENU.origin_ecef() @ ENU.rotation_to_ecef()
    way = S - x
    return way @ up / np.linalg.norm(up) / np.linalg.norm(way, axis=1)


def check_surface(surface, rng):
    """Compare one certificate on a surface with minima by other means; return whether it claims a gap."""
    constraint, place, along = surface(rng)
    kind, S, z, sigma, rows = drawn_on(surface, place, rng)
    problem = assemble(S, rows, frame=ENU, constraints=constraint)
    fix = solve(problem)
    proof = fix.certificate
    if not fix.answered or proof.proof not in ("global", "region"):
        return False
    minima = least_on(place, along, kind, S, z, sigma, rng, REACH[surface])
    cost, slack = float(fix.cost), 1e-5 * (1.0 + float(fix.cost))
    inside = np.ones(len(minima), dtype=bool)
    if proof.region is not None:
        low, high = np.array(proof.region)
        inside = np.array([((x > low) & (x < high)).all() for _, x in minima], dtype=bool)
    known = np.concatenate([fix.position[None], problem.layout.take(fix.alternatives.x, "position").reshape(-1, 3)])
    for (least, x), within in zip(minima, inside, strict=True):
        if not within or (surface is not on_plane and elevations(S, x).min() < HORIZON):
            continue
        assert least >= cost - slack
        if proof.unique and least < cost + proof.margin - 0.01:
            apart = [
                np.linalg.norm(residuals(kind, S, z, other, sigma) - residuals(kind, S, z, x, sigma)) for other in known
            ]
            assert np.nanmin(apart) < 0.05, f"{kind}: {x} costs {least - cost} more, within {proof.margin}"
    return proof.unique


@machine_code
@pytest.mark.parametrize("surface", [on_plane, on_height, on_height_from_space])
def test_gaps_on_a_surface_hold_against_many_starts(surface, seed):
    rng = np.random.default_rng([seed, 1])
    assert sum(check_surface(surface, rng) for _ in range(TRIALS)) >= TRIALS // 2


@pytest.mark.full
@machine_code
@pytest.mark.parametrize("surface", [on_plane, on_height, on_height_from_space])
def test_gaps_on_a_surface_hold_in_full(surface, seed):
    rng = np.random.default_rng([seed, 2])
    assert sum(check_surface(surface, rng) for _ in range(FULL)) >= FULL // 2


# Infinity.


@pytest.mark.parametrize(("why", "margin"), [(UNBOUNDED, 7.8147), (BUDGET, 0.0)])
def test_where_infinity_is_near_the_gap_of_the_region_is_tried(why, margin, monkeypatch):
    """Proofs of one gap at a time fail from 9 on: only where infinity is the reason one between 9 and none is tried."""
    problem, real, tried = CASES["tdoa-3d"].problem, branch_and_bound.prove, []

    def failing(costs, asked):
        gap = asked.gaps[:, 0]
        tried.append(float(gap[0]))
        answer = real(costs, asked)
        return answer._replace(verdict=np.where(gap >= 9.0, why, answer.verdict), gap=gap)

    monkeypatch.setattr(branch_and_bound, "prove", failing)
    proof = certify(problem, solve(problem, "gtrs+lsr")).certificate
    assert (proof.proof, proof.unique) == ("global", margin > 0.0)
    assert proof.margin == pytest.approx(margin, abs=1e-3)
    assert tried[:2] == [25.0, 9.0]
    assert tried[2:] == [proof.margin]


# The cost of a proof is that of its fix.


@machine_code
@pytest.mark.parametrize("name", ["tdoa-3d", "range-2d", "angles-3d"])
def test_costs_beside_the_fix_are_compared_too(name, monkeypatch):
    """Rows that are turned about the fix leave its cost and its slope as they are, but nothing else."""
    problem = CASES[name].problem
    fix, real = solve(problem, "gtrs+lsr"), branch_and_bound.eliminate_nuisance

    def steeper(given):
        costs = real(given)
        phi = node_values(given, costs.kinds, costs.data[:1], fix.position.reshape(1, -1))
        rest = (costs.K @ phi[..., None])[..., 0] - costs.w
        return costs._replace(K=1.001 * costs.K, w=1.001 * (costs.w + rest) - rest)

    assert certify(problem, fix).certificate.reason != branch_and_bound.MISMATCHED
    monkeypatch.setattr(branch_and_bound, "eliminate_nuisance", steeper)
    turned = certify(problem, fix)
    assert turned.certificate.proof == "unknown"
    assert turned.certificate.reason == branch_and_bound.MISMATCHED
    assert turned.stages[-1].detail.endswith("1 position cost did not match")


# Station errors that last a run, of stations that move.


def moving(span, move):
    """Return a problem of ranges to two places of each station, one error each."""
    a, d = np.tile(np.arange(4), 2), 3
    place = np.stack([STATIONS[d][:4], STATIONS[d][:4] + move])
    own = Stations(place, tuple("ABCD"), covariance=np.broadcast_to(25.0 * np.eye(d), (4, d, d)), span=span)
    z = np.linalg.norm(TARGET[d] - place, axis=-1).ravel() + np.random.default_rng(5).standard_normal(8)
    rows = measured("range", z, a=a, epoch=np.repeat([0, 1], 4), sigma=1.0)
    return assemble(own, rows, times=[0.0, 1.0], motions=(Motion(0),))


def test_station_errors_of_a_run_are_refused_where_stations_move():
    assert "while stations move" in why_unsupported(moving("run", 500.0).flat())
    fix = solve(moving("run", 500.0))
    assert fix.certificate.proof == "unknown"
    assert "while stations move" in fix.certificate.reason
    for span, move in (("run", 0.0), ("epoch", 500.0)):
        assert why_unsupported(moving(span, move).flat()) == ""


@machine_code
@pytest.mark.parametrize(("span", "move"), [("run", 0.0), ("epoch", 500.0)])
def test_station_errors_that_are_posed_agree_with_the_problem(span, move):
    problem = moving(span, move)
    proof = solve(problem).certificate
    assert proof.reason != branch_and_bound.MISMATCHED
    assert proof.proof == "global"


def test_places_that_only_look_different_are_not_moving():
    problem = moving("run", 0.0)
    still = replace(problem.stations, position=problem.stations.position.copy())
    assert why_unsupported(replace(problem, stations=still).flat()) == ""


def test_differences_that_repeat_are_proven_to_infinity():
    """Of eight anchors in a ring seven differences are independent: an eighth row is rounding, and grows nowhere."""
    hall = np.array([[x, y, z] for z in (0.2, 3.0) for x, y in ((-4, -4), (4, -4), (4, 4), (-4, 4))])
    a = np.tile(np.arange(8), 3)
    problem = assemble(hall, measured("tdoa", a=a, b=(a + 1) % 8, sigma=0.2))
    truth = np.random.default_rng(1).uniform([-3.0, -3.0, 0.5], [3.0, 3.0, 2.5], (12, 3))
    fix = solve(simulate(problem, truth=truth, seed=2))
    assert {certificate.proof for certificate in fix.certificate} == {"global"}
