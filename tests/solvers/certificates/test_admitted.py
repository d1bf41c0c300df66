"""Proofs within what inequalities admit, against bounded searches by SciPy with residuals of their own."""

from dataclasses import replace

import numpy as np
import pytest
from model_checks.small import PLACE, ranges_to
from often import few
from scipy.optimize import minimize

from optloc import Status, assemble, measured, solve
from optloc.linear.constraints import box, faces, is_held, polygon
from optloc.problem.claims import GLOBAL, REGION
from optloc.solvers.certificates.admitted import certified
from optloc.solvers.stages import gtrs, lsr

SCALE = 1e4


def scene(seed):
    """Return a problem, its cost, and the bounds: earthquakes below a flat network, or targets in boxes."""
    rng = np.random.default_rng(seed)
    deep = bool(seed % 2)
    count = int(rng.integers(5, 8)) if deep else int(rng.integers(3, 6))
    place = rng.uniform(-20e3, 20e3, (count, 3 if deep else 2))
    if deep:
        place[:, 2] = rng.uniform(0.0, 1.0, count) * rng.choice([1.0, 300.0, 2000.0])
        truth = np.array([*rng.uniform(-20e3, 20e3, 2), -rng.uniform(0.0, 15e3)])
        low, high = np.full(3, -np.inf), np.array([np.inf, np.inf, place[:, 2].max()])
    else:
        place[:, 1] *= rng.choice([0.02, 0.2, 1.0])
        middle, reach = rng.uniform(-12e3, 12e3, 2), rng.uniform(1e3, 15e3, 2)
        low, high = middle - reach, middle + reach
        truth = rng.uniform(low, high)
    sigma = rng.choice([20.0, 100.0, 400.0])
    z = np.linalg.norm(place - truth, axis=-1) + sigma * rng.standard_normal(count)

    def cost(x):
        return float((((np.linalg.norm(place - x, axis=-1) - z) / sigma) ** 2).sum())

    def slope(x):
        reach = np.linalg.norm(place - x, axis=-1)
        return 2.0 * ((reach - z) / reach) @ (x - place) / sigma**2

    problem = assemble(place, measured("range", z, a=np.arange(count), sigma=sigma), constraints=box(low, high))
    return problem, (cost, slope), low, high, truth, rng


def searched(cost, slope, low, high, truth, rng, count):
    """Return the minima within bounds that descents from the truth and from random places end in."""
    found = []
    for i in range(count):
        start = truth if i == 0 else rng.uniform(-1.0, 1.0, len(truth)) * 10.0 ** rng.uniform(3.0, 4.8)
        done = minimize(
            lambda u: cost(u * SCALE),
            np.clip(start, np.maximum(low, -1e6), np.minimum(high, 1e6)) / SCALE,
            method="L-BFGS-B",
            jac=lambda u: slope(u * SCALE) * SCALE,
            bounds=list(zip(low / SCALE, high / SCALE, strict=True)),
            options={"maxiter": 3000, "ftol": 1e-15, "gtol": 1e-9},
        )
        found.append((done.fun, done.x * SCALE))
    return found


def settles(cost, low, high, x, rng):
    """Return where a random descent within bounds goes from a point: a search may stop on a slope."""
    value = cost(x)
    for _ in range(400):
        near = np.clip(x + 10.0 ** rng.uniform(-1.0, 3.0) * rng.standard_normal(len(x)), low, high)
        if cost(near) < value:
            x, value = near, cost(near)
    return x


def refuted(seed, count=12):
    """Return what a search finds that a claim excludes, in words, and the status."""
    problem, (cost, slope), low, high, truth, rng = scene(seed)
    fix = solve(problem)
    claim = fix.certificate
    if claim.proof != "global":
        return "", fix.status
    known = [fix.x, *fix.alternatives.x]
    for value, x in searched(cost, slope, low, high, truth, rng, count):
        gap = value - float(fix.cost)
        if gap < -1e-4 * (1.0 + value):
            return f"scene {seed}: {gap} at {x}", fix.status
        apart = min(np.linalg.norm(x - each) for each in known)
        if claim.unique and gap < claim.margin - 1e-3 and apart > 10.0:
            end = settles(cost, low, high, x, rng)
            if min(np.linalg.norm(end - each) for each in known) > 0.5 * apart:
                return f"scene {seed}: another minimum, {gap} more, at {x}", fix.status
    return "", fix.status


