"""Proofs for all positions: right about every minimum that is met, and there where enclosures fail."""

from itertools import product

import numpy as np
import pytest
from descent import levenberg
from proof.costs import WIDTH, beside, down_from, no_rivals
from proof.sampling import many
from scipy.optimize import least_squares, minimize_scalar

from optloc import Status, assemble, measured, solve
from optloc.kernels.jit import enabled
from optloc.proof.atlas import atlas_of
from optloc.proof.batch import ProofRequest, prove_all
from optloc.proof.box import reaches_infinity, station_cube
from optloc.proof.convex_boxes import set_minimum
from optloc.proof.global_search import UNBOUNDED, prove_atlas, prove_globally
from optloc.proof.local_search import BETTER, BUDGET, OTHER, UNIQUE, VALUE, prove_locally
from optloc.proof.nodes.node import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATIO
from optloc.proof.position_costs import PositionCosts
from optloc.proof.search_space import cost_of, empty_box

# Of directions, radians.
FINE = {"xatol": 1e-12}


def differences(S, sigma, x, rng):
    """Return nodes and whitened rows of range differences to the first station with independent arrival errors."""
    m, d = len(S) - 1, S.shape[1]
    C = np.concatenate([-np.ones((m, 1)), np.eye(m)], axis=1)
    root = np.linalg.cholesky(0.5 * sigma**2 * (np.eye(m) + 1.0))
    z = C @ np.linalg.norm(x - S, axis=1) + root @ rng.normal(size=m)
    data = np.zeros((m + 1, WIDTH))
    data[:, :d] = S
    return np.full(m + 1, RANGE), data, np.linalg.solve(root, C), np.linalg.solve(root, z)


def minima_of(S, K, w, starts):
    """Return the minima that an independent solver reaches, the least first: costs and positions."""

    def residual(p):
        return K @ np.linalg.norm(p - S, axis=1) - w

    def jacobian(p):
        line = p - S
        return K @ (line / np.linalg.norm(line, axis=1)[:, None])

    found = []
    for start in starts:
        p = levenberg(residual, start, jacobian).x
        for _ in range(8):  # Newton, to vanishing slope
            line = p - S
            r = np.linalg.norm(line, axis=1)
            u = line / r[:, None]
            J, e = K @ u, K @ r - w
            force = (K.T @ e) / r
            H = J.T @ J + force.sum() * np.eye(len(p)) - np.einsum("i,ij,ik->jk", force, u, u)
            step = np.linalg.solve(H, J.T @ e)
            if not np.linalg.norm(step) < 1e3 or np.linalg.eigvalsh(H)[0] <= 0.0:
                break
            p = p - step
        else:
            e = residual(p)
            if all(np.linalg.norm(p - q) > 0.1 for _, q in found):
                found.append((e @ e, p))
    return sorted(found, key=lambda pair: pair[0])


def outside(d, rng):
    way = rng.normal(size=d)
    return way / np.linalg.norm(way) * rng.uniform(10e3, 30e3)


def proven(prover, kinds, data, K, w, x, others, kappa, budget=4000):
    """Return the verdict, with other minima added as they are found, and how many boxes it took."""
    others, boxes = list(others), 0
    for _ in range(6):
        found = np.full(len(x), np.nan)
        rest = beside(others, len(x))
        f = K @ np.linalg.norm(x - data[:, : len(x)], axis=1) - w if (kinds == RANGE).all() else np.zeros(1)
        cost, box = cost_of(kinds, data, K, w), empty_box(*K.shape)
        verdict, more, *_ = prover(cost, box, x, rest, kappa, 1e-6 * (1.0 + f @ f), budget, found)
        boxes += more
        if verdict != OTHER:
            break
        others.append(minima_of(data[:, : len(x)], K, w, [found])[0][1])
    return verdict, boxes


def by_atlas(cost, box, x, others, kappa, eps, budget, found):
    return prove_atlas(cost, box, x, others, down_from(kappa), eps, budget, no_rivals(len(x)), found)


