"""What a certificate claims beside a bound: gaps on surfaces and towards infinity, and that it is about its own fix."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, ENU, STATIONS, TARGET
from proof.plain import node_values
from scipy.optimize import least_squares

from optloc import Motion, Stations, assemble, measured, simulate, solve
from optloc.base.types import Band
from optloc.compute.jit import enabled
from optloc.linear.constraints import height
from optloc.proof.pose import unsupported
from optloc.solvers.certify import branch_and_bound

machine_code = pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
TRIALS = 24


# Equalities: other minima are those on the surface, which the free cost does not show.


def on_plane(rng):
    """Return the constraint, and positions (n, 3) on it from coordinates (n, 2)."""
    normal = rng.standard_normal(3) * [0.5, 0.5, 1.0]
    normal /= np.linalg.norm(normal)
    value, axes = float(rng.uniform(-2e3, 2e3)), np.linalg.qr(np.column_stack([normal, np.eye(3)[:, :2]]))[0][:, 1:]
    band = Band("plane", np.array(value), np.array(value), normal, "slope", 0)
    return (band,), lambda y: value * normal + y @ axes.T


def on_height(rng):
    value = float(rng.uniform(0.0, 4e3))

    def place(y):
        x = np.column_stack([y, np.full(len(y), value)])
        for _ in range(4):
            x[:, 2] += value - ENU.to_geodetic(x)[2]
        return x

    return height(exactly=value), place


def residuals(S, z, x, sigma):
    """Return whitened residuals of arrivals with an unknown emission time."""
    r = np.linalg.norm(x - S, axis=1) / sigma
    return (r - r.mean()) - z


def least_on(surface, S, z, sigma, rng):
    """Return the distinct minima (cost, position) that SciPy reaches on a surface."""
    place, found = surface, []
    for start in rng.uniform(-1.0, 1.0, (40, 2)) * 10.0 ** rng.uniform(3.0, 4.7, (40, 1)):
        done = least_squares(
            lambda y: residuals(S, z, place(y[None])[0], sigma), start, x_scale=1e3, xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        bend = done.jac.T @ done.jac
        slope = np.sqrt(max(done.grad @ np.linalg.pinv(bend) @ done.grad, 0.0))
        x = place(done.x[None])[0]
        if slope < 1e-3 and all(np.linalg.norm(x - other) > 1.0 for _, other in found):
            found.append((2.0 * done.cost, x))
    return sorted(found, key=lambda each: each[0])


def check_surface(kind, rng):
    """Compare one certificate on a surface with minima by other means; return whether it claims a gap."""
    sigma = float(rng.choice([10.0, 100.0, 400.0]))
    S = rng.uniform(-5e3, 5e3, (4, 3)) * [1.0, 1.0, 0.3]
    constraint, place = kind(rng)
    truth = place(rng.uniform(-8e3, 8e3, (1, 2)))[0]
    arrival = np.linalg.norm(truth - S, axis=1) + sigma * rng.standard_normal(4)
    rows = measured("tdoa", arrival[1:] - arrival[0], a=[1, 2, 3], b=0, arrival_sigma=sigma)
    problem = assemble(S, rows, frame=ENU, constraints=constraint)
    fix = solve(problem)
    proof = fix.certificate.item()
    if not fix.answered or proof.proof not in ("global", "region"):
        return False
    z = (arrival - arrival.mean()) / sigma
    minima = least_on(place, S, z, sigma, rng)
    cost, slack = float(fix.cost), 1e-5 * (1.0 + float(fix.cost))
    inside = np.ones(len(minima), dtype=bool)
    if proof.region is not None:
        low, high = np.array(proof.region)
        inside = np.array([((x > low) & (x < high)).all() for _, x in minima], dtype=bool)
    known = np.concatenate([fix.position[None], problem.layout.take(fix.alternatives.x, "position").reshape(-1, 3)])
    for (least, x), within in zip(minima, inside, strict=True):
        if not within:
            continue
        assert least >= cost - slack
        if proof.unique and least < cost + proof.margin - 0.01:
            apart = np.linalg.norm(known - x, axis=1)
            assert np.nanmin(apart) < 0.05 * sigma, f"{x} costs {least - cost} more, within {proof.margin}"
    return proof.unique


@machine_code
@pytest.mark.parametrize("kind", [on_plane, on_height])
def test_gaps_on_a_surface_hold_against_many_starts(kind, seed):
    rng = np.random.default_rng([seed, 1])
    assert sum(check_surface(kind, rng) for _ in range(TRIALS)) > TRIALS // 4


@pytest.mark.full
@machine_code
@pytest.mark.parametrize("kind", [on_plane, on_height])
def test_gaps_on_a_surface_hold_in_full(kind, seed):
    rng = np.random.default_rng([seed, 2])
    assert sum(check_surface(kind, rng) for _ in range(20 * TRIALS)) > 5 * TRIALS


# Infinity.


@machine_code
def test_where_infinity_is_near_the_gap_of_the_region_is_tried(seed):
    """Far emitters in the plane: some gaps are 5.99, and no place far away costs less than that more."""
    rng = np.random.default_rng([seed, 3])
    S, n = rng.uniform(-5e3, 5e3, (5, 2)), 120
    way = rng.uniform(-np.pi, np.pi, n)
    truth = np.stack([np.cos(way), np.sin(way)], axis=1) * rng.uniform(40e3, 120e3, (n, 1))
    arrival = np.linalg.norm(truth[:, None] - S, axis=-1) + 10.0 * rng.standard_normal((n, 5))
    problem = assemble(S, measured("tdoa", arrival[:, 1:] - arrival[:, :1], a=[1, 2, 3, 4], b=0, arrival_sigma=10.0))
    fix = solve(problem)
    turn = np.linspace(-np.pi, np.pi, 20_000)
    front = -np.stack([np.cos(turn), np.sin(turn)], axis=1) @ S.T / 10.0
    front -= front.mean(1, keepdims=True)
    z = (arrival - arrival.mean(1, keepdims=True)) / 10.0
    infinity = ((front[None] - z[:, None]) ** 2).sum(-1).min(1)
    margin, cost = np.array([proof.margin for proof in fix.certificate]), fix.cost
    assert (infinity[margin > 0.0] > cost[margin > 0.0] + margin[margin > 0.0] - 0.01).all()
    near = np.abs(margin - 5.991) < 0.01
    assert near.any()
    assert (infinity[near] < cost[near] + 9.1).all()


# The cost of a proof is that of its fix.


@machine_code
@pytest.mark.parametrize("name", ["tdoa-3d", "range-2d", "angles-3d"])
def test_costs_beside_the_fix_are_compared_too(name, monkeypatch):
    """Rows that are turned about the fix leave its cost and its slope as they are, but nothing else."""
    problem = CASES[name].problem
    fix, real = solve(problem, "gtrs+lsr"), branch_and_bound.pose_costs

    def steeper(given):
        pose = real(given)
        phi = node_values(given, pose.kinds, pose.data[:1], fix.position.reshape(1, -1))
        rest = (pose.K @ phi[..., None])[..., 0] - pose.w
        return pose._replace(K=1.001 * pose.K, w=1.001 * (pose.w + rest) - rest)

    assert branch_and_bound.certify(problem, fix).certificate.item().reason != branch_and_bound.MISMATCHED
    monkeypatch.setattr(branch_and_bound, "pose_costs", steeper)
    turned = branch_and_bound.certify(problem, fix)
    assert turned.certificate.item().proof == "unknown"
    assert turned.certificate.item().reason == branch_and_bound.MISMATCHED
    assert turned.stages[-1].detail.endswith("1 posed cost did not match")


# Station errors that last a run, of stations that move.


def moving(span, move):
    """Return a problem of ranges to two places of each station, one error each."""
    a, d = np.tile(np.arange(4), 2), 3
    place = np.stack([STATIONS[d][:4], STATIONS[d][:4] + move])
    own = Stations(place, covariance=np.broadcast_to(25.0 * np.eye(d), (4, d, d)), span=span)
    rows = measured("range", a=a, epoch=np.repeat([0, 1], 4), sigma=1.0)
    return simulate(assemble(own, rows, times=[0.0, 1.0], motions=(Motion(0),)), TARGET[d], 5)


def test_station_errors_of_a_run_are_refused_where_stations_move():
    assert "while stations move" in unsupported(moving("run", 500.0).flat())
    fix = solve(moving("run", 500.0))
    assert fix.certificate.item().proof == "unknown"
    assert "while stations move" in fix.certificate.item().reason
    for span, move in (("run", 0.0), ("epoch", 500.0)):
        assert unsupported(moving(span, move).flat()) == ""


@machine_code
@pytest.mark.parametrize(("span", "move"), [("run", 0.0), ("epoch", 500.0)])
def test_station_errors_that_are_posed_agree_with_the_problem(span, move):
    problem = moving(span, move)
    proof = solve(problem).certificate.item()
    assert proof.reason != branch_and_bound.MISMATCHED
    assert proof.proof == "global"


def test_places_that_only_look_different_are_not_moving():
    problem = moving("run", 0.0)
    still = replace(problem.stations, position=problem.stations.position.copy())
    assert unsupported(replace(problem, stations=still).flat()) == ""
