"""Emitters that move, from frequencies of one epoch alone: found from nothing, as from the truth."""

from __future__ import annotations

import numpy as np
import pytest

from optloc import Motion, Problem, Stations, assemble, measured, solve
from optloc.solvers.starts.moving import _apart, moves_at_once, problem_at_rest

Array = np.ndarray
SEED = 20261123
# Kind, dimension and receivers: one or two rows more than a position and a velocity have unknowns.
SCENES = {
    "frequency differences in the plane": ("fdoa", 2, 7),
    "frequencies in the plane": ("range_rate", 2, 6),
    "frequency differences in space": ("fdoa", 3, 9),
}


def scene(kind: str, d: int, s: int, rng: np.random.Generator) -> tuple[Problem, Array]:
    """Return rates of moving receivers to 0.3 m/s, and position and velocity of the emitter."""
    place, speed = rng.uniform(-2e4, 2e4, (s, d)), rng.normal(0.0, 150.0, (s, d))
    truth = np.concatenate([rng.uniform(-4e4, 4e4, d), rng.normal(0.0, 100.0, d)])
    line = truth[:d] - place
    rate = ((truth[d:] - speed) * line).sum(1) / np.linalg.norm(line, axis=1) + rng.normal(0.0, 0.3, s)
    told = measured("range_rate", rate, a=np.arange(s), sigma=0.3)
    if kind == "fdoa":
        told = measured("fdoa", rate[1:] - rate[0], a=np.arange(1, s), b=0, arrival_sigma=0.3)
    stations = Stations(place[None], tuple("ABCDEFGHI"[:s]), velocity=speed[None])
    return assemble(stations, told, motions=(Motion(order=1),)), truth


def misses(name: str, trials: int, seed: int) -> list[str]:
    """Return the trials whose fix from nothing costs more than the one that is refined from the truth."""
    rng, out = np.random.default_rng([SEED, seed, *name.encode()]), []
    for trial in range(trials):
        problem, truth = scene(*SCENES[name], rng)
        fix, best = solve(problem), solve(problem, "lsr", start=truth)
        if not fix.cost <= best.cost * (1.0 + 1e-6) + 1e-6:
            out.append(f"trial {trial}: {fix.status.label}, cost {fix.cost}, from the truth {best.cost}")
    return out


@pytest.mark.parametrize("name", SCENES)
def test_moving_emitters_are_found_from_nothing(name, seed):
    assert not misses(name, 1, seed)


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_moving_emitters_are_found_from_nothing_in_full(name, seed):
    found = misses(name, 200, seed)
    assert len(found) <= 2, found


def test_only_a_target_of_unknown_velocity_at_one_epoch_moves_at_once():
    rows = measured("range_rate", np.zeros(6), a=np.arange(6), sigma=0.1)
    stations = Stations(np.zeros((1, 6, 2)) + np.arange(6.0)[:, None], tuple("ABCDEF"), velocity=np.ones((1, 6, 2)))
    moving = assemble(stations, rows, motions=(Motion(1),)).flat()
    assert moves_at_once(moving)
    assert problem_at_rest(moving).motions[0].order == 0
    assert not moves_at_once(assemble(stations, rows, motions=(Motion(0),)).flat())


def test_of_places_that_are_near_each_other_the_cheapest_is_kept():
    met = [(3.0, (100.0, 0.0)), (1.0, (101.0, 0.0)), (2.0, (0.0, 100.0))]
    np.testing.assert_array_equal(_apart(met, np.zeros(2)), [[101.0, 0.0], [0.0, 100.0]])