def by_both(cost, box, x, others, kappa, eps, budget, found):
    verdict, boxes, bound, gap, _ = prove_globally(
        cost, box, x, others, down_from(kappa), eps, budget, no_rivals(len(x)), found
    )
    return verdict if gap == kappa else BUDGET, boxes, bound


def by_enclosure(cost, box, x, others, kappa, eps, budget, found):
    nowhere = np.full(len(x), np.nan)
    return prove_locally(cost, box, x, others, kappa, eps, budget, np.inf, nowhere, nowhere, False, found)


@pytest.mark.usefixtures("form")
def test_in_the_plane_verdicts_are_those_of_brute_force():
    """Four stations nearly in line, so that a mirror image competes: the global minimum is proven, no other is."""
    rng = np.random.default_rng(5)
    wrong = right = 0
    for _ in range(many(25, 4)):
        S = rng.uniform(-5e3, 5e3, (4, 2)) * [1.0, 0.1]
        x = outside(2, rng)
        kinds, data, K, w = differences(S, 30.0, x, rng)
        grid = 10 ** rng.uniform(3.0, 5.5, (150, 1)) * np.array([[1.0, 0.0]])
        turn = rng.uniform(-np.pi, np.pi, 150)
        starts = grid[:, :1] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        minima = minima_of(S, K, w, [x, x * [1.0, -1.0], *starts])
        if not minima:
            continue
        for cost, x in minima:
            found = np.full(2, np.nan)
            args = (x, beside([], 2), 0.0, 1e-6 * (1.0 + cost), 4000)
            verdict = by_atlas(cost_of(kinds, data, K, w), empty_box(*K.shape), *args, found)[0]
            if verdict == BETTER:
                assert ((K @ np.linalg.norm(found - S, axis=1) - w) ** 2).sum() < cost
                wrong += 1
            elif verdict == VALUE:
                assert cost < minima[0][0] + 1e-5
                right += 1
            else:
                assert verdict == UNBOUNDED
    assert not enabled() or (wrong > 10 and right > 15)


