"""Bounds of runs over a box, against the cost itself at points of the box; and what is claimed of runs."""

from __future__ import annotations

import numpy as np
import pytest
from often import few
from proof.doppler import scenes_of
from proof.layouts import SEED
from proof.sampling import many

from optloc import Frame, Stations, assemble, measured, with_bias
from optloc.kernels.jit import enabled
from optloc.proof.atlas import atlas_of, set_centre
from optloc.proof.batch import costs_at
from optloc.proof.box import station_cube
from optloc.proof.curvature import C00, symmetric_entry
from optloc.proof.position_costs import position_costs
from optloc.proof.runs.prove import costs_of_runs
from optloc.proof.runs.rows import least_length, residual_at, rounding_of_residual
from optloc.proof.runs.run_costs import run_costs
from optloc.proof.runs.search import sum_at, tables_of
from optloc.proof.search_space import chart_on
from optloc.proof.space import Space, floor_of, set_curves, set_nodes
from optloc.proof.surface import SLIP
from optloc.solvers.certificates.position_cost import surfaces_of

Array = np.ndarray
pytestmark = pytest.mark.skipif(not enabled(), reason="runs are proven by machine code")


# Kinds, dimension, and whether clocks have priors: what stays finite at infinity, what does not, and along a height.
MIXTURES = {
    "tdoa in space": (("tdoa",), 3, False),
    "tdoa, rates and angles in space": (("tdoa", "range_rate", "azimuth", "elevation"), 3, True),
    "frequency differences in the plane": (("fdoa",), 2, False),
    "ranges and bearings in the plane": (("range", "azimuth"), 2, True),
}
NOTHING = np.empty((0, 3)), np.empty(0)


