"""What a proof covers, and the sentence that names what it does not."""

import numpy as np
import pytest

import optloc
from optloc import Motion, assemble, constraints, measured, with_bias
from optloc.proof.scope import MOST_FACTORS, held_height, is_run, is_scaled, why_too_large, why_unsupported

STATIONS = np.array([[0.0, 0.0], [1e3, 0.0], [0.0, 1e3], [1e3, 1e3]])
SPACE = np.column_stack([STATIONS, [0.0, 200.0, 100.0, 50.0]])


def ranging(stations=STATIONS, epochs=1, **more):
    a = np.tile(np.arange(4), epochs)
    rows = measured("range", np.full(len(a), 700.0), a=a, sigma=1.0, epoch=np.repeat(np.arange(epochs), 4))
    return assemble(stations, rows, **({"times": np.arange(float(epochs))} if epochs > 1 else {}), **more).flat()


def accelerating():
    return ranging(epochs=3, motions=(Motion(2),))


def in_space():
    return ranging(SPACE, epochs=3, motions=(Motion(1),))


def with_scales():
    return with_bias(ranging(), "scale", form="scale", per="station", sigma=0.1)


def two_targets(*motions):
    rows = measured("range", np.full(8, 700.0), a=np.tile(np.arange(4), 2), sigma=1.0, target=np.repeat([0, 1], 4))
    return assemble(STATIONS, rows, motions=motions).flat()


def beacon_and_emitter():
    return two_targets(Motion(known=np.array([[[500.0, 400.0]]])), Motion())


def two_emitters():
    return two_targets(Motion(), Motion())


def two_planes():
    fixed = constraints.box([10.0, 20.0], [10.0, 20.0])
    return ranging(constraints=fixed)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (ranging, ""),
        (accelerating, "the target accelerates"),
        (in_space, "the target moves in space"),
        (with_scales, f"there are several scales (4), but the proof covers {MOST_FACTORS}"),
        (two_planes, "the equalities leave no free direction"),
        (two_emitters, "there are 2 targets, but the proof covers one"),
        (beacon_and_emitter, "rows of a target with a known position share biases"),
    ],
)
def test_what_is_beyond_the_proof_is_named(make, words):
    assert why_unsupported(make()).startswith(words)
    assert bool(why_unsupported(make())) == bool(words)


def test_a_run_is_long_only_with_many_different_ranges():
    # stations that stay have four ranges, however many epochs there are
    assert not is_run(ranging(epochs=50))
    moving = STATIONS + np.arange(50.0)[:, None, None]
    assert is_run(ranging(moving, epochs=50))
    assert why_too_large(ranging(moving, epochs=50)).startswith("there are 200 different ranges")
    assert why_too_large(ranging()) == ""


def test_an_unknown_factor_makes_a_problem_scaled():
    problem = with_bias(ranging(), "speed", form="scale", per="kind", sigma=0.1)
    assert is_scaled(problem)
    assert why_too_large(problem) == "a factor of the rows is unknown"
    assert not is_scaled(with_bias(ranging(), "late", form="offset", per="kind", sigma=1.0))


def test_a_height_is_held_by_a_course_over_ground_alone():
    frame = optloc.Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0)
    level = constraints.height(500.0, 500.0)
    over = ranging(SPACE, 3, frame=frame, motions=(Motion(1, over="ground"),), constraints=level)
    assert held_height(over) is over.constraints[0]
    assert held_height(in_space()) is None