@pytest.mark.parametrize("first", few(range(0, 300, 6), 1))
def test_no_search_within_the_bounds_refutes_a_claim(first):
    told = [refuted(seed) for seed in range(first, first + 6)]
    assert [words for words, _ in told if words] == []
    assert sum(status == Status.OK for _, status in told) > 0


def test_a_mirror_image_that_is_not_admitted_does_not_count_whatever_it_costs():
    place = np.array([[0.0, 0.0, 0.0], [9e3, 0.0, 5.0], [0.0, 9e3, -4.0], [8e3, 9e3, 0.0], [4e3, -5e3, 3.0]])
    truth = np.array([3e3, 4e3, -5e3])
    better = []
    for seed in range(6):  # noise makes the image cheaper in some of them
        z = np.linalg.norm(place - truth, axis=-1) + 20.0 * np.random.default_rng(seed).standard_normal(5)
        rows = measured("range", z, a=np.arange(5), sigma=20.0)
        free = solve(assemble(place, rows))
        assert free.status == Status.AMBIGUOUS
        fix = solve(assemble(place, rows, constraints=box([-np.inf] * 3, [np.inf, np.inf, 5.0])))
        assert fix.status == Status.OK
        assert fix.certificate.margin > 9.0
        assert fix.position == pytest.approx(truth, abs=200.0)
        better.append(float(free.cost) < float(fix.cost))
    assert any(better)
    assert not all(better)


def test_a_minimum_on_an_edge_counts_where_the_cost_falls_outwards():
    place = np.array([[-6e3, 0.0], [0.0, 0.0], [7e3, 0.0]])
    rows = measured("range", np.linalg.norm(place - np.array([1e3, 3e3]), axis=-1), a=np.arange(3), sigma=400.0)
    fix = solve(assemble(place, rows, constraints=box([-np.inf, -2.5e3], [np.inf, np.inf])))
    assert fix.status == Status.AMBIGUOUS  # the image is at -3 km, and half a kilometre short of it hardly costs more
    assert fix.alternatives.x[:, 1] == pytest.approx([-2.5e3])
    # near the line of the stations the cost falls inwards: no minimum
    fix = solve(assemble(place, rows, constraints=box([-np.inf, 100.0], [np.inf, np.inf])))
    assert fix.status == Status.OK


def test_the_corners_of_a_polygon_hold_from_outside_alone():
    region = polygon([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 2.0], [0.0, 4.0]])
    rows = measured("range", [1.0, 1.0, 1.0], a=[0, 1, 2], sigma=1.0)
    problem = assemble(np.array([[0.0, 9.0], [9.0, 0.0], [5.0, 5.0]]), rows, constraints=region).flat()
    corners = {tuple(level.side for level in face): face for face in faces(problem) if len(face) == 2}
    for edges, corner, out, held in (
        ((4, 0), (0.0, 0.0), (-1.0, -1.0), True),
        ((4, 0), (0.0, 0.0), (-1.0, 1.0), False),
        ((2, 3), (2.0, 2.0), (0.0, 1.0), False),  # the notch: sideways it goes on
    ):
        told = is_held(problem, corners[edges], np.array([corner]), np.array([out]))
        assert told.tolist() == [held], edges
    edge = next(face for face in faces(problem) if len(face) == 1 and face[0].side == 0)
    assert is_held(problem, edge, np.array([[2.0, 0.0]]), np.array([[0.0, -1.0]])).all()
    assert not is_held(problem, edge, np.array([[2.0, 0.0]]), np.array([[0.0, 1.0]])).any()


def test_a_fix_inside_its_box_is_proven_and_the_claim_is_in_its_pool():
    bounded = replace(
        ranges_to(PLACE, 2.0, np.array([0.5, -1.0, 2.0, -0.5, 1.0])),
        constraints=tuple(box([-5e3, -5e3], [5e3, 5e3])),
    )
    pool = lsr(bounded, gtrs(bounded, None))
    told = certified(bounded, pool).proven
    assert told.unique.tolist() == [True]
    assert told.proof[0] in (GLOBAL, REGION)
