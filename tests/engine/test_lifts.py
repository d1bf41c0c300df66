"""Linear rows as tapes: the coefficients that arrays have, kind by kind, and starts that lead to the same minimum."""

import numpy as np
import pytest

from optloc import assemble, measured, simulate
from optloc.engine import lifts
from optloc.engine.lifts import lift
from optloc.engine.plan import plan_of
from optloc.kernels import jit
from optloc.kernels.tape_table import INPUT, OUTPUT, run_tape
from optloc.kernels.trace import evaluate
from optloc.linear.least_squares_ranges import ranges
from optloc.models.primitives import Point
from optloc.solvers.starts.squared_range import Coordinates, lift_rows

STATIONS = np.array([[0.0, 0, 0], [10e3, 0, 600], [0, 10e3, 300], [10e3, 10e3, 0], [5e3, 5e3, 900], [2e3, 7e3, 100]])
TRUTH = np.array([3e3, 4e3, 2e3])
ALL, OTHERS = np.arange(6), np.arange(1, 6)
ROWS = {
    "groa": (measured("groa", a=OTHERS, b=0, sigma=0.002),),
    "rss_difference": (measured("rss_difference", a=OTHERS, b=0, sigma=0.1),),
    "angles": tuple(measured(kind, a=ALL, sigma=0.005) for kind in ("azimuth", "elevation")),
    "tdoa + azimuth": (measured("tdoa", a=OTHERS, b=0, sigma=5.0), measured("azimuth", a=[1, 2], sigma=0.01)),
    "tdoa + elevation": (measured("tdoa", a=OTHERS, b=0, sigma=5.0), measured("elevation", a=[1, 2], sigma=0.01)),
    "range + groa": (measured("range", a=ALL, sigma=5.0), measured("groa", a=OTHERS, b=0, sigma=0.01)),
}


def entries(found, row, inputs):
    """Return the outputs of the tape of a row for numbers by sort of input."""
    block, table = int(np.searchsorted(found.first, row, side="right")) - 1, found.tapes.table
    registers = np.zeros((found.tapes.registers, 1))
    for (to, *_), (what, which) in zip(table[slice(*table[block : block + 2, INPUT])], found.source[row], strict=False):
        registers[to] = found.number[which] if what == lifts.NUMBER else inputs[what][which]
    with jit.plain():
        run_tape(found.tapes, block, registers, 1)
    return registers[table[slice(*table[block : block + 2, OUTPUT]), 0], 0]


@pytest.mark.parametrize("name", ROWS)
def test_tapes_have_the_coefficients_of_arrays(name):
    problem = simulate(assemble(STATIONS, *ROWS[name]), TRUTH, 1).flat()
    found = ranges(problem)
    on_cone = found is not None and bool(found.free.any())
    node = {(i, 0): i for i in range(6)}
    origin = STATIONS[found.reference[0]] if on_cone else STATIONS.mean(0)
    to = Coordinates(origin[None], np.array([9e3]), on_cone)
    made = lift(problem.take(np.zeros(1, dtype=int)).with_rows(z=problem.z), found, node, on_cone)
    y = np.append((TRUTH - origin) / 9e3, 0.0)
    offset = np.zeros(6)
    if found is not None:
        offset[found.station] = found.offset[0] / 9e3
    inputs = {
        lifts.SEEN: problem.observed[0],
        lifts.STATION: ((STATIONS - origin) / 9e3).ravel(),
        lifts.OFFSET: offset,
        lifts.POINT: y,
    }
    at, seen = 0, 0
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        lifted = lift_rows(problem, rows, start, found, to)
        if lifted is None:
            continue
        factor = np.broadcast_to(lifted.factor(y[None, :3]), (1, rows.count))
        for i in range(rows.count):
            own = entries(made, at, inputs)
            np.testing.assert_allclose(own[:4], lifted.row[0, i], rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(own[4], lifted.right[0, i], rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(abs(own[5]), abs(factor[0, i]), rtol=1e-12)
            at, seen = at + 1, seen + 1
    assert at == len(made.sigma) == seen > 0


def test_elevations_alone_are_not_linear():
    problem = assemble(STATIONS, measured("elevation", a=ALL, sigma=0.01))
    assert not len(lift(problem, None, {(i, 0): i for i in range(6)}, on_cone=False).sigma)
    assert plan_of(problem) is None


def test_a_row_is_written_once():
    """The same function for numbers and for tapes: a point of both."""
    from optloc.models import MODELS

    a, b = Point((0.1, 0.2, 0.3)), Point((-0.4, 0.5, 0.0))
    entry = lifts.enter(MODELS["groa"], 1.3, a, b, None)
    made = lifts._tape_of(MODELS["groa"], 3, False, False, False)
    numbers = {lifts._M: 1.3} | {lifts._A + i: v for i, v in enumerate(a.position)}
    numbers |= {lifts._B + i: v for i, v in enumerate(b.position)} | {lifts._T + i: 0.7 for i in range(3)}
    out = evaluate(made, {seed: numbers[seed] for seed, _ in made.inputs})
    np.testing.assert_allclose(out, [*entry.x, entry.last, entry.right, entry.factor(Point((0.7,) * 3))], rtol=1e-14)