def flat_cell(count, seed):
    """Return problems with five stations in a flat box, emitters 10-30 km out, 30 m noise, and their minima."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(count):
        S = rng.uniform(-0.5, 0.5, (5, 3)) * [10e3, 10e3, 300.0]
        x = outside(3, rng)
        problem = differences(S, 30.0, x, rng)
        starts = [x, x * [1.0, 1.0, -1.0], *rng.normal(size=(6, 3)) * 20e3]
        minima = minima_of(S, *problem[2:], starts)
        if minima:
            out.append((problem, minima))
    return out


def shares(cell, kappa):
    """Return the shares of fixes that are proven with an enclosure, and everywhere."""
    counts = np.zeros(2)
    for problem, minima in cell:
        best, x = minima[0]
        others = [p for cost, p in minima[1:] if cost < best + kappa] if kappa else []
        for k, prover in enumerate((by_enclosure, by_both)):
            verdict, _ = proven(prover, *problem, x, others, kappa)
            # A better point is the failure of the solver here, not of the proof.
            counts[k] += verdict in (UNIQUE, VALUE, BETTER)
    return counts / len(cell)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize(("kappa", "least"), [(0.0, 0.95), pytest.param(9.0, 0.75, marks=pytest.mark.full)])
def test_flat_networks_are_proven_where_enclosures_fail(kappa, least):
    enclosure, everywhere = shares(flat_cell(many(25, 3), 6), kappa)
    assert everywhere >= enclosure
    if enabled():
        assert everywhere >= least
        assert kappa == 0.0 or everywhere > enclosure + 0.2


@pytest.mark.full
@pytest.mark.parametrize(("kappa", "least"), [(0.0, 0.97), (9.0, 0.8)])
def test_flat_networks_in_full(kappa, least):
    enclosure, everywhere = shares(flat_cell(300, 7), kappa)
    assert everywhere >= max(enclosure, least)


def wrong_claims(count, seed):
    """Offer the atlas mirrors of flat networks for fixes, and fixes without their mirrors; return claims and offers."""
    claims = offers = 0
    rng = np.random.default_rng(seed)
    for _ in range(count):
        S = rng.uniform(-5e3, 5e3, (5, 3)) * [1.0, 1.0, 0.01]
        x = np.array([*rng.uniform(-1e4, 1e4, 2), rng.uniform(3e3, 11e3)])
        kinds, data, K, w = differences(S, 7.0, x, rng)
        found = minima_of(S, K, w, [x, x * [1.0, 1.0, -1.0]])
        if len(found) < 2:
            continue
        (least, best), (more, mirror) = found[:2]
        cost, box = cost_of(kinds, data, K, w), empty_box(*K.shape)
        asked = [(mirror, 0.0), (mirror, 25.0)] if more > least + 1e-3 * (1.0 + least) else []
        asked += [(best, 25.0)] if more < least + 24.0 else []
        for place, kappa in asked:
            args = (place, beside([], 3), kappa, 1e-6 * (1.0 + more), 3000, np.zeros(3))
            verdict, _, _, gap, _ = by_atlas(cost, box, *args)
            claims += verdict in (UNIQUE, VALUE) and (place is mirror or gap == kappa)
            offers += 1
    return claims, offers


@pytest.mark.usefixtures("form")
def test_no_mirror_of_a_flat_network_is_proven(seed):
    claims, offers = wrong_claims(many(60, 2), 30 + seed)
    assert claims == 0
    assert offers > many(60, 0)


@pytest.mark.full
def test_no_mirror_of_a_flat_network_is_proven_in_full(seed):
    claims, offers = wrong_claims(300, 60 + seed)
    assert claims == 0
    assert offers > 300


def shown(problems, minima, gaps, budget):
    """Return what a budget shows of the least minimum of each problem, by the machine code of batches."""
    kinds, x, least = problems[0][0], np.array([m[0][1] for m in minima]), np.array([m[0][0] for m in minima])
    data, K, w = (np.stack(arrays) for arrays in list(zip(*problems, strict=True))[1:])
    (n, d), none = x.shape, np.zeros(len(x), dtype=np.int64)
    nowhere = np.full((n, 2, d), np.nan)
    asked = ProofRequest(
        x,
        np.zeros((n, 0, d)),
        none,
        none,
        np.tile(gaps, (n, 1)),
        1e-6 * (1.0 + least),
        nowhere,
        nowhere,
        np.full(n, budget),
        np.zeros((n, 0, 3)),
        np.zeros((n, 0)),
    )
    return prove_all(PositionCosts(kinds, data, K, w, np.full(n, np.inf)), asked)


def check_what_is_shown(problem, minima, answer, budget):
    """Check a claim against the minima known; return the gap, -1 for none."""
    (_, data, K, w), (least, best) = problem, minima[0]
    if answer.verdict not in (UNIQUE, VALUE):
        return -1.0
    rivals = answer.rivals[: answer.met]
    assert answer.boxes <= budget
    assert (answer.verdict == UNIQUE) == (answer.gap > 0.0)
    assert least - 2e-6 * (1.0 + least) <= answer.bound <= least
    for cost, x in minima[1:]:
        near = np.linalg.norm(rivals - x, axis=1) < 1e-3 * np.linalg.norm(x - best)
        assert cost > least + answer.gap or near.any()
    for x in rivals:  # each is a minimum, and there is none twice
        cost, again = minima_of(data[:, :3], K, w, [x])[0]
        assert np.linalg.norm(again - x) < 1e-3 * np.linalg.norm(x - best)
        assert least <= cost < least + 25.0
    assert all(np.linalg.norm(a - b) > 1.0 for i, a in enumerate(rivals) for b in rivals[:i])
    return float(answer.gap)


@pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
def test_a_budget_shows_as_much_as_it_can_and_goes_on_beside_rivals(seed):
    """Of every minimum that SciPy knows within the gap that is claimed the proof has told."""
    cell, budgets, met = flat_cell(40, 90 + seed), (120, 250, 600, 3000), 0
    gaps = np.empty((len(cell), len(budgets)))
    for k, budget in enumerate(budgets):
        answer = shown(*zip(*cell, strict=True), [25.0, 9.0, 0.0], budget)
        met += int(answer.met.sum())
        for i, (problem, minima) in enumerate(cell):
            gaps[i, k] = check_what_is_shown(problem, minima, answer.take(i), budget)
    assert (np.diff(gaps, axis=1) >= 0.0).all()  # more boxes never show less
    assert {-1.0, 0.0, 25.0} <= {*gaps.ravel()}
    assert met > 10


def cost_along(S, K, w, turn, v):
    """Return the costs at an inverse range of directions in the plane, also at infinity; nothing cancels."""
    way = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    beyond = v * (S**2).sum(1) - 2.0 * way @ S.T  # r - 1/v, times r v + 1
    phi = beyond / (1.0 + np.linalg.norm(way[..., None, :] - v * S, axis=-1))
    return ((phi @ K.T - w) ** 2).sum(-1)


def ends_of(S, K, w):
    """Return the costs at infinity of all directions in the plane from which the cost rises on all sides."""
    turn = np.linspace(-np.pi, np.pi, 721)
    cost, ends = cost_along(S, K, w, turn, 0.0), []
    for k in np.flatnonzero((cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:])) + 1:
        least = [
            minimize_scalar(
                lambda t, v=v: cost_along(S, K, w, t, v), bounds=turn[[k - 1, k + 1]], method="bounded", options=FINE
            ).fun
            for v in (0.0, 1e-7)
        ]
        ends += [least[0]] if least[1] > least[0] else []
    return np.array(ends)


@pytest.mark.skipif(not enabled(), reason="plain Python takes a thousand times longer for a box")
def test_no_way_to_infinity_ends_within_the_gap_that_is_proven(seed):
    rng, fallen = np.random.default_rng([seed, 3]), 0
    for _ in range(20):
        problems, minima, S = [], [], rng.uniform(-5e3, 5e3, (100, 4, 2))
        for place in S:
            x = outside(2, rng)
            problems.append(differences(place, 10.0 ** rng.uniform(1.8, 2.8), x, rng))
            starts = [x, *(2.0 * x * rng.standard_normal((4, 2)))]
            minima.append(minima_of(place, *problems[-1][2:], starts) or [(np.inf, x)])
        answer = shown(problems, minima, [25.0, 9.0, 6.0, 0.0], 1000)
        for i in np.flatnonzero(answer.verdict == UNIQUE):
            ends = ends_of(S[i], *problems[i][2:]) - minima[i][0][0]
            assert not (ends < answer.gap[i] - 1e-3).any()
            fallen += answer.gap[i] < 25.0 and answer.boxes[i] < 1000 and ends.min(initial=25.0) < 25.0
        if fallen > 1:
            break
    assert fallen > 1


@pytest.mark.usefixtures("form")
def test_a_cost_that_falls_to_infinity_is_no_proof():
    """Wave fronts that bend away from their source: the cost falls towards infinity, whatever point is offered."""
    S = np.array([[-1e3, 0.0], [0.0, 200.0], [1e3, 0.0], [0.0, -200.0]])
    rng = np.random.default_rng(8)
    kinds, data, K, w = differences(S, 1.0, np.array([0.0, 1e9]), rng)
    w = w + 0.5 * K @ np.array([-200.0, 0.0, -200.0, 0.0]) / 100.0
    x = least_squares(lambda p: K @ np.linalg.norm(p - S, axis=1) - w, [0.0, 1e5]).x
    args = (x, beside([], 2), 9.0, 1e-6, 4000, np.zeros(2))
    verdict = by_atlas(cost_of(kinds, data, K, w), empty_box(*K.shape), *args)[0]
    assert verdict not in (UNIQUE, VALUE)


@pytest.mark.usefixtures("form")
def test_costs_that_grow_without_end_are_not_for_the_atlas():
    kinds, data, K, _ = differences(np.eye(3), 1.0, np.ones(3), np.random.default_rng(9))
    assert reaches_infinity(kinds, K)
    assert not reaches_infinity(kinds, np.eye(3))
    for kind in (LINEAR, HEIGHT):
        assert not reaches_infinity(np.array([RANGE, RANGE, kind]), K)
    assert reaches_infinity(np.array([AZIMUTH, ELEVATION, RATIO]), np.eye(3))
    data, K = np.concatenate([data, np.zeros((1, WIDTH))]), np.pad(K, ((0, 0), (0, 1)))
    cost, box = cost_of(np.append(kinds, LINEAR), data, K, np.zeros(2)), empty_box(*K.shape)
    x = np.array([3.0, 4.0, 5.0])
    verdict = by_both(cost, box, x, beside([]), 0.0, 1e-6, 10, np.zeros(3))[0]
    assert verdict not in (UNIQUE, VALUE)


@pytest.mark.usefixtures("form")
def test_the_box_around_a_minimum_is_convex_in_every_sample():
    """Hessians in the coordinates of the atlas, by central differences of the cost itself."""
    rng = np.random.default_rng(10)
    for problem, minima in flat_cell(many(8, 2), 11):
        _, data, K, w = problem
        middle, radius = station_cube(*problem[:2], minima[0][1])
        atlas, cost, box = atlas_of(middle, radius, 3, 1), cost_of(*problem), empty_box(*K.shape)
        assert set_minimum(cost, box, atlas, 0, minima[0][1], 0.0, 1e-6, np.inf)
        for s in rng.uniform(-1.0, 1.0, (50, 3)) * atlas.minima.sides[0]:
            assert np.linalg.eigvalsh(hessian_at(atlas, data, K, w, s))[0] > -1e-3


def positions(atlas, u):
    """Return the positions of coordinates u (n, 3) of the home of the minimum, by the definition."""
    home = int(atlas.minima.home[0])
    if home == 6:
        return atlas.middle + atlas.radius * u
    p = np.insert(u[:, :2], home // 2, 1.0 if home % 2 else -1.0, axis=1)
    return atlas.middle + atlas.radius * p / u[:, 2:]


def hessian_at(atlas, data, K, w, s):
    step, signs = 1e-3 * np.eye(3), np.array([1.0, -1.0, -1.0, 1.0])
    out = np.zeros((3, 3))
    for k in range(3):
        for m in range(3):
            corners = s + np.array([step[k] + step[m], step[k] - step[m], step[m] - step[k], -step[k] - step[m]])
            u = atlas.minima.start[0] + corners @ atlas.minima.axes[0].T
            x = positions(atlas, u)
            f = ((np.linalg.norm(x[:, None] - data[:, :3], axis=-1) @ K.T - w) ** 2).sum(-1)
            out[k, m] = f @ signs / 4e-6
    return out


# Regular sets of stations: the fix lies at the middle of the stations, where the distance to the middle has a kink.
def corners(count):
    turn = 2.0 * np.pi * np.arange(count) / count
    return 1e3 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


REGULAR = {f"{count} corners": corners(count) for count in range(3, 13)}
REGULAR["cube"] = 1e3 * np.array(list(product((-1.0, 1.0), repeat=3)))
REGULAR["octahedron"] = 1e3 * np.concatenate([np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("kind", ["range", "tdoa", "toa"])
@pytest.mark.parametrize("name", REGULAR)
def test_the_middle_of_a_regular_set_of_stations_is_proven(name, kind):
    place = REGULAR[name]
    n, d = place.shape
    for away, noise in ((0.0, 0.0), (0.0, 1.0), (1e-3, 1.0), (1.0, 0.0), (90.0, 1.0), (110.0, 1.0)):
        rng = np.random.default_rng(1)
        ranges = np.linalg.norm(place - away, axis=1) + noise * rng.standard_normal(n)
        if kind == "tdoa":
            z, a, b = ranges[1:] - ranges[0], np.arange(1, n), np.zeros(n - 1, dtype=int)
            rows = measured("tdoa", z, a=a, b=b, arrival_sigma=1.0)
        else:
            rows = measured(kind, ranges + 123.0 * (kind == "toa"), a=np.arange(n), sigma=1.0)
        fix = solve(assemble(place, rows))
        assert fix.status == Status.OK
        assert np.linalg.norm(fix.position - np.full(d, away)) < 6.0
