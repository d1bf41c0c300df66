"""A block of one problem, whose steps run as plain Python: for tests of single steps of the engine."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from optloc.engine import fixes, plan, ranges
from optloc.engine.admission import admission_of, levels_of
from optloc.engine.draw import draw_ranges, draw_tapes
from optloc.engine.evaluator import count_lifted, count_unknowns, evaluated_by, keep
from optloc.engine.memory import COST, ORIGIN, G, H, X, make_room
from optloc.linear.redundancy import degrees_of_freedom


@dataclass(frozen=True)
class Block:
    """A problem in the memory of one lane."""

    module: ModuleType
    model: Any
    rows: Any
    room: Any

    def form(self, kernel):
        """Return the form of a kernel for one lane that the kernels of whole fixes call, so that no other is made."""
        mark = "one_by_ranges" if self.module is ranges else "one_by_tapes"
        return evaluated_by(kernel, self.module, mark, **fixes._ONE)

    def run(self, kernel, *arguments):
        return self.form(kernel)(*arguments)

    def put(self, x, row=X):
        """Write unknowns (p,) to a row of vectors, positions from the origin."""
        self.room.vector[row, :, 0] = x - self.room.vector[ORIGIN, :, 0]

    def at(self, row=X):
        return self.room.vector[row, :, 0] + self.room.vector[ORIGIN, :, 0]

    def equations(self, shift=0):
        """Return information, right side and cost that were written for row X or the trial."""
        lower = np.tril(self.room.matrix[H + shift, :, :, 0])
        whole = lower + np.tril(lower, -1).T
        return whole, self.room.vector[G + shift, :, 0], self.room.scalar[COST + shift, 0]


def block_of(problem, module):
    """Return a single problem with its measurements and stations in a block, for the evaluator of a module."""
    one = plan._without_measurements(problem)
    admission = admission_of(one)
    dof = int(degrees_of_freedom(one.flat())[0])
    drawn = draw_ranges(one, admission) if module is ranges else draw_tapes(one, admission, dof)
    model, rows = drawn.model, drawn.rows(problem)
    if admission.level.shape[1]:
        model = model._replace(admission=admission._replace(level=levels_of(problem)))
    position = problem.stations.position
    station = position[drawn.node[0], drawn.node[1]][None]
    size, d = problem.layout.size, problem.dimension
    made = Block(module, model, rows, None)
    kept = made.run(keep, model, rows, station.shape[1], d, size)
    unknowns, lifted = made.run(count_unknowns, rows, d, size), made.run(count_lifted, rows)
    room = made.run(make_room, model, station.shape[1], d, unknowns, lifted)
    room.item[:] = 0
    block = Block(module, model, kept, room)
    block.run(fixes._see, model, kept, np.atleast_2d(problem.z), station, room, True)
    return block
