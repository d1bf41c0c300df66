"""The statement of a nonlinear program, and networks that are none."""

import pytest
from solvers.posing.scenes import ranged

from optloc import InvalidProblem, solve
from optloc.solvers.posing.programs import pose_program, pose_pulses


def test_a_program_has_symbols_of_its_own_and_no_constraint():
    problem = ranged(1).flat()
    first, second = pose_program(problem, solve), pose_program(problem, solve)
    assert first.program is not second.program
    assert first.program.statement.g.shape[0] == 0
    with pytest.raises(InvalidProblem, match="networks of stations"):
        pose_pulses(problem, solve)