def mixture(rng: np.random.Generator, kinds: tuple[str, ...], d: int, prior: bool, epochs: int = 12):
    """Return a run of three moving stations, each with a clock of its own, some rows absent."""
    start, speed, times = rng.uniform(-1e4, 1e4, (3, d)), rng.normal(0.0, 100.0, (3, d)), 10.0 * np.arange(epochs)
    place, told = start + times[:, None, None] * speed, []
    size = {"tdoa": 1e3, "fdoa": 30.0, "range": 1e4, "range_rate": 30.0, "azimuth": 1.0, "elevation": 0.3}
    for kind in kinds:
        two = kind in ("tdoa", "fdoa")
        a, b = np.tile([1, 2] if two else [0, 1, 2], epochs), np.zeros(epochs * (2 if two else 3), dtype=int)
        noise = {"arrival_sigma": 0.01 * size[kind]} if two else {"sigma": 0.01 * size[kind]}
        told.append(
            measured(
                kind,
                rng.uniform(0.1, 1.0, len(a)) * size[kind],
                a=a,
                b=b if two else None,
                epoch=np.repeat(np.arange(epochs), len(a) // epochs),
                weight=(rng.uniform(size=len(a)) > 0.1) * 1.0,
                **noise,
            )
        )
    stations = Stations(place, ("A", "B", "C"), velocity=np.broadcast_to(speed, place.shape))
    made = assemble(stations, *told, frame=Frame("cartesian"), times=times)
    return with_bias(made, "late", kind=kinds[0], members=["B", "C"], sigma=20.0 if prior else None)


def runs_of(rng: np.random.Generator):
    """Yield runs of all mixtures, and of passes over a known height, with a place each."""
    for kinds, d, prior in MIXTURES.values():
        problem = mixture(rng, kinds, d, prior).flat()
        yield problem, rng.uniform(-3e4, 3e4, d)
    scenes = scenes_of("passes of nine satellites", 1, 0)
    yield scenes.problem.flat(), scenes.truth[0]


def spaces(problem, run, x: Array):
    """Yield where boxes of a run lie, with functions that draw a box there and return its half-widths."""
    tables, (planes, surface) = tables_of(run), surfaces_of(problem, x[None])
    chart, _ = chart_on(run.look, x, tables.small, planes[0], surface[0])
    middle, radius = station_cube(run.cost.kinds, run.cost.data, x)
    atlas, none = atlas_of(middle, radius, len(x), 0), np.empty((0, 3))
    yield Space(False, atlas, chart, none, none), tables
    if not len(surface[0]) and not {"range"} & {rows.kind for rows in problem.rows}:
        yield Space(True, atlas, chart, none, none), tables


def put(space: Space, tables, rng: np.random.Generator, d: int) -> tuple[Array, Array, int]:
    """Draw a box, and return its centre, half-widths and piece."""
    at, half = np.zeros(3), np.zeros(3)
    if space.far:
        piece = int(rng.integers(2 * d + 1))
        at[:d], half[:d] = rng.uniform(-0.9, 0.9, d), 10.0 ** rng.uniform(-4.0, -0.5, d)
        if piece < 2 * d:
            at[d - 1] = rng.uniform(0.0, 1.0)
            half[d - 1] = min(half[d - 1], at[d - 1])
        return at, half, piece
    free = 2 if d == 2 or len(space.chart.surface) else 3
    length = np.linalg.norm(space.chart.sense[:, :free], axis=0)
    at[:free] = rng.uniform(-3e4, 3e4, free) / length
    half[:free] = 10.0 ** rng.uniform(0.0, 4.3, free) / length
    return at, half, 0


def place(space: Space, tables, cost, at: Array, half: Array, piece: int) -> bool:
    """Bound the nodes of a box; return whether it can be."""
    tables.box.at[:], tables.box.half[:] = at, half
    if space.far:
        set_centre(space.atlas, piece, at)
    return bool(set_nodes(space, cost, tables.box))


def test_a_run_costs_what_its_dense_rows_cost():
    rng = np.random.default_rng(SEED)
    for problem, x in runs_of(rng):
        places = (x + rng.normal(0.0, 1e3, (5, len(x))))[None]
        own, blur = costs_of_runs(run_costs(problem), places)
        np.testing.assert_allclose(own, costs_at(position_costs(problem), places)[0], rtol=1e-9)
        assert (blur < 1e-6 * (1.0 + np.sqrt(own))).all()


def test_rows_have_weights_of_their_own():
    rng = np.random.default_rng(SEED + 2)
    problem = mixture(rng, ("tdoa",), 3, prior=True)
    weight = rng.uniform(0.2, 1.0, problem.count) * (np.arange(problem.count) > 0)  # the first row is absent
    problem = problem.with_rows(weight=weight).flat()
    x = rng.uniform(-3e4, 3e4, (1, 1, 3))
    assert np.isclose(costs_of_runs(run_costs(problem), x)[0], costs_at(position_costs(problem), x)[0], rtol=1e-9).all()


def test_few_rows_cost_nowhere_more_than_all():
    rng = np.random.default_rng(SEED + 1)
    for problem, x in runs_of(rng):
        run = run_costs(problem).runs[0]
        look = run.look
        for _ in range(20):
            at = x + rng.normal(0.0, 10.0 ** rng.uniform(1.0, 5.0), len(x))
            costs = position_costs(problem)._replace(
                kinds=look.kinds, data=look.data[None], K=look.K[None], w=look.w[None]
            )
            all_rows = costs_of_runs(run_costs(problem), at[None, None])[0][0, 0]
            assert costs_at(costs, at[None, None])[0][0, 0] <= all_rows * (1.0 + 1e-9)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("count", few([20, 60], 1))
def test_no_point_of_a_box_costs_less_than_its_bound(seed, count):
    rng, good = np.random.default_rng([SEED, seed, 2]), 0
    for problem, x in runs_of(rng):
        run = run_costs(problem).runs[0]
        for space, tables in spaces(problem, run, x):
            floor, box, sheet = floor_of(space, run.cost), tables.box, tables.sheet
            for _ in range(many(count, 4)):
                at, half, piece = put(space, tables, rng, len(x))
                if not place(space, tables, run.cost, at, half, piece):
                    continue
                here, noise, slip = (
                    residual_at(run.rows, box.nodes, sheet),
                    rounding_of_residual(run.rows, floor, box.nodes),
                    0.0,
                )
                if len(space.chart.surface):
                    slip = box.graph[SLIP]
                lows = [least_length(box.half, box.nodes, box.curves, box.lean, slip, sheet, here, False)]
                set_curves(space, run.cost, box)
                lows += [least_length(box.half, box.nodes, box.curves, box.lean, slip, sheet, here, True)]
                good += max(lows) > 0.0
                for _ in range(12):
                    inside = at + half * rng.choice([rng.uniform(-1.0, 1.0, 3), rng.choice([-1.0, 1.0], 3)])
                    if place(space, tables, run.cost, inside, np.zeros(3), piece):
                        cost = residual_at(run.rows, box.nodes, sheet)
                        assert np.sqrt(cost) >= max(lows) - noise, (problem.rows[0].kind, space.far, half)
    assert good > many(100 * count // 60, 8)


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("count", few([15, 40], 1))
def test_no_point_of_a_box_has_a_hessian_beyond_its_bounds(seed, count):
    rng, good = np.random.default_rng([SEED, seed, 3]), 0
    for problem, x in runs_of(rng):
        run = run_costs(problem).runs[0]
        for space, tables in spaces(problem, run, x):
            floor, free = floor_of(space, run.cost), 2 if len(space.chart.surface) else len(x)

            def hessian_at(at: Array, half: Array, piece: int, space=space, tables=tables, floor=floor, run=run):
                tables.box.at[:], tables.box.half[:] = at, half
                if space.far:
                    set_centre(space.atlas, piece, at)
                _, ball = sum_at(run, space, tables, floor)
                sums = tables.box.sums.copy()
                whole = np.array([[sums[symmetric_entry(k, m)] for m in range(3)] for k in range(3)])
                return whole, np.array([[sums[C00 + symmetric_entry(k, m)] for m in range(3)] for k in range(3)]), ball

            for _ in range(many(count, 2)):
                at, half, piece = put(space, tables, rng, len(x))
                centre, change, ball = hessian_at(at, half, piece)
                if not ball < np.inf:
                    continue
                good += 1
                for _ in range(8):
                    inside = at + half * rng.choice([rng.uniform(-1.0, 1.0, 3), rng.choice([-1.0, 1.0], 3)])
                    there, _, known = hessian_at(inside, np.zeros(3), piece)
                    if known < np.inf:
                        moved = (there - centre)[:free, :free]
                        beyond = np.maximum(np.abs(moved) - change[:free, :free], 0.0)
                        assert np.linalg.norm(beyond, 2) <= ball * (1.0 + 1e-6) + 1e-9 * np.abs(centre).max()
    assert good > many(100 * count // 40, 8)
