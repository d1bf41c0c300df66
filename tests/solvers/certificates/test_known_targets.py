"""Proofs with a beacon: the lone problem has the cost of the whole one, and no search beats a proven fix."""

from dataclasses import replace

import numpy as np
import pytest
from often import few
from scipy.optimize import minimize

import optloc
from optloc.base.types import Motion
from optloc.linear.normal import prior_parts
from optloc.proof.scope import why_unsupported
from optloc.solvers.certificates.known_targets import has_known_target, lone_problem

SIGMA = 3.0


class Scene:
    """A beacon, an emitter and stations with late clocks; the cost is written with numpy alone."""

    def __init__(self, seed, kind="tdoa", *, prior=None, every=True):
        rng = np.random.default_rng(seed)
        s = int(rng.integers(5, 7))
        self.kind, self.stations = kind, rng.uniform(-5e3, 5e3, (s, 2))
        self.beacon, self.truth = rng.uniform(-4e3, 4e3, 2), rng.uniform(-9e3, 9e3, 2)
        self.late = np.arange(s) > 0 if every else np.isin(np.arange(s), [1, 2])
        clock = rng.normal(0.0, 200.0, s) * self.late
        way = [np.linalg.norm(place - self.stations, axis=1) + clock for place in (self.beacon, self.truth)]
        way = [each + rng.normal(0.0, 1e3) * (kind == "toa") for each in way]
        way = [each[1:] - each[0] if kind == "tdoa" else each for each in way]
        self.z = np.concatenate(way) + rng.normal(0.0, SIGMA, 2 * len(way[0]))
        self.prior = prior
        m = len(way[0])
        ends = {"a": np.tile(np.arange(s)[-m:], 2), **({"b": 0} if kind == "tdoa" else {})}
        rows = optloc.measured(
            kind, self.z, **ends, sigma=SIGMA, target=np.repeat([0, 1], m), epoch=np.repeat([0, 1], m)
        )
        names = [f"R{i}" for i in range(s)]
        motions = (Motion(known=self.beacon[None, None]), Motion())
        made = optloc.assemble(optloc.station_array(self.stations, names), rows, motions=motions)
        members = [name for name, late in zip(names, self.late, strict=True) if late]
        self.problem = optloc.with_bias(made, "clock", members=members, **({} if prior is None else {"sigma": prior}))

    def cost(self, position):
        """Return the least chi-square at a position (2,) over clocks and emission times, by linear least squares."""
        s, m = len(self.stations), len(self.z) // 2
        places = (self.beacon, np.asarray(position))
        way = [np.linalg.norm(place - self.stations, axis=1) for place in places]
        way = [each[1:] - each[0] if self.kind == "tdoa" else each for each in way]
        clocks = np.eye(s)[s - m :, self.late]
        columns = [np.tile(clocks, (2, 1))]
        if self.kind == "toa":
            columns.append(np.repeat(np.eye(2), m, axis=0))
        A, y = np.concatenate(columns, axis=1) / SIGMA, (self.z - np.concatenate(way)) / SIGMA
        if self.prior is not None:
            A = np.concatenate([A, np.eye(A.shape[1])[: self.late.sum()] / self.prior])
            y = np.concatenate([y, np.zeros(self.late.sum())])
        return float(((y - A @ np.linalg.lstsq(A, y, rcond=None)[0]) ** 2).sum())

    def minima(self):
        """Return the minima (q, 2) that descents from a grid of starts reach, and their costs (q,)."""
        grid = np.stack(np.meshgrid(*[np.linspace(-12e3, 12e3, 5)] * 2), axis=-1).reshape(-1, 2)
        found = [
            minimize(self.cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6}) for start in grid
        ]
        return np.array([each.x for each in found]), np.array([each.fun for each in found])


CASES = [
    ("tdoa", None, True),
    ("tdoa", 300.0, False),
    ("toa", None, True),
    ("toa", 150.0, True),
    ("range", 500.0, True),
]


@pytest.mark.parametrize(("kind", "prior", "every"), CASES)
def test_the_lone_problem_has_the_cost_of_the_whole_problem(kind, prior, every):
    scene = Scene(3, kind, prior=prior, every=every)
    whole, fix = scene.problem.flat(), optloc.solve(scene.problem)
    lone = lone_problem(whole, fix.x)
    assert len(lone.problem.motions) == 1
    assert why_unsupported(lone.problem) == ""
    found = optloc.solve(lone.problem, start=lone.alone(fix.x)[None])
    assert float(found.cost[0]) + lone.constant == pytest.approx(scene.cost(fix.take("position[1]")), abs=1e-6)
    np.testing.assert_allclose(lone.together(lone.alone(fix.x), fix.x), fix.x, rtol=1e-9, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("first", few(range(0, 100, 20), 1))
@pytest.mark.parametrize(("kind", "prior", "every"), CASES[:4])
def test_no_search_beats_a_proven_fix(kind, prior, every, first):
    proven = 0
    for seed in range(first // 4, first // 4 + 5):
        scene = Scene(100 + seed, kind, prior=prior, every=every)
        fix = optloc.solve(scene.problem)
        if fix.certificate.proof != "global":
            continue
        proven += 1
        place, cost = scene.minima()
        best = float(fix.cost)
        assert cost.min() >= best - 1e-4 * (1.0 + best), seed
        listed = [fix.take("position[1]"), *fix.layout.take(fix.alternatives.x, "position[1]")]
        near = np.min([np.linalg.norm(place - one, axis=1) for one in listed if np.isfinite(one).all()], axis=0) < 1.0
        assert (near | (cost > best + fix.certificate.margin - 1e-3)).all(), seed
    assert proven


def test_a_proven_fix_of_a_beacon_and_an_emitter_is_ok():
    scene = Scene(1)
    fix = optloc.solve(scene.problem)
    assert (fix.status, fix.certificate.proof) == (optloc.Status.OK, "global")
    assert fix.certificate.bound == pytest.approx(float(fix.cost), abs=0.1)
    assert "with known targets as a prior" in fix.stages[-1].detail


def test_a_batch_has_a_proof_for_each_problem():
    scene = Scene(1)
    noise = np.random.default_rng(0).normal(0.0, SIGMA, (3, len(scene.z)))
    fixes = optloc.solve(scene.problem.with_rows(z=scene.z + noise))
    assert [one.certificate.proof for one in fixes] == ["global"] * 3


def test_rows_beyond_the_map_have_no_lone_problem():
    scene = Scene(1)
    assert has_known_target(scene.problem.flat())
    assert not has_known_target(replace(scene.problem, motions=(scene.problem.motions[0],) * 2).flat())
    scaled = optloc.with_bias(scene.problem, "speed", form="scale", per="kind", sigma=0.1)
    assert not has_known_target(scaled.flat())
    assert {name for name, _, _ in prior_parts(scaled)} == {"speed"}
